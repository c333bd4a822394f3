# SPDX-License-Identifier: Apache-2.0

"""Simulation-based calibration with the paper's likelihood: as many free points as pixels are drawn, and scored as they
are.

`sigma_max` is so small that windows of 3 x 3 pixels hold the sums: 3 sigma f / z stays within 1.2 pixels.
"""

from collections.abc import Iterator
from dataclasses import replace

from bayes3d_ros.validation.experiments import Step, row_step
from bayes3d_ros.validation.experiments.calibration import HEADER, WANTED, line, notes, plot, scene_row, summary
from bayes3d_ros.validation.reference.calibration_problem import SETTINGS, small_problem

__all__ = ["HEADER", "WANTED", "count", "line", "notes", "plot", "steps", "summary"]

POINT_SCENES, QUICK_POINT_SCENES = 400, 40
POINTS = replace(SETTINGS, likelihood="points", sigma_max=0.002)


def count(quick: bool) -> int:
    """How many scenes there are."""
    return QUICK_POINT_SCENES if quick else POINT_SCENES


def steps(quick: bool) -> Iterator[Step]:
    """A row a scene. Scene k is the same whatever their number."""
    problem = small_problem(POINTS)
    for k in range(count(quick)):
        yield row_step(scene_row, k, problem)
