# SPDX-License-Identifier: Apache-2.0

"""The mug-pose experiment: its images, the exact posterior, scores of densities, and what it says of made-up rows."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("mujoco", reason="the scenes need MuJoCo (extra: sim)")

from bayes3d_ros.posterior.types import ParseError, SceneSamples
from bayes3d_ros.validation.experiments import mug_pose
from bayes3d_ros.validation.experiments.mug_pose_parser import (
    COARSER,
    INDEPENDENT,
    KnownMug,
    ParserStep,
    parser_rows,
)
from bayes3d_ros.validation.experiments.mug_pose_summary import COARSE, PARSER
from bayes3d_ros.validation.experiments.mug_pose_truth import Truth, mug_row
from bayes3d_ros.validation.networks.von_mises import Mixture, VonMises
from bayes3d_ros.validation.reference.exact_yaw import entropy, every_yaw, yaw_axis, yaw_posterior
from bayes3d_ros.validation.simulate.mug_images import (
    MUG_CAMERA,
    MUG_CONDITIONS,
    TRAINED,
    mug_images,
    mug_view,
    upright_mug,
)
from bayes3d_ros.validation.simulate.random_scenes import REALSENSE
from bayes3d_ros.validation.simulate.shared_error_frames import PlacedObject
from bayes3d_ros.validation.simulate.small_images import clean_depth
from bayes3d_ros.validation.statistics.model_sizes import ModelSizes
from bayes3d_ros.validation.statistics.yaw_samples import (
    WeightedYaws,
    circular_sd,
    kernel_density,
    weighted_yaws,
    yaw_scores,
)

YAWS = 90


@pytest.fixture(scope="module")
def mug():
    return upright_mug()


@pytest.fixture(scope="module")
def clean(mug):
    return every_yaw(mug, mug_view(TRAINED, np.random.default_rng(0)), YAWS)


def test_images_are_those_of_their_seed_whatever_their_number(mug):
    few, more, other = (mug_images(mug, TRAINED, n, (seed,)) for n, seed in ((2, 1), (3, 1), (2, 2)))
    np.testing.assert_array_equal(few.depth, more.depth[:2])
    np.testing.assert_array_equal(few.yaw, more.yaw[:2])
    assert (few.yaw != other.yaw).all()
    moved = mug_images(mug, MUG_CONDITIONS["moved"], 1, (1,)).view
    assert 0 < abs(moved.x) <= 0.04 and not MUG_CONDITIONS["moved"].one_view and TRAINED.one_view


def test_what_is_rendered_in_a_box_is_what_is_rendered_whole(mug):
    view = mug_view(MUG_CONDITIONS["camera"], np.random.default_rng(3))
    placed = PlacedObject(mug.thing, mug.pose(view, 1.0))
    whole = mug.thing.caster.render(np.linalg.inv(placed.T_table_object) @ view.T_table_camera, MUG_CAMERA).depth
    bare = clean_depth([], view.T_table_camera, MUG_CAMERA)
    np.testing.assert_array_equal(clean_depth([placed], view.T_table_camera, MUG_CAMERA), np.fmin(bare, whole))


def test_the_posterior_is_flat_where_the_handle_is_hidden_and_sharp_where_it_is_not(clean):
    """Seen along +y, a handle that points to +y (90 degrees) is behind the mug."""
    axis = np.degrees(yaw_axis(YAWS))
    rng = np.random.default_rng(0)
    away, aside = (yaw_posterior(TRAINED.noise.add(clean[k], rng), clean, TRAINED.noise) for k in (YAWS // 4, 0))
    hidden = np.abs(axis - 90) < 30
    np.testing.assert_allclose(away[hidden], away[hidden].mean(), rtol=0.1)  # the body has facets
    assert away[np.abs(axis - 90) < 45].sum() > 0.999
    assert axis[aside.argmax()] == 0 and aside.max() > 0.99
    assert entropy(np.full(YAWS, 1 / YAWS)) == pytest.approx(np.log(2 * np.pi))
    assert entropy(aside) < entropy(away) < np.log(2 * np.pi)


def test_the_handle_is_in_sight_where_the_body_does_not_hide_it(mug):
    view = mug_view(TRAINED, np.random.default_rng(0))
    aside, behind, before = (mug.handle_in_sight(view, np.radians(degrees)) for degrees in (0, 90, 270))
    assert behind == 0.0 and before == 1.0 and 0.9 < aside <= 1.0
    partly = [mug.handle_in_sight(view, np.radians(degrees)) for degrees in range(0, 91, 5)]
    assert (np.diff(partly) <= 0.05).all() and any(0.2 < share < 0.8 for share in partly)


def test_a_circular_standard_deviation_is_that_of_a_narrow_density_and_large_of_a_flat_one():
    axis = yaw_axis(3600)
    narrow = np.exp(-0.5 * ((axis - 1.0) / 0.05) ** 2)
    assert circular_sd(axis, narrow / narrow.sum()) == pytest.approx(np.degrees(0.05), rel=1e-3)
    assert circular_sd(axis, np.full(3600, 1 / 3600)) > 360
    two = np.isin(np.arange(3600), (0, 900)) / 2  # a quarter turn apart: a mean resultant of cos(45 degrees)
    assert circular_sd(axis, two) == pytest.approx(np.degrees(np.sqrt(np.log(2))))


def test_cross_entropy_is_least_of_the_posterior_itself():
    axis = yaw_axis(720)
    q = VonMises(1.0, 20.0)
    exact = np.exp(q.log_density(axis))
    exact /= exact.sum()
    own, other = (yaw_scores(d, axis, exact, 1.1) for d in (q.log_density, VonMises(1.2, 20.0).log_density))
    assert own.cross_entropy == pytest.approx(entropy(exact), abs=1e-9) and own.cross_entropy < other.cross_entropy
    sure = yaw_scores(VonMises(-2.0, 1e6).log_density, axis, exact, 1.1)
    assert sure.cross_entropy > 1e5 and sure.floored == pytest.approx(np.log(200 * np.pi), abs=0.01)
    assert own.floored == pytest.approx(own.cross_entropy - np.log1p(-0.01), abs=0.01)
    assert own.log_p_true == pytest.approx(float(q.log_density(np.array([1.1]))[0]))


def test_the_density_of_samples_integrates_to_one_and_is_never_zero():
    yaws = np.concatenate([np.linspace(-0.01, 0.01, 5), np.linspace(2.99, 3.01, 5)])
    density = kernel_density(WeightedYaws(yaws, np.repeat([0.05, 0.15], 5), np.arange(10)))
    axis = yaw_axis(3600)
    p = np.exp(density(axis)) * 2 * np.pi / len(axis)
    assert p.sum() == pytest.approx(1, abs=1e-9) and (p > 0).all()
    assert p[np.abs(axis - 3.0) < 0.3].sum() == pytest.approx(0.75 * 0.99 + 0.01 * 0.6 / (2 * np.pi), abs=1e-4)


def test_the_kernel_is_as_wide_as_independent_samples_say():
    """Of 400 normal yaws the density comes near the normal's own entropy; copies of one draw say nothing of each
    other, and alone get the widest kernel."""
    rng, even = np.random.default_rng(0), np.full(400, 1 / 400)
    truth = np.radians(1.0) * rng.standard_normal(5000)
    own_entropy = float(np.log(np.radians(1.0) * np.sqrt(2 * np.pi * np.e)))
    samples = np.radians(1.0) * rng.standard_normal(400)
    loss = -kernel_density(WeightedYaws(samples, even, np.arange(400)))(truth).mean()
    assert own_entropy < loss < own_entropy + 0.05
    copies = samples[np.repeat(np.arange(40), 10)] + 1e-5 * rng.standard_normal(400)
    as_copies, as_samples = (
        -kernel_density(WeightedYaws(copies, even, draw))(truth).mean()
        for draw in (np.repeat(np.arange(40), 10), np.arange(400))
    )
    assert as_copies < own_entropy + 0.1 < as_samples
    one = kernel_density(WeightedYaws(copies[:2], even[:2] * 200, np.zeros(2, int)))(np.array([copies[0]]))
    assert np.exp(one[0]) == pytest.approx(0.99 / (np.radians(8.0) * np.sqrt(2 * np.pi)), rel=0.02)


def samples_of(yaws, log_weight, T_table_camera):
    turned = T_table_camera[:3, :3].T @ Rotation.from_euler("z", np.reshape(yaws, (-1, 1))).as_matrix()
    none = np.zeros(len(yaws))
    return SceneSamples(
        log_weight=np.asarray(log_weight),
        num_objects=np.ones(len(yaws), int),
        type=np.zeros((len(yaws), 1), int),
        face=np.zeros((len(yaws), 1), int),
        position=np.zeros((len(yaws), 1, 3)),
        orientation=Rotation.from_matrix(turned).as_quat()[:, None],
        p_outlier=none,
        sigma=none,
    )


def test_yaws_of_samples_are_those_in_the_tables_frame():
    view = mug_view(TRAINED, np.random.default_rng(0))
    samples = samples_of([0.3, -2.0], np.log([0.2, 0.8]), view.T_table_camera)
    found = weighted_yaws(samples, view.T_table_camera)
    np.testing.assert_allclose(found.yaw, [0.3, -2.0])
    np.testing.assert_allclose(found.weight, [0.2, 0.8])
    assert list(found.draw) == [0, 1]
    drawn = weighted_yaws(samples._replace(draw=np.array([[7], [7]])), view.T_table_camera)
    assert list(drawn.draw) == [7, 7]


@pytest.fixture
def rows_of_parser(mug, clean):
    """Rows of a stand-in for a parser that gives samples about the true yaw, or fails."""
    images = mug_images(mug, TRAINED, 1, (5,))
    truth = Truth(images, np.array([yaw_posterior(images.depth[0], clean, TRAINED.noise)]), np.ones(1))
    turn = 0.5  # of the true mesh in the frame of the model

    def made(fails: bool):
        def parse(frame):
            assert frame.intrinsics == MUG_CAMERA != REALSENSE
            if fails:
                raise ParseError("no scene of 1 objects was found")
            own = images.yaw[0] - turn + np.array([-0.05, 0.05])
            return SimpleNamespace(samples=samples_of(own, np.log([0.5, 0.5]), frame.T_table_camera))

        known = KnownMug(SimpleNamespace(parse=parse, library=None), turn, -0.01, 1.0, ModelSizes((2048,), 32, 64))
        step = ParserStep(5, INDEPENDENT)
        assert [ParserStep(1).method, ParserStep(5, voxel_size=COARSER).method] == [PARSER, COARSE]
        return parser_rows(step, 0, lambda condition, group: truth, lambda step, group: known)

    return made


def test_the_parsers_rows_score_its_samples(rows_of_parser):
    row, *others = rows_of_parser(False)
    resultant = float(np.cos(0.05))
    assert row["log_p_true"][0] == pytest.approx(0.5 * np.log(1 / (2 * (1 - resultant)) / (2 * np.pi)), abs=0.01)
    assert row["samples_log_p_true"][0] > 0 and row["failed"] == 0
    ((mean, concentration),) = row["von_mises"][0]
    assert concentration == pytest.approx(1 / 0.05**2, rel=0.01) and "member_cross_entropy" not in row
    assert np.cos(mean - row["yaw"][0]) == pytest.approx(1, abs=1e-6)
    assert (row["file_bytes"], row["memory_bytes"], row["padded_memory_bytes"]) == (2048, 32, 64)
    assert row["method"] == "Bayes3D (independent)" and row["training"] == 5
    assert row["frame_off_degrees"] == pytest.approx(np.degrees(-0.01), abs=1e-3)
    assert [row["test"], *(o["test"] for o in others)] == list(MUG_CONDITIONS)
    lost = rows_of_parser(True)[0]
    assert lost["failed"] == 1 and lost["log_p_true"][0] == pytest.approx(-np.log(2 * np.pi), abs=1e-3)


def made_up(method, training, loss, test="as trained"):
    row = {"method": method, "training": training, "test": test, "seconds": 1.0, "memory_bytes": 4000}
    row |= {"cross_entropy": [loss, loss + 1], "log_p_true": [-loss, -loss], "file_bytes": 1000 * (training + 1)}
    row |= {"floored": [loss, loss + 0.5]}
    row |= {"entropy": [-3.0, 0.1], "best_von_mises": [-2.9, 0.2]}
    row |= {"sd": [1.0, 40.0], "exact_sd": [0.8, 30.0], "handle": [1.0, 0.0]}
    if method == PARSER:
        row |= {"samples_cross_entropy": [0.0, 1.0], "samples_log_p_true": [0.0, 1.0], "failed": 1}
    else:
        row |= {"rate": 1e-3, "steps": 0, "training_loss": 0.1, "validation_loss": 0.2}
    return row


def test_summary_lines_and_picture(tmp_path):
    rows = [made_up("network 1 M", 10, 1.5), made_up("network 1 M", 100, 0.2), made_up(PARSER, 1, 0.9)]
    rows += [made_up(PARSER, 5, 0.3), made_up(PARSER, 10, 0.3), made_up(PARSER, 10, 0.4), made_up(PARSER, 0, -1.0)]
    told = mug_pose.summary(rows)
    assert told["network_needs"] == {"as trained": 100}
    ten = told["as trained: Bayes3D 10"]
    assert (ten["cross_entropy"], ten["in_sight"], ten["hidden"]) == (0.85, 0.35, 1.35)
    assert (ten["images"], ten["failed"]) == (4, 2) and "less_ours" not in ten
    assert (ten["median"], ten["floored"]) == (0.85, 0.6)
    assert told["as trained: network 1 M 10"]["ours_lower"] == 1 and told["undecided"] == []
    assert told["as trained: network 1 M 10"]["less_ours"] == pytest.approx([1.2, 1.2, 1.2])
    assert told["trained: network 1 M 100"]["rate"] == 1e-3
    assert told["as trained: exact"] == {"entropy": -1.45, "best_von_mises": -1.35}
    assert told["Bayes3D: size"]["file_bytes"] == 11_000
    rows[1] = made_up("network 1 M", 100, 2.0)
    assert mug_pose.summary(rows)["network_needs"] == {"as trained": None}
    paths = mug_pose.plot(rows, tmp_path)
    assert [path.suffix for path in paths] == [".pdf", ".png"] * 2 and all(path.stat().st_size > 1000 for path in paths)
    rows[0] |= {"looks": [[50, 1.0, 1.1], [100, 0.8, 0.9]], "steps": 100}
    names = [path.name for path in mug_pose.plot(rows, tmp_path)]
    assert names[4:] == ["mug-pose-training.pdf", "mug-pose-training.png"]
    assert "mesh" in mug_pose.line(rows[-1]) and mug_pose.plot([], tmp_path) == []


def test_what_is_not_met_is_judged_with_five_views():
    network = "network 1 M"
    rows = [made_up(network, 100, 0.2), made_up(network, 3000, 0.1), made_up(PARSER, 5, 0.3), made_up(PARSER, 10, 0.0)]
    rows += [made_up(network, size, loss, "moved") for size, loss in ((1000, 0.6), (3000, 0.3))]
    rows += [made_up(PARSER, 5, 0.4, "moved")]
    told = mug_pose.summary(rows)
    assert told["not_met"] == [f"as trained: {network}, 100 images", f"moved: {network}, 3000 images"]
    assert told["moved: Bayes3D 5"]["above_exact"] == pytest.approx(0.9 - -1.45)
    rows[3]["file_bytes"] = 16_001
    assert mug_pose.summary(rows)["not_met"] == told["not_met"]
    rows += [made_up(COARSE, 5, 0.4) | {"file_bytes": 16_001}]
    assert mug_pose.summary(rows)["not_met"] == [*told["not_met"], "a file of 16001 bytes"]


def test_where_the_interval_holds_zero_a_lower_loss_decides_nothing():
    """Two groups of images: ours is better by 2 in one, and worse by 1 in the other."""
    network = "network 1 M"
    rows = [made_up(network, 100, 1.0) | {"cross_entropy": [3.0, 3.0, 0.0, 0.0], "entropy": [0.0] * 4}]
    rows[0] |= {"handle": [1.0] * 4, "member_cross_entropy": [1.4, 1.6]}
    rows += [made_up(PARSER, 5, 1.0) | {"cross_entropy": [1.0, 1.0]} for _ in range(2)]
    told = mug_pose.summary(rows)
    assert told["undecided"] == [f"as trained: {network}, 100 images"] and told["not_met"] == []
    assert told[f"as trained: {network} 100"]["members"] == [1.4, 1.6]
    assert told[f"as trained: {network} 100"]["ours_lower"] == 0.5


def test_a_row_scores_every_member_on_its_own(clean, mug):
    images = mug_images(mug, TRAINED, 1, (5,))
    truth = Truth(images, np.array([yaw_posterior(images.depth[0], clean, TRAINED.noise)]), np.ones(1))
    good, bad = VonMises(float(images.yaw[0]), 100.0), VonMises(float(images.yaw[0]) + 0.5, 100.0)
    row = mug_row("network 1 M (ensemble)", 10, "as trained", [Mixture((good, bad))], [truth])
    apart = row["member_cross_entropy"]
    alone = [mug_row("network 1 M", 10, "as trained", [Mixture((one,))], [truth]) for one in (good, bad)]
    assert apart == [one["cross_entropy"][0] for one in alone]
    assert apart[0] < row["cross_entropy"][0] < apart[0] + np.log(2) + 0.001 < apart[1]


@pytest.mark.parametrize("quick", [True, False])
def test_steps_are_those_that_are_counted(quick):
    assert len(list(mug_pose.steps(quick))) == mug_pose.count(quick)
