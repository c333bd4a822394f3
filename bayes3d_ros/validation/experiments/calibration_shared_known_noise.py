# SPDX-License-Identifier: Apache-2.0

"""Simulation-based calibration under shared errors, with a sampler that is told the true sigma and p_outlier.

Scenes and images are those of `calibration-shared`. Faults that remain are not caused by the nodes of sigma and
p_outlier that are chosen from each image. Ranks of sigma and p_outlier are random numbers here, as all samples tie.
"""

from collections.abc import Iterator

from bayes3d_ros.validation.bench.benchmark import ten_ycb_types
from bayes3d_ros.validation.experiments import Step, row_step
from bayes3d_ros.validation.experiments.calibration_shared import (
    HEADER,
    WANTED,
    count,
    line,
    notes,
    plot,
    shared_scene_row,
    summary,
)
from bayes3d_ros.validation.reference.shared_error_problem import shared_problem

__all__ = ["HEADER", "WANTED", "count", "line", "notes", "plot", "steps", "summary"]


def steps(quick: bool) -> Iterator[Step]:
    """A row a scene. Scene k is the same whatever their number."""
    problem = shared_problem(ten_ycb_types())
    for k in range(count(quick)):
        yield row_step(shared_scene_row, k, problem, noise_known=True)
