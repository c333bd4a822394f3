# SPDX-License-Identifier: Apache-2.0

"""Experiments: one module a result, one row of EXPERIMENTS each. `bayes3d evaluate NAME` runs them."""

from collections.abc import Callable, Iterator, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, ParamSpec, Protocol, cast

Row = dict[str, Any]  # JSON values: no NaN, no numpy; metres, radians, seconds
Step = Callable[[], list[Row]]  # does the work of one step; its rows reach the disk together
Of = ParamSpec("Of")
Wanted = dict[str, str]  # of a summary: name of a number, or GROUP.NAME -> what is wanted of it, in words

# Name on the command line -> module; imported when it is run, because it imports jax.
EXPERIMENTS: dict[str, str] = {
    "additivity": "bayes3d_ros.validation.experiments.additivity",
    "calibration": "bayes3d_ros.validation.experiments.calibration",
    "calibration-points": "bayes3d_ros.validation.experiments.calibration_points",
    "calibration-shared": "bayes3d_ros.validation.experiments.calibration_shared",
    "calibration-shared-known-noise": "bayes3d_ros.validation.experiments.calibration_shared_known_noise",
    "calibration-unknown": "bayes3d_ros.validation.experiments.calibration_unknown",
    "camera-tracking": "bayes3d_ros.validation.experiments.camera_tracking",
    "coverage": "bayes3d_ros.validation.experiments.coverage",
    "coverage-tables": "bayes3d_ros.validation.experiments.coverage_tables",
    "dial": "bayes3d_ros.validation.experiments.dial",
    "exactness": "bayes3d_ros.validation.experiments.exactness",
    "learning": "bayes3d_ros.validation.experiments.learning",
    "mug-pose": "bayes3d_ros.validation.experiments.mug_pose",
    "noise-ablation": "bayes3d_ros.validation.experiments.noise_ablation",
    "object-type": "bayes3d_ros.validation.experiments.object_type",
    "open-world": "bayes3d_ros.validation.experiments.open_world",
    "parsing": "bayes3d_ros.validation.experiments.parsing",
    "planted": "bayes3d_ros.validation.experiments.planted",
    "real-scenes": "bayes3d_ros.validation.experiments.real_scenes",
    "repeatability": "bayes3d_ros.validation.experiments.repeatability",
    "score-width": "bayes3d_ros.validation.experiments.score_width",
    "type-odds": "bayes3d_ros.validation.experiments.type_odds",
}

# Of them those that measure the recordings of a folder, which may be named: their modules are FolderExperiments.
ON_FOLDER = frozenset({"real-scenes"})


class Experiment(Protocol):
    """What the module of an experiment offers. `quick` is a run of a minute or so that does every kind of step once.

    The module's docstring says what is measured: it opens the experiment's page in docs/validation. A module whose
    summary has limits also has WANTED (`wanted`).
    """

    HEADER: str  # above the lines of rows

    def notes(self, quick: bool) -> list[str]:
        """What a user should know before it starts, such as what is left out and why; one line each."""

    def count(self, quick: bool) -> int:
        """How many steps there are."""

    def steps(self, quick: bool) -> Iterator[Step]:
        """One step after the other, the same in every run, each to be called once or not at all.

        A run that goes on after an interruption does not call the steps that were done before. So the rows of a step
        depend on no step before it, neither on their random numbers nor on their results, and its work is done when it
        is called; what all steps need is prepared before the first one, or when a step first needs it.
        """

    def line(self, row: Row) -> str:
        """A row for people, under HEADER."""

    def summary(self, rows: Sequence[Row]) -> dict[str, Any]:
        """What all rows say: numbers, or groups of numbers, by name; None where there is nothing to say."""

    def plot(self, rows: Sequence[Row], folder: Path) -> list[Path]:
        """Write pictures into the folder; returns their paths."""


class FolderExperiment(Protocol):
    """What the module of an experiment of ON_FOLDER offers besides."""

    def on_folder(self, folder: Path | None, out: Path | None) -> Experiment:
        """The experiment on the recordings of a folder (None: its default), which may write pictures into `out` while
        it runs. Raises BagError where a folder that is named has no recordings."""


def row_step(row: Callable[Of, Row], *arguments: Of.args, **options: Of.kwargs) -> Step:
    """A step of one row: that of these arguments."""
    return lambda: [row(*arguments, **options)]


def wanted(experiment: Experiment) -> Wanted:
    """What is wanted of the numbers of an experiment's summary; empty where it has no limits."""
    return dict(getattr(experiment, "WANTED", {}))


def load_on_folder(name: str, folder: Path | None, out: Path) -> Experiment:
    """An experiment of ON_FOLDER, see `FolderExperiment`. Raises KeyError for a name that EXPERIMENTS lacks."""
    return cast(FolderExperiment, import_module(EXPERIMENTS[name])).on_folder(folder, out)


def load(name: str) -> Experiment:
    """The module of an experiment. Raises KeyError for a name that EXPERIMENTS lacks."""
    return cast(Experiment, import_module(EXPERIMENTS[name]))
