# SPDX-License-Identifier: Apache-2.0

"""Learn a voxel model of an unknown object from a few calibrated depth views of it on the table."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass

import numpy as np
import trimesh
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from bayes3d_ros.geometry.depth_frame import DepthFrame, sees_beyond
from bayes3d_ros.geometry.farthest_points import farthest_first
from bayes3d_ros.learning.align import align_views, moved, residual_between
from bayes3d_ros.learning.fuse import Fused, FusionError, Seen, fuse
from bayes3d_ros.learning.fusion_constants import CONTRADICTED, EDGE_RADIUS, NORMAL_RADIUS, PLACE_ERROR, SEEN_THROUGH
from bayes3d_ros.learning.segment import (
    Surface,
    Thing,
    View,
    ViewError,
    check_pixels,
    middle,
    nearest_thing,
    places_of,
    segment,
    surface,
    thing_at,
    thing_beside,
)
from bayes3d_ros.objects.mesh_import import contact_normals
from bayes3d_ros.objects.model import NAME_PATTERN, ObjectModel, is_reserved
from bayes3d_ros.settings import LearnerSettings

MOST_VIEWS_A_MODEL = 10


class LearningError(Exception):
    """Views that no model can be made of; one line that says why."""


@dataclass(frozen=True)
class ViewReport:
    """What became of one view."""

    stamp_ns: int
    points: int  # on the object
    shift: float  # metres by which its pose was corrected, at the object
    turn: float  # radians
    refused: str = ""  # why nothing of it is in the model
    cut_off: str = ""  # what the object reaches and may go on beyond: the image's border or a setting; empty: nothing


@dataclass(frozen=True, eq=False)
class Learned:
    """A model and how it came about. `coverage` is the share of its surface that some view saw; `residual`: see
    `align.py`, metres."""

    model: ObjectModel
    T_table_object: Float[np.ndarray, "4 4"]  # where it stood
    views: tuple[ViewReport, ...]
    coverage: float
    residual: float = float("nan")

    @property
    def cut_off(self) -> dict[str, list[int]]:
        """What cuts the object off in views that were used, and the numbers of these, from 1 on."""
        views_at: dict[str, list[int]] = {}
        for number, view in enumerate(self.views, 1):
            if view.cut_off and not view.refused:
                views_at.setdefault(view.cut_off, []).append(number)
        return views_at

    @property
    def notes(self) -> tuple[str, ...]:
        """What a user should know of this model, one line each."""
        used = sum(not view.refused for view in self.views)
        one = (
            "learned from one view: the side that it hides is unknown, and closed by the convex hull of what was seen",
        )
        beyond = (
            f"{limit} cuts the object off in {', '.join(f'view {k}' for k in views)}: what is beyond is not seen"
            for limit, views in self.cut_off.items()
        )
        return (*(one if used == 1 else ()), *beyond)


def learn(frames: Sequence[DepthFrame], name: str, settings: LearnerSettings | None = None) -> Learned:
    """The model of the object that these frames show. Its frame has z up as captured, x and y along the table's, and
    its origin at the centre of its box's base. Raises LearningError with one line where none can be made."""
    settings = settings or LearnerSettings()
    check_name(name)
    if not 1 <= len(frames) <= MOST_VIEWS_A_MODEL:
        raise LearningError(f"expected 1 to {MOST_VIEWS_A_MODEL} views, got {len(frames)}")
    with ThreadPoolExecutor() as pool:  # numpy lets go of the interpreter
        parts = list(pool.map(lambda frame: _segmented(frame, settings), frames))
        views = {k: part for k, part in enumerate(parts) if isinstance(part, View)}
        refused = {k: part for k, part in enumerate(parts) if isinstance(part, str)}
        things, missing = choose_things(views, settings)
        refused |= missing
        oriented = pool.map(lambda k: surface(views[k], things[k], NORMAL_RADIUS), things)
        surfaces = dict(zip(things, oriented, strict=True))
    while True:
        if not surfaces:
            reasons = "; ".join(f"view {k + 1}: {why}" for k, why in sorted(refused.items()))
            raise LearningError(f"none of {len(frames)} views can be used: {reasons}")
        used = sorted(surfaces)
        shifts = dict(zip(used, align_views([surfaces[k] for k in used]), strict=True))
        aligned = {k: moved(surfaces[k], shifts[k]) for k in used}
        poses = {k: shifts[k].matrix() @ views[k].T_table_camera for k in used}
        worst, why = _worst(frames, views, aligned, poses, settings)
        if worst is None:
            break
        refused[worst] = why
        del surfaces[worst]
    # Normals of few pixels keep edges; those of a single view are averaged with no other's.
    sharp = {k: moved(surface(views[k], things[k], EDGE_RADIUS), shifts[k]) for k in used} if len(used) > 1 else aligned
    try:
        fused = fuse([Seen(sharp[k], frames[k], poses[k]) for k in used], settings.voxel_size)
    except FusionError as error:
        raise LearningError(str(error)) from None
    reports = tuple(
        ViewReport(frame.stamp_ns, 0, 0.0, 0.0, refused[k])
        if k in refused
        else ViewReport(
            frame.stamp_ns,
            len(things[k].points),
            *_correction(frame, poses[k], aligned[k]),
            cut_off=things[k].cut_off,
        )
        for k, frame in enumerate(frames)
    )
    model, T_table_object = _model(name, fused, reports, settings)
    residual = residual_between(list(aligned.values()))
    return Learned(model, T_table_object, reports, float((fused.views > 0).mean()), residual)


def _segmented(frame: DepthFrame, settings: LearnerSettings) -> View | str:
    """The view, or why there is none."""
    try:
        return segment(frame, settings)
    except ViewError as error:
        return str(error)


def check_name(name: str) -> None:
    """Raise LearningError where a model cannot be called so."""
    if not NAME_PATTERN.fullmatch(name):
        raise LearningError(f"name: expected letters, digits, '_' and '-', got {name!r}")
    if is_reserved(name):
        raise LearningError(f"name: {name!r} stands for things of no type in the library, expected another")


def spread_views(poses: Sequence[Float[np.ndarray, "4 4"] | None], most: int) -> list[int]:
    """Which of many frames to learn from: those with a pose, as far apart as can be, at most `most`."""
    there = [k for k, pose in enumerate(poses) if pose is not None]
    if len(there) <= most:
        return there
    places = np.array([pose[:3, 3] for pose in poses if pose is not None])
    chosen = farthest_first(0, most, lambda k: np.linalg.norm(places - places[k], axis=1))
    return sorted({there[k] for k in chosen})  # of a camera that stands still one


def choose_things(views: dict[int, View], settings: LearnerSettings) -> tuple[dict[int, Thing], dict[int, str]]:
    """In every view the thing to learn (`choose_thing`), and of those that do not show it, why. Raises LearningError
    where no view shows it."""
    chosen: dict[int, Thing] = {}
    missing: dict[int, str] = {}
    for k, view in views.items():
        try:
            chosen[k] = choose_thing(view, list(chosen.values()), settings)
        except ViewError as error:
            missing[k] = str(error)
    if missing and not chosen:  # one line: the others say the same
        others = len(missing) - 1
        more = f"; nor in {others} other view{'s' * (others != 1)}" if others else ""
        raise LearningError(next(iter(missing.values())) + more)
    return chosen, missing


def choose_thing(view: View, before: Sequence[Thing], settings: LearnerSettings) -> Thing:
    """The thing to learn of those in a view, given what was chosen in the views before.

    With a place (`at_x`, `at_y`) it is in every view the thing nearest to that place (`thing_at`). Without one it is in
    the first view as `cluster` says, and in the others the one that was chosen before (`thing_beside`). Raises
    ViewError where it is not there, where `cluster` is "only" and there are several to begin with, and where the view's
    pixels are too far apart for the voxels.
    """
    within = settings.max_shift + PLACE_ERROR
    if settings.place is not None:
        chosen = thing_at(view, settings.place, within)
    elif before:
        chosen = thing_beside(view, before, within)
    elif settings.cluster == "central":
        centre = np.array([settings.workspace_x, settings.workspace_y])
        chosen = nearest_thing(view, centre)
    elif settings.cluster == "only" and len(view.things) > 1:
        raise ViewError(
            f"{places_of(view.things)}: expected one, or the place of the one to learn (at_x, at_y; --at X Y), "
            "or cluster largest or central, or a smaller workspace"
        )
    else:
        chosen = view.things[0]
    check_pixels(view, chosen, settings.voxel_size)
    return chosen


def new_share(thing: Thing, before: Sequence[Thing], voxel_size: float) -> float:
    """Share of the voxels that a view sees of an object which none of the views before it saw."""
    here = _voxels(thing, voxel_size)
    known = np.concatenate([np.zeros(0, np.int64), *(_voxels(other, voxel_size) for other in before)])
    return float((~np.isin(here, known)).mean())


def _voxels(thing: Thing, voxel_size: float) -> Int[np.ndarray, "V"]:
    """Numbers of the voxels that hold its points: 21 bits for each coordinate."""
    cell = np.floor(thing.points / voxel_size).astype(np.int64) + 2**20
    return np.unique((cell[:, 0] << 42) | (cell[:, 1] << 21) | cell[:, 2])


def _worst(
    frames: Sequence[DepthFrame],
    views: dict[int, View],
    aligned: dict[int, Surface],
    poses: dict[int, Float[np.ndarray, "4 4"]],
    settings: LearnerSettings,
) -> tuple[int | None, str]:
    """The view that fits the others least, if it must go, and why."""
    if len(aligned) < 2:
        return None, ""
    shift = {k: _correction(frames[k], poses[k], aligned[k])[0] for k in aligned}
    far = max(shift, key=lambda k: shift[k])
    if shift[far] > settings.max_shift:
        return far, (
            f"its camera pose is {1e3 * shift[far]:.0f} mm off at the object, "
            f"expected at most {1e3 * settings.max_shift:.0f}"
        )
    through = {
        k: float(
            np.mean([sees_beyond(frames[j], poses[j], aligned[k].points, SEEN_THROUGH) for j in aligned if j != k])
        )
        for k in aligned
    }
    wrong = max(through, key=lambda k: through[k])
    if len(aligned) > 2 and through[wrong] > CONTRADICTED:
        return wrong, f"other views see through {through[wrong]:.0%} of its points: its camera pose must be wrong"
    return None, ""


def _correction(frame: DepthFrame, pose: Float[np.ndarray, "4 4"], surface: Surface) -> tuple[float, float]:
    """How far a pose was moved at the object (metres), and turned (radians)."""
    assert frame.T_table_camera is not None
    change = pose @ np.linalg.inv(frame.T_table_camera)
    place = np.append(middle(surface.points), 0.0)
    back = np.linalg.inv(change)
    shift = back[:3, :3] @ place + back[:3, 3] - place
    return float(np.linalg.norm(shift)), float(Rotation.from_matrix(change[:3, :3]).magnitude())


def _model(
    name: str, fused: Fused, reports: tuple[ViewReport, ...], settings: LearnerSettings
) -> tuple[ObjectModel, Float[np.ndarray, "4 4"]]:
    """The model, in the object's own frame, with an upright box; and that frame's pose on the table."""
    axes, size, place = _upright_box(fused.hull)
    base = np.array([*place, 0.0])
    hull = trimesh.convex.convex_hull(fused.hull - base)
    solid = fused.solid._replace(origin=fused.solid.origin - base)
    T_object_box = np.eye(4)
    T_object_box[:3, :3] = axes
    T_object_box[2, 3] = size[2] / 2
    normals = contact_normals(hull, axes, solid.centre_of_mass)
    normals[5] = [0.0, 0.0, -1.0]  # it stood so
    heights = (normals @ hull.vertices.T).max(1)
    heights[5] = 0.0
    told = [asdict(report) for report in reports]
    counts = np.bincount(fused.views, minlength=len(reports) + 1)
    model = ObjectModel(
        name=name,
        **solid._asdict(),
        T_object_box=T_object_box,
        box_size=size,
        contact_normal=normals,
        contact_height=heights,
        provenance={
            "kind": "views",
            "views": told,
            "surface_voxels_by_views": counts.tolist(),
            "settings": asdict(settings) | ({"at_x": None, "at_y": None} if settings.place is None else {}),  # no NaN
        },
        surface_views=fused.views,
    )
    T_table_object = np.eye(4)
    T_table_object[:3, 3] = base
    return model, T_table_object


def _upright_box(
    hull: Float[np.ndarray, "H 3"],
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"], Float[np.ndarray, "2"]]:
    """Axes, size and the base's middle of the smallest upright box, its x within 45 degrees of the table's."""
    to_box, _ = trimesh.bounds.oriented_bounds_2D(hull[:, :2])
    angle = -np.arctan2(to_box[1, 0], to_box[0, 0])
    angle = (angle + np.pi / 4) % (np.pi / 2) - np.pi / 4
    c, s = np.cos(angle), np.sin(angle)
    axes = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    along = hull @ axes
    low, high = along.min(0), along.max(0)
    low[2] = 0.0
    return axes, high - low, axes[:2, :2] @ ((low[:2] + high[:2]) / 2)
