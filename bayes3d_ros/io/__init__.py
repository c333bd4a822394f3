# SPDX-License-Identifier: Apache-2.0

"""Recordings, result files and pictures."""
