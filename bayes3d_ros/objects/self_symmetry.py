# SPDX-License-Identifier: Apache-2.0

"""Poses in which an object at rest looks like itself: half turns of a box, a mug upside down, any turn of a can.

A search that found one of them need not find the others, and the posterior has to hold them all.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from bayes3d_ros.geometry.poses import slide

ALIKE = 7  # kept for every face
TURNED = 60  # turns in yaw, a full circle: peaks of the likelihood over a mug's yaw are 4 to 8 degrees wide
_TURNS = 60  # in yaw, that are compared first
_COMPARED_POINTS = 64  # of the surface
_YAW_HALVINGS = 5  # of the step in yaw
_SLIDES = 3  # at the end
_ALIKE_WITHIN = 0.006  # metres, root mean square between the surfaces
_CUT_OFF_M = 0.02  # metres: farther is no worse
_HALF_TURN = 0.1  # radians off one
_SQUARE_WITHIN = 0.1  # of the entries of a rotation, off quarter turns
_AS_GOOD = 1e-4  # metres that those may lie farther off than the best turn found
_SAME_TURN = 0.35  # radians: closer poses on one face are one mode


class SelfSymmetry(NamedTuple):
    """For each contact face, the faces on which the object looks alike, best first; the face itself where there are
    fewer. `shift` is (x, y) in metres along the placement's own axes, and yaw in radians, added to the placement's."""

    face: Int[np.ndarray, "6 A"]
    shift: Float[np.ndarray, "6 A 3"]
    # For each contact face, turns by k / TURNED of a circle, with the (x, y) that keeps the surface in its place as far
    # as it can be: of a mug, the body stays and the handle moves.
    turned: Float[np.ndarray, "6 T 3"]


class _Surface(NamedTuple):
    points: Float[np.ndarray, "S 3"]
    normals: Float[np.ndarray, "S 3"]
    tree: cKDTree


def self_symmetry(
    points: Float[np.ndarray, "S 3"], normals: Float[np.ndarray, "S 3"], T_contact_object: Float[np.ndarray, "6 4 4"]
) -> SelfSymmetry:
    """Compare the surface resting on every face and at every turn with itself; the best turns are made finer."""
    surface = _Surface(points, normals, cKDTree(points))
    some = points[np.linspace(0, len(points) - 1, min(_COMPARED_POINTS, len(points))).astype(int)]
    resting = [some @ T[:3, :3].T + T[:3, 3] for T in T_contact_object]
    whole = [points @ T[:3, :3].T + T[:3, 3] for T in T_contact_object]
    centre = 0.5 * (points.max(0) + points.min(0))
    extent = np.array([np.ptp(w[:, 2]) for w in whole])
    middle = np.array([0.5 * (w.max(0) + w.min(0))[:2] for w in whole])
    faces = len(T_contact_object)
    found = _nothing_alike(faces)
    turn = np.arange(_TURNS) * 2 * np.pi / _TURNS
    c, s = np.cos(turn), np.sin(turn)
    best: list[list[tuple[float, int, np.ndarray]]] = [[] for _ in range(faces)]
    for face, T in enumerate(T_contact_object):
        for other in [f for f in range(face, faces) if abs(extent[f] - extent[face]) < 2 * _ALIKE_WITHIN]:
            x, y = middle[other]
            turned = np.stack([c * x - s * y, s * x + c * y], 1)
            shift = np.concatenate([middle[face] - turned, turn[:, None]], 1)
            shift, error = _slid(shift, resting[other], T, surface)
            if other == face:
                found.turned[face], _ = _slid_on(shift[:: _TURNS // TURNED], resting[face], T, surface)
            lowest = (error <= np.roll(error, 1)) & (error <= np.roll(error, -1)) & (error < 2 * _ALIKE_WITHIN)
            shift, error = shift[lowest], error[lowest]
            for halving in range(_YAW_HALVINGS if len(shift) else 0):
                step = np.array([0, 0, np.pi / _TURNS / 2**halving])
                tried = np.concatenate([shift - step, shift, shift + step])
                tried, errors = (a.reshape(3, len(shift), -1) for a in _slid(tried, resting[other], T, surface))
                pick = errors[..., 0].argmin(0), np.arange(len(shift))
                shift, error = tried[pick], errors[..., 0][pick]
            if len(shift):
                shift, error = _slid_on(shift, resting[other], T, surface)
            square = _squared(shift, T, T_contact_object[other], centre)
            squared = _slid(square, resting[other], T, surface)[1] if len(shift) else error
            shift = np.where((squared < error + _AS_GOOD)[:, None], square, shift)
            for e, row in zip(error, shift, strict=True):
                if e < _ALIKE_WITHIN:
                    best[face].append((e, other, row))
                    if other != face:
                        best[other].append((e, face, _inverse(row)))
    for face in range(faces):
        chosen: list[tuple[int, np.ndarray]] = [(face, np.zeros(3))]  # itself needs no place
        for _, other, row in sorted(best[face], key=lambda b: b[0]):
            if all(other != f or abs(_wrapped(row[2] - r[2])) > _SAME_TURN for f, r in chosen) and len(chosen) <= ALIKE:
                chosen.append((other, row))
        for place, (other, row) in enumerate(chosen[1:]):
            found.face[face, place], found.shift[face, place] = other, row
    return _reversible(found)


def _nothing_alike(faces: int) -> SelfSymmetry:
    alike = np.tile(np.arange(faces)[:, None], (1, ALIKE))
    return SelfSymmetry(alike, np.zeros((faces, ALIKE, 3)), np.zeros((faces, TURNED, 3)))


def _reversible(found: SelfSymmetry) -> SelfSymmetry:
    """Only ways that lead back exactly: of (a to b, b to a) one is made the other's inverse, a lone one gets an inverse
    where there is room and is dropped where there is none. A sampler may then jump along them."""
    faces = len(found.face)
    paired = _nothing_alike(faces)._replace(turned=found.turned)
    room = [ALIKE] * faces

    def add(face: int, other: int, shift: Float[np.ndarray, "3"]) -> None:
        place = ALIKE - room[face]
        paired.face[face, place], paired.shift[face, place] = other, shift
        room[face] -= 1

    for place in range(ALIKE):  # the best of every face first
        for face in range(faces):
            other, shift = int(found.face[face, place]), found.shift[face, place]
            if other == face and not shift.any():
                continue
            placed = ALIKE - room[face]
            known = zip(paired.face[face, :placed], paired.shift[face, :placed], strict=True)
            if any(other == f and abs(_wrapped(shift[2] - s[2])) < _SAME_TURN for f, s in known):
                continue
            own = other == face and abs(_wrapped(shift[2] - np.pi)) < _HALF_TURN  # a half turn is its own way back
            shift = np.array([*shift[:2], np.pi]) if own else shift
            back = _inverse(shift)
            if room[face] and (own or room[other] - (other == face)):
                add(face, other, shift)
                if not own:
                    add(other, face, back)
    return paired


def _squared(
    shift: Float[np.ndarray, "T 3"],
    T_contact_object: Float[np.ndarray, "4 4"],
    T_contact_other: Float[np.ndarray, "4 4"],
    centre: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "T 3"]:
    """With the object turned by quarter turns about its own axes, if it nearly is: a posterior is finer than a fit, and
    what is symmetric in its voxels is so exactly."""
    squared = shift.copy()
    for k, (x, y, yaw) in enumerate(shift):
        turn = (np.linalg.inv(T_contact_object) @ slide(x, y, yaw) @ T_contact_other)[:3, :3]
        square = np.round(turn)
        if np.abs(turn - square).max() > _SQUARE_WITHIN or np.linalg.det(square) != 1:
            continue
        about = np.eye(4)
        about[:3, :3], about[:3, 3] = square, centre - square @ centre
        moved = T_contact_object @ about @ np.linalg.inv(T_contact_other)
        squared[k] = *moved[:2, 3], np.arctan2(moved[1, 0], moved[0, 0]) % (2 * np.pi)
    return squared


def _inverse(shift: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    c, s = np.cos(shift[2]), np.sin(shift[2])
    return np.array([-(c * shift[0] + s * shift[1]), -(-s * shift[0] + c * shift[1]), -shift[2]])


def _wrapped(angle: float) -> float:
    return float((angle + np.pi) % (2 * np.pi) - np.pi)


def _slid(
    shift: Float[np.ndarray, "T 3"],
    points: Float[np.ndarray, "P 3"],
    T_contact_object: Float[np.ndarray, "4 4"],
    surface: _Surface,
) -> tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, "T"]]:
    """One round of sliding the points to where they lie on the surface, and how far off it they were before."""
    c, s = np.cos(shift[:, 2:]), np.sin(shift[:, 2:])
    x = c * points[:, 0] - s * points[:, 1] + shift[:, :1]
    y = s * points[:, 0] + c * points[:, 1] + shift[:, 1:2]
    at = np.stack([x, y, np.broadcast_to(points[:, 2], x.shape)], -1)
    local = (at - T_contact_object[:3, 3]) @ T_contact_object[:3, :3]
    distance, index = surface.tree.query(local.reshape(-1, 3), distance_upper_bound=_CUT_OFF_M)
    distance, index = distance.reshape(x.shape), np.minimum(index, len(surface.points) - 1).reshape(x.shape)
    along = surface.normals[index]
    off = (along * (surface.points[index] - local)).sum(-1)  # to the surface's plane: its points lie a voxel apart
    near = np.isfinite(distance)
    off = np.where(
        near, np.where(distance < 0.5 * _CUT_OFF_M, off, np.copysign(np.minimum(distance, _CUT_OFF_M), off)), 0.0
    )
    error = np.sqrt(np.where(near, off**2, _CUT_OFF_M**2).mean(1))
    normal = (along @ T_contact_object[:3, :3].T)[..., :2] * near[..., None]
    square = np.einsum("tpa,tpb->tab", normal, normal) + 0.5 * np.eye(2)
    slide = np.linalg.solve(square, (normal * off[..., None]).sum(1)[..., None])[..., 0]
    return shift + np.concatenate([slide, np.zeros((len(shift), 1))], 1), error


def _slid_on(
    shift: Float[np.ndarray, "T 3"],
    points: Float[np.ndarray, "P 3"],
    T_contact_object: Float[np.ndarray, "4 4"],
    surface: _Surface,
) -> tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, "T"]]:
    """`_SLIDES` rounds of `_slid`: to where the points lie on the surface best, and how far off before the last."""
    for _ in range(_SLIDES):
        shift, error = _slid(shift, points, T_contact_object, surface)
    return shift, error
