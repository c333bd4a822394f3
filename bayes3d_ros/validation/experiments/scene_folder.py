# SPDX-License-Identifier: Apache-2.0

"""A folder of recordings: scenes to parse, and views of single objects to learn models from."""

from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.io.bags import BagDamage, BagError, FrameReader, read_frames
from bayes3d_ros.resources import share_directory
from bayes3d_ros.validation.statistics.ground_truth import GROUND_TRUTH, GroundTruth

VIEWS = "views_"  # how the names of bags with views of one object begin; models are learned from them


class RecordedScene(NamedTuple):
    """A bag, and the truth where it comes with one."""

    frames: FrameReader
    truth: GroundTruth | None

    @property
    def name(self) -> str:
        """Of the bag's folder or file, without .mcap."""
        return self.frames.bag.name.removesuffix(".mcap")

    def readable(self, most: int | None = None) -> Iterator[DepthFrame]:
        """Its first frames (`most`; None: all of them), but for those that cannot be read."""
        try:
            yield from islice(self.frames, most)
        except BagDamage:  # raised after the last frame
            return


class SceneFolder:
    """The recordings of a folder (rosbag2 folders and .mcap files in it), or of a single bag.

    scenes: in the order of their names. views: bags of views, by the type that they show: the folder's own, and the
    bundled (simulated) ones of other types. left_out: a line for each bag that cannot be read. Raises BagError where
    a ground_truth.json is damaged.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.scenes: list[RecordedScene] = []
        self.left_out: list[str] = []
        self.own_views = _views(folder)
        self.views = dict(sorted((_views(share_directory() / "bags") | self.own_views).items()))
        for bag in _bags(folder):
            if not bag.name.startswith(VIEWS):
                try:
                    self.scenes.append(recorded_scene(bag))
                except BagError as error:
                    self.left_out.append(str(error))


def recorded_scene(bag: Path) -> RecordedScene:
    """A bag with its truth. Raises BagError."""
    return RecordedScene(read_frames(bag), _truth(bag))


def _views(folder: Path) -> dict[str, Path]:
    """Bags of views, by type: that of the only object of the truth, or else what the bag's name says."""
    found = {}
    for bag in _bags(folder):
        if bag.name.startswith(VIEWS):
            truth = _truth(bag)
            types = truth.types if truth else ()
            found[types[0] if len(types) == 1 else bag.stem.removeprefix(VIEWS)] = bag
    return found


def _truth(bag: Path) -> GroundTruth | None:
    return GroundTruth(bag) if (bag / GROUND_TRUTH).is_file() else None


def _bags(folder: Path) -> list[Path]:
    if (folder / "metadata.yaml").is_file():
        return [folder]
    return sorted(path for path in folder.iterdir() if _is_bag(path)) if folder.is_dir() else []


def _is_bag(path: Path) -> bool:
    return path.suffix == ".mcap" if path.is_file() else (path / "metadata.yaml").is_file() or any(path.glob("*.mcap"))
