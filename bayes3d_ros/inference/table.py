"""Find the table in a depth image, and tell which returns belong to the workspace."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage
from scipy.spatial import ConvexHull, Delaunay, QhullError

from bayes3d_ros.model.posterior import ParseError

_INLIER = 0.008  # metres at 1 m, growing with depth squared beyond
_TRIALS = 400
_CELL = 0.02  # metres, of the map of the table's support
_BELOW = 0.02  # metres below the plane that still count as the table


class Plane(NamedTuple):
    """Points x of the plane satisfy normal . x = distance in the camera frame; the normal points to the camera's side."""

    normal: Float[np.ndarray, "3"]
    distance: float


def _tolerance(z: Float[np.ndarray, "N"]) -> Float[np.ndarray, "N"]:
    return _INLIER * np.maximum(z**2, 0.5)


def find_plane(points: Float[np.ndarray, "N 3"], seed: int = 0) -> Plane:
    """The dominant plane (sample consensus with a truncated quadratic loss, then least squares on the inliers).

    Returns clearly below a plane count against it, mildly: a table hides what is under it, save beyond its edge.
    Raises ParseError where no plane holds a tenth of the returns.
    """
    if len(points) < 200:
        raise ParseError(f"no table in sight: only {len(points)} returns in range, expected at least 200")
    rng = np.random.default_rng(seed)
    sample = points[rng.permutation(len(points))[:3000]].astype(np.float64)
    tolerance = _tolerance(sample[:, 2])
    a, b, c = sample[rng.integers(len(sample), size=(3, _TRIALS))]
    normal = np.cross(b - a, c - a)
    norm = np.linalg.norm(normal, axis=1)
    keep = norm > 1e-3
    if not keep.any():
        raise ParseError("no table in sight: the returns do not span a plane")
    normal = normal[keep] / norm[keep, None]
    distance = (normal * a[keep]).sum(1)
    flip = -np.sign(distance)
    normal, distance = normal * flip[:, None], distance * flip
    height = (sample @ normal.T - distance) / tolerance[:, None]
    score = np.maximum(1 - height**2, 0).sum(0) - 0.2 * (height < -3).sum(0)
    best = int(np.argmax(score))
    return refine_plane(points, Plane(normal[best], float(distance[best])))


def refine_plane(points: Float[np.ndarray, "N 3"], plane: Plane, rounds: int = 5) -> Plane:
    """Weighted least squares with range noise growing as z^2 and a robust (Geman-McClure) loss."""
    normal, distance = plane
    for k in range(rounds):
        height = points @ normal - distance
        scale = _tolerance(points[:, 2]) / (1 + k)
        near = np.abs(height) < 3 * scale
        if near.sum() < 100:
            raise ParseError(f"no table in sight: the best plane holds {near.sum()} returns, expected at least 100")
        p, h, s = points[near], height[near], scale[near]
        weight = 1 / (p[:, 2] ** 4 * (1 + (h / s) ** 2) ** 2)
        mean = (weight[:, None] * p).sum(0) / weight.sum()
        spread = np.einsum("n,na,nb->ab", weight, p - mean, p - mean)
        normal = np.linalg.eigh(spread)[1][:, 0]
        normal = normal * -np.sign(normal @ mean)
        distance = float(normal @ mean)
    held = (np.abs(points @ normal - distance) < _tolerance(points[:, 2])).mean()
    if held < 0.1:
        raise ParseError(f"no table in sight: the best plane holds {held:.0%} of the returns, expected at least 10%")
    return Plane(normal, distance)


def table_frame(plane: Plane, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "4 4"]:
    """T_camera_table: z along the normal, origin where the optical axis meets the table, x to the camera's right.

    Where the axis misses the table, or meets it far behind what is seen of it, the origin is the middle of what is seen.
    """
    z = plane.normal
    x = np.array([1.0, 0.0, 0.0]) - z[0] * z
    if np.linalg.norm(x) < 1e-3:
        x = np.array([0.0, 1.0, 0.0]) - z[1] * z
    x /= np.linalg.norm(x)
    on_plane = points[np.abs(points @ plane.normal - plane.distance) < _tolerance(points[:, 2])]
    ahead = plane.distance / z[2] if abs(z[2]) > 1e-3 else np.inf
    seen = np.percentile(on_plane[:, 2], [2, 98])
    if seen[0] <= ahead <= seen[1]:
        origin = np.array([0.0, 0.0, ahead])
    else:
        middle = np.median(on_plane, 0)
        origin = middle - (middle @ z - plane.distance) * z
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(z, x), z], 1)
    T[:3, 3] = origin
    return T


def workspace(
    points: Float[np.ndarray, "H W 3"],
    T_camera_table: Float[np.ndarray, "4 4"],
    table_size: tuple[float, float],
    height: float,
    margin: float = 0.05,
) -> Bool[np.ndarray, "H W"]:
    """Which returns stand on or above what is seen of the table: above the convex hull of the table's surface, grown by
    `margin` metres, and inside the prior area grown likewise. NaN points are not."""
    local = (points - T_camera_table[:3, 3]) @ T_camera_table[:3, :3]
    z_camera = points[..., 2]
    with np.errstate(invalid="ignore"):
        tall = (local[..., 2] > -_BELOW * np.maximum(1, z_camera**2)) & (local[..., 2] < height)
        tall &= (np.abs(local[..., 0]) < table_size[0] / 2 + margin) & (np.abs(local[..., 1]) < table_size[1] / 2 + margin)
        surface = local[tall & (np.abs(local[..., 2]) < _tolerance(z_camera))][:, :2]
    hull = _support(surface, margin)
    if hull is None:
        raise ParseError("no table in sight: nothing is seen of its surface inside the table's area")
    inside = np.zeros(tall.shape, bool)
    inside[tall] = hull.find_simplex(local[tall][:, :2]) >= 0
    return inside


def _support(surface: Float[np.ndarray, "N 2"], margin: float) -> Delaunay | None:
    """The convex hull of the largest connected piece of surface, grown by `margin`."""
    if len(surface) < 50:
        return None
    low = surface.min(0)
    index = ((surface - low) / _CELL).astype(int)
    counts = np.zeros(index.max(0) + 3, int)
    np.add.at(counts, tuple(index.T + 1), 1)
    # Objects cut the visible surface into pieces: bridge gaps of a hand's width.
    labels, found = ndimage.label(ndimage.binary_dilation(counts > 1, iterations=3))
    if found == 0:
        return None
    sizes = ndimage.sum_labels(counts > 1, labels, np.arange(1, found + 1))
    piece = labels[tuple(index.T + 1)] == 1 + int(np.argmax(sizes))
    piece &= counts[tuple(index.T + 1)] > 1
    ring = margin * np.stack([np.cos(a := np.linspace(0, 2 * np.pi, 16, endpoint=False)), np.sin(a)], 1)
    try:
        corners = surface[piece][ConvexHull(surface[piece]).vertices]
        return Delaunay((corners[:, None] + ring).reshape(-1, 2))
    except (QhullError, ValueError):
        return None
