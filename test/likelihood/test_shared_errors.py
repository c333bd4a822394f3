# SPDX-License-Identifier: Apache-2.0

"""Errors that pixels share: cells against quadrature, what they cannot excuse, information that saturates, the kernel
against the reference, and limits in which the model is another."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import logsumexp

from bayes3d_ros.geometry.camera import Intrinsics
from bayes3d_ros.likelihood import slow_cells, slow_object_cells
from bayes3d_ros.likelihood import slow_shared_errors as slow
from bayes3d_ros.likelihood.density import IN_WORKSPACE, NO_RETURN, Noise
from bayes3d_ros.likelihood.image_model import gain, log_marginal, shared_errors
from bayes3d_ros.likelihood.own_plane import own_plane_log_density
from bayes3d_ros.likelihood.scene_score import log_likelihood_scene, pad_scene, render_objects
from bayes3d_ros.likelihood.scored_image import scored_image
from bayes3d_ros.likelihood.shared_errors import BLED_SHARE, Amplitudes, shared_error_image
from bayes3d_ros.objects.library_arrays import library_arrays
from bayes3d_ros.objects.mesh_import import model_from_mesh
from bayes3d_ros.objects.model import Library
from bayes3d_ros.objects.placement import Placement, Table

trimesh = pytest.importorskip("trimesh")
SIGMA, P, OUTLIER = 0.001, 0.005, 0.015
SHIPPED = Amplitudes(*map(np.float32, (0.0012, 0.001, 0.05, 0.001, 0.15, 0.1, 0.7, 0.015)))
NONE = Amplitudes(*map(np.float32, (0, 0, 0.05, 0, 0, 0, 0, 0)), np.False_)
CAMERA = Intrinsics(120.0, 120.0, 47.5, 35.5, 96, 72)
NEAR, FAR, SIGMA_MAX, WINDOW = 0.1, 5.0, 0.005, 3


def cells(residuals, lost=0.0):
    """One cell a row of residuals, metres; none is a plane of its own."""
    residual = np.atleast_2d(np.asarray(residuals, float))
    whole = np.ones(residual.shape)
    k = np.arange(len(residual))
    middle = 3.0 * np.stack([k % 6, k // 6], 1)
    label = np.full(len(residual), slow.OBJECT)
    return slow_cells.SurfaceCells(
        residual,
        whole,
        OUTLIER * whole,
        lost * whole,
        whole > 0,
        label,
        middle,
        np.full((len(residual), 4), -np.inf),
        np.median(residual, 1),
    )


def _log_object(residuals, errors):
    found = slow_cells.modes(cells(residuals), SIGMA, P)
    own = cells(residuals)
    middle = slow_object_cells.seen_middle(own, 0.005)
    return slow_object_cells.log_object(slow_object_cells.object_errors(own, found, 0, 1.0, errors, middle))


def by_quadrature(residual, sd, mean=0.0):
    b = np.linspace(-0.12, 0.12, 400_001)
    inlier = np.exp(-0.5 * ((residual[:, None] - b) / SIGMA) ** 2) / (np.sqrt(2 * np.pi) * SIGMA)
    log_cell = np.log(P * OUTLIER + (1 - P) * inlier).sum(0)
    log_prior = -0.5 * ((b - mean) / sd) ** 2 - np.log(np.sqrt(2 * np.pi) * sd)
    return logsumexp(log_cell + log_prior) + np.log(b[1] - b[0])


@pytest.mark.parametrize("count", [4, 9, 25])
@pytest.mark.parametrize("offset", [0.0, 0.001, 0.003, 0.006, 0.01, 0.02, 0.05])
@pytest.mark.parametrize("sd", [0.0005, 0.001, 0.003])
def test_a_cell_is_its_integral_over_the_offset(count, offset, sd):
    rng = np.random.default_rng(count)
    residual = offset + SIGMA * rng.normal(size=count)
    found = slow_cells.modes(cells(residual), SIGMA, P).normal(0.0, sd)[0]
    assert found == pytest.approx(by_quadrature(residual, sd), abs=0.1)


def test_a_table_of_cells_is_its_integral():
    """What a cell lacks, a table lacks thousands of times: .009 nats a cell if modes were as sharp as they would be if
    it were known which returns are outliers."""
    rng, count, p, sigma, sd = np.random.default_rng(0), 4000, 0.09, 0.004, 0.002
    residual = sd * rng.standard_normal((count, 1)) + sigma * rng.standard_normal((count, 9))
    residual = np.where(rng.random(residual.shape) < p, rng.uniform(-0.5, 0.5, residual.shape), residual)
    own = cells(residual)
    found = slow_cells.modes(own._replace(outlier=np.ones(residual.shape)), sigma, p).normal(0.0, sd)
    b = np.linspace(-6, 6, 201) * sd
    inlier = np.exp(-0.5 * ((residual[:, :, None] - b) / sigma) ** 2) / (np.sqrt(2 * np.pi) * sigma)
    log_cell, log_prior = np.log(p + (1 - p) * inlier).sum(1), -0.5 * (b / sd) ** 2
    exact = logsumexp(log_cell + log_prior, axis=1) - logsumexp(log_prior)
    assert abs((found - exact).mean()) < 0.0025


def test_a_cell_with_two_surfaces_counts_both_modes():
    residual = np.array([0.0002, -0.0005, 0.0003, 0.0001, 0.0203, 0.0198, 0.0201, 0.0206, 0.0199])
    for sd in (0.001, 0.01):
        assert slow_cells.modes(cells(residual), SIGMA, P).normal(0.0, sd)[0] == pytest.approx(
            by_quadrature(residual, sd), abs=0.1
        )


def test_what_is_seen_through_is_not_excused():
    """A block 15 mm in front of its model may be a dent or a bulge; 15 mm behind, the camera would see through it."""
    rng = np.random.default_rng(0)
    errors = _errors(SHIPPED)
    noise = SIGMA * rng.normal(size=(30, 9))
    off = np.where(np.arange(30)[:, None] % 7 == 3, 0.015, 0.0)  # four blocks, spread out

    def value(sign):
        return _log_object(noise + sign * off, errors)

    assert value(0) - value(-1) < 4 * 8
    assert value(0) - value(1) > 4 * 45


def _errors(amplitudes, image=None):
    image = image or _bare_image()[0]
    errors = shared_error_image(image, amplitudes, SIGMA_MAX)
    pairs = len(errors.nodes.sigma)
    nodes = errors.nodes._replace(sigma=np.full(pairs, SIGMA, np.float32), p_outlier=np.full(pairs, P, np.float32))
    return errors._replace(nodes=nodes)


def test_information_saturates():
    """Four times the pixels a block, and the same blocks: the width of an offset of the whole object stays, to 10 %."""
    rng = np.random.default_rng(1)
    errors = _errors(SHIPPED)

    def width(count):
        noise = SIGMA * rng.normal(size=(40, count))
        shifts = np.linspace(-0.003, 0.003, 7)
        values = [_log_object(noise + s, errors) for s in shifts]
        return np.sqrt(-1 / (2 * np.polyfit(shifts, values, 2)[0]))

    assert width(36) == pytest.approx(width(9), rel=0.1)


def _table():
    pose = np.eye(4)
    pose[:3, :3] = np.array([[1, 0, 0], [0, -np.sin(0.8), -np.cos(0.8)], [0, np.cos(0.8), -np.sin(0.8)]])
    pose[2, 3] = 0.7
    return Table(jnp.asarray(pose, jnp.float32), jnp.array([0.8, 0.8]))


def _bare_image(depth=None, seed=0):
    T = np.asarray(_table().T_camera_table, np.float64)
    bare = T[:3, 2] @ T[:3, 3] / (CAMERA.rays() @ T[:3, 2])
    rng = np.random.default_rng(seed)
    depth = (bare if depth is None else depth) + SIGMA * rng.normal(size=bare.shape)
    kind = np.where(rng.random(bare.shape) < 0.03, NO_RETURN, IN_WORKSPACE)
    return scored_image(CAMERA, np.where(kind > 0, depth, 0), kind, bare, NEAR, FAR, SIGMA_MAX), bare


def test_a_return_of_the_table_beside_an_outline_counts_where_its_own_ray_meets_the_table():
    """From row to row the table is 7 mm farther: the table's part of the window is that of the pixel's own ray, and
    a return there has the table's density times that part; half of it is for what is bled from beside."""
    image, bare = _bare_image()
    errors = _errors(SHIPPED._replace(edge_share=np.float32(0), bad_share=np.float32(0), unknown=np.False_), image)
    row, column = 20, 40
    label = np.ones(bare.shape, int)
    label[row : row + 2, column - 1 : column + 2] = slow.OBJECT  # the pixel itself and what is below it and beside
    depth = np.where(label == slow.OBJECT, 0.4, bare)
    edge = np.zeros(bare.shape, bool)
    edge[row, column] = True
    assert abs(bare[row - 1, column] - bare[row, column]) > 0.007

    def density(z):
        moved = np.asarray(image.depth).copy()
        moved[row, column] = z
        return float(np.exp(slow.log_edges(depth, label, edge, image._replace(depth=moved), errors, 0, 1.0)[0]))

    one = np.exp(-0.5 / float(SHIPPED.edge_blur) ** 2)
    part = one / (1 + 2 * one)  # of the row above
    x, y = float(image.ray_x[column]), float(image.ray_y[row])
    sd = np.hypot(SIGMA * float(errors.spread[row, column]) / np.sqrt(1 + x * x + y * y), float(errors.nodes.table[1]))
    peak = (1 - P) * (1 - BLED_SHARE) * part / (np.sqrt(2 * np.pi) * sd)
    assert density(bare[row, column]) == pytest.approx(peak, rel=0.01)
    assert 0.5 * peak < density(bare[row - 1, column]) < peak  # bled from the row above
    assert density((bare[row - 1, column] + bare[row, column]) / 2) < 0.1 * peak


@pytest.fixture(scope="module")
def scene():
    """A brick and a tower on a table, one in front of the other, with a bias and a dent; unknown things behind and
    beside."""
    shapes = {"brick": (0.10, 0.06, 0.04), "tower": (0.05, 0.05, 0.14)}
    library = library_arrays(
        Library(tuple(model_from_mesh(trimesh.creation.box(e), n, 0.004) for n, e in shapes.items()))
    )
    table = _table()
    blank, bare = _bare_image()
    objects = Placement(*(jnp.array(a) for a in ([1, 0], [5, 5], [0.02, -0.01], [0.08, -0.03], [0.3, 0.9])))
    rendered, labels = jnp.asarray(bare, jnp.float32)[None], np.ones(bare.shape, int)
    padded = pad_scene(rendered, WINDOW)
    truth = bare.astype(np.float32).astype(float)
    for k in range(2):
        one = jax.tree.map(lambda a, k=k: a[k : k + 1], objects)
        padded = render_objects(one, padded, jax.device_put(blank), library, table, WINDOW)
        depth = np.asarray(padded[0], float)[1 : 1 + len(bare), 1 : 1 + bare.shape[1]]
        labels = np.where(depth < truth, slow.OBJECT + k, labels)
        truth = np.minimum(truth, depth)
    dented = truth + 0.001 * (labels >= slow.OBJECT)
    dented[30:34, 40:44] -= 0.008
    dented[8:20, 30:75] = np.minimum(dented[8:20, 30:75], 0.74)  # something unknown behind the tower,
    dented[36:42, 24:40] = np.minimum(dented[36:42, 24:40], 0.645)  # and beside the brick, where depth goes on
    image, _ = _bare_image(dented, seed=3)
    return image, bare, truth, labels, library, table, objects


@pytest.mark.parametrize("amplitudes", [SHIPPED, NONE, SHIPPED._replace(unknown=np.False_)])
@pytest.mark.parametrize("which", [(0,), (1,), (0, 1)])
def test_the_kernel_adds_up_to_the_reference(scene, amplitudes, which):
    """Object after object, each with the error that the last one's returns share."""
    image, bare, _, _, library, table, objects = scene
    model = shared_errors(image, shared_error_image(image, amplitudes, SIGMA_MAX))
    context = jax.device_put(image), library, table
    total, padded = jnp.asarray(model.empty), pad_scene(jnp.asarray(bare, jnp.float32)[None], WINDOW)
    empty = float(log_marginal(model, total)[0])
    truth, labels = bare.astype(np.float32), np.ones(bare.shape, int)
    for k in which:
        one = jax.tree.map(lambda a, k=k: a[k : k + 1], objects)
        more, _ = gain(model, one, jnp.zeros(1, jnp.int32), padded, context, WINDOW)
        total = total + more
        padded = render_objects(one, padded, *context, WINDOW)
        depth = np.asarray(padded[0])[1 : 1 + len(bare), 1 : 1 + bare.shape[1]]
        truth, labels = np.minimum(truth, depth), np.where(depth < truth, slow.OBJECT + k, labels)
    before = slow.log_density(bare, np.ones(bare.shape, int), image, model.image)
    whole = slow.log_density(truth, labels, image, model.image)
    weight = model.image.nodes.log_weight.astype(float)
    expected = logsumexp(whole + weight) - logsumexp(before + weight)
    # Measured: without amplitudes 0.0011, one object 0.0036, the second in front of the first 0.776.
    bound = 0.002 if not amplitudes.bias else 0.006 if len(which) == 1 else 0.8
    assert float(log_marginal(model, total)[0]) - empty == pytest.approx(expected, abs=bound)


def test_gains_do_not_depend_on_what_else_is_scored(scene):
    """Nor on its order: what the kernel works in is used again, and what it knows of a scene is kept."""
    image, bare, _, _, library, table, objects = scene
    model = shared_errors(image, shared_error_image(image, SHIPPED, SIGMA_MAX))
    context = jax.device_put(image), library, table
    rng = np.random.default_rng(4)
    kinds = [jnp.asarray(rng.integers(0, n, 24)) for n in (2, 6)]
    places = [jnp.asarray(rng.uniform(-w, w, 24), jnp.float32) for w in (0.3, 0.3, 3.0)]
    many, first = Placement(*kinds, *places), jax.tree.map(lambda a: a[:1], objects)
    padded = pad_scene(jnp.asarray(bare, jnp.float32)[None], WINDOW)
    scenes = jnp.concatenate([padded, render_objects(first, padded, *context, WINDOW)])
    ancestor = jnp.asarray(rng.integers(0, 2, 24), jnp.int32)
    together, _ = gain(model, many, ancestor, scenes, context, WINDOW)
    for k in range(24):
        one = jax.tree.map(lambda a, k=k: a[k : k + 1], many)
        alone, _ = gain(model, one, ancestor[k : k + 1], scenes, context, WINDOW)
        assert np.array_equal(alone[0], together[k])


def test_without_amplitudes_pixels_are_independent(scene):
    """Of inner pixels the independent model looks at their neighbours as well: on slopes that
    costs it up to half a nat a pixel."""
    image, bare, truth, labels, _, _, _ = scene
    errors = shared_error_image(image, NONE, SIGMA_MAX)
    flat = errors._replace(spread=np.ones_like(errors.spread))
    ones = np.ones(bare.shape, int)
    node = 0
    apart = slow.log_density(truth, labels, image, flat) - slow.log_density(bare, ones, image, flat)
    noise = Noise(jnp.asarray(flat.nodes.sigma[node : node + 1]), jnp.asarray(flat.nodes.p_outlier[node : node + 1]))
    scenes = pad_scene(jnp.asarray(np.stack([bare, truth]), jnp.float32), WINDOW)
    independent = log_likelihood_scene(scenes, jax.device_put(image), noise, WINDOW)[:, 0, 0]
    objects = int((labels >= slow.OBJECT).sum())
    assert apart[node, 0] == pytest.approx(float(independent[1] - independent[0]), abs=0.6 * objects)
    assert np.ptp(apart[node]) < 1e-6  # no amplitude matters


def _cost_a_cm2(surface):
    """Nats by which a known surface is likelier than an unknown thing of its shape, a square centimetre of it as the
    camera sees it."""
    rays = CAMERA.rays()
    depth = surface(rays[..., 0], rays[..., 1])
    patch = np.zeros(depth.shape, bool)
    patch[21:51, 41:55] = True
    rng = np.random.default_rng(5)
    seen = np.where(patch, depth, 2.0) + SIGMA * rng.normal(size=depth.shape)
    everywhere, behind = np.full(depth.shape, IN_WORKSPACE), np.full(depth.shape, 2.0)
    image = scored_image(CAMERA, seen, everywhere, behind, NEAR, FAR, SIGMA_MAX)
    sigma, p = np.array([SIGMA]), np.array([P])
    unknown = own_plane_log_density(image, patch, np.ones(depth.shape), 4, sigma, p)[0]
    known = -0.5 * ((seen - depth)[patch] / SIGMA) ** 2 - np.log(np.sqrt(2 * np.pi) * SIGMA)
    return (known.sum() - unknown[patch].sum()) / (1e4 * (depth[patch] / CAMERA.fx) ** 2).sum()


def _tilted(angle):
    def plane(x, y):
        return 0.5 / (1 - np.tan(angle) * x)

    return plane


def _cylinder(x, y, radius=0.04, away=0.5):
    """Upright, its axis in front of the camera."""
    a, b, c = 1 + x**2, -2 * (away + radius), (away + radius) ** 2 - radius**2
    return (-b - np.sqrt(np.maximum(b * b - 4 * a * c, 0))) / (2 * a)


def test_unknown_surfaces_cost_the_same_whatever_their_slope_and_more_where_they_bend():
    costs = [_cost_a_cm2(_tilted(np.radians(a))) for a in (0, 20, 40, 60)]
    assert min(costs) > 2.0 and max(costs) / min(costs) < 1.12, costs
    assert 1.1 < _cost_a_cm2(_cylinder) / min(costs) < 1.3


def test_an_unknown_surface_goes_on_from_block_to_block():
    """Each block's density depends on its own returns and on those of the blocks to its left and above; a surface that
    goes on costs less than blocks that are apart, each of them a plane."""
    rays = CAMERA.rays()
    patch = np.zeros(rays.shape[:2], bool)
    patch[24:48, 40:64] = True
    rng = np.random.default_rng(7)
    noise = SIGMA * rng.normal(size=patch.shape)
    blocks = np.kron(rng.uniform(-0.02, 0.02, (18, 24)), np.ones((4, 4)))

    def log_density(depth):
        image = scored_image(
            CAMERA, np.where(patch, depth, 1.0), np.full(patch.shape, IN_WORKSPACE), np.full(patch.shape, 2.0), NEAR,
            FAR, SIGMA_MAX,
        )  # fmt: skip
        return own_plane_log_density(image, patch, np.ones(patch.shape), 4, np.array([SIGMA]), np.array([P]))[0]

    plane = _tilted(np.radians(30))(rays[..., 0], rays[..., 1]) + noise
    smooth, apart = log_density(plane), log_density(plane + blocks)
    per_block = (smooth - apart)[patch].sum() / 36
    assert 3.5 < per_block < 4.5, per_block
    moved = plane.copy()
    moved[32:36, 48:52] += 0.004
    changed = np.abs(log_density(moved) - smooth) > 1e-5
    expected = np.zeros(patch.shape, bool)
    for row, column in ((8, 12), (8, 13), (9, 12)):  # itself, and the blocks to its right and below
        expected[4 * row : 4 * row + 4, 4 * column : 4 * column + 4] = True
    assert np.array_equal(changed, expected)
