# SPDX-License-Identifier: Apache-2.0

"""Depth recordings of simulated scenes; shares no renderer and no noise model with the likelihood."""
