# SPDX-License-Identifier: Apache-2.0

"""What an active-stereo depth camera does to a perfect depth image; shares no code with the likelihoods."""

from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter, map_coordinates, maximum_filter, minimum_filter
from scipy.special import ndtr

from bayes3d_ros.geometry.camera import Intrinsics, unproject


@dataclass(frozen=True)
class SensorNoise:
    """Parameters of the depth camera; every effect is off at zero. The defaults resemble a RealSense D435.

    range_sigma: standard deviation of the depth noise at 1 m, metres; it grows with depth squared.
    range_correlation: how far the range noise of neighbouring pixels hangs together, pixels (matching windows overlap).
    bias: standard deviation of a smooth error of depth, metres, the same in every frame of a recording.
    bias_length: the distance over which that error changes, metres.
    image_bias: largest error that varies slowly over the image (at most a wave across it), metres; see
        correlated_errors.py for this and the next three.
    object_bias: largest error of an object as a whole, metres; every object has its own, uniform within this.
    waviness: standard deviation of waves in every surface, fixed in the world, metres of depth.
    waviness_length: how far apart two points are whose waves have a correlation of exp(-1/2), metres.
    disparity_step: disparities are multiples of this, pixels.
    depth_step: depths are multiples of this, metres.
    baseline: distance to the second imager (to the camera's right), metres; what that one cannot see does not return.
    edge_jump: a depth edge is a jump of more than this fraction of the depth within 3x3 pixels.
    edge_jitter: standard deviation of how far depth edges wander from where they are, pixels.
    edge_dropout: fraction of the pixels within two pixels of a depth edge that do not return, in blobs.
    mixed_pixels: fraction of the pixels at depth edges that float between the two surfaces.
    grazing_cosine: surfaces seen at a smaller cosine between ray and normal drop out, all of them at cosine zero.
    hole_dropout: fraction of all pixels that do not return for no reason that is modelled, in blobs.
    min_range, max_range: nearest and farthest depth that returns, metres.
    """

    range_sigma: float = 0.0015
    range_correlation: float = 1.0
    bias: float = 0.0008
    bias_length: float = 0.05
    image_bias: float = 0.0
    object_bias: float = 0.0
    waviness: float = 0.0
    waviness_length: float = 0.05
    disparity_step: float = 1 / 32
    depth_step: float = 0.001
    baseline: float = 0.05
    edge_jump: float = 0.03
    edge_jitter: float = 0.8
    edge_dropout: float = 0.3
    mixed_pixels: float = 0.1
    grazing_cosine: float = 0.25
    hole_dropout: float = 0.001
    min_range: float = 0.15
    max_range: float = 4.0

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            if not (isinstance(value, int | float) and value >= 0):
                raise ValueError(f"{f.name} must be a number >= 0, got {value!r}")
        for name in ("edge_dropout", "mixed_pixels", "grazing_cosine", "hole_dropout"):
            if getattr(self, name) > 1:
                raise ValueError(f"{name} must lie in [0, 1], got {getattr(self, name)}")


NO_NOISE = SensorNoise(
    **{
        f.name: 0.0
        for f in fields(SensorNoise)
        if f.name not in ("bias_length", "waviness_length", "max_range", "edge_jump")
    }
)


class BiasField(NamedTuple):
    """A stationary Gaussian random field over camera coordinates, as a sum of plane waves; unit standard deviation."""

    waves: Float[np.ndarray, "K 3"]  # radians per metre
    phases: Float[np.ndarray, "K"]

    def at(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch"]:
        """Its value at points in metres."""
        angles = points @ self.waves.T + self.phases
        return np.cos(angles).sum(-1) * np.sqrt(2 / len(self.phases))


def sample_bias_field(noise: SensorNoise, rng: np.random.Generator, waves: int = 48) -> BiasField:
    """The bias of one camera, drawn once a recording: its covariance is exp(-distance^2 / (2 bias_length^2))."""
    length = max(noise.bias_length, 1e-6)
    return BiasField(rng.normal(size=(waves, 3)) / length, rng.uniform(0, 2 * np.pi, waves))


def add_sensor_noise(
    depth: Float[np.ndarray, "height width"],
    cosine: Float[np.ndarray, "height width"],
    intrinsics: Intrinsics,
    noise: SensorNoise,
    bias: BiasField,
    rng: np.random.Generator,
) -> Float[np.ndarray, "height width"]:
    """The depth image a camera would give, float32, NaN where there is no return.

    depth is perfect, NaN where there is no surface; cosine is that of the angle between each ray and surface normal.
    """
    z = np.asarray(depth, np.float64)
    z = _jitter_edges(z, noise, rng)
    far = np.nan_to_num(z, nan=1e3)
    nearest, farthest = minimum_filter(far, 3), maximum_filter(far, 3)
    edge = farthest - nearest > noise.edge_jump * nearest
    lost = stereo_shadow(z, intrinsics, noise)
    lost |= maximum_filter(edge, 3) & (_blobs(z.shape, 1.5, rng) < noise.edge_dropout)
    lost |= _blobs(z.shape, 3.0, rng) < noise.hole_dropout
    if noise.grazing_cosine > 0:
        lost |= _blobs(z.shape, 1.5, rng) < 1 - np.nan_to_num(cosine, nan=1.0) / noise.grazing_cosine
    mixed = edge & (rng.random(z.shape) < noise.mixed_pixels) & (farthest < noise.max_range)
    z = np.where(mixed, nearest + rng.random(z.shape) * (farthest - nearest), z)
    error = noise.range_sigma * _smooth_normal(z.shape, noise.range_correlation, rng) * z**2
    if noise.bias > 0:
        error += noise.bias * bias.at(unproject(np.nan_to_num(z), intrinsics).astype(np.float64))
    z = z + error
    if noise.disparity_step > 0 and noise.baseline > 0:
        strength = intrinsics.fx * noise.baseline
        z = strength / np.maximum(np.round(strength / z / noise.disparity_step), 1) / noise.disparity_step
    if noise.depth_step > 0:
        z = np.round(z / noise.depth_step) * noise.depth_step
    lost |= ~((z >= noise.min_range) & (z <= noise.max_range))
    return np.where(lost, np.nan, z).astype(np.float32)


def stereo_shadow(depth: Float[np.ndarray, "height width"], intrinsics: Intrinsics, noise: SensorNoise) -> np.ndarray:
    """Pixels whose surface the second imager cannot see because something nearer hides it there: no match, no depth."""
    height, width = depth.shape
    if noise.baseline == 0:
        return np.zeros(depth.shape, bool)
    disparity = np.nan_to_num(intrinsics.fx * noise.baseline / depth, nan=0.0)
    margin = int(np.ceil(disparity.max())) + 2
    column = np.arange(width) - disparity + margin
    rows = np.broadcast_to(np.arange(height)[:, None], depth.shape)
    seen = np.zeros((height, width + margin + 2))
    for whole in (np.floor(column).astype(int), np.ceil(column).astype(int)):
        np.maximum.at(seen, (rows, whole), disparity)
    nearest = np.minimum(seen[rows, np.floor(column).astype(int)], seen[rows, np.ceil(column).astype(int)])
    return nearest > disparity * (1 + noise.edge_jump)


def _jitter_edges(z: np.ndarray, noise: SensorNoise, rng: np.random.Generator) -> np.ndarray:
    """Depth edges moved by a smooth random displacement; depths away from edges stay as they are."""
    if noise.edge_jitter == 0:
        return z
    shift = noise.edge_jitter * np.stack([_smooth_normal(z.shape, 1.5, rng) for _ in range(2)])
    moved = map_coordinates(z, np.indices(z.shape) + shift, order=0, mode="nearest")
    jump = np.abs(np.nan_to_num(moved, nan=1e3) - np.nan_to_num(z, nan=1e3))
    return np.where(jump > noise.edge_jump * np.nan_to_num(z, nan=1e3), moved, z)


def _smooth_normal(shape: tuple[int, int], correlation: float, rng: np.random.Generator) -> np.ndarray:
    """Standard normal at every pixel, smooth over `correlation` pixels."""
    white = rng.normal(size=shape)
    if correlation == 0:
        return white
    impulse = np.zeros((2 * int(4 * correlation) + 3,) * 2)
    impulse[impulse.shape[0] // 2, impulse.shape[1] // 2] = 1
    scale = np.sqrt((gaussian_filter(impulse, correlation, mode="wrap") ** 2).sum())
    return gaussian_filter(white, correlation, mode="wrap") / scale


def _blobs(shape: tuple[int, int], correlation: float, rng: np.random.Generator) -> np.ndarray:
    """Uniform on [0, 1] at every pixel, smooth over `correlation` pixels, so that thresholds give blobs."""
    return ndtr(_smooth_normal(shape, correlation, rng))
