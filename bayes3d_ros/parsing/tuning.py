# SPDX-License-Identifier: Apache-2.0

"""The numbers of the coarse search, alignment, mixture and sampler. They change how much work finds the answer, and not
the posterior.

Whatever the search finds, the sampler's weights are proper: with other values a frame takes more time, or more
particles for the same precision. Constants that change the posterior itself are in `posterior_constants.py`.

The end of a comment says on what a value was chosen: "slivers" are the scenes of `bayes3d evaluate planted --quick`,
"exactness" the problems of that experiment; "not recorded": nobody wrote it down.
"""

from typing import NamedTuple


class SearchTuning(NamedTuple):
    """From the whole space of one object to a mixture that fits the likelihood."""

    # Surface samples over cells (`coarse_search.py`)
    cell: float = 0.02  # metres, side of a cell; not recorded
    yaws: int = 24  # steps of yaw in a full turn; not recorded
    most_cells: int = 1024  # cells that are scored, nearest to unexplained returns first; not recorded
    # Metres of depth. Half a cell's diagonal and half a yaw step displace a sample by 2 cm: with less, samples of a
    # thin part miss its returns.
    coarse_tolerance: float = 0.02
    coarse_penalty: float = 0.5  # of a sample that the camera sees past; one that matches gains 1; not recorded
    coarse_points: int = 36  # surface samples of a type; not recorded
    gathered: int = 3  # cells either way over which the returns about a cell are counted; not recorded
    # Pixels of unexplained returns in these cells from which they are searched; not recorded.
    fewest_unexplained: int = 8
    # Metres in front of the scene that noise explains at most; three times the default `sigma_max`. Chosen on seed 0 of
    # `noise-ablation`: at a sigma of 24 mm 53 % of 19 types were right without it, 89 % with it.
    widest_noise: float = 0.015
    nats_a_pixel: float = 8.0  # rough gain of an explained pixel; not recorded
    # Consensus of neighbours (`neighbour_depth.py`): of 40 good returns among 200 bad ones 36 points meet too few
    many_outliers: float = 0.3  # share of the returns above which the search looks at consensus; not recorded
    consensus_reach: int = 2  # pixels; not recorded
    consensus_within: float = 0.02  # of the depth: returns of one surface; not recorded
    consensus_fewest: int = 3  # returns that make a surface; not recorded
    # Candidates (`search.py`)
    best_cells: int = 48  # best (type, face, cell), of any type; not recorded
    quarters: int = 4  # parts of a turn: each of these cells is tried at the best yaw of every part; slivers
    aligned_tolerance: float = 0.01  # metres of depth, when all samples score aligned hypotheses; not recorded
    aligned_penalty: float = 1.0  # likewise, of a sample that the camera sees past; not recorded
    candidates: int = 480  # hypotheses scored with the model: enough for a dozen types; slivers
    candidates_a_type: int = 6  # candidates of each type, at least, in larger libraries; slivers
    candidates_apart: tuple[float, float] = (0.008, 0.1)  # m, rad: of a type and face, nearer are copies; not recorded
    starts: int = 8  # hypotheses of any type followed uphill, beside the best of each type; not recorded
    start_types: int = 12  # types of which the best hypothesis is followed, at most; slivers
    early_a_type: int = 4  # hypotheses of each of these types followed for a few rounds first; slivers
    early_draws: int = 8  # draws for each mode and round of these; slivers
    early_rounds: int = 4  # tables of several things: the worst of eight misses 9 nats of evidence with 2, 2 with 4
    # Types of which the best is turned all around, and turns kept for each, on the whole: a mug in plain view
    # (three_objects) was missed at its yaw, by 60 nats, with two seeds of four.
    turned_types: int = 6
    turns_kept: int = 2
    turned_rounds: int = 3  # in which these are followed by a model of shared errors
    starts_apart: tuple[float, float] = (0.004, 0.05)  # m, rad: as candidates_apart; not recorded
    # Subtracted for each better pose of the type at a place; mug or cup, two bricks (exactness).
    repeated_nats: float = 4.0
    least_sigma: float = 0.002  # metres: with less, candidates one pixel off the peak score as misses; not recorded
    worth_nats: float = 5.0  # gain of the best candidate below which nothing is searched; not recorded
    # Factor on a pixel's log likelihood where the search scores pixels as if they erred independently: about ten share
    # an error. Other values here were chosen with it.
    pixel_weight: float = 0.1
    # Alignment (`alignment.py`)
    align_rounds: int = 10  # not recorded
    align_first_tolerance: float = 0.02  # metres, how far off a point may be; not recorded
    align_last_tolerance: float = 0.006  # metres; not recorded
    align_looseness: tuple[float, float, float] = (
        0.012,
        0.012,
        0.3,
    )  # m, m, rad: standard deviations where no surface constrains; not recorded
    aligned_residual: float = 0.015  # metres of residual that one surface sample is worth; not recorded
    # Modes and the mixture (`mode_search.py`, `proposal.py`)
    narrow_draws: int = 20  # draws for each mode and round; not recorded
    narrow_rounds: int = 4  # not recorded
    # Under shared errors: rounds that score pixels alone, then draws and rounds with the full model, from modes widened
    # by m, m, rad. In real clutter, modes of pixels alone are 5 mm off.
    shared_rough_rounds: int = 1
    shared_draws: int = 16
    shared_rounds: int = 4
    shared_spread: tuple[float, float, float] = (0.003, 0.003, 0.04)
    shared_fit_rounds: int = 2  # as `fit_rounds`
    fit_draws: int = 24  # draws for each mode and round of the paraboloid; not recorded
    fit_rounds: int = 5  # not recorded
    # Modes that become components of the mixture; slivers, and the yaws of a hidden handle (moving_camera).
    finalists: int = 14
    finalist_types: int = 6  # of these, how many are the best of their types; slivers
    finalists_apart: tuple[float, float] = (0.006, 0.15)  # m, rad: of a type and face, nearer are copies; not recorded
    inflation: float = 1.5  # factor from a mode's covariance to its component's; not recorded
    flatten: float = 4.0  # divisor of the nats between modes before the first pilots; not recorded
    even_share: float = 0.4  # share of the first pilots that is divided evenly: a fit may miss a peak that draws find
    pilot_rounds: int = 4  # at most; not recorded
    pilot_draws: int = 192  # draws in a round; p(type) of slivers depends on them
    pilot_ess: float = 0.2  # effective fraction of the pilots at which the mixture fits; not recorded
    # Pilots are drawn wider than the mixture (smallest ESS over six frames and six seeds 0.004 before, 0.13 after,
    # together with LATERAL): too narrow a component cannot see that it is.
    pilot_scale: float = 1.5
    # Exponent on the masses of a type's modes, as pilots estimate them; mug or cup, two bricks (exactness).
    trust_modes: float = 0.5
    trust_types: float = 0.3  # exponent on the masses of types; likewise
    smallest_spread: tuple[float, float, float] = (2e-5, 2e-5, 2e-4)  # m, m, rad, of a mode; not recorded
    largest_spread: tuple[float, float, float] = (0.05, 0.05, 2.0)  # m, m, rad; not recorded
    freedom: float = 4.0  # degrees of freedom of a component's Student t; not recorded
    shares: tuple[float, float, float] = (
        0.84,
        0.12,
        0.04,
    )  # of modes, of cells where an object could hide, of the prior
    shares_without_modes: tuple[float, float, float] = (0.0, 0.7, 0.3)  # likewise, without a candidate worth a search
    # The table (`support_plane.py`)
    plane_trials: int = 400  # of sample consensus; not recorded


class SamplerTuning(NamedTuple):
    """From the mixture to the posterior."""

    # The path from the proposal to the target (`smc.py`)
    draws_a_particle: int = 2  # draws of the proposal for each particle, before thinning; p(type) of slivers
    planned_levels: int = 6  # exponents planned by pilots; not recorded
    step_keeps: float = 0.33  # share of the effective draws that a step of the exponent keeps; not recorded
    most_levels: int = 16  # not recorded
    too_uneven: float = 0.15  # effective fraction below which a planned step is shortened; not recorded
    moves_at_target: int = 2  # MCMC moves after resampling at the target; one at other exponents; not recorded
    # Moves (`mcmc_moves.py`)
    walk_lengths: tuple[float, float] = (0.05, 1.0)  # of a component's scale: peaks are of all widths; not recorded
    walk_scale: tuple[float, float, float] = (0.004, 0.004, 0.05)  # m, m, rad where no component is near; not recorded
    # Rejuvenation (`rejuvenation.py`)
    cooling: float = 0.7  # ratio of neighbouring exponents: about three quarters of the particles stay effective
    moves_when_cold: int = 3  # MCMC moves at b = 1 at the end: one of each kind
    # The backward kernel (`backward_kernel.py`)
    last_floor: float = 0.02  # share of the kernel that is uniform over the objects; not recorded


SEARCH = SearchTuning()
SAMPLER = SamplerTuning()
