"""Depth of voxel models along rays. `renderers` is the one table of backends; `reference` is what tests trust."""

from collections.abc import Callable

from bayes3d_ros.model.rendering.voxel_march import march

renderers: dict[str, Callable] = {"march": march}
