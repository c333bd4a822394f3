# SPDX-License-Identifier: Apache-2.0

"""Depth frames with errors that pixels share, made of other forms than those that the likelihood knows.

An amplitude scales all of it: standard deviations are times the amplitude, ranges and shares times min(1, amplitude),
so that x 0 leaves independent noise and nothing else. The errors of a seed at one amplitude are those at another,
scaled. Lengths, forms and the noise's growth with depth are drawn anew for every frame.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage
from scipy.spatial.transform import Rotation

from bayes3d_ros.geometry.camera import unproject
from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.validation.simulate.random_scenes import REALSENSE, RestingObject, alone, bare_depth, nearest
from bayes3d_ros.validation.simulate.ray_casting import Rendering

# Standard deviations at amplitude x 1.
OBJECT_BIAS = 0.0012  # metres of depth, of an object as a whole
WAVINESS = 0.0007  # metres of depth, of the field on every surface
IMAGE_BIAS, IMAGE_TILT = 0.001, 0.001  # metres: of the whole image; at its borders, of each of two slopes over it
OUTLINE_SHIFT = 0.3  # pixels of the full image across an outline; half the variance makes the object larger or smaller
# Uniform, up to these at amplitude x 1 and more.
TABLE_OFF, TABLE_TURNED = 0.003, np.radians(0.5)  # metres, radians by which the given camera pose has the table wrong
DROPPED, MIXED = 0.4, 0.3  # shares of the pixels at depth edges
# Whatever the amplitude.
WAVE_LENGTHS = (0.01, 0.2)  # metres, log-uniform
NOISE_AT_METRE = (0.0008, 0.002)  # metres: standard deviation of a pixel's own error at 1 m, uniform
NOISE_POWERS = (1, 2)  # it grows as this power of depth
FORMS = ("smooth", "planar")
EDGE_JUMP = 0.02  # metres: neighbours that differ by more are a depth edge
DROPPED_LENGTH = 1.5  # pixels: dropped pixels come in runs of about this length

_WAVES, _DEGREES_OF_FREEDOM = 64, 5  # of a smooth field's spectrum, Student's t: rougher than a Gaussian's
_NORMAL_SMOOTHING, _OUTLINE_BAND = 1.5, 2  # pixels


class PlacedObject(NamedTuple):
    """An object of a scene."""

    thing: RestingObject
    T_table_object: Float[np.ndarray, "4 4"]


class FrameErrors(NamedTuple):
    """The errors of one frame of K objects, scaled by its amplitude. Lengths in metres, outlines in pixels."""

    amplitude: float
    noise_at_metre: float
    noise_power: int
    form: str  # of FORMS
    wave_length: float
    waviness: float
    image: Float[np.ndarray, "3"]  # constant, and slopes over u and v in [-1, 1]
    object_bias: Float[np.ndarray, "K"]
    growth: Float[np.ndarray, "K"]  # outlines move outwards by this
    displacement: Float[np.ndarray, "K 2"]  # and with the object's picture by this, along u and v
    table_off: float  # the given pose has the table so much too high
    table_turned: Float[np.ndarray, "2"]  # and turned by this vector about its x and y
    dropped: float
    mixed: float

    def row(self) -> dict[str, Any]:
        """What tells frames apart, as JSON values."""
        return {
            "noise_at_metre": round(self.noise_at_metre, 6),
            "noise_power": self.noise_power,
            "form": self.form,
            "wave_length": round(self.wave_length, 4),
        }


def sample_frame_errors(amplitude: float, objects: int, rng: np.random.Generator) -> FrameErrors:
    """Errors of a frame of so many objects. The numbers drawn do not depend on the amplitude."""
    part = min(1.0, amplitude)
    angle = rng.uniform(0, 2 * np.pi)
    return FrameErrors(
        amplitude=amplitude,
        noise_at_metre=float(rng.uniform(*NOISE_AT_METRE)),
        noise_power=int(rng.choice(NOISE_POWERS)),
        form=str(rng.choice(FORMS)),
        wave_length=float(np.exp(rng.uniform(*np.log(WAVE_LENGTHS)))),
        waviness=amplitude * WAVINESS,
        image=amplitude * rng.normal(0, [IMAGE_BIAS, IMAGE_TILT, IMAGE_TILT]),
        object_bias=amplitude * rng.normal(0, OBJECT_BIAS, objects),
        growth=amplitude * rng.normal(0, OUTLINE_SHIFT / 2**0.5, objects),
        displacement=amplitude * rng.normal(0, OUTLINE_SHIFT / 2**0.5, (objects, 2)),
        table_off=part * float(rng.uniform(-TABLE_OFF, TABLE_OFF)),
        table_turned=part * rng.uniform(0, TABLE_TURNED) * np.array([np.cos(angle), np.sin(angle)]),
        dropped=part * float(rng.uniform(0, DROPPED)),
        mixed=part * float(rng.uniform(0, MIXED)),
    )


def shared_error_frame(
    objects: Sequence[PlacedObject],
    T_table_camera: Float[np.ndarray, "4 4"],
    errors: FrameErrors,
    stamp_ns: int,
    rng: np.random.Generator,
) -> DepthFrame:
    """What a camera at this pose gives of a table with these objects. The pose of the frame is the one that is given:
    wrong by the errors' table_off and table_turned."""
    waves, edges, noise = (np.random.default_rng(s) for s in rng.integers(2**63, size=3))
    layers = [
        _outline_moved(own, T_table_camera, errors.growth[k], errors.displacement[k]) for k, own in enumerate(objects)
    ]
    clean = nearest(layers, bare_depth(T_table_camera))
    depth = clean.depth + shared_errors_of(clean, errors, waves)
    depth = _edges_lost(clean.depth, depth, errors, edges)
    depth = depth + errors.noise_at_metre * clean.depth**errors.noise_power * noise.normal(size=depth.shape)
    given = given_pose(T_table_camera, errors)
    return DepthFrame(depth.astype(np.float32), REALSENSE, stamp_ns, "camera", given)


def shared_errors_of(
    clean: Rendering, errors: FrameErrors, rng: np.random.Generator
) -> Float[np.ndarray, "height width"]:
    """Metres to add to depth: the image's plane, and each surface's bias and field; zero where nothing is seen."""
    height, width = clean.depth.shape
    v, u = np.linspace(-1, 1, height)[:, None], np.linspace(-1, 1, width)[None]
    total = errors.image[0] + errors.image[1] * u + errors.image[2] * v
    points = unproject(clean.depth.astype(np.float32), REALSENSE)
    bias = np.append(errors.object_bias, np.zeros(2))  # of the table and the floor: the image's
    for k, seed in enumerate(rng.integers(2**63, size=len(bias))):
        own = clean.solid == k
        if errors.waviness > 0 and own.any():
            field = _smooth if errors.form == "smooth" else _planar
            wave = field(points[own], errors.wave_length, np.random.default_rng(seed))
            total[own] += errors.waviness * wave
        total[own] += bias[k]
    return np.where(np.isfinite(clean.depth), total, 0.0)


def given_pose(T_table_camera: Float[np.ndarray, "4 4"], errors: FrameErrors) -> Float[np.ndarray, "4 4"]:
    """T_table_camera as told: the table is moved about the middle of the true one."""
    moved = np.eye(4)
    moved[:3, :3] = Rotation.from_rotvec(np.append(errors.table_turned, 0.0)).as_matrix()
    moved[2, 3] = errors.table_off
    return np.linalg.inv(moved) @ T_table_camera


def _smooth(points: Float[np.ndarray, "N 3"], length: float, rng: np.random.Generator) -> Float[np.ndarray, "N"]:
    """A stationary random field of unit standard deviation at points in metres: random Fourier features."""
    scale = np.sqrt(rng.chisquare(_DEGREES_OF_FREEDOM, _WAVES) / _DEGREES_OF_FREEDOM)
    waves = (rng.normal(size=(_WAVES, 3)) / scale[:, None] / length).astype(np.float32)
    angles = points @ waves.T
    angles += rng.uniform(0, 2 * np.pi, _WAVES).astype(np.float32)
    return np.cos(angles, out=angles).sum(1) * np.sqrt(2 / _WAVES)


def _planar(points: Float[np.ndarray, "N 3"], length: float, rng: np.random.Generator) -> Float[np.ndarray, "N"]:
    """A field of unit standard deviation that is a plane of its own, with a jump, in each cell of a lattice of
    this spacing, turned and moved at random."""
    turned = points @ Rotation.random(random_state=np.random.RandomState(rng.integers(2**31))).as_matrix().T
    local = turned / length + rng.uniform(0, 1, 3)
    whole = np.floor(local).astype(np.int64)
    _, cell = np.unique((whole + 2**20) @ np.array([1, 2**21, 2**42]), return_inverse=True)
    level, slope = rng.normal(size=cell.max() + 1), rng.normal(size=(cell.max() + 1, 3))
    # Three coordinates, uniform in the cell, have a variance of 1 / 12 each: slopes make half of the field's.
    return np.sqrt(0.5) * level[cell] + np.sqrt(2.0) * (slope[cell] * (local - whole - 0.5)).sum(1)


def _outline_moved(
    placed: PlacedObject, T_table_camera: Float[np.ndarray, "4 4"], growth: float, displacement: Float[np.ndarray, "2"]
) -> Rendering:
    """The object alone, its outline moved across itself by `growth` plus the displacement's part along its normal;
    pixels that show it either way keep their depth."""
    own = alone(*placed, T_table_camera)
    mask = own.solid >= 0
    if (growth == 0 and not displacement.any()) or not mask.any():
        return own
    band = _OUTLINE_BAND + int(np.ceil(abs(growth) + np.linalg.norm(displacement)))
    outward, near = _outline_normals(mask, band)
    v, u = np.nonzero(near)
    shift = growth + outward[near] @ displacement
    pixels = np.stack([u, v], 1) - shift[:, None] * outward[near]
    shown = placed.thing.caster.cast(np.linalg.inv(placed.T_table_object) @ T_table_camera, pixels, REALSENSE)
    hit = shown.solid >= 0
    new, gone = hit & ~mask[near], ~hit
    depth, solid, cosine = (a.copy() for a in own)
    for image, values, none in ((depth, shown.depth, np.nan), (solid, shown.solid, -1), (cosine, shown.cosine, np.nan)):
        image[v[new], u[new]] = values[new]
        image[v[gone], u[gone]] = none
    return Rendering(depth, solid, cosine)


def _outline_normals(
    mask: Bool[np.ndarray, "height width"], band: int
) -> tuple[Float[np.ndarray, "height width 2"], Bool[np.ndarray, "height width"]]:
    """Unit vectors (u, v) that point out of a mask, and the pixels within `band` of its outline."""
    rows, columns = (np.flatnonzero(mask.any(axis)) for axis in (1, 0))
    edge = 4 * band
    box = np.s_[max(rows[0] - edge, 0) : rows[-1] + edge, max(columns[0] - edge, 0) : columns[-1] + edge]
    part = np.asarray(mask[box])
    distance = ndimage.distance_transform_edt(~part) - ndimage.distance_transform_edt(part)
    along_v, along_u = np.gradient(ndimage.gaussian_filter(distance, _NORMAL_SMOOTHING))
    normal = np.stack([along_u, along_v], -1) / np.maximum(np.hypot(along_u, along_v), 1e-6)[..., None]
    outward, near = np.zeros((*mask.shape, 2)), np.zeros(mask.shape, bool)
    outward[box], near[box] = normal, np.abs(distance) <= band
    return outward, near


def _edges_lost(
    clean: Float[np.ndarray, "height width"],
    depth: Float[np.ndarray, "height width"],
    errors: FrameErrors,
    rng: np.random.Generator,
) -> Float[np.ndarray, "height width"]:
    """Depth with pixels along its edges mixed between front and back, or gone (NaN)."""
    front, back = (f(np.nan_to_num(clean, nan=1e3), 3) for f in (ndimage.minimum_filter, ndimage.maximum_filter))
    edge = (back - front > EDGE_JUMP) & (back < 1e3)
    chance, share, white = rng.uniform(size=edge.shape), rng.uniform(size=edge.shape), rng.normal(size=edge.shape)
    mixed = edge & (chance < errors.mixed)
    depth = np.where(mixed, front + share * (back - front), depth)
    blobs = ndimage.gaussian_filter(white, DROPPED_LENGTH)
    limit = np.quantile(blobs, errors.dropped) if errors.dropped > 0 else -np.inf
    return np.where(edge & (blobs < limit), np.nan, depth)
