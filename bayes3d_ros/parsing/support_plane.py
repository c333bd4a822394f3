# SPDX-License-Identifier: Apache-2.0

"""Find the table in a depth image, and tell which returns belong to the workspace."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError

from bayes3d_ros.geometry.robust import geman_mcclure
from bayes3d_ros.likelihood.density import BEYOND, IN_WORKSPACE, NO_RETURN
from bayes3d_ros.parsing.posterior_constants import (
    BELOW_TABLE,
    EDGE_WIDTH,
    PLANE_TOLERANCE,
    SMALLEST_PIECE,
    STANDING_SHARE,
    SUPPORT_CELL,
    SUPPORT_MARGIN,
)
from bayes3d_ros.parsing.tuning import SEARCH
from bayes3d_ros.posterior.types import ParseError

_ROUNDING = 1e-9  # metres: whole columns of pixels lie on a side of the table's polygon that points to the camera


class Plane(NamedTuple):
    """Points x of the plane satisfy normal . x = distance in the camera frame; the normal points to the origin.
    Metres."""

    normal: Float[np.ndarray, "3"]
    distance: float


def _tolerance(z: Float[np.ndarray, "N"]) -> Float[np.ndarray, "N"]:
    return PLANE_TOLERANCE * np.maximum(z**2, 0.5)


def find_plane(points: Float[np.ndarray, "N 3"], seed: int = 0) -> Plane:
    """The dominant plane of points in the camera's frame, metres (sample consensus with a truncated quadratic loss,
    then least squares on the inliers).

    Returns clearly below a plane count against it, mildly: a table hides what is under it, save beyond its edge.
    Raises ParseError where no plane holds a tenth of the returns.
    """
    if len(points) < 200:
        raise ParseError(f"no table in sight: only {len(points)} returns in range, expected at least 200")
    rng = np.random.default_rng(seed)
    sample = points[rng.permutation(len(points))[:3000]].astype(np.float64)
    tolerance = _tolerance(sample[:, 2])
    a, b, c = sample[rng.integers(len(sample), size=(3, SEARCH.plane_trials))]
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
    """The plane near the given one that points in the camera's frame, metres, show: weighted least squares with range
    noise growing as z^2 and a robust (Geman-McClure) loss. Raises ParseError where few points lie on it."""
    normal, distance = plane
    for k in range(rounds):
        height = points @ normal - distance
        scale = _tolerance(points[:, 2]) / (1 + k)
        near = np.abs(height) < 3 * scale
        if near.sum() < 100:
            raise ParseError(f"no table in sight: the best plane holds {near.sum()} returns, expected at least 100")
        p, h, s = points[near], height[near], scale[near]
        weight = 1 / (p[:, 2] ** 4 * geman_mcclure(h, s))
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
    """T_camera_table, metres: z along the normal, x to the camera's right, origin where the optical axis meets the
    table. points: of the camera's frame.

    If the axis misses the table, or meets it far behind what is seen, the origin is the middle of what is seen.
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
) -> Int[np.ndarray, "H W"]:
    """The class of every pixel: IN_WORKSPACE if its return belongs to the table or to an object on it, BEYOND if it
    belongs to something else, NO_RETURN if the point is NaN or, along the table's edge, if it cannot be told.

    Candidates are returns between just below the plane and `height` above it, inside the prior area. What rises
    from the plane is cut into connected pieces. A piece counts as a whole if most of it stands over the convex hull
    of the visible surface of the table. (A chair behind the table touches the table's edge in the image, and a part
    of it may lean over.) Raises ParseError if nothing of the table is seen.
    """
    local = (points - T_camera_table[:3, 3]) @ T_camera_table[:3, :3]
    z_camera = points[..., 2]
    with np.errstate(invalid="ignore"):
        candidate = (local[..., 2] > -BELOW_TABLE * np.maximum(1, z_camera**2)) & (local[..., 2] < height)
        candidate &= (np.abs(local[..., :2]) < np.array(table_size) / 2).all(-1)
        flat = candidate & (np.abs(local[..., 2]) < _tolerance(z_camera))
    # The foot of a wall or of an object lies in the plane too: keep what is flat all around.
    surface = local[ndimage.binary_erosion(flat | np.isnan(z_camera), iterations=2, border_value=1) & flat][:, :2]
    eye = -T_camera_table[:3, :3].T @ T_camera_table[:3, 3]
    hull = _support(surface, eye[:2])
    if hull is None:
        raise ParseError("no table in sight: nothing is seen of its surface inside the table's area")
    over = np.zeros(candidate.shape, bool)
    over[candidate] = in_polygon(hull, local[candidate][:, :2])
    pieces, count = connected_pieces(candidate & ~flat, z_camera)
    stands = np.zeros(candidate.shape, bool)
    if count:
        share = ndimage.mean(over, pieces, np.arange(count + 1))
        size = np.bincount(pieces.ravel(), minlength=count + 1)
        stands = (pieces > 0) & ((share > STANDING_SHARE) & (size >= SMALLEST_PIECE))[pieces]
    # The foot of what stands beyond the table's edge is as flat as the table.
    other = np.isfinite(z_camera) & ~stands & ~(flat & over)
    table = flat & over & ~ndimage.binary_dilation(other, iterations=EDGE_WIDTH)
    return np.where(stands | table, IN_WORKSPACE, np.where(other, BEYOND, NO_RETURN))


def depth_of_table(
    rays: Float[np.ndarray, "H W 3"], T_camera_table: Float[np.ndarray, "4 4"], far: float
) -> Float[np.ndarray, "H W"]:
    """Depth in metres at which rays (x, y, 1) meet the table's plane from above, inf where they do not before `far`."""
    normal = T_camera_table[:3, 2]
    facing = rays @ normal
    with np.errstate(divide="ignore"):
        depth = (normal @ T_camera_table[:3, 3]) / facing
    return np.where((facing < -1e-3) & (depth > 0) & (depth < far), depth, np.inf)


def usable_share(
    pixel_class: Int[np.ndarray, "H W"],
    rays: Float[np.ndarray, "H W 3"],
    T_camera_table: Float[np.ndarray, "4 4"],
    table_size: tuple[float, float],
    far: float,
) -> float:
    """Of the pixels whose rays (x, y, 1) meet the table's prior area before `far` metres, the share whose return
    the likelihood uses: as the table's, as an object's, or as evidence that nothing is in between. NaN if no ray
    meets it."""
    bare = depth_of_table(rays, T_camera_table, far)
    met = np.isfinite(bare)
    local = (rays[met] * bare[met, None] - T_camera_table[:3, 3]) @ T_camera_table[:3, :2]
    on_table = (np.abs(local) < np.array(table_size) / 2).all(-1)
    return float((pixel_class[met][on_table] != NO_RETURN).mean()) if on_table.any() else float("nan")


def connected_pieces(
    risen: Bool[np.ndarray, "H W"], depth: Float[np.ndarray, "H W"]
) -> tuple[Int[np.ndarray, "H W"], int]:
    """Pieces of a part of an image that are connected without a jump in depth: labels from 1 on, and their number."""
    # Two labels a pixel would need a graph; dropping the pixel right of a jump, or below it, is enough here.
    with np.errstate(invalid="ignore"):
        cut = np.zeros(risen.shape, bool)
        for axis in (0, 1):
            step = np.diff(depth, axis=axis)
            jump = np.abs(step) > 0.03 * np.take(depth, range(1, depth.shape[axis]), axis)
            later = np.zeros(risen.shape, bool)
            later[(slice(1, None), slice(None)) if axis == 0 else (slice(None), slice(1, None))] = jump
            cut |= later
    pieces, count = ndimage.label(risen & ~cut)
    # Pixels on the cuts join the nearest piece.
    nearest = ndimage.distance_transform_edt(pieces == 0, return_distances=False, return_indices=True)
    return np.where(risen, pieces[tuple(nearest)], 0) if count else pieces, count


def in_polygon(hull: ConvexHull, points: Float[np.ndarray, "N 2"]) -> Bool[np.ndarray, "N"]:
    """Which points, in metres, lie in a convex polygon or on its border."""
    return (points @ hull.equations[:, :2].T <= _ROUNDING - hull.equations[:, 2]).all(1)


def _support(surface: Float[np.ndarray, "N 2"], eye: Float[np.ndarray, "2"]) -> ConvexHull | None:
    """The convex hull of the largest connected piece of the table's surface, grown by a margin and extended to
    below the camera: the lower edge of the image is not the edge of the table."""
    if len(surface) < 50:
        return None
    low = surface.min(0)
    index = ((surface - low) / SUPPORT_CELL).astype(int)
    counts = np.zeros(index.max(0) + 3, int)
    np.add.at(counts, tuple(index.T + 1), 1)
    # Objects cut the visible surface into pieces: bridge gaps of a hand's width.
    labels, found = ndimage.label(ndimage.binary_dilation(counts > 1, iterations=3))
    if found == 0:
        return None
    sizes = ndimage.sum_labels(counts > 1, labels, np.arange(1, found + 1))
    piece = labels[tuple(index.T + 1)] == 1 + int(np.argmax(sizes))
    piece &= counts[tuple(index.T + 1)] > 1
    ring = SUPPORT_MARGIN * np.stack([np.cos(a := np.linspace(0, 2 * np.pi, 16, endpoint=False)), np.sin(a)], 1)
    try:
        corners = surface[piece][ConvexHull(surface[piece]).vertices]
        return ConvexHull(np.concatenate([(corners[:, None] + ring).reshape(-1, 2), eye[None]]))
    except (QhullError, ValueError):
        return None
