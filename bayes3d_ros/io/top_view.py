# SPDX-License-Identifier: Apache-2.0

"""A scene's objects on the table, seen from above, with what is not known of their poses."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Arc, Ellipse, Patch, Polygon

from bayes3d_ros.geometry.camera import Intrinsics
from bayes3d_ros.io.image_panels import place_number
from bayes3d_ros.io.palette import FAINT, INK, UNKNOWN_GREY, colour
from bayes3d_ros.io.placed_objects import PlacedMode, StandingObject, placed_candidates, placed_objects
from bayes3d_ros.io.table_view import TableView, area_outline, camera_on_table, visible_part
from bayes3d_ros.objects.model import ObjectModel
from bayes3d_ros.posterior.types import ScenePosterior, UnexplainedPlace

_SIGMAS = 2.0  # standard deviations that ellipses and arcs show
_SHORTEST_ARROW = 0.03  # metres
_ENLARGED, _WIDEST = 10, 0.25  # times that an ellipse is shown larger, if it is not wider then (metres)
_PALE = 0.45  # opacity of modes but the heaviest
_SEEN, _AREA = "#f4f1e8", "#8a7a55"  # the visible part of the table, the outline of the area


def draw_top_view(
    axis: Axes,
    posterior: ScenePosterior,
    view: TableView,
    intrinsics: Intrinsics | None = None,
    models: Mapping[str, ObjectModel] | None = None,
) -> list[Artist]:
    """Draw the scene into an axis, in metres of the table's frame, and return the entries of its legend. The ranges are
    those of `view`, widened where something would be outside.

    models: by type; without them objects have no footprint.
    """
    T = camera_on_table(posterior, intrinsics)
    objects = placed_objects(posterior, T, models or {})
    candidates = placed_candidates(posterior, T)
    known = bool(np.isfinite(posterior.T_camera_table).all())  # else the axes are not those of the table's frame
    places = posterior.unexplained if known else ()
    view = view.holding(_extent(objects, places))
    legend = _table(axis, view, T, intrinsics if known else None)
    legend += _camera(axis, view, T) if known else []
    for thing in objects:
        _object(axis, thing)
    legend += _object_symbols(objects)
    for candidate in candidates:
        x, y = candidate.place
        axis.plot(x, y, "x", color=FAINT, markersize=8, markeredgewidth=1.8, zorder=6)
        words = f"p {candidate.probability:.2f}"
        axis.annotate(words, (x, y), (7, -9), textcoords="offset points", fontsize=8.5, color=FAINT)
    if candidates:
        legend.append(_marker("x", FAINT, "perhaps an object (not listed), p(exists)"))
    for place in places:
        axis.text(place.x, place.y, "?", fontsize=15, fontweight="bold", color=INK, ha="center", va="center")
    if places:
        legend.append(_marker("$?$", INK, "returns that no object explains"))
    _dress(axis, view, known)
    return legend


def position_ellipse(mode: PlacedMode) -> tuple[float, float, float]:
    """Width and height (metres) and angle (degrees) of the ellipse of two standard deviations of a mode's position."""
    variance, axes = np.linalg.eigh(mode.covariance)
    width, height = 2 * _SIGMAS * np.sqrt(np.maximum(variance[::-1], 0.0))
    return float(width), float(height), float(np.degrees(np.arctan2(axes[1, 1], axes[0, 1])))


def _extent(objects: tuple[StandingObject, ...], places: tuple[UnexplainedPlace, ...]) -> Float[np.ndarray, "N 2"]:
    points = [np.concatenate([mode.footprint, mode.centre[None]]) for thing in objects for mode in thing.modes]
    return np.concatenate([*points, np.array([[place.x, place.y] for place in places]).reshape(-1, 2)])


def _table(axis: Axes, view: TableView, T: Float[np.ndarray, "4 4"], intrinsics: Intrinsics | None) -> list[Artist]:
    """The area's outline and what the image holds of it."""
    legend: list[Artist] = []
    part = visible_part(view.area, T, intrinsics)
    if intrinsics is not None and len(part) > 2:
        axis.add_patch(Polygon(part, facecolor=_SEEN, edgecolor="none", zorder=0))
        legend.append(Patch(facecolor=_SEEN, edgecolor="#dddddd", label="table in the camera's field of view"))
    axis.add_patch(Polygon(area_outline(view.area), fill=False, edgecolor=_AREA, linewidth=1.2, zorder=1))
    legend.append(Line2D([], [], color=_AREA, linewidth=1.2, label="border of the searched area"))
    return legend


def _camera(axis: Axes, view: TableView, T: Float[np.ndarray, "4 4"]) -> list[Artist]:
    """Where it is and looks; at the border of the view where it is outside."""
    place, looks = T[:2, 3], T[:2, 2]
    margin = 0.03 * max(view.x[1] - view.x[0], view.y[1] - view.y[0])
    shown = np.clip(place, [view.x[0] + margin, view.y[0] + margin], [view.x[1] - margin, view.y[1] - margin])
    beyond = float(np.linalg.norm(place - shown))
    words = f"camera, {T[2, 3]:.2f} m high"
    if beyond > 0.005:
        words = f"camera, {beyond:.2f} m beyond\nthis point, {T[2, 3]:.2f} m high"
    length = float(np.linalg.norm(looks))
    if length > 0.05:  # else it looks straight down
        tip = shown + looks / length * 2.5 * margin
        axis.annotate("", tip, shown, arrowprops={"arrowstyle": "-|>", "color": INK, "linewidth": 1.6}, zorder=7)
    axis.plot(*shown, "s", color=INK, markersize=8, zorder=7, label="_camera")
    left = shown[0] < (view.x[0] + view.x[1]) / 2
    axis.annotate(
        words, shown, (10 if left else -10, 0), textcoords="offset points", fontsize=8.5, color=INK,
        ha="left" if left else "right", va="center", zorder=7,
        bbox={"boxstyle": "square,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.85},
    )  # fmt: skip
    return [_marker("s", INK, "camera, and where it looks")]


def _object(axis: Axes, thing: StandingObject) -> None:
    """Its modes, the heaviest one last."""
    for k, mode in reversed(list(enumerate(thing.modes))):
        _mode(axis, mode, thing, 1.0 if k == 0 else _PALE)
    first = thing.modes[0]
    corner = first.footprint[np.argmax(first.footprint @ [0.3, 1.0])] if len(first.footprint) else first.centre
    place_number(axis, corner[0], corner[1], thing.label, offset=(8, 12), unknown=thing.unknown)
    if len(thing.modes) > 1:
        for k, mode in enumerate(thing.modes):  # below each other, right of the object's number
            axis.annotate(
                f"p(pose) {mode.weight:.2f}", (corner[0], corner[1]), (18, 12 - 11 * k), textcoords="offset points",
                fontsize=8.5, color=INK if k == 0 else FAINT, zorder=8, va="center",
            )  # fmt: skip


def _mode(axis: Axes, mode: PlacedMode, thing: StandingObject, alpha: float) -> None:
    """Footprint, silhouette, heading with its uncertainty, and the ellipse of the position."""
    tone = UNKNOWN_GREY if thing.unknown else colour(thing.label)
    if len(mode.silhouette):
        axis.add_patch(Polygon(mode.silhouette, facecolor=tone, edgecolor="none", alpha=0.22 * alpha, zorder=2))
    if len(mode.footprint):
        style = "--" if thing.unknown or alpha < 1 else "-"
        axis.add_patch(
            Polygon(
                mode.footprint, fill=False, edgecolor=tone, linestyle=style, alpha=alpha, zorder=3,
                linewidth=1.8 if alpha == 1 else 1.3,
            )
        )  # fmt: skip
        reach = float((mode.footprint @ mode.heading).max() - mode.centre @ mode.heading)
    else:
        reach = 0.0
    reach = max(1.2 * reach, _SHORTEST_ARROW)
    turn, spread = np.degrees(np.arctan2(mode.heading[1], mode.heading[0])), np.degrees(_SIGMAS * mode.yaw_sigma)
    if spread < 180:  # else no direction is better than another
        arrow = {"arrowstyle": "-|>", "color": tone, "linewidth": 1.5, "alpha": alpha, "shrinkA": 0, "shrinkB": 0}
        x, y = mode.centre + reach * mode.heading
        axis.annotate("", (x, y), (mode.centre[0], mode.centre[1]), arrowprops=arrow, zorder=5)
    spread = min(spread, 180.0)
    axis.add_patch(
        Arc(
            tuple(mode.centre), 2 * reach, 2 * reach, angle=turn, theta1=-spread, theta2=spread, color=tone,
            linewidth=2.2, alpha=0.7 * alpha, zorder=4,
        )
    )  # fmt: skip
    width, height, angle = position_ellipse(mode)
    axis.add_patch(
        Ellipse(
            tuple(mode.centre), width, height, angle=angle, facecolor=tone, edgecolor=INK, linewidth=0.7,
            alpha=0.85 * alpha, zorder=6,
        )
    )  # fmt: skip
    if alpha == 1 and _ENLARGED * width < _WIDEST:
        axis.add_patch(
            Ellipse(
                tuple(mode.centre), _ENLARGED * width, _ENLARGED * height, angle=angle, fill=False, edgecolor=INK,
                linewidth=1.0, linestyle=":", zorder=6,
            )
        )  # fmt: skip


def _object_symbols(objects: tuple[StandingObject, ...]) -> list[Artist]:
    """Of the legend: those that the picture holds."""
    found: list[Artist] = []
    if any(len(thing.modes[0].footprint) and not thing.unknown for thing in objects):
        found.append(Patch(facecolor="#dddddd", edgecolor=INK, label="object: its box and its outline from above"))
    if any(thing.unknown for thing in objects):
        dashed = Patch(fill=False, edgecolor=UNKNOWN_GREY, linestyle="--", label="unknown object: its box")
        found.append(dashed)
    if objects:
        ellipse = Line2D([], [], marker="o", color="none", markerfacecolor="#888888", markeredgecolor=INK)
        ellipse.set_label(f"2 σ of its position; dotted: {_ENLARGED} times as large")
        found.append(ellipse)
        found.append(_marker(r"$\rightarrow$", INK, "its x axis (y if x is upright); arc: 2 σ of yaw"))
    if any(len(thing.modes) > 1 for thing in objects):
        found.append(
            Patch(fill=False, edgecolor="#aaaaaa", linestyle="--", label="pale: its other poses; p(pose) of each")
        )
    return found


def _marker(symbol: str, tone: str, words: str) -> Artist:
    return Line2D([], [], marker=symbol, color="none", markerfacecolor=tone, markeredgecolor=tone, label=words)


def _dress(axis: Axes, view: TableView, known: bool) -> None:
    axis.set(xlim=view.x, ylim=view.y, aspect="equal")
    axis.grid(color="#e6e6e6", linewidth=0.7)
    axis.set_axisbelow(True)
    axis.tick_params(labelsize=8.5, colors=INK)
    frame = "of the table's frame, m" if known else "along the table, m (its frame is not known)"
    axis.set_xlabel(f"x {frame}", fontsize=9.5, color=INK)
    axis.set_ylabel(f"y {frame}", fontsize=9.5, color=INK)
    axis.set_title("from above", fontsize=11, color=INK, loc="left")
