# SPDX-License-Identifier: Apache-2.0

"""Objects in tf: real messages, and a tf that is made up, as tf2_ros is not on PyPI."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from geometry_msgs.msg import TransformStamped

from bayes3d_ros.geometry.poses import inverse_pose, look_at, pose_matrix
from bayes3d_ros.posterior.reframe import in_frame, table_frame
from bayes3d_ros.ros import object_transforms
from bayes3d_ros.ros.from_messages import stamp_to_ns, transform_to_matrix
from bayes3d_ros.ros.object_transforms import ObjectTransforms

IDS = ("bowl_1", "can_1")


class MadeUpTf:
    """What all listeners hear: whatever anybody sends. Stands in for the module tf2_ros."""

    def __init__(self) -> None:
        self.sent: list[TransformStamped] = []
        self.frames: dict[str, str] = {}  # child, parent
        self.listening = 0

    def send(self, transforms: list[TransformStamped]) -> None:
        self.sent += transforms
        self.frames |= {t.child_frame_id: t.header.frame_id for t in transforms}

    def TransformBroadcaster(self, node) -> SimpleNamespace:
        return SimpleNamespace(sendTransform=self.send)

    def Buffer(self) -> SimpleNamespace:
        told = lambda: yaml.safe_dump({child: {"parent": parent} for child, parent in self.frames.items()})  # noqa: E731
        return SimpleNamespace(all_frames_as_yaml=told)

    def TransformListener(self, buffer, node, spin_thread: bool) -> SimpleNamespace:
        self.listening += 1

        def unregister() -> None:
            self.listening -= 1

        return SimpleNamespace(unregister=unregister)


@pytest.fixture
def tf(monkeypatch) -> MadeUpTf:
    made = MadeUpTf()
    monkeypatch.setattr(object_transforms, "tf2_ros", made)
    return made


@pytest.fixture
def node() -> SimpleNamespace:
    told: list[str] = []
    logger = SimpleNamespace(warning=told.append)
    return SimpleNamespace(told=told, get_logger=lambda: logger, get_fully_qualified_name=lambda: "/left/scene_parser")


@pytest.fixture
def posterior(depth_frame, fake_posterior):
    T_camera_table = inverse_pose(look_at(np.array([0.1, -0.6, 0.5]), np.zeros(3)))
    return replace(fake_posterior(depth_frame(12_345), ("bowl", "can")), T_camera_table=T_camera_table)


def listening(node) -> ObjectTransforms:
    transforms = ObjectTransforms(node)
    transforms.resume()
    return transforms


def test_transforms_are_the_poses_below_the_frame_that_they_are_told_in(tf, node, posterior) -> None:
    transforms = listening(node)
    for told, parent in ((posterior, "camera"), (in_frame(posterior, table_frame(posterior)), "table")):
        tf.sent.clear()
        transforms.send(told, IDS)
        assert [t.child_frame_id for t in tf.sent] == ["left/scene_parser/bowl_1", "left/scene_parser/can_1"]
        for sent, found in zip(tf.sent, told.objects, strict=True):
            assert (sent.header.frame_id, stamp_to_ns(sent.header.stamp)) == (parent, 12_345)
            expected = pose_matrix(found.position, found.orientation)
            np.testing.assert_allclose(transform_to_matrix(sent.transform), expected, atol=1e-12)
    assert not node.told  # what tf has from this node is its own
    transforms.pause()
    assert tf.listening == 0


@pytest.mark.parametrize("others", [{"left/scene_parser/bowl_1": "world"}, {"gripper": "left/scene_parser/bowl_1"}])
def test_a_frame_that_tf_has_is_never_sent_and_a_line_says_so_once(tf, node, posterior, others) -> None:
    tf.frames |= others
    transforms = listening(node)
    for _ in range(3):
        transforms.send(posterior, IDS)
    assert {t.child_frame_id for t in tf.sent} == {"left/scene_parser/can_1"}
    (line,) = node.told
    assert line.startswith("publish_tf: tf has a frame 'left/scene_parser/bowl_1' already, below ")


def test_a_frame_that_somebody_else_begins_to_send_is_left_to_them(tf, node, posterior) -> None:
    transforms = listening(node)
    transforms.send(posterior, IDS)
    tf.frames["left/scene_parser/can_1"] = "world"
    tf.sent.clear()
    transforms.send(posterior, IDS)
    assert {t.child_frame_id for t in tf.sent} == {"left/scene_parser/bowl_1"} and len(node.told) == 1


def test_after_a_pause_the_frames_are_still_this_nodes_own(tf, node, posterior) -> None:
    """What was sent before is in tf for ever."""
    transforms = listening(node)
    transforms.send(posterior, IDS)
    transforms.pause()
    tf.sent.clear()
    transforms.send(posterior, IDS)  # a scene that was being parsed meanwhile
    assert not tf.sent and tf.listening == 0
    transforms.resume()
    transforms.resume()
    transforms.send(posterior, IDS)
    assert len(tf.sent) == 2 and not node.told and tf.listening == 1


def test_without_tf2_ros_a_line_says_that_nothing_is_sent(node, posterior, monkeypatch) -> None:
    monkeypatch.setattr(object_transforms, "tf2_ros", None)
    transforms = listening(node)
    transforms.send(posterior, IDS)
    transforms.pause()
    assert node.told == ["publish_tf: tf: tf2_ros is not installed; no transforms are sent"]
