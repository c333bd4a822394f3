# SPDX-License-Identifier: Apache-2.0

"""Cameras, meshes and voxel grids: arrays in, arrays out."""
