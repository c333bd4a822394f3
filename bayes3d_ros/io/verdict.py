# SPDX-License-Identifier: Apache-2.0

"""Whether a posterior may be relied on, in words."""

from typing import NamedTuple

from bayes3d_ros.posterior.types import ScenePosterior

# Objects of the bundled bags have 0.76 and more (docs/outputs.md).
LEAST_EXPLAINED = 0.7
# A stage of the sampler with less has its weight on a handful of scenes. Stages of the first frames of three_objects,
# occluded_object, lying_object and unknown_object have 0.13 and more.
LEAST_ESS = 0.05


class Verdict(NamedTuple):
    """healthy: nothing is wrong. words: one line that says so, or what is wrong."""

    healthy: bool
    words: str


def scene_verdict(posterior: ScenePosterior) -> Verdict:
    """Of a parsed frame: the parser's own warnings, the shares that are explained, and effective sample sizes."""
    wrong = []
    if posterior.too_little_usable:
        wrong.append(f"only {posterior.usable_share:.0%} of the table's pixels are usable: objects may be missed")
    if posterior.unexplained:
        count = len(posterior.unexplained)
        places = "a place" if count == 1 else f"{count} places"
        wrong.append(f"something stands at {places} (?) where the scene has no object")
    poor = [
        f"object {label} ({found.explained:.0%})"
        for label, found in enumerate(posterior.objects, 1)
        if found.explained < LEAST_EXPLAINED
    ]
    if poor:
        wrong.append(f"pixels of {', '.join(poor)} do not fit the model: worn, or another object")
    if posterior.ess and min(posterior.ess) < LEAST_ESS:
        wrong.append(f"few samples carry the weight (effective sample size {min(posterior.ess):.0%}): raise particles")
    if wrong:
        return Verdict(False, "Check: " + "; ".join(wrong))
    shares = [found.explained for found in posterior.objects if found.explained == found.explained]
    told = []
    if posterior.ess:
        told.append(f"effective sample size at least {min(posterior.ess):.0%}")
    if shares:
        told.append(f"each object explained to at least {min(shares):.0%}")
    return Verdict(True, "Healthy: " + ", ".join(told or ["no warning"]))
