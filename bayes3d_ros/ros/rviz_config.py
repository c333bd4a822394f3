# SPDX-License-Identifier: Apache-2.0

"""The RViz configuration of a scene_parser: config/bayes3d.rviz with the names that it really has."""

from typing import Any

import yaml

from bayes3d_ros.resources import share_directory
from bayes3d_ros.ros.depth_transport import RAW

NODE_IN_FILE, IMAGE_IN_FILE = "/scene_parser", "/depth/image_rect"  # it fits a node of that name as it is
# image_transport takes the CameraInfo of an image from this name beside it; RViz has no setting for it.
INFO_BESIDE_IMAGE = "camera_info"
_TRANSPORT = "Depth Map Transport Hint"  # the name of RViz's setting


def rviz_config(node: str, depth: str, frame: str, transport: str = RAW) -> str:
    """The text of a configuration for a scene_parser, given full names, the depth images' transport, and with `frame`
    as RViz's fixed frame."""
    config = yaml.safe_load((share_directory() / "config" / "bayes3d.rviz").read_text())
    config["Visualization Manager"]["Global Options"]["Fixed Frame"] = frame

    def named(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: transport if key == _TRANSPORT else named(item) for key, item in value.items()}
        if isinstance(value, list):
            return [named(item) for item in value]
        if value == IMAGE_IN_FILE:
            return depth
        if isinstance(value, str) and value.startswith(f"{NODE_IN_FILE}/"):
            return node + value.removeprefix(NODE_IN_FILE)
        return value

    return yaml.safe_dump(named(config), sort_keys=False)
