"""Cameras, meshes and voxel grids: arrays in, arrays out."""
