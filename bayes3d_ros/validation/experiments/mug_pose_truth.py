# SPDX-License-Identifier: Apache-2.0

"""Test images of the mug-pose experiment, their exact posteriors, and what a row says of them."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayes3d_ros.validation.experiments import Row
from bayes3d_ros.validation.networks import von_mises
from bayes3d_ros.validation.reference.exact_yaw import entropy, every_yaw, yaw_axis, yaw_posterior
from bayes3d_ros.validation.simulate.mug_images import MUG_CONDITIONS, MugImages, UprightMug, mug_images
from bayes3d_ros.validation.statistics.yaw_samples import YawScores, circular_sd, yaw_scores

GROUP, QUICK_GROUP = 10, 1  # images of a group
TEST_SEED = 12


class Truth(NamedTuple):
    """Test images of one camera and place; of each the exact posterior over `yaw_axis()`, and the share of the handle
    that the mug does not hide."""

    images: MugImages
    posterior: Float[np.ndarray, "N K"]
    handle: Float[np.ndarray, "N"]


def group_truth(
    mug: Callable[[], UprightMug],
    fixed: Callable[[], Float[np.ndarray, "K height width"]],
    each: int,
    condition: str,
    group: int,
) -> Truth:
    """A group of test images of a condition. The images of a quick run are the first of a full one's. fixed: what the
    camera would see at every yaw where neither it nor the mug is moved."""
    drawn = MUG_CONDITIONS[condition]
    images = mug_images(mug(), drawn, each, (TEST_SEED, list(MUG_CONDITIONS).index(condition), group))
    clean = fixed() if drawn.one_view else every_yaw(mug(), images.view, len(fixed()))
    handle = np.array([mug().handle_in_sight(images.view, yaw) for yaw in images.yaw])
    return Truth(images, np.array([yaw_posterior(depth, clean, drawn.noise) for depth in images.depth]), handle)


def _scores(said: Sequence[von_mises.VonMises | von_mises.Mixture], groups: Sequence[Truth]) -> list[YawScores]:
    """Of what is said of every image of all groups."""
    images = ((exact, yaw) for truth in groups for exact, yaw in zip(truth.posterior, truth.images.yaw, strict=True))
    return [
        yaw_scores(q.log_density, yaw_axis(len(exact)), exact, yaw)
        for q, (exact, yaw) in zip(said, images, strict=True)
    ]


def mug_row(method: str, size: int, condition: str, said: Sequence[von_mises.Mixture], groups: Sequence[Truth]) -> Row:
    """A value an image in each list: of what a method said of it (`von_mises`: mean in radians and concentration of
    each member), with `sd`, its standard deviation in degrees; `floored` is the cross-entropy where a hundredth of the
    density is uniform, as it is of samples. Then the true `yaw`, the exact posterior's own entropy and standard
    deviation, the cross-entropy of the best von Mises that there is, and the share of the handle in sight."""
    scores = _scores(said, groups)
    best = [s.cross_entropy for s in _scores([fit for truth in groups for fit in _best_fits(truth)], groups)]
    row = {
        "method": method,
        "training": size,
        "test": condition,
        "von_mises": [[[round(m, 5), float(f"{k:.5g}")] for m, k in one.members] for one in said],
        "cross_entropy": [round(s.cross_entropy, 4) for s in scores],
        "floored": [round(s.floored, 4) for s in scores],
        "log_p_true": [round(s.log_p_true, 4) for s in scores],
        "sd": [round(s.sd, 3) for s in scores],
        "yaw": [round(float(yaw), 5) for truth in groups for yaw in truth.images.yaw],
        "entropy": [round(entropy(exact), 4) for truth in groups for exact in truth.posterior],
        "exact_sd": [round(circular_sd(yaw_axis(len(p)), p), 3) for truth in groups for p in truth.posterior],
        "handle": [round(float(share), 3) for truth in groups for share in truth.handle],
        "best_von_mises": [round(value, 4) for value in best],
    }
    if len(said[0].members) > 1:
        alone = [_scores(member, groups) for member in zip(*(one.members for one in said), strict=True)]
        row["member_cross_entropy"] = [round(float(np.mean([s.cross_entropy for s in own])), 4) for own in alone]
    return row


def _best_fits(truth: Truth) -> list[von_mises.VonMises]:
    """The von Mises of least cross-entropy from each exact posterior: its weighted maximum likelihood."""
    axis = yaw_axis(truth.posterior.shape[1])
    return [von_mises.fit(axis, exact) for exact in truth.posterior]
