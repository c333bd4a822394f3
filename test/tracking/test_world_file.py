# SPDX-License-Identifier: Apache-2.0

"""Worlds that are known beforehand, from files."""

from types import SimpleNamespace

import numpy as np
import pytest

from bayes3d_ros.tracking.camera_estimate import WorldError
from bayes3d_ros.tracking.world_file import load_world

LIBRARY = SimpleNamespace(names=("box", "mug"))
MUG = "{type: mug, position: [0.1, -0.2, 0.03], orientation: [0, 0, 1, 0]}"


def test_a_world_is_read(tmp_path):
    file = tmp_path / "world.yaml"
    file.write_text(f"objects:\n- {MUG}\n- {MUG.replace('mug', 'box')}\n")
    world = load_world(file, True, LIBRARY)
    assert world.types == ("mug", "box") and world.table_visible
    expected = [[-1, 0, 0, 0.1], [0, -1, 0, -0.2], [0, 0, 1, 0.03], [0, 0, 0, 1]]
    np.testing.assert_allclose(world.T_world_object[0], expected)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("objects: [", "expected yaml"),
        ("- mug", "expected one key, objects, with a list"),
        ("objects: []", "objects: expected at least one"),
        ("objects: [mug]", r"objects\[0\]: expected the keys type, position, orientation"),
        ("objects: [{type: mug, position: [0, 0, 0]}]", r"objects\[0\]: expected the keys"),
        (f"objects: [{MUG.replace('mug', '7')}]", r"objects\[0\].type: expected an object of the library, it has no 7"),
        (f"objects: [{MUG.replace('-0.2, ', '')}]", r"objects\[0\].position: expected 3 numbers, got \[0.1, 0.03\]"),
        (f"objects: [{MUG.replace('0.1', '.nan')}]", r"objects\[0\].position: expected 3 numbers"),
        (f"objects: [{MUG.replace('0.1', 'true')}]", r"objects\[0\].position: expected 3 numbers"),
        (f"objects: [{MUG.replace('0.1', '1' * 400)}]", r"objects\[0\].position: expected 3 numbers"),
        (f"objects: [{MUG.replace('0.1', '1.0e+30')}]", r"objects\[0\].position: expected 3 numbers"),
        (f"objects: [{MUG.replace('[0.1, -0.2, 0.03]', '7')}]", r"objects\[0\].position: expected 3 numbers, got 7"),
        ("objects: 2020-13-45", "expected yaml: month must be"),
        ("objects: !!int ''", "expected yaml"),
        ("[" * 3000, "expected yaml"),
        (f"objects: [{MUG}, {MUG.replace('1, 0]', '2, 0]')}]", r"objects\[1\].orientation: expected a quaternion"),
    ],
)
def test_what_is_wrong_is_said_in_a_line(tmp_path, text, told):
    file = tmp_path / "world.yaml"
    file.write_text(text)
    with pytest.raises(WorldError, match=f"world.yaml: {told}") as error:
        load_world(file, True, LIBRARY)
    assert "\n" not in str(error.value)


def test_a_file_that_cannot_be_read(tmp_path):
    with pytest.raises(WorldError, match="none.yaml: expected a readable world file"):
        load_world(tmp_path / "none.yaml", True, LIBRARY)
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(WorldError, match="this is no text"):
        load_world(tmp_path / "binary.yaml", True, LIBRARY)
