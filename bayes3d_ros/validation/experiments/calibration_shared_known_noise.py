# SPDX-License-Identifier: Apache-2.0

"""Calibration under errors that pixels share where the sampler is told sigma and p_outlier: what is left of its faults
when none comes from the nodes that are chosen from each image. The same scenes and images as of `calibration-shared`;
ranks of sigma and p_outlier are drawn at random, as all samples tie."""

from collections.abc import Iterator

from bayes3d_ros.validation.bench.benchmark import ten_ycb_types
from bayes3d_ros.validation.experiments import Step, row_step
from bayes3d_ros.validation.experiments.calibration_shared import (
    HEADER,
    count,
    line,
    notes,
    plot,
    shared_scene_row,
    summary,
)
from bayes3d_ros.validation.reference.shared_error_problem import shared_problem

__all__ = ["HEADER", "count", "line", "notes", "plot", "steps", "summary"]


def steps(quick: bool) -> Iterator[Step]:
    """A row a scene. Scene k is the same whatever their number."""
    problem = shared_problem(ten_ycb_types())
    for k in range(count(quick)):
        yield row_step(shared_scene_row, k, problem, noise_known=True)
