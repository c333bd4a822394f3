# SPDX-License-Identifier: Apache-2.0

"""How well the yaw of a mug is known (Bayes3D, "6D Pose Uncertainty"): the parser with a mug that it learned from 1 to
10 views, against convolutional networks trained on 10 to 10,000 images, which output a von Mises distribution.

Loss: cross-entropy from the exact posterior (`exact_yaw.py`: enumeration with the true mesh, the camera, the mug's
place and the stated noise). Images are those of `mug_images.py`; both methods are given the same image, and the parser
the camera's pose. A von Mises is fitted to its 1,000 samples by maximum likelihood; beside that stands the loss of the
samples themselves, through a kernel. `mug-pose-handle` shows how widely each spreads the yaw, by how much of the handle
is in sight.

Pixels of these images err independently, as in the paper. The shipped likelihood allows for errors that pixels share.
With five views there is also the parser with `likelihood: independent`, which is that of the paper (`independent`), and
one whose model has voxels of 2 mm in place of 5 mm (`2 mm`): voxels are no smooth body, so the likelihood changes from
yaw to yaw where the handle is hidden.

Networks have three sizes. Of the middle one there is also, at 1,000 and 10,000 images, what a reviewer would ask for:
one trained on images that are shifted, offset and made noisier at random (`augmented`), and the mean of five
(`ensemble`). `mug-pose-training` shows how the losses of all fell while they were trained.
"""

import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayes3d_ros.learning.learn import learn
from bayes3d_ros.objects.mesh_import import model_from_mesh
from bayes3d_ros.objects.model import Library, ObjectModel
from bayes3d_ros.objects.store import load_library, save_model
from bayes3d_ros.parsing.parser import SceneParser
from bayes3d_ros.posterior.types import ParseError
from bayes3d_ros.settings import LearnerSettings, ParserSettings
from bayes3d_ros.validation.experiments import Row, Step
from bayes3d_ros.validation.experiments.mug_pose_plot import plot
from bayes3d_ros.validation.experiments.mug_pose_summary import ENOUGH_VIEWS, PARSER, WANTED, summary
from bayes3d_ros.validation.networks import augmentation, von_mises
from bayes3d_ros.validation.networks.depth_input import DepthScale
from bayes3d_ros.validation.networks.installed import require_networks
from bayes3d_ros.validation.reference.exact_yaw import YAWS, entropy, every_yaw, yaw_axis, yaw_posterior
from bayes3d_ros.validation.simulate.capture_views import capture
from bayes3d_ros.validation.simulate.mug_images import (
    MUG_CAMERA,
    MUG_CONDITIONS,
    TRAINED,
    MugImages,
    UprightMug,
    mug_images,
    mug_view,
    upright_mug,
)
from bayes3d_ros.validation.statistics.model_sizes import ModelSizes, model_sizes
from bayes3d_ros.validation.statistics.yaw_samples import (
    WeightedYaws,
    YawScores,
    circular_sd,
    kernel_density,
    weighted_yaws,
    yaw_scores,
)

__all__ = ["HEADER", "WANTED", "count", "line", "notes", "plot", "steps", "summary"]

TRAINING, QUICK_TRAINING = (10, 30, 100, 300, 1000, 3000, 10_000), (10, 100)
ASKED, QUICK_ASKED = (1000, 10_000), (100,)  # training images of the networks that a reviewer would ask for
VIEWS, QUICK_VIEWS = (1, 2, ENOUGH_VIEWS, 10), (ENOUGH_VIEWS,)
TRUE_MESH = 0  # views of the model that is made from the mesh itself
GROUPS, QUICK_GROUPS = 10, 1  # of test images a condition: a group has one camera and place
GROUP, QUICK_GROUP = 10, 1  # images of a group
TRAINING_SEED, TEST_SEED = 11, 12
QUICK_STEPS = 60
QUICK_YAWS = 720  # of the exact posterior
SCALE = DepthScale(0.5, 0.1)
# Channels of convolutions and widths of hidden layers, by the number of parameters.
NETWORKS: dict[str, tuple[tuple[int, ...], tuple[int, ...]]] = {
    "0.1 M": ((8, 16, 32, 64), (128,)),
    "1 M": ((16, 32, 64, 128), (512, 256)),
    "7 M": ((16, 32, 64, 128), (2048, 1800)),
}
AUGMENTATION = augmentation.usual(SCALE, shift=3)
AUGMENTED, ENSEMBLE = "augmented", "ensemble"
INDEPENDENT = "independent"  # the likelihood that the images are drawn from
FINER = 0.002  # metres: sides of voxels
ASKED_OF = "1 M"  # size of these networks
SETTINGS = ParserSettings(
    fixed_objects=1, max_objects=1, unknown=False, particles=500, score_width=MUG_CAMERA.width, sigma_max=0.01
)  # every particle gives two samples
LEARNED = LearnerSettings(voxel_size=0.005)
HEADER = f"{'method':<23} {'training':>8} {'test':<10} {'images':>6} {'cross-entropy':>13} {'log p(true)':>11} {'s':>7}"


class Truth(NamedTuple):
    """Test images of one camera and place; of each the exact posterior over `yaw_axis()`, and the share of the handle
    that the mug does not hide."""

    images: MugImages
    posterior: Float[np.ndarray, "N K"]
    handle: Float[np.ndarray, "N"]


class KnownMug(NamedTuple):
    """A parser of one mug, and the yaw of the true mesh in its model's frame."""

    parser: SceneParser
    turn: float  # radians
    seconds: float  # of learning
    sizes: ModelSizes


def notes(quick: bool) -> list[str]:
    """What the figures are of. Raises NetworksMissingError where networks cannot be trained."""
    require_networks()
    return [
        f"the exact posterior is given the true camera, place and noise, in {QUICK_YAWS if quick else YAWS} steps of "
        "the yaw; where the mug is moved neither method knows its place, so there the exact posterior is sharper than "
        "that of the images alone",
        "networks get the depth of every return, scaled, and a channel that is 1 where nothing returned; the parser "
        "gets the camera's pose, in `camera` that of each image, and leaves out returns that its mask leaves out "
        "(decision 2)",
        "networks are trained on images of one camera and place, those of `as trained`",
        f"views are of 640 x 480 pixels, a hundred times as many as an image of {MUG_CAMERA.width} x "
        f"{MUG_CAMERA.height} has, with a D435's noise and exact camera poses",
        f"von Mises distributions of networks and of samples have concentrations of at most "
        f"{von_mises.LARGEST_CONCENTRATION:g}",
    ]


class NetworkStep(NamedTuple):
    """A network to train."""

    size: str  # of NETWORKS
    kind: str  # "", AUGMENTED or ENSEMBLE
    images: int

    @property
    def method(self) -> str:
        """What rows call it."""
        return f"network {self.size}" + (f" ({self.kind})" if self.kind else "")


def network_steps(quick: bool) -> list[NetworkStep]:
    """The networks, in the order of their steps."""
    if quick:
        small = next(iter(NETWORKS))
        plain = [NetworkStep(small, "", images) for images in QUICK_TRAINING]
        return plain + [NetworkStep(small, kind, n) for n in QUICK_ASKED for kind in (AUGMENTED, ENSEMBLE)]
    plain = [NetworkStep(size, "", images) for images in TRAINING for size in NETWORKS]
    return plain + [NetworkStep(ASKED_OF, kind, images) for images in ASKED for kind in (AUGMENTED, ENSEMBLE)]


class ParserStep(NamedTuple):
    """A parser to test."""

    views: int
    likelihood: str = SETTINGS.likelihood
    voxel_size: float = LEARNED.voxel_size  # metres

    @property
    def method(self) -> str:
        """What rows call it."""
        changed = [self.likelihood] if self.likelihood != SETTINGS.likelihood else []
        changed += [f"{1000 * self.voxel_size:g} mm"] if self.voxel_size != LEARNED.voxel_size else []
        return f"{PARSER} ({', '.join(changed)})" if changed else PARSER


def parser_steps(quick: bool) -> tuple[list[ParserStep], int]:
    """The parsers, and groups of test images."""
    views, groups = (QUICK_VIEWS, QUICK_GROUPS) if quick else ((*VIEWS, TRUE_MESH), GROUPS)
    parsers = [*map(ParserStep, views), ParserStep(ENOUGH_VIEWS, INDEPENDENT)]
    return (parsers if quick else [*parsers, ParserStep(ENOUGH_VIEWS, voxel_size=FINER)]), groups


def count(quick: bool) -> int:
    """A step is a trained network, or a group of test images of every condition with a parser."""
    parsers, groups = parser_steps(quick)
    return len(network_steps(quick)) + len(parsers) * groups


def steps(quick: bool) -> Iterator[Step]:
    """Networks, then every parser in turn."""
    networks, (parsers, groups) = network_steps(quick), parser_steps(quick)
    mug = cache(upright_mug)
    yaws, each = (QUICK_YAWS, QUICK_GROUP) if quick else (YAWS, GROUP)
    fixed = cache(lambda: every_yaw(mug(), mug_view(TRAINED, np.random.default_rng(0)), yaws))
    truth = cache(partial(group_truth, mug, fixed, each))
    known = cache(partial(known_mug, mug))
    most = max(step.images for step in networks)
    images = cache(lambda: mug_images(mug(), TRAINED, most, (TRAINING_SEED,)))
    for step in networks:
        yield partial(_network_rows, step, images, partial(_all_groups, truth, groups), quick)
    for group in range(groups):
        for parser in parsers:
            yield partial(_parser_rows, parser, group, truth, known)


def group_truth(
    mug: Callable[[], UprightMug],
    fixed: Callable[[], Float[np.ndarray, "K height width"]],
    each: int,
    condition: str,
    group: int,
) -> Truth:
    """A group of test images of a condition. The images of a quick run are the first of a full one's. fixed: what the
    camera would see at every yaw where neither it nor the mug is moved."""
    drawn = MUG_CONDITIONS[condition]
    images = mug_images(mug(), drawn, each, (TEST_SEED, list(MUG_CONDITIONS).index(condition), group))
    clean = fixed() if drawn.one_view else every_yaw(mug(), images.view, len(fixed()))
    handle = np.array([mug().handle_in_sight(images.view, yaw) for yaw in images.yaw])
    return Truth(images, np.array([yaw_posterior(depth, clean, drawn.noise) for depth in images.depth]), handle)


def _all_groups(truth: Callable[[str, int], Truth], groups: int, condition: str) -> list[Truth]:
    return [truth(condition, group) for group in range(groups)]


def _network_rows(
    step: NetworkStep,
    images: Callable[[], MugImages],
    tests: Callable[[str], list[Truth]],
    quick: bool,
) -> list[Row]:
    """A row a condition, of a network trained on so many images."""
    from bayes3d_ros.validation.networks.models import NetworkPlan
    from bayes3d_ros.validation.networks.training import TrainingPlan
    from bayes3d_ros.validation.networks.variants import Variant, predictions_of, train_variant, training_told

    every, plain = images(), Variant(NetworkPlan(*NETWORKS[step.size]))
    variant = {"": plain, AUGMENTED: plain._replace(augmentation=AUGMENTATION), ENSEMBLE: plain._replace(members=5)}
    depth, yaw = SCALE.as_input(every.depth[: step.images]), every.yaw[: step.images].astype(np.float32)
    plan = TrainingPlan(most_steps=QUICK_STEPS, check_every=20) if quick else TrainingPlan()
    members = train_variant(variant[step.kind], depth, yaw, 2, von_mises.output_loss, plan, seed=step.images)
    told = training_told(members)
    rows = []
    for condition in MUG_CONDITIONS:
        scores: list[YawScores] = []
        groups = tests(condition)
        for truth in groups:
            said = predictions_of(members, SCALE.as_input(truth.images.depth))
            each = zip(*(von_mises.of_outputs(outputs) for outputs in said), strict=True)
            scores += _von_mises_scores([von_mises.Mixture(together) for together in each], truth)
        rows.append(_row(step.method, step.images, condition, scores, groups) | told)
    return rows


def _von_mises_scores(said: Sequence[von_mises.VonMises | von_mises.Mixture], truth: Truth) -> list[YawScores]:
    axis = yaw_axis(truth.posterior.shape[1])
    return [
        yaw_scores(q.log_density, axis, exact, yaw)
        for q, exact, yaw in zip(said, truth.posterior, truth.images.yaw, strict=True)
    ]


def _row(method: str, size: int, condition: str, scores: Sequence[YawScores], groups: Sequence[Truth]) -> Row:
    """A value an image in each list: of the von Mises, with its standard deviation in degrees; then the exact
    posterior's own entropy and standard deviation, the cross-entropy of the best von Mises that there is, and the share
    of the handle in sight."""
    best = [s.cross_entropy for truth in groups for s in _von_mises_scores(_best_fits(truth), truth)]
    return {
        "method": method,
        "training": size,
        "test": condition,
        "cross_entropy": [round(s.cross_entropy, 4) for s in scores],
        "log_p_true": [round(s.log_p_true, 4) for s in scores],
        "sd": [round(s.sd, 3) for s in scores],
        "entropy": [round(entropy(exact), 4) for truth in groups for exact in truth.posterior],
        "exact_sd": [round(circular_sd(yaw_axis(len(p)), p), 3) for truth in groups for p in truth.posterior],
        "handle": [round(float(share), 3) for truth in groups for share in truth.handle],
        "best_von_mises": [round(value, 4) for value in best],
    }


def _best_fits(truth: Truth) -> list[von_mises.VonMises]:
    """The von Mises of least cross-entropy from each exact posterior: its weighted maximum likelihood."""
    axis = yaw_axis(truth.posterior.shape[1])
    return [von_mises.fit(axis, exact) for exact in truth.posterior]


def known_mug(mug: Callable[[], UprightMug], step: ParserStep) -> KnownMug:
    """A parser of the mug, learned from so many views around it, or (TRUE_MESH) made from the mesh; compiled."""
    thing, model, turn, seconds = mug().thing, None, 0.0, 0.0
    if step.views == TRUE_MESH:
        model = model_from_mesh(thing.mesh, thing.name, step.voxel_size)
    else:
        captures = capture(thing, np.eye(4), step.views, (0.0, 0.0), seed=step.views)
        start = time.perf_counter()
        learned = learn(captures.frames, thing.name, replace(LEARNED, voxel_size=step.voxel_size))
        seconds = time.perf_counter() - start
        T_model_mesh = np.linalg.inv(learned.T_table_object) @ captures.T_table_object
        model, turn = learned.model, float(np.arctan2(T_model_mesh[1, 0], T_model_mesh[0, 0]))
    library = _by_way_of_a_file(model)
    parser = SceneParser(library, replace(SETTINGS, likelihood=step.likelihood))
    parser.warm_up(MUG_CAMERA.width, MUG_CAMERA.height)
    return KnownMug(parser, turn, seconds, model_sizes(library))


def _by_way_of_a_file(model: ObjectModel) -> Library:
    """The library of one model, as a robot would have it."""
    with tempfile.TemporaryDirectory(prefix="bayes3d-mug-pose-") as folder:
        save_model(model, Path(folder))
        return load_library(Path(folder))


def _parser_rows(
    step: ParserStep, group: int, truth: Callable[[str, int], Truth], known: Callable[[ParserStep], KnownMug]
) -> list[Row]:
    """A row a condition, of a group of its images."""
    mug = known(step)
    rows = []
    for number, condition in enumerate(MUG_CONDITIONS):
        own = truth(condition, group)
        stamps = [(1_700_000_000 + (group * len(MUG_CONDITIONS) + number) * GROUP + k) * 10**9 for k in range(GROUP)]
        start = time.perf_counter()
        found = [_samples_of(mug, own.images, k, stamps[k]) for k in range(len(own.images.yaw))]
        seconds = time.perf_counter() - start
        said = [_anything() if one is None else one for one in found]
        axis = yaw_axis(own.posterior.shape[1])
        samples = [
            yaw_scores(kernel_density(one), axis, exact, yaw)
            for one, exact, yaw in zip(said, own.posterior, own.images.yaw, strict=True)
        ]
        fits = [von_mises.fit(one.yaw, one.weight) for one in said]
        rows.append(
            _row(step.method, step.views, condition, _von_mises_scores(fits, own), [own])
            | {"samples_cross_entropy": [round(s.cross_entropy, 4) for s in samples]}
            | {"samples_log_p_true": [round(s.log_p_true, 4) for s in samples]}
            | {"failed": sum(one is None for one in found), "seconds": round(seconds, 2)}
            | {"learning_seconds": round(mug.seconds, 2), "file_bytes": max(mug.sizes.files)}
            | {"memory_bytes": mug.sizes.memory, "padded_memory_bytes": mug.sizes.padded_memory}
        )
    return rows


def _samples_of(mug: KnownMug, images: MugImages, k: int, stamp_ns: int) -> WeightedYaws | None:
    """Yaws of the true mesh; None where nothing is found."""
    try:
        posterior = mug.parser.parse(images.frame(k, stamp_ns))
    except ParseError:
        return None
    found = weighted_yaws(posterior.samples, images.view.T_table_camera)
    return found._replace(yaw=found.yaw + mug.turn)


def _anything() -> WeightedYaws:
    """What is known of the yaw where nothing is found."""
    axis = yaw_axis(720)
    return WeightedYaws(axis, np.full(len(axis), 1 / len(axis)), np.arange(len(axis)))


def line(row: Row) -> str:
    """A row, under HEADER."""
    return (
        f"{row['method']:<23} {row['training'] or 'mesh':>8} {row['test']:<10} {len(row['cross_entropy']):>6} "
        f"{np.mean(row['cross_entropy']):>13.3f} {np.mean(row['log_p_true']):>11.3f} {row['seconds']:>7.1f}"
    )
