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
_FEWEST_WALL_POINTS = 36
_GOLDEN = 0.618  # steps by this share of a range fill it evenly


class Body(NamedTuple):
    """The part of a surface that is of revolution; metres, table frame."""

    surface: Surface  # the points that were given, those of the body moved onto its profile
    own: Bool[np.ndarray, "N"]  # points of the body
    samples: Surface  # of the body, all round, also where nothing was measured; as dense as its points where those are
    guessed: Bool[np.ndarray, "M"]  # samples where nothing was measured
    axis: Float[np.ndarray, "2"]  # x and y of the upright axis

    @property
    def whole(self) -> Surface:
        """Samples of the body, the points that are not of the body, and those of the body that no sample is near."""
        if not len(self.samples.points):
            return self.surface
        apart, _ = cKDTree(_placed(self.samples)).query(_placed(self.surface))
        kept = ~self.own | (apart > NEAR_BODY / 2)
        return Surface(*(np.concatenate([a[kept], b]) for a, b in zip(self.surface, self.samples, strict=True)))


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
    if (np.abs(surface.normals[:, 2]) < STEEP).sum() < _FEWEST_WALL_POINTS:
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
    moved = _onto(surface, fit, axis)
    samples, guessed = _clear_samples(_samples(fit, axis), moved, fit.own)
    if len(samples.points):
        apart, nearest = cKDTree(_placed(samples)).query(_placed(moved))
        stray = ~fit.own & (apart < NEAR_BODY / 2)  # so near to the body that they must be noise of it
        for part, body in zip(moved, samples, strict=True):
            part[stray] = body[nearest[stray]]
        fit = fit._replace(own=fit.own | stray)
    return Body(moved, fit.own, samples, guessed, axis)


def _placed(surface: Surface) -> Float[np.ndarray, "N 6"]:
    """Points and normals, to be compared with others: the two sides of a wall are 2 NEAR_BODY apart."""
    return np.column_stack([surface.points, NEAR_BODY * surface.normals])


def without(body: Body, free: Bool[np.ndarray, "M"]) -> Body:
    """The body without the samples that were guessed where views see through."""
    kept = ~(body.guessed & free)
    samples = Surface(*(part[kept] for part in body.samples))
    return body._replace(samples=samples, guessed=body.guessed[kept])


def hollow(
    body: Body, free: Bool[np.ndarray, "X Y Z"], surface: Bool[np.ndarray, "X Y Z"], grid: VoxelGrid
) -> Bool[np.ndarray, "X Y Z"]:
    """Voxels inside the body whose ring about its axis is free where views tell: no view sees the foot of a cup on all
    sides. free: voxels that views found free; surface: voxels of the surface that was seen."""
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
    if (own & (np.abs(rings.normal[:, 0]) > STEEP)).sum() < _FEWEST_WALL_POINTS:
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


def _onto(surface: Surface, fit: _BodyFit, axis: Float[np.ndarray, "2"]) -> Surface:
    """The surface, its points of the body on the curves of their nodes."""
    points, normals, own = surface.points.copy(), surface.normals.copy(), fit.own
    place, normal = curve(fit.profile, fit.node[own], fit.along[own])
    points[own], normals[own] = _turned(place, normal, fit.rings.outward[own], axis)
    return Surface(points, normals)


def _turned(
    place: Float[np.ndarray, "N 2"],
    normal: Float[np.ndarray, "N 2"],
    outward: Float[np.ndarray, "N 2"],
    axis: Float[np.ndarray, "2"],
) -> Surface:
    """Points and normals of a profile in these directions from the axis."""
    return Surface(
        np.column_stack([axis + place[:, :1] * outward, place[:, 1]]),
        np.column_stack([normal[:, :1] * outward, normal[:, 1]]),
    )


def _samples(fit: _BodyFit, axis: Float[np.ndarray, "2"]) -> Surface:
    """Points of the body, spread evenly over all azimuths; where each lies along its node's curve a measured one
    does."""
    node, along = fit.node[fit.own], fit.along[fit.own]
    sectors = len(np.unique(np.floor(fit.rings.azimuth[fit.own] / (2 * np.pi) * SECTORS)))
    order = np.argsort(node, kind="stable")
    body, first, there = np.unique(node[order], return_index=True, return_counts=True)
    length = np.maximum(2 * np.pi * fit.profile.place[body, 0], PROFILE_CELL)
    number = np.maximum(np.round(length * len(node) * SECTORS / sectors / length.sum()).astype(int), 1)
    ring = np.repeat(np.arange(len(body)), number)
    step = np.arange(len(ring)) - np.repeat(np.cumsum(number) - number, number)
    other = first[ring] + np.floor(_GOLDEN * step % 1.0 * there[ring]).astype(int)
    place, normal = curve(fit.profile, body[ring], along[order][other])
    turn = 2 * np.pi * (step / number[ring] + _GOLDEN * ring % 1.0)  # rings' points lie between each other
    return _turned(place, normal, np.stack([np.cos(turn), np.sin(turn)], 1), axis)


def _clear_samples(
    samples: Surface, surface: Surface, own: Bool[np.ndarray, "N"]
) -> tuple[Surface, Bool[np.ndarray, "M"]]:
    """Those that lie at points of the body, and those that are far from all other points; which are the latter."""
    body, _ = cKDTree(_placed(Surface(*(part[own] for part in surface)))).query(_placed(samples))
    measured = body < PROFILE_CELL
    clear = measured.copy()
    if own.all():
        clear[:] = True
    else:
        other, _ = cKDTree(surface.points[~own]).query(samples.points)
        clear |= other > BESIDE_BODY
    return Surface(samples.points[clear], samples.normals[clear]), ~measured[clear]
