# SPDX-License-Identifier: Apache-2.0

"""What is reported for objects that the library does not hold, and for empty tables? Simulated tables of YCB objects.

The library holds ten types. Kinds of frames: one foreign object (`unknown`; `lookalike` in the summary where a library
type fits what is seen of it), one known object (`known`), a dented one (`deformed`), known and foreign ones together
(`mixed`), and none, or known ones only (`empty`).
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import trimesh

from bayes3d_ros.geometry.camera import unproject
from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.objects.model import Library
from bayes3d_ros.parsing.parser import SceneParser
from bayes3d_ros.posterior.types import ParseError
from bayes3d_ros.settings import ParserSettings
from bayes3d_ros.validation.bench.benchmark import TEN_TYPES, ten_ycb_types, ycb_mesh
from bayes3d_ros.validation.experiments import Row, Step, row_step
from bayes3d_ros.validation.experiments.open_world_plot import plot
from bayes3d_ros.validation.experiments.open_world_summary import WANTED, summary
from bayes3d_ros.validation.simulate.deformations import deformed
from bayes3d_ros.validation.simulate.mixed_tables import table_of_a_choice
from bayes3d_ros.validation.simulate.random_scenes import (
    REALSENSE,
    RestingObject,
    perfect_depth,
    random_scene,
    resting_object,
)
from bayes3d_ros.validation.simulate.ray_casting import Rendering, SimulationError
from bayes3d_ros.validation.simulate.scene_file import find_mesh
from bayes3d_ros.validation.statistics.aligned_types import best_aligned, laid_types
from bayes3d_ros.validation.statistics.reported_things import TrueThing, answers

__all__ = ["HEADER", "WANTED", "count", "line", "notes", "plot", "steps", "summary"]

KINDS = ("unknown", "known", "deformed", "mixed", "empty")
FRAMES = {"unknown": 5, "known": 10, "deformed": 20}  # of each mesh
TABLES = {"mixed": 150, "empty": 200}
QUICK_MESHES, QUICK_TABLES = 10, 8  # a frame of every so-manieth foreign mesh and of each known one; tables of a kind
FULL_SEED, QUICK_SEED = 700_000, 500_000  # frames of a quick run are others; 400,000 to 440,000 were looked at
KIND_SEEDS = 10_000
KNOWN_ON_MIXED, FOREIGN_ON_MIXED, KNOWN_ON_EMPTY = (2, 4), (1, 3), (1, 3)
MIXED_AMPLITUDE = 1.0
EMPTY_AMPLITUDES = (0.0, 0.5, 1.0, 2.0, 3.0)  # in turn; every other table has known objects
SURFACE_POINTS = 20_000  # of a foreign mesh, that types are aligned with
HEADER = (
    f"{'frame':>6} {'kind':<9} {'things (what was said of them)':<60} {'claim':>6} {'ghosts':>6} {'false':>5} {'s':>5}"
)


class Job(NamedTuple):
    """One frame to make and parse."""

    kind: str  # of KINDS
    seed: int
    mesh: str  # a YCB name; empty for tables
    amplitude: float | None  # of shared errors; None where random_scene's own errors are used


class TrueFrame(NamedTuple):
    """A frame and what is truly there."""

    frame: DepthFrame
    things: list[TrueThing]
    clean: Rendering  # without errors; solids 0 .. K - 1 are the things


@dataclass
class YcbWorld:
    """The library, its objects as they can rest, and foreign ones, loaded when they are first asked for."""

    library: Library
    settings: ParserSettings = field(default_factory=ParserSettings)

    def __post_init__(self) -> None:
        self.models = self.library.by_name
        self.known: Callable[[str], RestingObject] = cache(self._known)
        self.foreign: Callable[[str], RestingObject] = cache(_foreign)
        self.parser: Callable[[], SceneParser] = cache(self._parser)
        self.laid = cache(lambda: laid_types(self.library.models))

    def _known(self, name: str) -> RestingObject:
        return resting_object(name, find_mesh(name, Path()), self.models[name].contact_normal)

    def _parser(self) -> SceneParser:
        parser = SceneParser(self.library, self.settings)
        parser.warm_up(REALSENSE.width, REALSENSE.height)
        return parser


def _foreign(name: str) -> RestingObject:
    return resting_object(name, find_mesh(name, Path()))


def ycb_world() -> YcbWorld:
    """The ten types as a library."""
    return YcbWorld(ten_ycb_types())


def foreign_names() -> list[str]:
    """YCB meshes outside of the ten."""
    folder = ycb_mesh(TEN_TYPES[0]).parent
    return sorted({path.stem for path in folder.glob("*.stl")} - set(TEN_TYPES))


def notes(quick: bool) -> list[str]:
    """What the figures are of."""
    every = "a tenth of the foreign meshes, a frame each, and 8 tables of a kind; " if quick else ""
    return [f"{every}meshes that cannot be cast or rest on nothing have a row with an error and count nowhere"]


def jobs(quick: bool) -> list[Job]:
    """The frames of a run, kinds in turn, so that an interrupted run tells of all of them."""
    start = QUICK_SEED if quick else FULL_SEED
    foreign = foreign_names()
    meshes = {"unknown": foreign[::QUICK_MESHES] if quick else foreign, "known": TEN_TYPES, "deformed": TEN_TYPES}
    by_kind: dict[str, list[Job]] = {}
    for number, kind in enumerate(KINDS):
        seeds = iter(range(start + KIND_SEEDS * number, start + KIND_SEEDS * (number + 1)))
        if kind in meshes:
            repeats = 1 if quick else FRAMES[kind]
            by_kind[kind] = [Job(kind, next(seeds), mesh, None) for _ in range(repeats) for mesh in meshes[kind]]
        else:
            amplitudes = (MIXED_AMPLITUDE,) if kind == "mixed" else EMPTY_AMPLITUDES
            tables = QUICK_TABLES if quick else TABLES[kind]
            by_kind[kind] = [Job(kind, next(seeds), "", amplitudes[k % len(amplitudes)]) for k in range(tables)]
    # Job k of n goes at (k + 1/2) / n of the run.
    order = [((k + 0.5) / len(own), job) for own in by_kind.values() for k, job in enumerate(own)]
    return [job for _, job in sorted(order, key=lambda pair: pair[0])]


def count(quick: bool) -> int:
    """How many frames there are."""
    return len(jobs(quick))


def steps(quick: bool) -> Iterator[Step]:
    """A row a frame."""
    world = ycb_world()
    for job in jobs(quick):
        yield row_step(job_row, job, world)


def job_row(job: Job, world: YcbWorld) -> Row:
    """Make a frame, parse it, and hold what is said against what is there."""
    row: Row = {"frame": job.seed, "kind": job.kind, "amplitude": job.amplitude}
    row |= dict.fromkeys(
        ("things", "aligned", "aligned_rms", "aligned_back_rms", "listed", "claim", "ghosts", "false_claims")
    )
    row |= dict.fromkeys(("unexplained", "log_evidence", "seconds", "error"))
    try:
        true = true_frame(job, world)
        posterior = world.parser().parse(true.frame)
    except (SimulationError, ParseError) as error:
        return row | {"error": f"{job.mesh}: {error}" if job.mesh else str(error)}
    if job.kind == "unknown":
        row |= alignment(true, job, world)
    said = answers(posterior, true.things, true.clean.solid, world.library)
    return row | {
        "things": said.things,
        "listed": len(posterior.objects),
        "claim": round(said.claim, 6),
        "ghosts": said.ghosts,
        "false_claims": said.false_claims,
        "unexplained": len(posterior.unexplained),
        "log_evidence": round(posterior.log_evidence, 4),
        "seconds": round(posterior.seconds, 3),
    }


def true_frame(job: Job, world: YcbWorld) -> TrueFrame:
    """The frame of a job. Raises SimulationError where it cannot be made."""
    if job.kind in ("mixed", "empty"):
        return _table(job, world)
    known = job.kind != "unknown"
    thing = world.known(job.mesh) if known else world.foreign(job.mesh)
    scene = random_scene(thing, job.seed)
    assert scene.frame.T_table_camera is not None
    clean = perfect_depth(thing, scene.T_table_object, scene.frame.T_table_camera)
    if job.kind == "deformed":
        scene = deformed(scene, thing, job.seed)
    return TrueFrame(scene.frame, [TrueThing(job.mesh, known, scene.T_camera_object, 1.0)], clean)


def _table(job: Job, world: YcbWorld) -> TrueFrame:
    """A table of a random choice of things; of the choices, the first one that can be made."""
    rng = np.random.default_rng([job.seed, 13])

    def resting(name: str) -> RestingObject:
        return world.known(name) if name in world.models else world.foreign(name)

    table = table_of_a_choice(lambda: _choice(job, rng), resting, job.amplitude or 0.0, job.seed)
    T_camera_table = np.linalg.inv(table.T_table_camera)
    names = [own.thing.name for own in table.objects]
    true = [
        TrueThing(name, name in world.models, T_camera_table @ own.T_table_object, table.visible_fraction(k))
        for k, (name, own) in enumerate(zip(names, table.objects, strict=True))
    ]
    return TrueFrame(table.frame, true, table.clean)


def _choice(job: Job, rng: np.random.Generator) -> list[str]:
    """Names of the things of a table, each at most once."""
    if job.kind == "empty":
        with_known = job.seed // len(EMPTY_AMPLITUDES) % 2
        known = int(rng.integers(KNOWN_ON_EMPTY[0], KNOWN_ON_EMPTY[1] + 1)) * with_known
        return [str(name) for name in rng.choice(TEN_TYPES, known, False)]
    known, foreign = (int(rng.integers(low, high + 1)) for low, high in (KNOWN_ON_MIXED, FOREIGN_ON_MIXED))
    names = [*rng.choice(TEN_TYPES, known, False), *rng.choice(foreign_names(), foreign, False)]
    return [str(name) for name in names]


def alignment(true: TrueFrame, job: Job, world: YcbWorld) -> Row:
    """The library type that fits what is seen of a foreign thing best, and how well."""
    T_table_camera = true.frame.T_table_camera
    assert T_table_camera is not None and true.things[0].T_camera_object is not None
    own = true.clean.solid == 0
    seen = unproject(true.clean.depth, REALSENSE)[own] @ T_table_camera[:3, :3].T + T_table_camera[:3, 3]
    T_table_object = T_table_camera @ true.things[0].T_camera_object
    surface = np.asarray(trimesh.sample.sample_surface(world.foreign(job.mesh).mesh, SURFACE_POINTS, seed=0)[0])
    surface = surface @ T_table_object[:3, :3].T + T_table_object[:3, 3]
    found = best_aligned(seen, surface, T_table_camera[:3, 3], world.laid())
    if found is None:
        return {}
    return {"aligned": found.type, "aligned_rms": round(found.rms, 6), "aligned_back_rms": round(found.back_rms, 6)}


def line(row: Row) -> str:
    """A row, under HEADER."""
    start = f"{row['frame']:>6} {row['kind']:<9} "
    if row["error"]:
        return start + str(row["error"])
    told = [f"{t['name']}: {t['said'] or '-'} {t['p_said'] or 0:.2f}" for t in row["things"]]
    if row["aligned_rms"] is not None:
        told.append(f"[{row['aligned']} {1e3 * row['aligned_rms']:.1f} mm]")
    return (
        f"{start}{', '.join(told) or 'nothing':<60} {row['claim']:>6.3f} {row['ghosts']:>6} {row['false_claims']:>5} "
        f"{row['seconds']:>5.2f}"
    )
