# SPDX-License-Identifier: Apache-2.0

"""Rows of the benchmark, with a stand-in for the parser; no time is asserted."""

import json

import pytest
import trimesh

from bayes3d_ros.io.bags import BagWriter
from bayes3d_ros.objects.mesh_import import model_from_mesh
from bayes3d_ros.objects.model import Library
from bayes3d_ros.validation.bench import benchmark


@pytest.fixture
def calls(monkeypatch, fake_posterior):
    made = []

    class Parser:
        def __init__(self, library, settings):
            self.names = library.names

        def warm_up(self, width, height):
            made.append(("warm_up", width, height))

        def parse(self, frame):
            made.append(("parse", frame.stamp_ns))
            return fake_posterior(frame, self.names)

    monkeypatch.setattr(benchmark, "SceneParser", Parser)
    return made


def test_a_row_is_timed_after_everything_is_compiled(tmp_path, depth_frame, calls):
    with BagWriter(tmp_path / "bag") as writer:
        for stamp in (1, 2):
            writer.write(depth_frame(stamp))
    library = Library((model_from_mesh(trimesh.creation.box((0.05, 0.04, 0.03)), "block", 0.01),))
    (row,) = benchmark.parse_rows([benchmark.Case(tmp_path / "bag", library.names)], library)
    assert calls[:2] == [("warm_up", 64, 48), ("parse", 1)]
    assert len(calls) == 2 + benchmark.REPEATS == 2 + row["frames"]
    assert {k: row[k] for k in ("what", "backend", "size", "bag", "library", "objects")} == {
        "what": "parse",
        "backend": "ours",
        "size": "64x48",
        "bag": "bag",
        "library": 1,
        "objects": 2,
    }
    assert row["seconds_min"] <= row["seconds"] <= row["seconds_max"]
    assert row["per_second"] == pytest.approx(1 / row["seconds"])
    json.dumps(row, allow_nan=False)
    assert benchmark.line(row).split()[:4] == ["parse", "bag", "1", "2"]


def test_bags_that_are_compared_take_turns(tmp_path, depth_frame, calls):
    bags = tmp_path / "one", tmp_path / "two"
    for stamps, bag in zip(((1,), (2, 3)), bags, strict=True):
        with BagWriter(bag) as writer:
            for stamp in stamps:
                writer.write(depth_frame(stamp))
    library = Library((model_from_mesh(trimesh.creation.box((0.05, 0.04, 0.03)), "block", 0.01),))
    rows = benchmark.parse_rows([benchmark.Case(bag, library.names) for bag in bags], library)
    assert [(row["bag"], row["frames"]) for row in rows] == [(bag.name, benchmark.REPEATS) for bag in bags]
    assert calls[:3] == [("warm_up", 64, 48), ("parse", 1), ("parse", 2)]
    assert [stamp for _, stamp in calls[3:9]] == [1, 2, 1, 3, 1, 2]


def test_cases_are_bags_that_exist(tmp_path, monkeypatch):
    monkeypatch.setenv("BAYES3D_DATA", str(tmp_path))
    bundled = [case.bag.name for case in benchmark.cases()]
    assert "one_object" in bundled and "real_sugar_box" not in bundled
    (tmp_path / "real_sugar_box").mkdir()
    real = [(case.bag.name, len(case.types)) for case in benchmark.cases()[len(bundled) :]]
    assert real == [("real_sugar_box", 1), ("real_sugar_box", 10)]
    assert benchmark.count() == len(bundled) + 12


def test_the_machine_and_the_versions_are_named():
    assert benchmark.machine()["cores"] >= 1 and benchmark.machine()["cpu"]
    assert set(benchmark.versions()) == {"python", "bayes3d_ros", "jax", "jaxlib", "numpy"}
    json.dumps([benchmark.machine(), benchmark.versions()], allow_nan=False)
