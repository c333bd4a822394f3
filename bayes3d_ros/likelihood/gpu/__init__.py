# SPDX-License-Identifier: Apache-2.0

"""Hypotheses rendered and scored by a Triton kernel."""
