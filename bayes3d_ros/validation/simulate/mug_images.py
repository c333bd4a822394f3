# SPDX-License-Identifier: Apache-2.0

"""Small depth images of a mug whose yaw is uniform: as networks are trained on them, and otherwise.

The mug has the size of the YCB mug (025_mug) and is made of primitives. The YCB mug itself is a scan: its body is not
round, and an exact posterior reads the yaw from that to two degrees where the handle is hidden.
"""

from typing import NamedTuple, cast

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from bayes3d_ros.geometry.camera import Intrinsics
from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.geometry.poses import direction, look_at
from bayes3d_ros.validation.simulate.random_scenes import RestingObject, resting_object
from bayes3d_ros.validation.simulate.shared_error_frames import PlacedObject
from bayes3d_ros.validation.simulate.small_images import IndependentNoise, clean_depth

MUG_NAME = "mug"
_RADIUS, _HEIGHT, _WALL = 0.0465, 0.081, 0.0035  # metres: 025_mug's
_HANDLE = (0.03, 0.014, 0.05)  # metres: how far it reaches out, its breadth and its height
_SECTIONS = 128  # of a turn: the body is round to 0.02 mm
MUG_CAMERA = Intrinsics(120.0, 120.0, 31.5, 23.5, 64, 48)
_SAME_DEPTH = 1e-4  # metres
_MIDDLE = 0.04  # metres above the table that the camera looks at: half of the mug's height


class MugCondition(NamedTuple):
    """What images of one kind are drawn from."""

    distance: tuple[float, float]  # of the camera from the middle of the fixed point's mug, metres
    pitch: tuple[float, float]  # of the camera, degrees downwards
    moved: float  # metres by which the mug stands off the fixed point at most, along x and y
    noise: IndependentNoise

    @property
    def one_view(self) -> bool:
        """Whether camera and mug are at the same place in all images."""
        return self.distance[0] == self.distance[1] and self.pitch[0] == self.pitch[1] and self.moved == 0


TRAINED = MugCondition((0.45, 0.45), (20.0, 20.0), 0.0, IndependentNoise(0.003, 0.005))
MUG_CONDITIONS = {
    "as trained": TRAINED,
    "camera": TRAINED._replace(distance=(0.5, 0.6), pitch=(28.0, 40.0)),
    "noise": TRAINED._replace(noise=IndependentNoise(0.006, 0.02)),
    "moved": TRAINED._replace(moved=0.04),
}


class MugView(NamedTuple):
    """Where the camera is, and the mug's axis."""

    T_table_camera: Float[np.ndarray, "4 4"]
    x: float  # metres, table frame
    y: float


class UprightMug(NamedTuple):
    """The mesh: upright, its axis the z axis of its frame, its handle along x; and the handle alone."""

    thing: RestingObject
    handle: RestingObject

    def pose(self, view: MugView, yaw: float) -> Float[np.ndarray, "4 4"]:
        """T_table_object of the mug upright at the view's place, turned by yaw about its axis."""
        T = np.eye(4)
        T[:3, :3] = Rotation.from_euler("z", yaw).as_matrix()
        T[:2, 3] = view.x, view.y
        return T

    def clean(self, view: MugView, yaw: float) -> Float[np.ndarray, "height width"]:
        """What the camera would see without errors, metres."""
        return clean_depth([PlacedObject(self.thing, self.pose(view, yaw))], view.T_table_camera, MUG_CAMERA)

    def handle_in_sight(self, view: MugView, yaw: float) -> float:
        """Of the pixels that would show the handle if it stood alone, the share that the mug's body leaves."""
        alone, bare = (
            clean_depth(things, view.T_table_camera, MUG_CAMERA)
            for things in ([PlacedObject(self.handle, self.pose(view, yaw))], [])
        )
        shows = alone < bare
        return float((self.clean(view, yaw)[shows] > alone[shows] - _SAME_DEPTH).mean())


def upright_mug() -> UprightMug:
    """The mug, its base on z = 0."""
    meshes = _body_meshes() + _handle_meshes(inside=_WALL / 2), _handle_meshes(inside=0.0)
    whole, part = (cast(trimesh.Trimesh, trimesh.util.concatenate(own)) for own in meshes)
    return UprightMug(resting_object(MUG_NAME, whole), resting_object("handle", part))


def _body_meshes() -> list[trimesh.Trimesh]:
    wall = trimesh.creation.annulus(_RADIUS - _WALL, _RADIUS, _HEIGHT, sections=_SECTIONS)
    bottom = trimesh.creation.cylinder(_RADIUS, _WALL, sections=_SECTIONS)
    wall.apply_translation((0, 0, _HEIGHT / 2))
    bottom.apply_translation((0, 0, _WALL / 2))
    return [wall, bottom]


def _handle_meshes(inside: float) -> list[trimesh.Trimesh]:
    """inside: metres by which it reaches into the wall."""
    out, breadth, height = _HANDLE
    bar = 0.3 * out
    grip = trimesh.creation.box((bar, breadth, height))
    grip.apply_translation((_RADIUS + out - bar / 2, 0, _HEIGHT / 2))
    ends = [trimesh.creation.box((out, breadth, bar)) for _ in range(2)]
    for end, side in zip(ends, (-1, 1), strict=True):
        end.apply_translation((_RADIUS - inside + out / 2, 0, _HEIGHT / 2 + side * (height - bar) / 2))
    return [grip, *ends]


def mug_view(condition: MugCondition, rng: np.random.Generator) -> MugView:
    """A camera that looks along +y at the fixed point, and a place of the mug."""
    middle = np.array([0.0, 0.0, _MIDDLE])
    pitch, distance = np.radians(rng.uniform(*condition.pitch)), rng.uniform(*condition.distance)
    x, y = rng.uniform(-condition.moved, condition.moved, 2)
    return MugView(look_at(middle + distance * direction(-np.pi / 2, pitch), middle), float(x), float(y))


class MugImages(NamedTuple):
    """N images from one view."""

    depth: Float[np.ndarray, "N height width"]  # metres, NaN where there is no return
    yaw: Float[np.ndarray, "N"]  # radians, from 0 to 2 pi
    view: MugView

    def frame(self, k: int, stamp_ns: int) -> DepthFrame:
        """Image k with its camera pose, for the parser."""
        return DepthFrame(self.depth[k], MUG_CAMERA, stamp_ns, "camera", self.view.T_table_camera)


def mug_images(mug: UprightMug, condition: MugCondition, count: int, seed: tuple[int, ...]) -> MugImages:
    """Images of uniform yaw from one view; the first n are the same whatever their number."""
    view = mug_view(condition, np.random.default_rng([*seed, 0]))
    turns, pixels = (np.random.default_rng([*seed, k]) for k in (1, 2))
    yaw = turns.uniform(0, 2 * np.pi, count)
    shape = (count, MUG_CAMERA.height, MUG_CAMERA.width)
    depth = np.empty(shape, np.float32)
    for k in range(count):
        depth[k] = condition.noise.add(mug.clean(view, yaw[k]), pixels)
    return MugImages(depth, yaw, view)
