# SPDX-License-Identifier: Apache-2.0

"""What tracking is tuned by: constants that change how much work finds the camera, and not where it is.

The filter's weights are proper whatever its search finds. Constants that change the posterior stand in
`posterior_constants.py`. "Not recorded": nobody wrote down what the value was chosen on.
"""

from typing import NamedTuple

_Six = tuple[float, float, float, float, float, float]  # metres three times, then radians


class FilterTuning(NamedTuple):
    """Of the filter and its search (`marginal_filter.py`)."""

    # Metres of sigma at least, round by round: before alignment, and after; not recorded.
    blurs: tuple[float, ...] = (0.012, 0.003, 0.001, 0.0, 0.0)
    round_share: float = 0.1  # of the hypotheses, each round; not recorded
    starts: int = 2  # of alignment; not recorded
    least_outliers: float = 0.02  # p_outlier while searching: with less, one bad pixel decides; not recorded
    # Metres: residuals beyond count little, step by step; not recorded.
    reaches: tuple[float, ...] = (0.03, 0.015, 0.006, 0.003, 0.0015, 0.0008)
    least_reach: tuple[float, float] = (4.0, 0.003)  # but none so small, in sigmas and at most in metres; not recorded
    # Pixels across, at most, of the images that alignment looks at: with more it is surer than voxels allow. The clamp
    # of `evaluate camera-tracking` was 0.05 cm off at 100 x 100; with 64 0.17-0.24 cm (four seeds), with 100 0.6 cm.
    aligned_width: int = 34
    keep: float = 0.1  # share of a round's draws that stay effective when they are weighed; not recorded
    widen: float = 1.2  # of the scale learned from a round, for the next; not recorded
    freedom: float = 5.0  # degrees of, of the proposal's Student t; not recorded
    from_motion: float = 0.1  # share of the filter's draws that come from the predictive; not recorded
    narrowest: _Six = (1e-5, 1e-5, 1e-5, 2e-5, 2e-5, 2e-5)  # metres and radians, of a proposal; not recorded
    # Of the particles, that draws may have moved from: with all 844 of 2,048 hypotheses the pairs cost more than the
    # images did.
    ancestors: int = 32
    # Coarse sigmas that draws are scored at: of pixels there are enough to tell sigma to a tenth.
    noise_levels: int = 3
    # Noise between coarse points (`tracker.py`): images this small tell it to a few percent at best.
    noise_between: tuple[int, int] = (6, 4)


class RelocaliseTuning(NamedTuple):
    """Of finding a camera of which one frame is all there is (`relocalise.py`, and `tracker.py` for the table). Checked
    on `bags/moving_camera`: it was found in each of the ten frames alone."""

    draws: int = 8192  # a power of two; not recorded
    aligned: int = 96  # of them; not recorded
    apart: tuple[float, float] = (0.1, 0.3)  # share of the distance, rad: nearer in both count as one; not recorded
    reaches: tuple[float, ...] = (0.05, 0.05, 0.05, 0.03, 0.03, 0.02, 0.015, 0.01, 0.006)  # metres; not recorded
    scale: _Six = (0.1, 0.1, 0.1, 0.3, 0.3, 0.3)  # metres and radians that alignment may move a camera; not recorded
    beside: float = 0.25  # metres that the target may be beside the optical axis, over a table; not recorded
    level: float = 0.05  # sine of the angle below which a camera looks along the table, not at it; not recorded
    rough_sigma: float = 0.02  # metres, before alignment; not recorded
    fine_sigma: float = 0.006  # metres, after; not recorded
    p_outlier: float = 0.1  # not recorded
    widest: int = 64  # pixels across, at most, of the image that is looked at; not recorded
    plane_width: int = 160  # pixels across, of the image that the table is found in; not recorded


FILTER = FilterTuning()
RELOCALISE = RelocaliseTuning()
