"""A convex solid around an object that is tighter than its box: the box with its twelve edges cut off."""

import itertools

import numpy as np
from jaxtyping import Float, Int

CORNERS, EDGES = 32, 48  # the most that a solid of 18 faces has

# Outward normals of the faces: along the axes, and half way between two of them.
_NORMALS = np.array([n for n in itertools.product((-1, 0, 1), repeat=3) if 0 < np.count_nonzero(n) < 3], float)


def hull(cells: Int[np.ndarray, "S 3"]) -> tuple[Float[np.ndarray, "32 3"], Int[np.ndarray, "48 2"]]:
    """Corners, in voxels, and edges, as two corners each, of the solid around some cells of a voxel grid. What is not
    needed of the 32 and 48 repeats the first corner."""
    reach = (cells @ _NORMALS.T).max(0) + np.maximum(_NORMALS, 0).sum(1)
    threes = np.array(list(itertools.combinations(range(len(_NORMALS)), 3)))
    meet = np.abs(np.linalg.det(_NORMALS[threes])) > 0.5
    points = np.linalg.solve(_NORMALS[threes[meet]], reach[threes[meet]][..., None])[..., 0]
    corners = np.unique(points[(points @ _NORMALS.T <= reach + 1e-6).all(1)].round(3), axis=0)
    # Two corners that lie on the same two faces are the ends of an edge.
    on = np.abs(corners @ _NORMALS.T - reach) < 1e-2
    ends = np.argwhere(np.triu(on.astype(int) @ on.T >= 2, 1))
    return (
        np.concatenate([corners, np.repeat(corners[:1], CORNERS - len(corners), 0)]),
        np.concatenate([ends, np.zeros((EDGES - len(ends), 2), int)]),
    )
