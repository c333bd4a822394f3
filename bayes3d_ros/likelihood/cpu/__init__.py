# SPDX-License-Identifier: Apache-2.0

"""Hypotheses rendered and scored by loops that numba compiles."""
