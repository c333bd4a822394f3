# SPDX-License-Identifier: Apache-2.0

"""Surfaces of revolution about an upright axis: the body of a mug, a can or a bowl.

Much of what stands on tables is round but for a handle or a spout. Views show each side of a round body with errors of
their own (depth bias, camera poses), so each side of a learned body would differ from the next by tenths of a
millimetre, and the likelihood would read a yaw from that where there is none. So where points all round lie on one
profile, within their noise, they are moved onto that profile, and the body is sampled anew from it, evenly.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from bayes3d_ros.geometry.voxel_grid import VoxelGrid
from bayes3d_ros.learning.fusion_constants import (
    AGREEING,
    BESIDE_BODY,
    HOLLOW,
    NEAR_BODY,
    PROFILE_CELL,
    SECTORS,
    STEEP,
)
from bayes3d_ros.learning.profile import TERMS, Profile, Rings, curve, own_nodes, profile_of, rings_about
from bayes3d_ros.learning.segment import Surface

_AXIS_ROUNDS = 20
_GOLDEN = 0.618  # steps by this share of a range fill it evenly


class Body(NamedTuple):
    """What of a surface is of revolution."""

    surface: Surface  # the same points, those of the body on its profile
    own: Bool[np.ndarray, "N"]  # points of the body
    samples: Surface  # of the body, as dense as its points; also where nothing was measured
    axis: Float[np.ndarray, "2"]  # metres, table frame


class _BodyFit(NamedTuple):
    """Where points lie about the curve of their node, metres."""

    rings: Rings
    profile: Profile
    node: Int[np.ndarray, "N"]  # -1: none
    along: Float[np.ndarray, "N"]
    off: Float[np.ndarray, "N"]
    own: Bool[np.ndarray, "N"]  # points of the body


def body_of_revolution(surface: Surface) -> Body | None:
    """The part of a surface in the table frame that is of revolution about an upright axis; None where there is
    none."""
    if (np.abs(surface.normals[:, 2]) < STEEP).sum() < SECTORS:
        return None
    axis = _axis(surface)
    rough = _fit_body(surface, axis)
    if rough is None:
        return None
    sides = rough.own & (np.abs(rough.rings.normal[:, 0]) > STEEP)
    axis = axis + np.linalg.lstsq(surface.normals[sides, :2], rough.off[sides], rcond=None)[0]
    fit = _fit_body(surface, axis)
    if fit is None:
        return None
    moved = _onto(surface, fit)
    samples = _clear_samples(_samples(fit.profile, fit.node[fit.own], fit.along[fit.own], axis), moved, fit.own)
    apart, nearest = cKDTree(samples.points).query(moved.points)
    stray = ~fit.own & (apart < NEAR_BODY / 2)  # so near to the body that they must be noise of it
    for part, body in zip(moved, samples, strict=True):
        part[stray] = body[nearest[stray]]
    return Body(moved, fit.own | stray, samples, axis)


def hollow(
    body: Body, free: Bool[np.ndarray, "X Y Z"], surface: Bool[np.ndarray, "X Y Z"], grid: VoxelGrid
) -> Bool[np.ndarray, "X Y Z"]:
    """Voxels inside the body on whose ring about its axis views found others free and hardly any of the surface: no
    view looks down to the foot of a cup on all sides."""
    centres = grid.centres()
    radius = np.linalg.norm(centres[:, :2] - body.axis, axis=1)
    layer = np.floor((centres[:, 2] - grid.origin[2]) / grid.voxel_size).astype(int)
    reach = np.zeros(grid.shape[2])
    sample_layer = grid.cells(body.samples.points)[:, 2]
    np.maximum.at(reach, sample_layer, np.linalg.norm(body.samples.points[:, :2] - body.axis, axis=1))
    ring = np.floor(radius / grid.voxel_size).astype(int) * grid.shape[2] + layer
    voxels, passed, held = (np.bincount(ring, one) for one in (np.ones(len(ring)), free.ravel(), surface.ravel()))
    is_free = (passed > HOLLOW * voxels) & (held < (1 - AGREEING) * passed)
    return ((radius < reach[layer]) & is_free[ring]).reshape(grid.shape)


def _fit_body(surface: Surface, axis: Float[np.ndarray, "2"]) -> _BodyFit | None:
    """The body about this axis; None where it has no sides."""
    rings = rings_about(surface, axis)
    profile = profile_of(rings)
    if profile is None or not profile.of_body.any():
        return None
    node = own_nodes(rings, profile)
    apart = rings.place - profile.place[node]
    along, height = (np.einsum("ni,ni->n", apart, way[node]) for way in (profile.along, profile.normal))
    off = height - np.einsum("nk,nk->n", profile.terms[node], along[:, None] ** np.arange(TERMS))
    own = (node >= 0) & (np.abs(off) < NEAR_BODY / 2)
    if (own & (np.abs(rings.normal[:, 0]) > STEEP)).sum() < SECTORS:
        return None
    return _BodyFit(rings, profile, node, along, off, own)


def _axis(surface: Surface) -> Float[np.ndarray, "2"]:
    """Where in the table's plane the normals of walls meet: least squares with Cauchy weights."""
    wall = np.abs(surface.normals[:, 2]) < STEEP
    points, normals = surface.points[wall, :2], surface.normals[wall, :2]
    across = np.stack([-normals[:, 1], normals[:, 0]], 1) / np.linalg.norm(normals, axis=1, keepdims=True)
    target, weight = np.einsum("ni,ni->n", across, points), np.ones(len(points))
    axis = np.zeros(2)
    for _ in range(_AXIS_ROUNDS):
        weighted = across * weight[:, None]
        axis = np.linalg.lstsq(weighted.T @ across, weighted.T @ target, rcond=None)[0]
        miss = target - across @ axis
        weight = 1 / (1 + (miss / (2 * max(float(np.median(np.abs(miss))), PROFILE_CELL / 2))) ** 2)
    return axis


def _onto(surface: Surface, fit: _BodyFit) -> Surface:
    """The surface, its points of the body on the curves of their nodes."""
    points, normals, own = surface.points.copy(), surface.normals.copy(), fit.own
    place, normal = curve(fit.profile, fit.node[own], fit.along[own])
    points[own], normals[own] = _turned(place - [1, 0] * fit.rings.place[own], normal, fit.rings.outward[own])
    points[own, :2] += surface.points[own, :2]
    return Surface(points, normals)


def _turned(
    place: Float[np.ndarray, "N 2"], normal: Float[np.ndarray, "N 2"], outward: Float[np.ndarray, "N 2"]
) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 3"]]:
    """Radius and height, and normals of a profile, in these directions from the axis."""
    point, unit = (np.column_stack([part[:, :1] * outward, part[:, 1]]) for part in (place, normal))
    return point, unit


def _samples(
    profile: Profile, node: Int[np.ndarray, "B"], t: Float[np.ndarray, "B"], axis: Float[np.ndarray, "2"]
) -> Surface:
    """As many points as there are, which lie at t on the curves of their nodes, spread evenly over all azimuths."""
    order = np.argsort(node, kind="stable")
    body, first, there = np.unique(node[order], return_index=True, return_counts=True)
    length = np.maximum(2 * np.pi * profile.place[body, 0], PROFILE_CELL)
    number = np.maximum(np.round(length * len(node) / length.sum()).astype(int), 1)
    ring = np.repeat(np.arange(len(body)), number)
    step = np.arange(len(ring)) - np.repeat(np.cumsum(number) - number, number)
    other = first[ring] + np.floor(_GOLDEN * step % 1.0 * there[ring]).astype(int)
    place, normal = curve(profile, body[ring], t[order][other])
    turn = 2 * np.pi * (step / number[ring] + _GOLDEN * ring % 1.0)  # rings' points lie between each other
    points, normals = _turned(place, normal, np.stack([np.cos(turn), np.sin(turn)], 1))
    points[:, :2] += axis
    return Surface(points, normals)


def _clear_samples(samples: Surface, surface: Surface, own: Bool[np.ndarray, "N"]) -> Surface:
    """Those that lie beside points of the body, or beside none of anything."""
    points, normals = samples

    def placed(points: Float[np.ndarray, "M 3"], normals: Float[np.ndarray, "M 3"]) -> Float[np.ndarray, "M 6"]:
        return np.column_stack([points, NEAR_BODY * normals])  # sides of a wall are apart

    body, _ = cKDTree(placed(surface.points[own], surface.normals[own])).query(placed(points, normals))
    if own.all():
        return samples
    other, _ = cKDTree(surface.points[~own]).query(points)
    clear = (other > np.where(body < NEAR_BODY, NEAR_BODY / 2, BESIDE_BODY)) | (body < PROFILE_CELL)
    return Surface(points[clear], normals[clear])
