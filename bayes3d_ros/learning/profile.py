# SPDX-License-Identifier: Apache-2.0

"""The profile of a body of revolution: a curve over radius and height.

Its nodes are fitted to the means of points in small cells, one in each sector of azimuth that shows the cell, so that
no side counts for more than another: quadratic regression with Cauchy weights, which a handle does not move. A node is
the body's where enough of the circle agrees with its fit and little of what is beside it does not: flat sides agree in
a few directions alone.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from bayes3d_ros.geometry.planes import SAME_SHEET
from bayes3d_ros.learning.fusion_constants import (
    AGREEING,
    ALIKE,
    AROUND,
    BESIDE_BODY,
    FACINGS,
    ONE_CURVE,
    PAST_EDGE,
    PROFILE_CELL,
    PROFILE_WIDTH,
    ROUND_WITHIN,
    SECTORS,
    UPRIGHT_TURN,
)
from bayes3d_ros.learning.segment import Surface

TERMS = 3  # of a quadratic
_ROUNDS = 8  # of reweighting: weights settle in five
_REACH = 2.0  # widths of a profile's weights: cells farther off do not count
_FEWEST_POINTS = 2  # of a cell
_AT_A_TIME = 128  # nodes, which bounds memory
_NODES = 8  # nearest to a point, among which its own is sought


class Rings(NamedTuple):
    """Points in coordinates about an axis; metres, radians."""

    place: Float[np.ndarray, "N 2"]  # radius and height
    normal: Float[np.ndarray, "N 2"]  # outward and up
    azimuth: Float[np.ndarray, "N"]
    outward: Float[np.ndarray, "N 2"]  # unit vectors away from the axis, in the table's plane
    radial: Bool[np.ndarray, "N"]  # whether the normal's plane holds the axis, nearly


class Profile(NamedTuple):
    """Height of the curve along each node's normal, c0 + c1 t + c2 t^2, t along the curve from the node, metres."""

    place: Float[np.ndarray, "P 2"]  # radius and height of each node, metres
    normal: Float[np.ndarray, "P 2"]  # unit vectors, outward and up
    terms: Float[np.ndarray, "P 3"]
    of_body: Bool[np.ndarray, "P"]
    past_edge: Bool[np.ndarray, "P"]  # nodes of the body that noise carried past its edges

    @property
    def along(self) -> Float[np.ndarray, "P 2"]:
        return np.stack([-self.normal[:, 1], self.normal[:, 0]], 1)


class _ProfileCells(NamedTuple):
    """Means of the points in cells of the profile, by facing and by sector of azimuth."""

    place: Float[np.ndarray, "C 2"]
    normal: Float[np.ndarray, "C 2"]
    sector: Int[np.ndarray, "C"]
    radial: Bool[np.ndarray, "C"]
    points: Int[np.ndarray, "C"]  # how many


def rings_about(surface: Surface, axis: Float[np.ndarray, "2"]) -> Rings:
    """Points of a surface in cylindrical coordinates about an upright axis (its x and y, metres, table frame)."""
    apart = surface.points[:, :2] - axis
    radius = np.linalg.norm(apart, axis=1)
    outward = apart / np.maximum(radius, 1e-9)[:, None]
    normals = surface.normals
    return Rings(
        np.stack([radius, surface.points[:, 2]], 1),
        np.stack([np.einsum("ni,ni->n", normals[:, :2], outward), normals[:, 2]], 1),
        np.arctan2(apart[:, 1], apart[:, 0]),
        outward,
        np.abs(normals[:, 1] * outward[:, 0] - normals[:, 0] * outward[:, 1]) < UPRIGHT_TURN,
    )


def profile_of(rings: Rings) -> Profile | None:
    """The curve that fits points all round, and which nodes of it are the body's; None where no cell holds points
    enough, or nothing goes round."""
    cells = _cells(rings)
    if not cells.radial.any():
        return None
    place, normal = _nodes(cells)
    node, cell, t, height = _pairs(place, normal, cells)
    alike = np.einsum("pi,pi->p", cells.normal[cell], normal[node])
    near = cells.radial[cell] & (np.hypot(t, height) < _REACH * PROFILE_WIDTH) & (alike > ONE_CURVE)
    terms, off = _fits(node[near], t[near], height[near], len(place))
    close = np.abs(t) < PROFILE_WIDTH
    shown = _by_sector(close, node, cell, cells, len(place))
    around = _by_sector(close & near, node, cell, cells, len(place))
    enough = (around > 0).sum(1) >= AROUND * SECTORS
    scatter = np.abs(off[(close & near)[near] & enough[node[near]]])
    if not len(scatter):
        return None
    within = float(np.clip(3 * 1.48 * np.median(scatter), *ROUND_WITHIN))
    agrees = close & near
    agrees[near] &= np.abs(off) < within
    share = (_by_sector(agrees, node, cell, cells, len(place)) / np.maximum(shown, 1)).sum(1)
    of_body = (share >= AROUND * SECTORS) & (share >= AGREEING * (shown > 0).sum(1))
    profile = Profile(place, normal, terms, of_body, np.zeros(len(place), bool))
    return profile._replace(past_edge=_past_edges(profile))


def _cells(rings: Rings) -> _ProfileCells:
    """Points whose normals' planes hold the axis and other points have cells of their own."""
    sector = np.floor((rings.azimuth / (2 * np.pi) % 1.0) * SECTORS).astype(int) % SECTORS
    cell = np.floor(rings.place / PROFILE_CELL).astype(int)
    key = np.column_stack([cell, _facing(rings.normal), rings.radial, sector])
    found, cell_of, number = np.unique(key, axis=0, return_inverse=True, return_counts=True)
    place, normal = _means(rings.place, cell_of, number), _means(rings.normal, cell_of, number)
    kept = number >= _FEWEST_POINTS
    return _ProfileCells(place[kept], _unit(normal[kept]), found[kept, -1], found[kept, -2] > 0, number[kept])


def _facing(normal: Float[np.ndarray, "N 2"]) -> Int[np.ndarray, "N"]:
    """Which of FACINGS ranges of directions, half a range off the axes, so that walls and level surfaces lie in the
    middle of theirs."""
    turn = np.arctan2(normal[:, 1], normal[:, 0]) / (2 * np.pi) * FACINGS + 0.5
    return np.floor(turn).astype(int) % FACINGS


def _unit(vectors: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 2"]:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-9)


def _nodes(cells: _ProfileCells) -> tuple[Float[np.ndarray, "P 2"], Float[np.ndarray, "P 2"]]:
    """Places and unit normals, each the mean of those of one cell in all sectors."""
    place, normal = cells.place[cells.radial], cells.normal[cells.radial]
    key = np.column_stack([np.floor(place / PROFILE_CELL).astype(int), _facing(normal)])
    _, node_of, number = np.unique(key, axis=0, return_inverse=True, return_counts=True)
    return _means(place, node_of, number), _unit(_means(normal, node_of, number))


def _means(
    values: Float[np.ndarray, "N 2"], group: Int[np.ndarray, "N"], number: Int[np.ndarray, "G"]
) -> Float[np.ndarray, "G 2"]:
    return np.stack([np.bincount(group, column, len(number)) for column in values.T], 1) / number[:, None]


def _pairs(
    place: Float[np.ndarray, "P 2"], normal: Float[np.ndarray, "P 2"], cells: _ProfileCells
) -> tuple[Int[np.ndarray, "K"], Int[np.ndarray, "K"], Float[np.ndarray, "K"], Float[np.ndarray, "K"]]:
    """Rows of nodes, and of the cells about each that face as it does, in order of the nodes; how far the cell lies
    along and above the node, metres."""
    tree = cKDTree(cells.place)
    found = []
    for start in range(0, len(place), _AT_A_TIME):
        own = slice(start, start + _AT_A_TIME)
        near = tree.query_ball_point(place[own], BESIDE_BODY)
        node = start + np.repeat(np.arange(len(near)), [len(each) for each in near])
        cell = np.concatenate(near).astype(int)
        facing = np.einsum("pi,pi->p", cells.normal[cell], normal[node]) > ALIKE
        node, cell = node[facing], cell[facing]
        apart = cells.place[cell] - place[node]
        t = apart[:, 1] * normal[node, 0] - apart[:, 0] * normal[node, 1]
        height = np.einsum("pi,pi->p", apart, normal[node])
        beside = (np.abs(t) < PROFILE_WIDTH) | (np.hypot(t, height) < _REACH * PROFILE_WIDTH)
        found.append((node[beside], cell[beside], t[beside], height[beside]))
    node, cell, t, height = (np.concatenate(part) for part in zip(*found, strict=True))
    return node, cell, t, height


def _fits(
    node: Int[np.ndarray, "K"], t: Float[np.ndarray, "K"], height: Float[np.ndarray, "K"], count: int
) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, "K"]]:
    """Quadratics of heights over t about each node, and how far each height lies off its own node's."""
    scale = PROFILE_WIDTH ** np.arange(TERMS)
    powers = np.stack([(t / PROFILE_WIDTH) ** k for k in range(TERMS)], 1)
    nearby = np.exp(-(powers[:, 1] ** 2) / 2)
    terms, off = np.zeros((count, TERMS)), height
    scatter = ROUND_WITHIN[0]
    for _ in range(_ROUNDS):
        weight = nearby / (1 + (off / scatter) ** 2)
        moments, towards = np.empty((count, TERMS, TERMS)), np.empty((count, TERMS))
        for i in range(TERMS):
            towards[:, i] = np.bincount(node, weight * powers[:, i] * height, count)
            for j in range(TERMS):
                moments[:, i, j] = np.bincount(node, weight * powers[:, i] * powers[:, j], count)
        moments += (1e-3 * moments[:, 0, 0] + 1e-12)[:, None, None] * np.diag([0.0, 1.0, 1.0])
        moments[:, 0, 0] += 1e-12
        terms = np.linalg.solve(moments, towards[..., None])[..., 0]
        off = height - np.einsum("pi,pi->p", powers, terms[node])
    return terms / scale, off


def _by_sector(
    taken: Bool[np.ndarray, "K"],
    node: Int[np.ndarray, "K"],
    cell: Int[np.ndarray, "K"],
    cells: _ProfileCells,
    count: int,
) -> Float[np.ndarray, "P S"]:
    """Points in the cells of those pairs of a node and a cell that are taken, by sector of azimuth."""
    key = node[taken] * SECTORS + cells.sector[cell[taken]]
    return np.bincount(key, cells.points[cell[taken]], count * SECTORS).reshape(count, SECTORS)


def _past_edges(profile: Profile) -> Bool[np.ndarray, "P"]:
    """Nodes that lie above another side of the body, where most of their own side about them lies below that."""
    body = np.flatnonzero(profile.of_body)
    place, normal = curve(profile, body, np.zeros(len(body)))
    past_edge = np.zeros(len(profile.place), bool)
    near = cKDTree(place).query_ball_point(place, _REACH * PROFILE_WIDTH)
    for own, others in zip(body, near, strict=True):
        apart = place[others] - profile.place[own]
        along = apart @ profile.along[own]
        above = apart @ profile.normal[own] - (along[:, None] ** np.arange(TERMS)) @ profile.terms[own]
        facing = normal[others] @ profile.normal[own]
        side = (facing < ALIKE) & (facing > SAME_SHEET)
        together = (normal[others] @ normal[others].T > ONE_CURVE) & side
        mostly = together @ above / np.maximum(together.sum(1), 1)
        past = side & (np.abs(along) < PROFILE_WIDTH) & (above > PAST_EDGE) & (mostly < 0)
        past_edge[body[np.array(others)[past]]] = True
    return past_edge


def own_nodes(rings: Rings, profile: Profile) -> Int[np.ndarray, "N"]:
    """Of every point the row of the nearest node of the body that faces as it does; -1 where none is near it, or noise
    carried that past an edge."""
    body = np.flatnonzero(profile.of_body)
    count = min(_NODES, len(body))
    far, found = cKDTree(profile.place[body]).query(rings.place, k=list(range(1, count + 1)))
    node = np.full(len(rings.place), -1)
    for column in range(count):
        candidate = body[found[:, column]]
        alike = np.einsum("ni,ni->n", rings.normal, profile.normal[candidate]) > ONE_CURVE
        taken = (node < 0) & rings.radial & alike & (far[:, column] < PROFILE_WIDTH)
        node[taken] = candidate[taken]
    return np.where(profile.past_edge[node], -1, node)


def curve(
    profile: Profile, node: Int[np.ndarray, "N"], t: Float[np.ndarray, "N"]
) -> tuple[Float[np.ndarray, "N 2"], Float[np.ndarray, "N 2"]]:
    """Radius and height (metres) and unit normals of points on the curves of these nodes, t metres along the curve from
    the node."""
    c, normal, along = profile.terms[node], profile.normal[node], profile.along[node]
    height, slope = c[:, 0] + c[:, 1] * t + c[:, 2] * t**2, c[:, 1] + 2 * c[:, 2] * t
    return profile.place[node] + t[:, None] * along + height[:, None] * normal, _unit(normal - slope[:, None] * along)
