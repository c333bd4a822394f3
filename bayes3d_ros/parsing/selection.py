# SPDX-License-Identifier: Apache-2.0

"""Which hypotheses the search keeps at a level: near-copies are dropped, and types come before places, so that what is
seen best crowds out neither another type nor another place (docs/decisions/005-search.md)."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from bayes3d_ros.objects.library_arrays import LibraryArrays
from bayes3d_ros.objects.placement import Placement
from bayes3d_ros.parsing.mode_search import Hypotheses, best_first
from bayes3d_ros.parsing.proposal import wrap
from bayes3d_ros.parsing.tuning import SEARCH

_CROWDED_OUT_NATS = 1e6  # more than any two gains differ by: hypotheses lowered by this come last


def distinct(placement: Placement, score: Float[Array, "N"], near: tuple[float, float]) -> Float[Array, "N"]:
    """Scores, with -inf for near-copies of a better hypothesis. Hypotheses are sorted by falling score."""
    same = (placement.type[:, None] == placement.type) & (placement.face[:, None] == placement.face)
    close = jnp.hypot(placement.x[:, None] - placement.x, placement.y[:, None] - placement.y) < near[0]
    close &= jnp.abs(wrap(placement.yaw[:, None] - placement.yaw)) < near[1]
    better = jnp.tril(same & close, -1)
    return jnp.where(better.any(1), -jnp.inf, score)


def _apart(placement: Placement, score: Float[Array, "N"], library: LibraryArrays, most: int) -> Float[Array, "N"]:
    """Scores, lowered for all but the `most` best hypotheses of a place, which come after all others.

    Within a place, each hypothesis is also lowered by `repeated_nats` for every better one of its type. So what is
    seen best crowds out neither objects elsewhere nor another type of a few per cent. Hypotheses are sorted by
    falling score.
    """
    apart = jnp.hypot(placement.x[:, None] - placement.x, placement.y[:, None] - placement.y)
    close = apart < library.radius[placement.type]
    before = jnp.tril(close & jnp.isfinite(score), -1)
    same = before & (placement.type[:, None] == placement.type)
    score = score - SEARCH.repeated_nats * same.sum(1)
    return jnp.where(before.sum(1) < most, score, score - _CROWDED_OUT_NATS)


def best_of_types(type_id: Int[Array, "N"], score: Float[Array, "N"], each: int, most_types: int) -> Bool[Array, "N"]:
    """Which hypotheses are among the `each` best of their type, for the `most_types` types with the best best
    hypothesis. A few returns may belong to any type, and many poses of one type must not crowd out the others."""
    better = (score[:, None] < score) | ((score[:, None] == score) & jnp.tril(jnp.ones((len(score),) * 2, bool), -1))
    same = type_id[:, None] == type_id
    best_of_type = ~(better & same).any(1)
    types_before = (better & best_of_type).sum(1)  # of a type's best: how many other types are better
    rank_of_type = jnp.where(same & best_of_type, types_before, 0).sum(1)
    return jnp.isfinite(score) & ((better & same).sum(1) < each) & (rank_of_type < most_types)


def chosen_first(
    found: Hypotheses, score: Float[Array, "N"], chosen: Bool[Array, "N"], count: int
) -> tuple[Hypotheses, Float[Array, "C"]]:
    """The `count` best hypotheses, those that are chosen before all others. Scores of the chosen ones are raised."""
    return best_first(found, score + jnp.where(chosen, _CROWDED_OUT_NATS, 0.0), count)


def types_first(
    modes: Hypotheses,
    value: Float[Array, "N"],
    near: tuple[float, float],
    of_types: tuple[int, int],
    others: int,
    library: LibraryArrays,
) -> Hypotheses:
    """The best `each` of `types` types, those with the best best hypothesis, and `others` more of any type. near:
    metres and radians within which two hypotheses of a type and face are copies. Hypotheses are sorted by falling
    value."""
    each, types = of_types
    value = distinct(modes.placement, value, near)
    first = best_of_types(modes.placement.type, value, each, types)
    value = _apart(modes.placement, value, library, others * 3 // 4)
    return chosen_first(modes, value, first, others + each * types)[0]


def together(
    modes: Hypotheses, value: Float[Array, "N"], others: Hypotheses, of_others: Float[Array, "M"]
) -> tuple[Hypotheses, Float[Array, "NM"]]:
    """Two lists as one, by falling value."""
    both = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), modes, others)
    value = jnp.concatenate([value, of_others])
    return best_first(both, value, len(value))
