# SPDX-License-Identifier: Apache-2.0

"""Transforms over time: laws of composition and inversion, interpolation between stamps, and no extrapolation."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bayes3d_ros.geometry.transform_tree import LONGEST_GAP_NS, TransformTree

SECOND = 10**9
# world - table, world - base - arm - camera, and a frame that is not connected.
LINKS = [("world", "table"), ("world", "base"), ("base", "arm"), ("arm", "camera"), ("odom", "wheel")]


def pose(seed):
    rng = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(rng.normal(size=3)).as_matrix(), rng.normal(size=3)
    return T


def shifted(x):
    T = np.eye(4)
    T[0, 3] = x
    return T


@pytest.fixture
def tree():
    made = TransformTree()
    for k, (parent, child) in enumerate(LINKS):
        made.add(parent, child, 0, pose(k), static=True)
    return made


def test_a_chain_is_the_product_of_its_links(tree):
    expected = np.linalg.inv(pose(0)) @ pose(1) @ pose(2) @ pose(3)
    np.testing.assert_allclose(tree.lookup("table", "camera", 123), expected, atol=1e-12)
    np.testing.assert_allclose(tree.lookup("world", "arm", 0), pose(1) @ pose(2), atol=1e-12)


def test_laws(tree):
    frames = ["world", "table", "base", "arm", "camera"]
    for a in frames:
        np.testing.assert_allclose(tree.lookup(a, a, 5), np.eye(4), atol=1e-12)
        for b in frames:
            back = np.linalg.inv(tree.lookup(a, b, 5))
            np.testing.assert_allclose(tree.lookup(b, a, 5), back, atol=1e-12)
            for c in frames:
                through = tree.lookup(a, b, 5) @ tree.lookup(b, c, 5)
                np.testing.assert_allclose(tree.lookup(a, c, 5), through, atol=1e-12)


def test_what_is_connected(tree):
    assert tree.connects("table", "camera") and tree.connects("camera", "/table")
    assert not tree.connects("table", "wheel") and not tree.connects("table", "nowhere")
    assert not tree.connects("nowhere", "nowhere")
    assert tree.lookup("table", "wheel", 0) is None and tree.lookup("nowhere", "table", 0) is None
    assert tree.frames == ["arm", "base", "camera", "odom", "table", "wheel", "world"]


def test_between_two_stamps_and_not_beyond():
    tree = TransformTree()
    tree.add("table", "base", 0, shifted(1.0), static=True)
    for second in (12, 10, 11):  # in any order
        tree.add("base", "camera", second * SECOND, shifted(float(second)))
    for second, x in ((10, 11.0), (10.25, 11.25), (11, 12.0), (11.5, 12.5), (12, 13.0)):
        np.testing.assert_allclose(tree.lookup("table", "camera", int(second * SECOND)), shifted(x), atol=1e-12)
    assert tree.lookup("table", "camera", 10 * SECOND - 1) is None
    assert tree.lookup("table", "camera", 12 * SECOND + 1) is None
    assert tree.connects("table", "camera")


def test_turns_are_halved():
    tree, turn = TransformTree(), np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec([0, 0, 1.2]).as_matrix()
    tree.add("table", "camera", 0, np.eye(4))
    tree.add("table", "camera", SECOND, turn)
    half = Rotation.from_matrix(tree.lookup("table", "camera", SECOND // 2)[:3, :3]).as_rotvec()
    np.testing.assert_allclose(half, [0, 0, 0.6], atol=1e-12)


def test_a_long_gap_and_a_change_of_parent_are_not_bridged():
    tree = TransformTree()
    tree.add("a", "camera", 0, shifted(0.0))
    tree.add("a", "camera", LONGEST_GAP_NS + 1, shifted(1.0))
    tree.add("b", "camera", LONGEST_GAP_NS + 3, shifted(2.0))
    assert tree.lookup("a", "camera", SECOND) is None
    assert tree.lookup("a", "camera", LONGEST_GAP_NS + 2) is None
    np.testing.assert_array_equal(tree.lookup("a", "camera", LONGEST_GAP_NS + 1), shifted(1.0))
    np.testing.assert_array_equal(tree.lookup("b", "camera", LONGEST_GAP_NS + 3), shifted(2.0))


def test_the_later_of_two_counts_and_slashes_do_not():
    tree = TransformTree()
    for x in (1.0, 2.0):
        tree.add("/table", "/base", 0, shifted(x), static=True)
        tree.add("base", "camera", SECOND, shifted(x))
    np.testing.assert_array_equal(tree.lookup("table", "camera", SECOND), shifted(4.0))


def test_a_loop_ends():
    tree = TransformTree()
    tree.add("a", "b", 0, shifted(1.0), static=True)
    tree.add("b", "a", 0, shifted(-1.0), static=True)
    np.testing.assert_array_equal(tree.lookup("a", "b", 0), shifted(1.0))
    assert tree.lookup("a", "c", 0) is None
