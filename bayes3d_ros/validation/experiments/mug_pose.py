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
one whose model has voxels of 5 mm in place of 3 mm (`5 mm`), the size of the paper's: its file is small, but voxels
are no smooth body, so the likelihood changes from yaw to yaw where the handle is hidden.

Networks have three sizes. Of the middle one there is also, at some numbers of images (ASKED), what a reviewer would ask
for: one trained on images that are shifted, offset and made noisier at random (`augmented`), and the mean of five
(`ensemble`), whose members also show how much chance matters. `mug-pose-training` shows how the losses of all
fell while they were trained.
"""

from collections.abc import Callable, Iterator
from functools import cache, partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from bayes3d_ros.validation.experiments import Row, Step
from bayes3d_ros.validation.experiments.mug_pose_parser import (
    COARSER,
    INDEPENDENT,
    TRUE_MESH,
    VIEWED_FROM,
    ParserStep,
    known_mug,
    parser_rows,
)
from bayes3d_ros.validation.experiments.mug_pose_plot import plot
from bayes3d_ros.validation.experiments.mug_pose_summary import ENOUGH_VIEWS, WANTED, summary
from bayes3d_ros.validation.experiments.mug_pose_truth import (
    GROUP,
    QUICK_GROUP,
    Truth,
    group_truth,
    mug_row,
)
from bayes3d_ros.validation.networks import augmentation, von_mises
from bayes3d_ros.validation.networks.depth_input import DepthScale
from bayes3d_ros.validation.networks.installed import require_networks
from bayes3d_ros.validation.reference.exact_yaw import YAWS, every_yaw
from bayes3d_ros.validation.simulate.mug_images import (
    MUG_CAMERA,
    MUG_CONDITIONS,
    TRAINED,
    MugImages,
    mug_images,
    mug_view,
    upright_mug,
)

if TYPE_CHECKING:  # of an extra that need not be installed
    from bayes3d_ros.validation.networks.training import Trained

__all__ = ["HEADER", "WANTED", "count", "line", "notes", "plot", "steps", "summary"]

TRAINING, QUICK_TRAINING = (10, 30, 100, 300, 1000, 3000, 10_000), (10, 100)
VIEWS, QUICK_VIEWS = (1, 2, ENOUGH_VIEWS, 10), (ENOUGH_VIEWS,)
GROUPS, QUICK_GROUPS = 10, 1  # of test images a condition: a group has one camera and place
TRAINING_SEED = 11
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
# Training images of the networks that a reviewer would ask for, and the size of these networks.
ASKED: dict[str, tuple[int, ...]] = {AUGMENTED: (100, 1000, 10_000), ENSEMBLE: (1000, 10_000)}
QUICK_ASKED: dict[str, tuple[int, ...]] = {AUGMENTED: (100,), ENSEMBLE: (100,)}
ASKED_OF = "1 M"
HEADER = f"{'method':<23} {'training':>8} {'test':<10} {'images':>6} {'cross-entropy':>13} {'log p(true)':>11} {'s':>7}"


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
        f"views are {VIEWED_FROM:g} m away and of 640 x 480 pixels, a hundred times as many as an image of "
        f"{MUG_CAMERA.width} x {MUG_CAMERA.height} has, with a D435's noise and exact camera poses; the mug is learned "
        "anew for each group of images, and its yaw is that of its seen surface on the mesh",
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
    small = next(iter(NETWORKS))
    if quick:
        plain, asked, asked_of = [NetworkStep(small, "", images) for images in QUICK_TRAINING], QUICK_ASKED, small
    else:
        plain, asked, asked_of = [NetworkStep(size, "", n) for n in TRAINING for size in NETWORKS], ASKED, ASKED_OF
    return plain + [NetworkStep(asked_of, kind, images) for kind in asked for images in asked[kind]]


def parser_steps(quick: bool) -> tuple[list[ParserStep], int]:
    """The parsers, and groups of test images."""
    views, groups = (QUICK_VIEWS, QUICK_GROUPS) if quick else ((*VIEWS, TRUE_MESH), GROUPS)
    parsers = [*map(ParserStep, views), ParserStep(ENOUGH_VIEWS, INDEPENDENT)]
    return (parsers if quick else [*parsers, ParserStep(ENOUGH_VIEWS, voxel_size=COARSER)]), groups


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
    known = partial(known_mug, mug)
    most = max(step.images for step in networks)
    images = cache(lambda: mug_images(mug(), TRAINED, most, (TRAINING_SEED,)))
    alone: "dict[tuple[str, int], Trained]" = {}
    for step in networks:
        yield partial(_network_rows, step, images, partial(_all_groups, truth, groups), alone, quick)
    for group in range(groups):
        for parser in parsers:
            yield partial(parser_rows, parser, group, truth, known)


def _all_groups(truth: Callable[[str, int], Truth], groups: int, condition: str) -> list[Truth]:
    return [truth(condition, group) for group in range(groups)]


def _network_rows(
    step: NetworkStep,
    images: Callable[[], MugImages],
    tests: Callable[[str], list[Truth]],
    alone: "dict[tuple[str, int], Trained]",
    quick: bool,
) -> list[Row]:
    """A row a condition, of a network trained on so many images. alone: plain networks by size and number of images,
    from which an ensemble takes its first member."""
    from bayes3d_ros.validation.networks.models import NetworkPlan
    from bayes3d_ros.validation.networks.training import QUICK_PLAN, TrainingPlan
    from bayes3d_ros.validation.networks.variants import Variant, predictions_of, train_variant, training_told

    every, plain = images(), Variant(NetworkPlan(*NETWORKS[step.size]))
    variant = {"": plain, AUGMENTED: plain._replace(augmentation=AUGMENTATION), ENSEMBLE: plain._replace(members=5)}
    depth, yaw = SCALE.as_input(every.depth[: step.images]), every.yaw[: step.images].astype(np.float32)
    plan = QUICK_PLAN if quick else TrainingPlan()
    own = step.size, step.images
    first = alone.get(own) if step.kind == ENSEMBLE else None
    members = train_variant(
        variant[step.kind], depth, yaw, 2, von_mises.output_loss, plan, seed=step.images, first=first
    )
    if not step.kind:
        alone[own] = members[0]
    told = training_told(members)
    rows = []
    for condition in MUG_CONDITIONS:
        said: list[von_mises.Mixture] = []
        groups = tests(condition)
        for truth in groups:
            outputs = predictions_of(members, SCALE.as_input(truth.images.depth))
            each = zip(*(von_mises.of_outputs(one) for one in outputs), strict=True)
            said += [von_mises.Mixture(together) for together in each]
        rows.append(mug_row(step.method, step.images, condition, said, groups) | told)
    return rows


def line(row: Row) -> str:
    """A row, under HEADER."""
    return (
        f"{row['method']:<23} {row['training'] or 'mesh':>8} {row['test']:<10} {len(row['cross_entropy']):>6} "
        f"{np.mean(row['cross_entropy']):>13.3f} {np.mean(row['log_p_true']):>11.3f} {row['seconds']:>7.1f}"
    )
