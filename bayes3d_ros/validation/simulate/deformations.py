# SPDX-License-Identifier: Apache-2.0

"""What real things and real cameras do that meshes and noise do not: dents and bulges, lost thin parts, mixed edges.

No model of ours has these forms: they are made of smooth bumps on the depth image, of morphology, and of averages."""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from bayes3d_ros.validation.simulate.random_scenes import REALSENSE, RandomScene, RestingObject, perfect_depth

SHARES = (0.1, 0.3)  # of what is seen of an object, that is off
OFF = (0.005, 0.015)  # metres by which it is off, either way
ACROSS = (0.02, 0.05)  # metres, of a bump
THIN = 4  # pixels: parts of an object that are no wider may be lost
MIXED = 0.3  # share of the pixels along outlines that average front and back


def deformed(scene: RandomScene, thing: RestingObject, seed: int) -> RandomScene:
    """The scene with its object as a worn one is seen. Depends on the scene and the seed alone."""
    frame = scene.frame
    assert frame.T_table_camera is not None
    rng = np.random.default_rng([seed, 77])
    clean = perfect_depth(thing, scene.T_table_object, frame.T_table_camera)
    mask = clean.solid == 0
    depth = frame.depth + _bumps(mask, clean.depth, rng)
    far = np.linalg.inv(frame.T_table_camera)
    rays = REALSENSE.rays()
    behind = (far[:3, 2] @ far[:3, 3]) / (rays @ far[:3, 2])
    lost = mask & ~ndimage.binary_opening(mask, iterations=THIN // 2) & (rng.uniform() < 0.5)
    depth = np.where(lost & np.isfinite(depth), behind + rng.normal(0, 0.001, depth.shape), depth)
    edge = ndimage.binary_dilation(mask) & ~ndimage.binary_erosion(mask)
    mixed = edge & (rng.uniform(size=edge.shape) < MIXED)
    share = rng.uniform(size=edge.shape)
    front = ndimage.minimum_filter(np.where(np.isfinite(clean.depth), clean.depth, 9.0), 3)
    depth = np.where(mixed & np.isfinite(depth), share * front + (1 - share) * behind, depth)
    return replace(scene, frame=replace(frame, depth=depth.astype(frame.depth.dtype)))


def _bumps(
    mask: Bool[np.ndarray, "H W"], depth: Float[np.ndarray, "H W"], rng: np.random.Generator
) -> Float[np.ndarray, "H W"]:
    """Metres to add to depth: bumps about random pixels of the mask until the share is covered."""
    v, u = np.nonzero(mask)
    total = np.zeros(mask.shape)
    if not len(v):
        return total
    share = rng.uniform(*SHARES)
    rows, columns = np.indices(mask.shape)
    for _ in range(60):
        if (np.abs(total[mask]) > 0.004).mean() >= share:
            break
        k = rng.integers(len(v))
        radius = rng.uniform(*ACROSS) / 2 * REALSENSE.fx / depth[v[k], u[k]]
        away = np.hypot(rows - v[k], columns - u[k]) / radius
        off = rng.uniform(*OFF) * rng.choice([-1, 1])
        total += np.where(mask, off * np.clip(1.5 * (1 - away**2), 0, 1), 0)
    return total
