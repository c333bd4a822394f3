# SPDX-License-Identifier: Apache-2.0

"""Images of errors that pixels share are of the density that scores them."""

import numpy as np
import pytest
from scipy.stats import kstest

from bayes3d_ros.geometry.camera import Intrinsics
from bayes3d_ros.likelihood.density import IN_WORKSPACE
from bayes3d_ros.likelihood.error_nodes import ErrorNodes
from bayes3d_ros.likelihood.scored_image import scored_image
from bayes3d_ros.likelihood.shared_errors import BLOCK_SIDE, shared_error_image
from bayes3d_ros.likelihood.slow_cells import cells_of
from bayes3d_ros.likelihood.slow_pixel_kinds import OBJECT, TABLE, kinds_of_pixels
from bayes3d_ros.likelihood.slow_shared_errors import log_density, objects_of, with_shared_errors
from bayes3d_ros.parsing.observe import amplitudes_of
from bayes3d_ros.settings import ParserSettings
from bayes3d_ros.validation.reference import shared_error_problem
from bayes3d_ros.validation.reference.prior_predictive import DepthRange
from bayes3d_ros.validation.reference.shared_error_cells import DrawnCells
from bayes3d_ros.validation.reference.shared_error_frame import (
    PinholeRays,
    RenderedScene,
    TrueErrors,
    lost_mass,
    margin_of,
    spread_of,
)
from bayes3d_ros.validation.reference.shared_error_predictive import sample_errors, sample_shared_depth
from bayes3d_ros.validation.reference.shared_error_problem import at_nodes, noise_posterior

WIDTH, HEIGHT = 20, 15
CAMERA = Intrinsics(153.75, 153.75, 9.5, 7.0, WIDTH, HEIGHT)
FOCAL = np.array([CAMERA.fx, CAMERA.fy])
RAYS = PinholeRays(*(a.astype(float) for a in (CAMERA.rays()[0, :, 0], CAMERA.rays()[:, 0, 1])), FOCAL)
LIMITS, SIGMA_MAX = DepthRange(0.3, 1.15), 0.005
AMPLITUDES = amplitudes_of(ParserSettings(unknown=False))
ERRORS = TrueErrors(0.0012, 0.05, 0.001, (1.0,))
BARE = 0.85 - 0.003 * np.arange(HEIGHT)[:, None] + np.zeros((HEIGHT, WIDTH))
WITHOUT_BAD = AMPLITUDES._replace(bad_share=np.float32(0))  # which cut the density off, by tens of nats
IMAGES = 100


def plate(off=0.0):
    """A plate 9 cm in front of the table, or farther away by `off` metres."""
    depth, label = BARE.copy(), np.full(BARE.shape, TABLE)
    depth[3:13, 4:16], label[3:13, 4:16] = 0.75 + off, OBJECT
    return RenderedScene(depth, label, BARE)


def image_of(depth):
    inside = np.full(depth.shape, IN_WORKSPACE)
    return scored_image(CAMERA, depth, inside, BARE, LIMITS.near, LIMITS.far, SIGMA_MAX)


def log_value(image, scene, errors, amplitudes):
    """log density, with the margin of ERRORS: what is told apart is not the margin."""
    return log_density(scene.depth, scene.label, image, density_of(image, errors, amplitudes, scene))[0, 0]


def density_of(image, errors, amplitudes, scene):
    """Of an image with these errors alone; of several scales the mean."""
    margin = margin_of(ERRORS, spread_of(scene))
    shared = shared_error_image(image, amplitudes, SIGMA_MAX)._replace(table_margin=margin)
    scales = len(errors.scale)
    nodes = ErrorNodes(
        *(np.array([value]) for value in errors[:3]),
        np.array(errors.scale),
        np.zeros((1, 1)),
        np.full(scales, -np.log(scales)),
    )
    return at_nodes(image, shared, nodes)


def log_mass(scene, errors=ERRORS):
    margin = margin_of(ERRORS, spread_of(scene))
    lost = lost_mass(scene.depth, scene.label, FOCAL, margin, LIMITS.far, 0.1).lost
    return np.log1p((1 - errors.p_outlier) * lost).sum()


def log_ratios(others, amplitudes=AMPLITUDES, **wrong):
    """Of the density divided by its integral: that of another scene or other errors over that which images are of."""
    found = []
    for k in range(IMAGES):
        rng = np.random.default_rng((0, k))
        image = image_of(sample_shared_depth(rng, plate(), RAYS, ERRORS, amplitudes, LIMITS, **wrong))
        own = log_value(image, plate(), ERRORS, amplitudes) - log_mass(plate())
        found.append([log_value(image, *other, amplitudes) - log_mass(*other) - own for other in others])
    return np.array(found).T


@pytest.mark.parametrize(
    ("amplitudes", "others"),
    [
        (AMPLITUDES, [(0, {"sigma": 0.00124}), (0, {"p_outlier": 0.057}), (0, {"table": 0.00107})]),
        (WITHOUT_BAD, [(2e-4, {}), (0, {"scale": (1.1,)})]),
    ],
    ids=["shipped", "without bad cells"],
)
def test_images_are_of_the_density(amplitudes, others):
    """The mean of another density over the own is one."""
    changed = [(plate(off), ERRORS._replace(**errors)) for off, errors in others]
    for ratio in np.exp(log_ratios(changed, amplitudes)):
        assert 0.02 < ratio.std() < 3
        assert abs(ratio.mean() - 1) < 3.5 * ratio.std() / np.sqrt(IMAGES)


def test_images_with_more_noise_are_not(monkeypatch):
    monkeypatch.setattr(f"{__name__}.IMAGES", 5)
    ratio = np.exp(log_ratios([(plate(), ERRORS._replace(sigma=1.03 * ERRORS.sigma))], noise_error=1.5))
    assert ratio.min() > 5


def test_edges_are_off_as_the_density_has_them(monkeypatch):
    """By what the cells of an object show with the scale in the middle, 1, whatever the object's own scale is."""
    told = []

    def spy(cells, v, u, original=DrawnCells.shared_error_at):
        told.append((v, u, original(cells, v, u)))
        return told[-1][-1]

    monkeypatch.setattr(DrawnCells, "shared_error_at", spy)
    errors, scene = ERRORS._replace(scale=(2.83,)), plate()
    image = image_of(sample_shared_depth(np.random.default_rng(0), scene, RAYS, errors, WITHOUT_BAD, LIMITS))
    density = density_of(image, errors._replace(scale=(0.35, 1.0, 2.83)), WITHOUT_BAD, scene)
    kinds = kinds_of_pixels(scene.depth, scene.label, image, density)
    cells = cells_of(scene.depth, scene.label, kinds, image, density)
    objects = objects_of(cells, scene.depth, scene.label, kinds, image, density)
    seen = with_shared_errors(scene.depth, scene.label, objects)
    ((v, u, off),) = told
    np.testing.assert_allclose(off, (seen - scene.depth)[v, u], atol=5e-6)
    assert np.abs(off).max() > 0.001


def test_outlines_are_those_of_the_density():
    scene = plate()
    image = image_of(scene.depth)
    kinds = kinds_of_pixels(scene.depth, scene.label, image, shared_error_image(image, AMPLITUDES, SIGMA_MAX))
    margin = np.full(BARE.shape, 0.008)
    found = lost_mass(scene.depth, scene.label, FOCAL, margin, LIMITS.far, 0.1)
    assert (found.edge == kinds.edge).all() and ((found.reach > 0) == kinds.near_outline).all()
    # A pixel of the plate: half of a tenth over 30 cm, from 2.8 cm in front of it to the farthest depth.
    reach = min(LIMITS.far, 0.75 + 0.3) - 0.75 + 0.028
    assert found.lost[3, 4] == pytest.approx(0.05 * (reach / 0.3 - 1))
    both = lost_mass(*(np.stack([a, a]) for a in scene[:2]), FOCAL, margin, LIMITS.far, 0.1)
    assert (both.lost == found.lost).all()


@pytest.mark.parametrize("whole_waves", [False, True])
def test_errors_have_their_moments(whole_waves):
    """Cells of one row: waves and the error that the whole plate shares, in closed form."""
    alone = {"lean": 0, "bad_share": 0, "model": 0, "edge_share": 0}
    amplitudes = AMPLITUDES._replace(**{name: np.float32(value) for name, value in alone.items()})
    errors = TrueErrors(2e-4, 1e-9, 0.002, (2.0,))
    draws = []
    for k in range(150):
        rng = np.random.default_rng((1, k))
        depth = sample_shared_depth(rng, plate(), RAYS, errors, amplitudes, LIMITS, whole_waves=whole_waves)
        off = depth - plate().depth
        draws.append([off[7, 7], off[7, 10], off[7, 13], off[1, 0], off[1, 19]])
    found = np.cov(np.array(draws).T) * 1e6
    # Blocks of three pixels.
    assert round(BLOCK_SIDE * FOCAL[0] / np.median(plate().depth)) == 3
    apart = 3 * 0.75 / FOCAL[0]
    bias2, wave2 = (2 * 1.2) ** 2, (2 * 1.0) ** 2
    expected = [bias2 + wave2 * np.exp(-k * apart / 0.05) for k in range(3)]
    error = 3.5 * (2 / 150) ** 0.5 * expected[0]
    assert found[0, 0] == pytest.approx(expected[0], abs=error)
    assert found[0, 1] == pytest.approx(expected[1], abs=error) and found[0, 2] == pytest.approx(expected[2], abs=error)
    # More than the waves' part of it would be off by if neighbours were not alike.
    assert found[0, 0] - found[0, 1] < 0.6 * wave2
    assert found[3, 3] == pytest.approx(4, abs=1.5) and abs(found[3, 4]) < 1.5 and abs(found[0, 3]) < 3


def test_errors_are_of_their_priors():
    errors = [sample_errors(np.random.default_rng(k), AMPLITUDES, (1e-3, 2e-3), (0.0, 0.1), 2) for k in range(300)]
    drawn = np.array([(*each[:3], *each.scale) for each in errors]).T
    shares = (drawn[0] - 1e-3) / 1e-3, drawn[1] / 0.1
    assert min(kstest(share, "uniform").pvalue for share in shares) > 0.01
    normal = np.log(drawn[2] / 1e-3) / 0.6, np.log(drawn[3]) / 0.6, np.log(drawn[4]) / 0.6
    assert min(kstest(value, "norm").pvalue for value in normal) > 0.01


def noise_ranks(noise_error, monkeypatch):
    monkeypatch.setattr(shared_error_problem, "_SIDE", 7)
    monkeypatch.setattr(shared_error_problem, "_NOISE_ROUNDS", 3)
    scene = RenderedScene(BARE, np.full(BARE.shape, TABLE), BARE)
    ranks = []
    for k in range(8):
        rng = np.random.default_rng((2, k))
        errors = sample_errors(rng, AMPLITUDES, (5e-4, 5e-3), (0.0, 0.1), 1)
        depth = sample_shared_depth(rng, scene, RAYS, errors, AMPLITUDES, LIMITS, noise_error=noise_error)
        image = image_of(depth)
        found = noise_posterior(image, shared_error_image(image, AMPLITUDES, SIGMA_MAX), scene, errors)
        ranks.append(np.interp(np.log(errors.sigma), np.log(found.sigma), found.below_sigma, 0, 1))
    return ranks


def test_calibration_finds_noise_that_is_too_large(monkeypatch):
    """Ranks of sigma given an empty table: uniform, and not where images are 1.5 times as noisy as the truth says."""
    assert kstest(noise_ranks(1.0, monkeypatch), "uniform").pvalue > 0.01
    assert kstest(noise_ranks(1.5, monkeypatch), "uniform").pvalue < 1e-4


@pytest.mark.parametrize(("off", "slope"), [(-0.020, 0.0), (0.010, 1.0)])
def test_excuses_end_gradually(off, slope):
    """A cell 2 cm in front of the plate, and a sloping one 1 cm behind it: a tenth of a millimetre of the plate's pose
    does not change the density by tens of nats."""
    noise = 0.0012 * np.random.default_rng(0).standard_normal(BARE.shape)
    depth = plate().depth + noise / np.sqrt(1 + RAYS.x**2 + RAYS.y[:, None] ** 2)
    depth[6:9, 9:12] += off + slope * 0.0049 * np.arange(-1, 2)
    image = image_of(depth)
    steps = np.arange(-1e-3, 1.01e-3, 1e-4)
    values = [log_value(image, plate(step), ERRORS, AMPLITUDES) for step in steps]
    assert np.abs(np.diff(values)).max() < 1.7
