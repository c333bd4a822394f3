# SPDX-License-Identifier: Apache-2.0

"""What an object is: voxel models, libraries of them, and how an object stands on a table."""
