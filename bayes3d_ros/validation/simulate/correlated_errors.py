# SPDX-License-Identifier: Apache-2.0

"""Errors of depth that hang together over many pixels, as real cameras and real tables have them."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayes3d_ros.geometry.camera import Intrinsics
from bayes3d_ros.validation.simulate.ray_casting import Rendering
from bayes3d_ros.validation.simulate.sensor_noise import BiasField, SensorNoise

_IMAGE_COSINES, _WAVES = 3, 24


class CorrelatedErrors(NamedTuple):
    """Errors of a recording's depth, metres: the camera's over its image, every object's, and waves in all surfaces.

    The waves are fixed in the world, so a camera that moves sees the same ones again.
    """

    image: Float[np.ndarray, "3 3"]  # of half cosines over the image's height and width, constant first
    offsets: Float[np.ndarray, "K"]  # of solid k; solids beyond K have none
    waviness: float  # standard deviation
    waves: BiasField  # over world coordinates, unit standard deviation

    def at(
        self, rendering: Rendering, T_world_camera: Float[np.ndarray, "4 4"], intrinsics: Intrinsics
    ) -> Float[np.ndarray, "height width"]:
        """What to add to the depth of a rendering; zero where it has no surface."""
        height, width = rendering.depth.shape
        error = _cosines(height) @ self.image @ _cosines(width).T
        error += np.append(self.offsets, np.zeros(2))[rendering.solid.clip(-1, len(self.offsets))]
        if self.waviness > 0:
            # In float32: many cosines a pixel, and micrometres do not matter.
            points = intrinsics.rays() * np.nan_to_num(rendering.depth).astype(np.float32)[..., None]
            placed = points @ T_world_camera[:3, :3].T.astype(np.float32) + T_world_camera[:3, 3].astype(np.float32)
            error += self.waviness * self.waves.at(placed)
        return np.where(np.isfinite(rendering.depth), error, 0.0)


def sample_correlated_errors(noise: SensorNoise, objects: int, rng: np.random.Generator) -> CorrelatedErrors:
    """Errors of one recording of so many objects, with the sizes that `noise` names."""
    image = rng.normal(size=(_IMAGE_COSINES, _IMAGE_COSINES))
    image /= np.abs(_cosines(65) @ image @ _cosines(65).T).max()
    offsets = rng.uniform(-1, 1, objects)
    waves = rng.normal(size=(_WAVES, 3)) / max(noise.waviness_length, 1e-6)
    phases = rng.uniform(0, 2 * np.pi, _WAVES)
    return CorrelatedErrors(
        noise.image_bias * image,
        noise.object_bias * offsets,
        noise.waviness,
        BiasField(waves.astype(np.float32), phases.astype(np.float32)),
    )


def _cosines(count: int) -> Float[np.ndarray, "count 3"]:
    """Half cosines over `count` pixels: a constant, half a wave, a whole wave."""
    return np.cos(np.pi * (np.arange(count)[:, None] + 0.5) / count * np.arange(_IMAGE_COSINES))
