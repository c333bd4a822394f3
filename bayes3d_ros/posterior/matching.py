# SPDX-License-Identifier: Apache-2.0

"""Which objects of different scene samples are the same object."""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment

SAME_TYPE_REACH = 0.2  # metres between the centres of two objects of one type that may be the same object
OTHER_TYPE_REACH = 0.1  # the same for two types, where their sizes are not known
SAME_TYPE_GAIN = 1e3  # same type first, then as many matches as possible, then distance


def match_costs(
    centre: Float[np.ndarray, "*batch 3"],
    type_: Int[np.ndarray, "*batch"],
    other_centre: Float[np.ndarray, "R 3"],
    other_type: Int[np.ndarray, "R"],
    radius: Float[np.ndarray, "T"] | None,
) -> Float[np.ndarray, "*batch R"]:
    """Cost of taking two objects for the same: negative where they may be (no match costs 0), infinite where they
    may not."""
    distance = np.linalg.norm(centre[..., None, :] - other_centre, axis=-1)
    same = type_[..., None] == other_type
    other_reach = OTHER_TYPE_REACH if radius is None else radius[type_][..., None] + radius[other_type]
    possible = (distance < np.where(same, SAME_TYPE_REACH, other_reach)) & (type_[..., None] >= 0)
    return np.where(possible, distance - np.where(same, SAME_TYPE_GAIN, 1.0), np.inf)


def match(costs: Float[np.ndarray, "S M R"]) -> Int[np.ndarray, "S M"]:
    """For every sample, the assignment of its objects to the R reference objects with the smallest total cost; -1:
    none."""
    samples, slots, references = costs.shape
    if references == 0 or slots == 0:
        return np.full((samples, slots), -1)
    assigned = np.where(costs.min(-1) < 0, costs.argmin(-1), -1)
    # If every object's own best choice is free, this is the optimum; only other samples need a solver.
    ordered = np.sort(np.where(assigned < 0, -1 - np.arange(slots), assigned), axis=1)
    for s in np.flatnonzero((ordered[:, 1:] == ordered[:, :-1]).any(1)):
        padded = np.concatenate([costs[s].clip(max=1.0), np.zeros((slots, slots))], 1)
        chosen = linear_sum_assignment(padded)[1]
        assigned[s] = np.where(chosen < references, chosen, -1)
    return assigned


def same_objects(
    centre: Float[np.ndarray, "S M 3"],
    type_: Int[np.ndarray, "S M"],
    weights: Float[np.ndarray, "S"],
    reference: int,
    radius: Float[np.ndarray, "T"] | None = None,
) -> Int[np.ndarray, "S M"]:
    """An index for every object; equal indices mean the same object, -1 an empty slot.

    The objects of the reference sample have the indices of their slots. Objects that match none of them have
    indices from M on, one for each group of objects that match each other. Groups are formed around the heaviest
    remaining object, one after the other.
    """
    samples, slots = type_.shape
    costs = match_costs(centre, type_, centre[reference], type_[reference], radius)
    costs[..., type_[reference] < 0] = np.inf
    index = match(costs)
    index[reference] = np.where(type_[reference] >= 0, np.arange(slots), -1)

    left: Bool[np.ndarray, "S M"] = (type_ >= 0) & (index < 0)
    if not left.any():
        return index
    # Heaviest first; the order of equal weights does not depend on the order of samples and slots.
    where = np.flatnonzero(left)
    place = centre.reshape(-1, 3)[where]
    keys = (place[:, 2], place[:, 1], place[:, 0], type_.ravel()[where], -np.repeat(weights, slots)[where])
    queue = where[np.lexsort(keys)]
    following = slots
    while queue.size:
        seed = queue[0]
        row = np.unravel_index(seed, left.shape)
        costs = match_costs(
            centre.reshape(-1, 3)[queue], type_.ravel()[queue], centre[row][None], type_[row][None], radius
        )[:, 0]
        # At most one object of each sample: its cheapest.
        order = np.lexsort((costs, queue // slots))
        first = np.concatenate([[True], np.diff(queue[order] // slots) > 0])
        chosen = order[first & (costs[order] < 0)]
        index.ravel()[queue[chosen]] = following
        queue = np.delete(queue, chosen)
        following += 1
    return index
