# SPDX-License-Identifier: Apache-2.0

"""RViz gets the names that the node really has."""

from collections.abc import Iterator
from typing import Any

import pytest
import yaml
from sensor_msgs.msg import Image

from bayes3d_ros.resources import share_directory
from bayes3d_ros.ros import rviz_config as module
from bayes3d_ros.ros.rviz_config import rviz_config

# What a display subscribes to. DepthCloud has its image in a property of its own name.
TYPES = {
    "MarkerArray": "visualization_msgs/msg/MarkerArray",
    "PointCloud2": "sensor_msgs/msg/PointCloud2",
    "PoseArray": "geometry_msgs/msg/PoseArray",
    "Image": "sensor_msgs/msg/Image",
    "DepthCloud": "sensor_msgs/msg/Image",
}


def topics(text: str) -> dict[str, str]:
    """The topics of all displays, with the types they are subscribed with."""
    found = {}
    for display in yaml.safe_load(text)["Visualization Manager"]["Displays"]:
        topic = display.get("Depth Map Topic") or display.get("Topic", {}).get("Value")
        if topic:
            found[topic] = TYPES[display["Class"].rpartition("/")[2]]
    return found


def strings(value: Any) -> Iterator[str]:
    """All strings in a configuration."""
    for item in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        yield from strings(item)
    if isinstance(value, str):
        yield value


@pytest.mark.parametrize(
    ("namespace", "name", "depth"),
    [("", "scene_parser", "/depth/image_rect"), ("/left", "kitchen", "/left/camera/depth/image_rect_raw")],
)
def test_every_topic_is_one_of_the_node(ros, library_folder, namespace: str, name: str, depth: str) -> None:
    remap = [f"__ns:={namespace or '/'}", f"__node:={name}", f"{namespace}/depth/image_rect:={depth}"]
    ros.start_parser(library_folder, "--ros-args", *(word for rule in remap for word in ("-r", rule)))
    ros.node.create_publisher(Image, depth, 1)
    wanted = topics(rviz_config(f"{namespace}/{name}", depth, "camera"))
    assert len(wanted) == 7

    def present() -> dict[str, list[str]] | None:
        there = dict(ros.node.get_topic_names_and_types())
        return there if wanted.keys() <= there.keys() and ros.node.count_subscribers(depth) else None

    there = ros.wait_for(present, f"topics {', '.join(wanted)}", seconds=60)
    assert {topic: there[topic] for topic in wanted} == {topic: [kind] for topic, kind in wanted.items()}


def test_nothing_of_the_defaults_is_left_and_the_frame_is_set() -> None:
    text = rviz_config("/left/kitchen", "/front/depth", "front_optical_frame")
    found = list(strings(yaml.safe_load(text)))
    assert not [value for value in found if "scene_parser" in value or value == module.IMAGE_IN_FILE]
    assert yaml.safe_load(text)["Visualization Manager"]["Global Options"]["Fixed Frame"] == "front_optical_frame"


@pytest.mark.parametrize("transport", ["raw", "compressedDepth"])
def test_the_depth_is_shown_in_its_transport(transport: str) -> None:
    text = rviz_config("/scene_parser", "/depth/image_rect", "camera", transport)
    displays = yaml.safe_load(text)["Visualization Manager"]["Displays"]
    assert [d["Depth Map Transport Hint"] for d in displays if d["Name"] == "Depth"] == [transport]


def test_with_the_defaults_it_is_the_file_itself() -> None:
    text = rviz_config(module.NODE_IN_FILE, module.IMAGE_IN_FILE, "camera_depth_optical_frame")
    assert yaml.safe_load(text) == yaml.safe_load((share_directory() / "config" / "bayes3d.rviz").read_text())
