# SPDX-License-Identifier: Apache-2.0

"""What the density integrates over in closed form, by importance sampling: differences between scenes of a box on a
table, 196 pixels, at one node of the errors' parameters."""

from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
from fixtures.sampled_marginal import log_marginal

from bayes3d_ros.geometry.camera import Intrinsics
from bayes3d_ros.likelihood.density import IN_WORKSPACE
from bayes3d_ros.likelihood.error_nodes import ErrorNodes
from bayes3d_ros.likelihood.own_plane import own_plane_log_density
from bayes3d_ros.likelihood.scored_image import scored_image
from bayes3d_ros.likelihood.shared_errors import shared_error_image
from bayes3d_ros.likelihood.slow_pixel_kinds import NOTHING, OBJECT, TABLE
from bayes3d_ros.likelihood.slow_shared_errors import log_density
from bayes3d_ros.parsing.observe import amplitudes_of
from bayes3d_ros.settings import ParserSettings

SIDE = 14
CAMERA = Intrinsics(80.0, 80.0, 6.5, 6.5, SIDE, SIDE)
AWAY, ELEVATION = 0.6, 0.8  # metres, radians
SIGMA, P, TABLE_SD, SIGMA_MAX = 0.001, 0.005, 0.0008, 0.005
SHIPPED = ParserSettings(unknown=False)
ENOUGH = 0.3  # nats
LIKELY = 60.0  # nats below the best: what is less likely decides nothing


class Box(NamedTuple):
    """Upright on the table: metres, radians."""

    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.3
    size: tuple[float, float, float] = (0.065, 0.05, 0.045)


TRUTH = Box()
OTHERS = {
    "1 mm along x": Box(x=0.001),
    "1 mm along y": Box(y=0.001),
    "3 mm along y": Box(y=-0.003),
    "2 degrees": Box(yaw=0.335),
    "1.5 mm larger": Box(size=(0.0665, 0.0515, 0.0465)),
}
PLATE = Box(size=(0.05, 0.05, 0.002))  # that may as well be nothing


class Errors(NamedTuple):
    """The amplitudes of a case, and how many blocks of the box are dented."""

    settings: ParserSettings
    dents: int = 0


CASES = {
    "shipped": Errors(SHIPPED),
    "twice": Errors(replace(SHIPPED, surface_bias=0.0024, surface_waves=0.002, model_error=0.002, object_lean=0.03)),
    "bias only": Errors(replace(SHIPPED, surface_waves=0.0, model_error=0.0, object_lean=0.0, bad_share=0.0)),
    "dents": Errors(SHIPPED, 3),
    "dents are common": Errors(replace(SHIPPED, bad_share=0.15), 3),
}
# Differences that are farther off than `ENOUGH`: by how much at most. Cells whose error cannot reach their returns are
# scored in the tails of their likelihoods, where the normal about a mode falls faster than returns that turn to
# outliers one by one: objects' without errors of their own, and the table's under a plate.
FARTHER_OFF = {("bias only", "1 mm along y"): 0.6, ("twice", "no plate"): 0.6}


def table_pose():
    c, s = np.cos(ELEVATION), np.sin(ELEVATION)
    pose = np.eye(4)
    pose[:3, :3] = [[1, 0, 0], [0, -s, -c], [0, c, -s]]
    pose[2, 3] = AWAY
    return pose


def drawn(box):
    """Depth, and labels of pixels; None: the bare table."""
    rays, T = CAMERA.rays().astype(float), table_pose()
    bare = T[:3, 2] @ T[:3, 3] / (rays @ T[:3, 2])
    if box is None:
        return bare, np.full(bare.shape, TABLE)
    c, s = np.cos(box.yaw), np.sin(box.yaw)
    T = T @ np.array([[c, -s, 0, box.x], [s, c, 0, box.y], [0, 0, 1, box.size[2] / 2], [0, 0, 0, 1]])
    eye, along, half = -T[:3, :3].T @ T[:3, 3], rays @ T[:3, :3], np.array(box.size) / 2
    sides = np.sort([(-half - eye) / along, (half - eye) / along], 0)
    enter, leave = sides[0].max(-1), sides[1].min(-1)
    hit = (enter < leave) & (enter < bare)
    return np.where(hit, enter, bare), np.where(hit, OBJECT, TABLE)


def by_block(values):
    return np.kron(values, np.ones((2, 2)))


def observed(box, case, seed):
    """An image of the box with errors drawn from the model, and with these errors at one node."""
    settings, rng = case.settings, np.random.default_rng(seed)
    depth, label = drawn(box)
    blocks = np.indices((SIDE // 2, SIDE // 2)).reshape(2, -1).T * 2 * AWAY / CAMERA.fx
    apart = np.linalg.norm(blocks[:, None] - blocks, axis=-1)
    waves = np.linalg.cholesky(np.exp(-apart / settings.wave_length)) @ rng.normal(size=len(blocks))
    own, waves = by_block(rng.normal(size=(SIDE // 2, SIDE // 2))), by_block(waves.reshape(SIDE // 2, -1))
    v, u = (np.indices(depth.shape) - CAMERA.cx) * AWAY / CAMERA.fx
    lean = settings.object_lean * (rng.normal() * u + rng.normal() * v)
    off = settings.surface_bias * rng.normal() + lean + settings.model_error * own + settings.surface_waves * waves
    whole = by_block((label == OBJECT).reshape(SIDE // 2, 2, SIDE // 2, 2).all((1, 3))) > 0
    inner = np.argwhere(whole[::2, ::2])
    for row, column in rng.permutation(inner)[: case.dents]:
        off[2 * row : 2 * row + 2, 2 * column : 2 * column + 2] -= rng.uniform(0.004, 0.015)
    noisy = depth + np.where(label == OBJECT, off, 0.5 * TABLE_SD * own) + SIGMA * rng.normal(size=depth.shape)
    everywhere = np.full(depth.shape, IN_WORKSPACE)
    image = scored_image(CAMERA, noisy, everywhere, drawn(None)[0], 0.1, 5.0, SIGMA_MAX)
    return image, at_one_node(image, shared_error_image(image, amplitudes_of(settings), SIGMA_MAX))


def at_one_node(image, errors):
    one = (np.array([value], np.float32) for value in (SIGMA, P, TABLE_SD, 1.0))
    nodes = ErrorNodes(*one, np.zeros((1, 1), np.float32), np.zeros(1, np.float32))
    standing = (image.pixel_class == IN_WORKSPACE) & (image.depth < image.bare_depth - errors.table_margin)
    own_plane = own_plane_log_density(image, standing, errors.spread, int(errors.block), nodes.sigma, nodes.p_outlier)
    return errors._replace(nodes=nodes, own_plane=own_plane)


def scene(box, image):
    """In arrays of the image's shape, which have more rows than the camera."""
    depth, label = drawn(box)
    below = [(0, len(image.depth) - SIDE), (0, 0)]
    return np.pad(depth, below, constant_values=np.inf), np.pad(label, below, constant_values=NOTHING)


@cache
def both(box, true_box, name, seed):
    """The reference's log density, and what sampling says of it."""
    image, errors = observed(true_box, CASES[name], seed)
    shown = *scene(box, image), image, errors
    found = log_marginal(*shown)
    assert found.share > 0.7 and found.error < 0.05  # effective draws
    return float(log_density(*shown)[0, 0]), found.value


def differences(box, true_box, name, seed):
    """Of a scene and the true one: the reference's, and sampling's."""
    one, true = both(box, true_box, name, seed), both(true_box, true_box, name, seed)
    return one[0] - true[0], one[1] - true[1]


@pytest.mark.parametrize("other", OTHERS)
@pytest.mark.parametrize("name", CASES)
def test_differences_between_scenes_are_those_of_the_integral(name, other):
    said, true = differences(OTHERS[other], TRUTH, name, 1)
    if abs(true) < LIKELY:
        assert said == pytest.approx(true, abs=FARTHER_OFF.get((name, other), ENOUGH))
    else:
        assert said < -LIKELY and said == pytest.approx(true, rel=0.1)


@pytest.mark.parametrize("name", CASES)
def test_whether_there_is_an_object(name):
    """A plate of 2 mm, worth some tens of nats."""
    said, true = differences(None, PLATE, name, 1)
    assert said == pytest.approx(true, abs=FARTHER_OFF.get((name, "no plate"), ENOUGH))


def test_other_amplitudes_are_told_apart():
    """The same image under twice the amplitudes: what the comparison would show of a wrong integral."""
    image, errors = observed(TRUTH, CASES["shipped"], 1)
    twice = errors._replace(amplitudes=amplitudes_of(CASES["twice"].settings))
    off = []
    for box in (TRUTH, OTHERS["3 mm along y"]):
        shown = scene(box, image)
        off.append(float(log_density(*shown, image, twice)[0, 0]) - log_marginal(*shown, image, errors).value)
    assert abs(off[1] - off[0]) > 10 * ENOUGH
