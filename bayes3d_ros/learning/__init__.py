# SPDX-License-Identifier: Apache-2.0

"""Voxel models of unknown objects from a few depth views. `learn.py` is the way in."""
