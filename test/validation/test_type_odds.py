# SPDX-License-Identifier: Apache-2.0

"""The type-odds experiment on made-up odds: calibrated ones pass, ones that are too large are found."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.special import expit

pytest.importorskip("mujoco", reason="the scenes need MuJoCo (extra: sim)")

from bayes3d_ros.objects.library_arrays import library_arrays
from bayes3d_ros.posterior.types import ParseError
from bayes3d_ros.validation.experiments import type_odds
from bayes3d_ros.validation.experiments.type_odds import Cell
from bayes3d_ros.validation.statistics.log_odds import (
    LEAST_PROBABILITY,
    best_scales,
    calibration_of_odds,
    certain_and_wrong,
)


def true_log_odds(size: int, spread: float, seed: int = 0) -> np.ndarray:
    """Log odds of the truth that are right: either answer is true with the probability that they say."""
    rng = np.random.default_rng(seed)
    odds = rng.normal(0, spread, size)
    return np.where(rng.uniform(size=size) < expit(odds), odds, -odds)


def rows_of(odds: np.ndarray, amplitude: float = 1.0, pair: str = "box + 1.5 mm") -> list[dict]:
    start = {"pair": pair, "amplitude": amplitude, "truth": 0, "type": "box", "form": "smooth", "wave_length": 0.05}
    return [
        start | {"frame": k, "log_odds": float(o), "p_true": float(expit(o)), "log_evidence": 1.0, "seconds": 0.1,
                 "error": None}
        for k, o in enumerate(odds)
    ]  # fmt: skip


@pytest.mark.parametrize("spread", [1.5, 3.0])
def test_right_odds_are_found_right(spread):
    told = type_odds.summary(rows_of(true_log_odds(600, spread)))
    cell = told["box + 1.5 mm x 1"]
    assert cell["judged"] and cell["scale_low"] < 1 < cell["scale_high"]
    assert told["not_met"] == [] and cell["log_loss"] < 0.69


@pytest.mark.parametrize(("factor", "side"), [(5.0, "scale_high"), (0.2, "scale_low")])
def test_odds_too_large_or_too_small_are_found(factor, side):
    told = type_odds.summary(rows_of(factor * true_log_odds(300, 2.0)))
    cell = told["box + 1.5 mm x 1"]
    assert cell["scale"] == pytest.approx(1 / factor, rel=0.35)
    assert "scale" in cell["not_met"] and (cell[side] < 0.7 if factor > 1 else cell[side] > 1.4)
    assert "box + 1.5 mm x 1: scale" in told["not_met"]
    if factor > 1:
        assert {"log loss", "certain answers"} <= set(cell["not_met"]) and "certain answers" in told["not_met"]
        assert told["certain"]["wrong"] > told["certain"]["allowed"]


def test_the_scale_is_not_judged_where_hardly_anything_or_half_of_it_is_wrong():
    sure, lost = type_odds.cell_summary(rows_of(np.full(50, 6.0))), type_odds.cell_summary(rows_of(np.zeros(50)))
    assert not sure["judged"] and sure["not_met"] == [] and sure["scale"] == pytest.approx(20)
    assert lost["wrong"] == 0.5 and not lost["judged"] and lost["not_met"] == []


def test_the_best_scale_is_that_of_a_fine_grid():
    odds = 3 * true_log_odds(200, 2.0)
    grid = np.linspace(0.01, 2, 2000)
    losses = np.logaddexp(0, -grid[:, None] * odds).mean(1)
    assert best_scales(odds[None])[0] == pytest.approx(grid[losses.argmin()], abs=2e-3)


def test_no_probability_is_an_infinite_loss():
    told = calibration_of_odds(np.array([0.0, 1.0, 1.0]))
    assert told.wrong == pytest.approx(1 / 3)
    assert told.log_loss == pytest.approx(-np.log(LEAST_PROBABILITY) / 3, rel=1e-3)
    assert told.scale < 0.2  # ln 2 / 13.8: two of three are right
    none = certain_and_wrong(np.array([0.0, 1.0, 0.5]))
    assert none == (2, 1, 0.0)


def test_frames_that_could_not_be_parsed_are_told(tmp_path):
    rows = rows_of(true_log_odds(20, 2.0))
    rows[3] |= {"log_odds": None, "p_true": None, "error": "no scene of 1 objects was found"}
    cell = type_odds.summary(rows)["box + 1.5 mm x 1"]
    assert (cell["frames"], cell["parsed"]) == (20, 19) and "parsed" in cell["not_met"]
    assert "no scene" in type_odds.line(rows[3]) and "box + 1.5 mm" in type_odds.line(rows[0])
    rows += rows_of(true_log_odds(20, 2.0, 1), 2.0)
    assert all(path.exists() for path in type_odds.plot(rows, tmp_path))
    assert type_odds.cell_summary(rows[3:4])["not_met"] == ["parsed"]


def test_log_odds_are_those_of_the_samples_weights():
    samples = SimpleNamespace(
        log_weight=np.log([0.5, 0.3, 0.2]).astype(np.float32), type=np.array([[0], [1], [0]], np.int32)
    )
    cell = Cell("box + 1.5 mm", 1.0)
    errors = type_odds.sample_frame_errors(1.0, 1, np.random.default_rng(0))
    seen = type_odds.OddsFrame(None, 1, errors)
    posterior = SimpleNamespace(samples=samples, log_evidence=3.0, ess=(0.5,), seconds=0.1)
    parser = SimpleNamespace(library=SimpleNamespace(names=("box", "box_larger")), parse=lambda frame: posterior)
    row = type_odds.frame_row(cell, 7, seen, parser)
    assert row["p_true"] == pytest.approx(0.3, abs=1e-6) and row["log_odds"] == pytest.approx(np.log(3 / 7), abs=1e-3)
    posterior.samples.type[:] = 0
    row = type_odds.frame_row(cell, 7, seen, parser)
    assert row["p_true"] == 0 and row["log_odds"] is None

    def fails(frame):
        raise ParseError("no table in sight")

    parser.parse = fails
    assert type_odds.frame_row(cell, 7, seen, parser)["error"] == "no table in sight"


def test_cells_frames_and_seeds_are_as_they_are_said_to_be():
    assert type_odds.count(False) == 20 * 300 and type_odds.count(True) == 240
    seeds = [
        {type_odds.frame_seed(Cell(pair, 1.0), k, quick) for k in range(type_odds.FRAMES)}
        for pair in type_odds.PAIRS
        for quick in (True, False)
    ]
    assert len(set.union(*seeds)) == sum(map(len, seeds))
    things = type_odds.pair_things("box + 3 mm")
    sizes = [np.ptp(thing.mesh.vertices, axis=0) for thing in things]
    np.testing.assert_allclose(sizes[1] - sizes[0], 0.003)
    truths = []
    for seed in range(6):
        here, more = (type_odds.frame(Cell("box + 3 mm", a), seed, things) for a in (0.0, 2.0))
        truths.append(here.truth)
        assert here.truth == more.truth and here.errors.wave_length == more.errors.wave_length
        assert np.nanmedian(np.abs(here.frame.depth - more.frame.depth)) < 0.02
    assert set(truths) == {0, 1}


def test_boxes_compile_to_code_of_one_shape():
    shapes = {tuple(a.shape for a in library_arrays(type_odds.pair_library(pair))) for pair in type_odds.BOXES}
    assert len(shapes) == 1
