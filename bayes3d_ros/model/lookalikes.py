"""Poses in which an object at rest looks like itself: half turns of a box, a mug upside down, any turn of a can.

A search that found one of them need not find the others, and the posterior has to hold them all.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

ALIKE = 7  # kept for every face
_TURNS = 30
_POINTS = 40
_ROUNDS = 5
_PROMISING = 0.014  # metres, before alignment
_ALIKE_WITHIN = 0.006  # metres, root mean square between the surfaces
_FAR = 0.02  # metres: farther is no worse
_SAME_TURN = 0.35  # radians: closer poses on one face are one mode


class Lookalikes(NamedTuple):
    """For each contact face, the other contacts that look alike, best first; the contact itself where there are fewer.
    `shift` is (x, y) in metres along the contact's own axes, and yaw in radians, added to the contact's."""

    face: Int[np.ndarray, "6 A"]
    shift: Float[np.ndarray, "6 A 3"]


def lookalikes(surface: Float[np.ndarray, "S 3"], T_contact_object: Float[np.ndarray, "6 4 4"]) -> Lookalikes:
    """Compare the surface resting on every face and at every turn with itself; the best are aligned to it."""
    tree = cKDTree(surface)
    some = surface[np.linspace(0, len(surface) - 1, min(_POINTS, len(surface))).astype(int)]
    resting = [some @ T[:3, :3].T + T[:3, 3] for T in T_contact_object]
    whole = [surface @ T[:3, :3].T + T[:3, 3] for T in T_contact_object]
    extent = np.array([np.ptp(w[:, 2]) for w in whole])
    middle = np.array([0.5 * (w.max(0) + w.min(0))[:2] for w in whole])
    faces = len(T_contact_object)
    found = Lookalikes(np.tile(np.arange(faces)[:, None], (1, ALIKE)), np.zeros((faces, ALIKE, 3)))
    for face, T in enumerate(T_contact_object):
        others = [f for f in range(faces) if abs(extent[f] - extent[face]) < 2 * _ALIKE_WITHIN]
        best: list[tuple[float, int, np.ndarray]] = []
        for other in others:
            turn = np.arange(_TURNS) * 2 * np.pi / _TURNS
            c, s = np.cos(turn), np.sin(turn)
            x, y = middle[other]
            turned = np.stack([c * x - s * y, s * x + c * y], 1)
            shift = np.concatenate([middle[face] - turned, turn[:, None]], 1)
            shift, error = _aligned(shift, resting[other], T, surface, tree)
            shift = shift[error < _PROMISING]
            if not len(shift):
                continue
            for _ in range(_ROUNDS):
                shift, error = _aligned(shift, resting[other], T, surface, tree)
            best += [(e, other, row) for e, row in zip(error, shift, strict=True) if e < _ALIKE_WITHIN]
        chosen: list[tuple[int, np.ndarray]] = [(face, np.zeros(3))]  # itself needs no place
        for _, other, row in sorted(best, key=lambda b: b[0]):
            if all(other != f or abs(_wrapped(row[2] - r[2])) > _SAME_TURN for f, r in chosen) and len(chosen) <= ALIKE:
                chosen.append((other, row))
        for place, (other, row) in enumerate(chosen[1:]):
            found.face[face, place], found.shift[face, place] = other, row
    return found


def _wrapped(angle: float) -> float:
    return float((angle + np.pi) % (2 * np.pi) - np.pi)


def _aligned(shift, points, T_contact_object, surface, tree):
    """One round of nearest points and the planar motion that fits them best; the error is of the motion given."""
    c, s = np.cos(shift[:, 2:]), np.sin(shift[:, 2:])
    x = c * points[:, 0] - s * points[:, 1] + shift[:, :1]
    y = s * points[:, 0] + c * points[:, 1] + shift[:, 1:2]
    at = np.stack([x, y, np.broadcast_to(points[:, 2], x.shape)], -1)
    local = (at - T_contact_object[:3, 3]) @ T_contact_object[:3, :3]
    distance, index = tree.query(local.reshape(-1, 3), distance_upper_bound=_FAR)
    distance, index = distance.reshape(x.shape), np.minimum(index, len(surface) - 1).reshape(x.shape)
    found = np.isfinite(distance)[..., None]
    error = np.sqrt((np.minimum(distance, _FAR) ** 2).mean(1))
    near = surface[index] @ T_contact_object[:3, :3].T + T_contact_object[:3, 3]
    count = np.maximum(found.sum(1, keepdims=True), 1)
    a0, b0 = ((p[..., :2] * found).sum(1, keepdims=True) / count for p in (at, near))
    u, v = (at[..., :2] - a0) * found, (near[..., :2] - b0) * found
    turn = np.arctan2((u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]).sum(1), (u * v).sum((1, 2)))
    c, s = np.cos(turn), np.sin(turn)
    arm = shift[:, :2] - a0[:, 0]
    moved = np.stack([c * arm[:, 0] - s * arm[:, 1], s * arm[:, 0] + c * arm[:, 1]], 1) + b0[:, 0]
    return np.concatenate([moved, (shift[:, 2] + turn)[:, None]], 1), error
