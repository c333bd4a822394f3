# SPDX-License-Identifier: Apache-2.0

"""Groups weighted poses into modes. The number of modes is found, not given.

A mode is a peak of the poses' density together with everything that flows up to it (topological mode analysis: Chazal
et al. 2013, "Persistence-based clustering in Riemannian manifolds"). The density is estimated with a Gaussian kernel of
standard deviations `REACH_ANGLE` and `REACH_DISTANCE`. Two peaks are two modes if the density between them falls below
1 / `VALLEY` of the lower peak. So narrow peaks are separated from about four kernel widths on (33 degrees, 4 cm), an
arc or a full ring of yaw is one wide mode, and a thin bridge of stray samples joins nothing. Few samples of a wide
posterior would make a peak each: so the kernel widens with the spacing of the samples until, for most of the weight, it
holds `NEIGHBOURS` effective ones.

Sums over pairs use einsum: for matrices this small, waking BLAS's threads costs more than it saves.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_array
from scipy.sparse.csgraph import minimum_spanning_tree

REACH_ANGLE = np.radians(8.0)  # the kernel's standard deviation in rotation ...
REACH_DISTANCE = 0.01  # ... and in metres
VALLEY = 4.0  # two peaks are two modes if the lower is this many times as dense as the pass between them
NEIGHBOURS = 8.0  # effective samples that the kernel must hold, or ...
SHARE = 1 / 6  # ... this share of the weight: six single poses may be six modes
SPARSE = 0.2  # share of the weight for which the kernel may hold fewer
NEGLIGIBLE_SHARE = 0.02  # weight of a mode that is not worth listing
DENSE = 0.5  # the medoid of a mode lies where it is at least this much as dense as at its peak
MOST_NODES = 256  # if more poses differ, this many stand for all


class Nodes(NamedTuple):
    """Distinct poses that stand for all N: their indices [K], the weight [K] that each stands for, their squared
    distances [K, K] in kernel widths, and the node [N] of every pose."""

    pose: Int[np.ndarray, "K"]
    weight: Float[np.ndarray, "K"]
    distance2: Float[np.ndarray, "K K"]
    owner: Int[np.ndarray, "N"]


def distances2(
    position: Float[np.ndarray, "N 3"],
    quaternion: Float[np.ndarray, "N 4"],
    other_position: Float[np.ndarray, "K 3"],
    other_quaternion: Float[np.ndarray, "K 4"],
) -> Float[np.ndarray, "N K"]:
    """Squared distances between poses: rotation angle and distance, each in kernel widths."""
    apart2 = sum(np.square(position[:, None, axis] - other_position[:, axis]) for axis in range(3))
    angle = 2 * np.arccos(np.abs(np.einsum("nq,kq->nk", quaternion, other_quaternion)).clip(max=1.0))
    return np.square(angle / REACH_ANGLE) + apart2 / REACH_DISTANCE**2


def nodes(
    position: Float[np.ndarray, "N 3"], quaternion: Float[np.ndarray, "N 4"], weights: Float[np.ndarray, "N"]
) -> Nodes:
    """Distinct poses: equal ones are one node. If more than MOST_NODES differ, poses are picked one by one, each
    the farthest from those already picked, until every pose is within a quarter of a kernel width of a picked one."""
    rows = np.concatenate([position, quaternion], 1)
    _, index, owner = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    owner = owner.ravel()
    if len(index) > MOST_NODES:
        mean_quaternion = np.linalg.eigh((quaternion * weights[:, None]).T @ quaternion)[1][:, -1:]
        mean_position = weights @ position / weights.sum()
        chosen = int(np.argmin(_chords2(position, quaternion, mean_position, mean_quaternion[:, 0])))
        nearest, owner, index = np.full(len(rows), np.inf), np.zeros(len(rows), int), index[:0]
        while len(index) < MOST_NODES and nearest.max() > 0.25**2:
            reach = _chords2(position, quaternion, position[chosen], quaternion[chosen])
            owner[reach < nearest] = len(index)
            index = np.append(index, chosen)
            nearest = np.minimum(nearest, reach)
            chosen = int(np.argmax(nearest))
    distance2 = distances2(position[index], quaternion[index], position[index], quaternion[index])
    return Nodes(index, np.bincount(owner, weights, len(index)), distance2, owner)


def _chords2(
    position: Float[np.ndarray, "N 3"],
    quaternion: Float[np.ndarray, "N 4"],
    other_position: Float[np.ndarray, "3"],
    other_quaternion: Float[np.ndarray, "4"],
) -> Float[np.ndarray, "N"]:
    """As `distances2` to one pose, with chords in place of angles: faster, and equal for small angles."""
    chord2 = 2 - 2 * np.abs(np.einsum("nq,q->n", quaternion, other_quaternion))
    apart2 = np.square(position - other_position).sum(1)
    return chord2.clip(0.0) * (2 / REACH_ANGLE) ** 2 + apart2 / REACH_DISTANCE**2


def kernel_width(nodes: Nodes) -> float:
    """The smallest width of 1, 1.25, 1.25^2, ... kernels at which, for most of the weight, enough lies within one
    width: NEIGHBOURS effective samples, or SHARE of the weight. Samples are counted where they lie: a light peak may
    hold enough of them, though a few samples elsewhere outweigh it."""
    weight = nodes.weight / nodes.weight.sum()
    width = 1.0
    while True:
        near = nodes.distance2 <= width**2
        held = np.einsum("ij,j->i", near, weight)
        samples = np.square(held) / np.einsum("ij,j->i", near, np.square(weight))
        few = (samples < NEIGHBOURS - 1e-6) & (held < SHARE - 1e-9)
        if weight[few].sum() <= SPARSE:
            return width
        width *= 1.25


def peaks(nodes: Nodes) -> Int[np.ndarray, "K"]:
    """A label for every node; equal ones flow up to the same peak."""
    count = len(nodes.weight)
    scaled = nodes.distance2 / kernel_width(nodes) ** 2
    half = np.exp(-scaled / 4)
    density = np.einsum("ij,ij,j->i", half, half, nodes.weight)
    # The ways that may lead over the highest passes, first by an estimate: a pair alone has exp(-d^2 / 8) midway.
    # Between poses nearer than four widths no other peak hides beside the middle.
    first, second = np.nonzero(np.triu(scaled < 16, 1))
    descent = scaled[first, second] / 8 - np.log(np.minimum(density[first], density[second]) / density.max()) + 1e-9
    tree = minimum_spanning_tree(csr_array((descent, (first, second)), shape=(count, count))).tocoo()
    first, second = tree.row, tree.col
    # The density midway between two poses follows from distances alone (Apollonius' theorem; SO(3) is flat enough at a
    # few kernel widths).
    midway = np.einsum("ej,ej,j->e", half[first], half[second], nodes.weight) * np.exp(scaled[first, second] / 8)
    passes = np.minimum(midway, np.minimum(density[first], density[second]))
    order = np.argsort(-passes, kind="stable")
    peak = list(range(count))  # a higher node on the way to the peak; itself at a peak
    for a, b, height in zip(first[order].tolist(), second[order].tolist(), passes[order].tolist(), strict=True):
        low, high = sorted((_follow(peak, a), _follow(peak, b)), key=lambda node: density[node])
        if density[low] < VALLEY * height:
            peak[low] = high
    return np.array([_follow(peak, node) for node in range(count)])


def _follow(peak: list[int], node: int) -> int:
    while peak[node] != node:
        peak[node] = node = peak[peak[node]]
    return node


def medoid(nodes: Nodes) -> int:
    """Index of the pose with the smallest mean squared distance from all poses, among the poses in dense places."""
    kernel = np.exp(-nodes.distance2 / (2 * kernel_width(nodes) ** 2))
    density, spread = (np.einsum("ij,j->i", pairs, nodes.weight) for pairs in (kernel, nodes.distance2))
    cost = np.where(density >= DENSE * density.max(), spread, np.inf)
    return int(nodes.pose[np.argmin(cost)])


def mode_labels(
    position: Float[np.ndarray, "N 3"],
    quaternion: Float[np.ndarray, "N 4"],
    weights: Float[np.ndarray, "N"],
    face: Int[np.ndarray, "N"],
) -> Int[np.ndarray, "N"]:
    """The mode of every pose: 0 for the heaviest mode. Poses that are left out have -1 if they weigh next to
    nothing themselves, and -2, -3, ... if their mode is too light.

    Poses on different contact faces (they differ by 90 degrees or more) are in different modes. Modes lighter than
    NEGLIGIBLE_SHARE are merged into one more mode if together they reach that share; otherwise their poses are left
    out.
    """
    labels = np.full(len(weights), -1)
    counts = len(weights) * weights / weights.sum() >= NEGLIGIBLE_SHARE / 2  # lighter ones are together less than 1 %
    groups = 0
    for side in np.unique(face[counts]):
        own = np.flatnonzero(counts & (face == side))
        lead = own[[np.argmax(weights[own])]]
        if (distances2(position[own], quaternion[own], position[lead], quaternion[lead]) < 1.5**2).all():
            labels[own] = groups  # by far the most frequent case: narrower than two peaks could be
        else:
            found = nodes(position[own], quaternion[own], weights[own])
            labels[own] = groups + np.unique(peaks(found), return_inverse=True)[1].ravel()[found.owner]
        groups = int(labels.max()) + 1
    share = np.bincount(labels + 1, weights, groups + 1)[1:] / weights.sum()
    light = np.flatnonzero(share < NEGLIGIBLE_SHARE)
    rest = np.isin(labels, light)
    if weights[rest].sum() >= NEGLIGIBLE_SHARE * weights.sum():
        labels[rest] = groups
        share = np.append(np.where(share < NEGLIGIBLE_SHARE, 0.0, share), weights[rest].sum() / weights.sum())
    rank = np.full(len(share) + 1, -1)
    rank[np.argsort(-share, kind="stable")] = np.arange(len(share))
    rank[light] = -2 - np.arange(len(light))
    return rank[labels]
