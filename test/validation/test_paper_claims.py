# SPDX-License-Identifier: Apache-2.0

"""The paper's claims against made-up summaries, and the page of them."""

import json
from copy import deepcopy
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from bayes3d_ros.cli import main
from bayes3d_ros.validation.experiments import EXPERIMENTS, noise_ablation, object_type, real_scenes_rows
from bayes3d_ros.validation.experiments.scene_models import SceneTruth
from bayes3d_ros.validation.paper_claims import (
    CLAIMS,
    LOW_NOISE,
    NOISY,
    frame_rate,
    less_training,
    memory,
    noise_priors,
    pose_beyond_training,
    scenes_right,
    tracking_error,
    tracking_rows,
    type_beyond_training,
)
from bayes3d_ros.validation.statistics.foreign_things import ForeignThing

MUG: dict[str, Any] = {
    "as trained: network 0.1 M 100": {"cross_entropy": 1.5},
    "as trained: network 7 M 100": {"cross_entropy": 1.4},
    "as trained: network 7 M 3000": {"cross_entropy": 0.1},
    "as trained: Bayes3D 1": {"cross_entropy": 0.9},
    "as trained: Bayes3D 5": {"cross_entropy": 0.2},
    "as trained: Bayes3D 10": {"cross_entropy": 0.1},
    "as trained: Bayes3D (independent) 5": {"cross_entropy": 0.15},
    "as trained: Bayes3D mesh": {"cross_entropy": 0.05},
    "as trained: exact": {"entropy": -1.0},
    "noise: network 7 M 3000": {"cross_entropy": 3.0},
    "noise: Bayes3D 5": {"cross_entropy": 0.5},
    "network 0.1 M: size": {"file_bytes": 4e5, "memory_bytes": 4e5},
    "network 7 M: size": {"file_bytes": 28e6, "memory_bytes": 28e6},
    "Bayes3D: size": {"file_bytes": 16_000, "memory_bytes": 1e6},
    "network_needs": {"as trained": 3000, "noise": None},
}
TYPE: dict[str, Any] = {
    "as trained: Bayes3D": {"images": 1000, "accuracy": 0.95, "log_loss": 0.1},
    "poses off: Bayes3D": {"images": 1000, "accuracy": 0.93, "log_loss": 0.2},
    "as trained: network 10000": {"images": 1000, "accuracy": 0.97, "log_loss": 0.08},
    "poses off: network 10000": {"images": 1000, "accuracy": 0.9, "log_loss": 0.4},
    "Bayes3D: size": {"file_bytes": 20_000, "memory_bytes": 1e6},
    "network: size": {"file_bytes": 12.6e6, "memory_bytes": 12.6e6},
    "network_needs": {"as trained": 10_000, "poses off": None},
}
NOISE: dict[str, Any] = {
    f"{level}: {prior}": {"right": 0.9 if prior == "inferred" else 0.3, "p_inferred_better": 1e-4}
    for level in NOISY
    for prior in ("inferred", *LOW_NOISE)
}
SCENES = {"meshes": {"things": 10, "right": 9, "false_objects": 1, "extra_unknown": 0, "with_truth": 4}}
TRACKING = {
    "fps_25": 120.0,
    "worst_position_cm_own": 0.5,
    "worst_orientation_deg_own": 4.0,
    "lost_own": 0,
    "not_met": ["power_drill 100 independent"],
}


def changed(summary: dict[str, Any], group: str, **values: Any) -> dict[str, Any]:
    other = deepcopy(summary)
    other[group] |= values
    return other


@pytest.mark.parametrize(
    ("answer", "summary", "words", "failing"),
    [
        (less_training, MUG, "5 views; as good: networks from 3,000 images on",
         changed(MUG, "network_needs", **{"as trained": 100})),
        (less_training, TYPE, "no training images; as good: networks from 10,000 images on",
         changed(TYPE, "network_needs", **{"as trained": 10})),
        (pose_beyond_training, MUG, "noise 0.50 against 3.00",
         changed(MUG, "noise: network 7 M 3000", cross_entropy=0.4)),
        (type_beyond_training, TYPE, "right 95.0%, out of distribution 93.0%",
         changed(TYPE, "poses off: Bayes3D", accuracy=0.9)),
        (type_beyond_training, TYPE, "log loss there 0.20, of the best network 0.40",
         changed(TYPE, "poses off: network 10000", log_loss=0.1)),
        (partial(memory, 1700, "cross_entropy"), MUG, "28 MB (network 7 M) against 16 KB: 1,750 times",
         changed(MUG, "Bayes3D: size", file_bytes=17_000)),
        (partial(memory, 600, "log_loss"), TYPE, "12.6 MB (network) against 20 KB: 630 times",
         changed(TYPE, "Bayes3D: size", file_bytes=22_000)),
        (noise_priors, NOISE, "highest noise 90% against 30% (3 mm, 0.01)",
         changed(NOISE, "high: 1 mm, 0.001", p_inferred_better=0.2)),
        (partial(scenes_right, "meshes"), SCENES, "9 of 10 things right in 4 frames, 1 too many",
         changed(SCENES, "meshes", right=8)),
        (partial(scenes_right, "meshes"), SCENES, "9 of 10", changed(SCENES, "meshes", extra_unknown=1)),
        (partial(frame_rate, 25, 103.2), TRACKING, "120.0 FPS", TRACKING | {"fps_25": 100.0}),
        (partial(tracking_error, "position_cm", "cm", 0.65), TRACKING, "0.500 cm", TRACKING | {"lost_own": 2}),
        (partial(tracking_error, "orientation_deg", "degrees", 4.2), TRACKING, "4.000 degrees",
         TRACKING | {"worst_orientation_deg_own": 4.3}),
        (tracking_rows, TRACKING, "no larger error in any row", TRACKING | {"not_met": ["power_drill 25 own"]}),
    ],
)  # fmt: skip
def test_a_claim_holds_or_not_by_the_numbers(answer, summary, words: str, failing) -> None:
    said = answer(summary)
    assert words in said.words and said.holds
    assert not answer(failing).holds
    assert answer({}) is None


def test_no_network_is_as_good() -> None:
    never = changed(MUG, "network_needs", **{"as trained": None})
    never["as trained: network 7 M 3000"] = {"cross_entropy": 0.3}
    said = less_training(never)
    assert said is not None and said.holds and "no network of up to 3,000 images" in said.words
    size = memory(1700, "cross_entropy", never)
    assert size is not None and "(network 7 M, which is not as good)" in size.words
    small = changed(MUG, "as trained: network 0.1 M 100", cross_entropy=0.15)
    enough = memory(20, "cross_entropy", small)
    assert enough is not None and "0.4 MB (network 0.1 M) against 16 KB: 25 times" in enough.words and enough.holds


def test_claims_read_summaries_as_experiments_write_them() -> None:
    assert {claim.experiment for claim in CLAIMS} <= set(EXPERIMENTS)
    assert {level.name for level in noise_ablation.CLAMPED} >= set(LOW_NOISE) and set(NOISY) <= set(
        noise_ablation.LEVELS
    )
    truth = SceneTruth((), (ForeignThing("a tin", None),))
    where = {"models": "learned", "bag": "dark", "library": 4, "frame": 1}
    dark = real_scenes_rows.summary(real_scenes_rows.unparsed_rows(where, truth, "no table in sight"))
    said = scenes_right("learned", dark)
    assert said is not None and said.words == "0 of 1 things right in 1 frames, 0 too many" and not said.holds
    assert scenes_right("meshes", dark) is None
    sizes = {"file_bytes": 20_000, "memory_bytes": 40_000}
    kinds = [
        {"method": method, "training": size, "test": test, "p": [p, 1 - p], "truth": [1, 0], "visible": [1.0, 1.0]}
        | sizes
        for method, size, p in (("Bayes3D", 0, 0.9), ("network", 10, 0.6), ("network", 300, 0.95))
        for test in ("as trained", "poses off")
    ]
    summary = object_type.summary(kinds)
    less, beyond = less_training(summary), type_beyond_training(summary)
    assert less is not None and less.words == "no training images; as good: networks from 300 images on"
    assert beyond is not None and not beyond.holds  # the larger network is better there, too
    size = memory(1050, "log_loss", summary)
    assert size is not None and size.words.startswith("0.02 MB (network) against 20 KB: 1 times; in memory 0.04")


def run(*arguments: Path | str) -> Any:
    return CliRunner().invoke(main.main, ["report", *map(str, arguments)])


def written(folder: Path, experiment: str, summary: Any, **more: Any) -> Path:
    file = folder / f"{experiment}.json"
    machine = {"cpu": "A CPU", "cores": 2, "device": "cpu"}
    runs = [{"commit": "aaaaaaaaaaaa", "started": "2026-11-25T23:10:00+00:00", "first_step": 0}]
    report = {"experiment": experiment, "rows": [], "summary": summary, "steps": 1, "machine": machine, "runs": runs}
    file.write_text(json.dumps(report | more))
    return file


def table_row(page: str, claim: str) -> list[str]:
    (found,) = [line for line in page.splitlines() if line.startswith(f"| {claim} |")]
    return [cell.strip() for cell in found[1:-1].split(" | ")]


def test_the_page_has_a_row_for_every_claim(tmp_path: Path) -> None:
    written(tmp_path, "camera-tracking", TRACKING | {"fps_25": 60.0})
    written(tmp_path, "real-scenes", SCENES)
    written(tmp_path, "mug-pose", MUG, quick=True)
    result = run(tmp_path, "--out", tmp_path)
    assert result.exit_code == 0, result.output
    assert result.stdout.splitlines()[-1] == str(tmp_path / "paper.md")
    page = (tmp_path / "paper.md").read_text()
    rows = {claim.claim: table_row(page, claim.claim) for claim in CLAIMS}
    slow = rows["The camera is tracked in real time at 25 x 25 pixels"]
    assert slow[1:5] == ["Table I", "103.207 FPS", "60.0 FPS", "**no**"] and "A CPU, 2 cores, JAX on cpu" in slow[6]
    assert rows["The camera is tracked in real time at 50 x 50 pixels"][3:5] == ["not measured", "-"]
    position = rows["Tracking is accurate: position"]
    assert position[2:5] == ["0.650 cm", "0.500 cm", "yes"] and position[6] == ""
    real = rows["Real single-object and multi-object scenes are parsed robustly, occluded objects included"]
    assert real[2:5] == ["figure only", "9 of 10 things right in 4 frames, 1 too many", "yes"]
    pose = rows["Out of distribution the network's pose does not generalize, ours does"]
    assert pose[3].endswith("(quick)") and pose[4] == "not decided"
    assert rows["The type posterior is as accurate as a network's with much less data"][3:5] == ["not run", "-"]
    assert "- [camera-tracking](camera-tracking.md): full, `aaaaaaaaaaaa`, 2026-11-25 23:10 UTC" in page
    assert "- object-type: not run (`bayes3d evaluate object-type --out DIR`)" in page


def test_other_experiments_have_no_page_of_claims(tmp_path: Path) -> None:
    assert run(written(tmp_path, "planted", {"scenes": 2}), "--out", tmp_path / "pages").exit_code == 0
    assert sorted(path.name for path in (tmp_path / "pages").glob("*.md")) == ["overview.md", "planted.md"]
