# SPDX-License-Identifier: Apache-2.0

"""Posterior inference over 3D tabletop scenes from depth images, for ROS 2."""

__version__ = "0.1.0"
