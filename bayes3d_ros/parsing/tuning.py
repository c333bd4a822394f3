# SPDX-License-Identifier: Apache-2.0

"""The numbers of the coarse search, alignment, mixture and sampler: they change how much work finds the answer, and no
posterior.

Whatever the search finds, the sampler's weights are proper: with other values a frame takes more time, or more
particles for the same precision. Constants that change the posterior itself stand in `posterior_constants.py`. "Not
recorded": nobody wrote down what the value was chosen on.
"""

from typing import NamedTuple


class SearchTuning(NamedTuple):
    """From the whole space of one object to a mixture that fits the likelihood."""

    # Surface samples over cells (`coarse_search.py`)
    cell: float = 0.02  # metres, side of a cell; not recorded
    yaws: int = 24  # a turn; not recorded
    most_cells: int = 1024  # searched, those nearest to unexplained returns first; not recorded
    # Metres of depth. Half a cell's diagonal and half a yaw step displace a point by 2 cm: a thin part then misses what
    # it belongs to.
    coarse_tolerance: float = 0.02
    coarse_penalty: float = 0.5  # of a point seen past, relative to the reward of one that matches; not recorded
    coarse_points: int = 36  # surface samples of a type; not recorded
    gathered: int = 3  # cells about a return over which returns are counted; not recorded
    fewest_unexplained: int = 8  # pixels of unexplained returns there; fewer are not searched for; not recorded
    nats_a_pixel: float = 8.0  # what a pixel explained is worth, roughly; not recorded
    # Consensus of neighbours (`neighbour_depth.py`): of 40 good returns among 200 bad ones 36 points meet too few
    many_outliers: float = 0.3  # share of the returns above which the search looks at consensus; not recorded
    consensus_reach: int = 2  # pixels; not recorded
    consensus_within: float = 0.02  # of the depth: returns of one surface; not recorded
    consensus_fewest: int = 3  # returns that make a surface; not recorded
    # Candidates (`search.py`)
    best_cells: int = 48  # of type, face and cell, whatever the type; not recorded
    quarters: int = 4  # of a turn: each of those, and the best of every type and face, at the best yaw of each
    aligned_tolerance: float = 0.01  # metres of depth, when all surface samples score what is aligned; not recorded
    aligned_penalty: float = 1.0  # then, of a point seen past, relative to the reward of one that matches; not recorded
    candidates: int = 480  # scored with the model: all of a dozen types; slivers
    candidates_a_type: int = 6  # of larger libraries, at least; slivers
    candidates_apart: tuple[float, float] = (0.008, 0.1)  # m, rad: of a type and face, nearer are copies; not recorded
    starts: int = 8  # followed uphill, beside the best of each type; not recorded
    start_types: int = 12  # types of which the best is, at most; slivers
    early_a_type: int = 4  # of each of these types, followed for a little before that; slivers
    early_draws: int = 8  # a mode and round, then; slivers
    early_rounds: int = 4  # tables of several things: the worst of eight misses 9 nats of evidence with 2, 2 with 4
    starts_apart: tuple[float, float] = (0.004, 0.05)  # m, rad, the same; not recorded
    repeated_nats: float = 4.0  # a further pose of a type at a place counts less by; mug or cup, two bricks (exactness)
    least_sigma: float = 0.002  # metres: at less, candidates a pixel beside the peak score as misses; not recorded
    worth_nats: float = 5.0  # below, no candidate is worth a search; not recorded
    # Share of a pixel's log likelihood that counts where a search scores pixels as if they erred independently: about
    # ten share an error. What was chosen here was chosen with it.
    pixel_weight: float = 0.1
    # Alignment (`alignment.py`)
    align_rounds: int = 10  # not recorded
    align_first_tolerance: float = 0.02  # metres, how far off a point may be; not recorded
    align_last_tolerance: float = 0.006  # metres; not recorded
    align_looseness: tuple[float, float, float] = (0.012, 0.012, 0.3)  # m, m, rad where no surface holds; not recorded
    aligned_residual: float = 0.015  # metres of residual that one surface sample is worth; not recorded
    # Modes and the mixture (`mode_search.py`, `proposal.py`)
    narrow_draws: int = 20  # a mode and round; not recorded
    narrow_rounds: int = 4  # not recorded
    # Of errors that pixels share: rounds in which pixels alone are scored, then draws and rounds of the model itself,
    # from modes that are wider by metres, metres, radians. Real clutter: modes of pixels alone are 5 mm off there.
    shared_rough_rounds: int = 1
    shared_draws: int = 16
    shared_rounds: int = 4
    shared_spread: tuple[float, float, float] = (0.003, 0.003, 0.04)
    shared_fit_rounds: int = 2  # as `fit_rounds`
    fit_draws: int = 24  # a mode and round, of the paraboloid; not recorded
    fit_rounds: int = 5  # not recorded
    finalists: int = 10  # modes of the mixture; slivers
    finalist_types: int = 6  # of which the best of a type each; slivers
    finalists_apart: tuple[float, float] = (0.006, 0.15)  # m, rad: of a type and face, nearer are copies; not recorded
    inflation: float = 1.5  # of a mode's covariance, as a component's; not recorded
    flatten: float = 4.0  # of the nats between modes before any pilot is drawn; not recorded
    even_share: float = 0.4  # of the first pilots, shared alike: a fit may have missed a peak that draws find
    pilot_rounds: int = 4  # at most; not recorded
    pilot_draws: int = 192  # slivers: p(type) rests on them
    pilot_ess: float = 0.2  # effective fraction of the pilots at which the mixture fits; not recorded
    # Pilots are drawn wider than the mixture (smallest ESS over six frames and six seeds 0.004 before, 0.13 after,
    # together with LATERAL): too narrow a component cannot see that it is.
    pilot_scale: float = 1.5
    trust_modes: float = 0.5  # in the pilots' word on the masses of a type's modes; mug or cup, two bricks (exactness)
    trust_types: float = 0.3  # the same on the masses of types
    smallest_spread: tuple[float, float, float] = (2e-5, 2e-5, 2e-4)  # m, m, rad, of a mode; not recorded
    largest_spread: tuple[float, float, float] = (0.05, 0.05, 2.0)  # m, m, rad; not recorded
    freedom: float = 4.0  # degrees of, of a component's Student t; not recorded
    shares: tuple[float, float, float] = (0.84, 0.12, 0.04)  # of the modes, of where something could hide, of anywhere
    shares_without_modes: tuple[float, float, float] = (0.0, 0.7, 0.3)  # the same where none is worth trying
    # The table (`support_plane.py`)
    plane_trials: int = 400  # of sample consensus; not recorded


class SamplerTuning(NamedTuple):
    """From the mixture to the posterior."""

    # The path from the proposal to the target (`smc.py`)
    draws_a_particle: int = 2  # of the proposal, before they are weighed and thinned; p(type) of slivers
    planned_levels: int = 6  # exponents; not recorded
    step_keeps: float = 0.33  # share of the effective draws that a step of the exponent keeps; not recorded
    most_levels: int = 16  # not recorded
    too_uneven: float = 0.15  # effective fraction below which a planned step is shortened; not recorded
    moves_at_target: int = 2  # once resampled there; on the way there one; not recorded
    # Moves (`mcmc_moves.py`)
    walk_lengths: tuple[float, float] = (0.05, 1.0)  # of a component's scale: peaks are of all widths; not recorded
    walk_scale: tuple[float, float, float] = (0.004, 0.004, 0.05)  # m, m, rad where no component is near; not recorded
    # Rejuvenation (`rejuvenation.py`)
    cooling: float = 0.7  # ratio of neighbouring exponents: about three quarters of the particles stay effective
    moves_when_cold: int = 3  # when all is done: one of each kind
    # The backward kernel (`backward_kernel.py`)
    last_floor: float = 0.02  # share of the kernel that is alike for all objects; not recorded


SEARCH = SearchTuning()
SAMPLER = SamplerTuning()
