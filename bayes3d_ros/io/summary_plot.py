# SPDX-License-Identifier: Apache-2.0

"""The picture of a parsed recording: its objects against time."""

from collections.abc import Callable, Sequence
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from bayes3d_ros.io.palette import BAD, FAINT, GOOD, INK, colour
from bayes3d_ros.io.scene_history import ObjectFacts, SceneHistory
from bayes3d_ros.io.verdict import LEAST_ESS, LEAST_EXPLAINED

_SIGMAS = 2.0  # standard deviations that a band shows, to either side
_MOST_NAMED = 16  # objects in the legend
_JUMP, _JUMP_SIGMAS = 0.01, 5.0  # metres, and standard deviations: an object that is farther off has jumped
_MANY = 40  # frames from which on lines have no dots


class _ObjectLine:
    """An object's numbers in every frame; NaN in frames that do not hold it."""

    def __init__(self, number: int, facts: dict[int, ObjectFacts], frames: int) -> None:
        self.number, self.frames, self._facts, self._count = number, len(facts), facts, frames
        first = next(iter(facts.values()))
        self.name, self.unknown = first.id, first.unknown

    def values(self, of: Callable[[ObjectFacts], float]) -> Float[np.ndarray, "F"]:
        return np.array([of(self._facts[k]) if k in self._facts else np.nan for k in range(self._count)])

    def positions(self, axis: int) -> Float[np.ndarray, "F"]:
        """Metres, on the table."""
        return self.values(lambda thing: float(thing.position[axis]))

    def sigmas(self, axis: int) -> Float[np.ndarray, "F"]:
        """Their standard deviations."""
        return self.values(lambda thing: float(thing.sigma[axis]))

    def middle(self, axis: int) -> float:
        """Metres; what positions are shown relative to."""
        places = self.positions(axis)
        return float(np.nanmedian(places)) if np.isfinite(places).any() else 0.0


def jumps(history: SceneHistory) -> list[str]:
    """Of every object that is for some frames far from its median: how far, and when first; a part of a line. Far: more
    than 10 mm, and than 5 standard deviations, along the table. None where the table's frame is of each image alone."""
    if history.table_found:
        return []
    found = []
    for track in _tracks(history):
        away = np.stack([track.positions(k) - track.middle(k) for k in (0, 1)])
        sigma = np.stack([track.sigmas(k) for k in (0, 1)])
        with np.errstate(invalid="ignore"):
            far = (np.abs(away) > np.maximum(_JUMP_SIGMAS * sigma, _JUMP)).any(0)
        if far.any():
            first = int(np.flatnonzero(far)[0])
            off = 1e3 * float(np.linalg.norm(away[:, first]))
            found.append(f"{track.name} is {off:.0f} mm from its median in frame {first + 1}")
    return found


def plot_history(history: SceneHistory, path: Path, title: str) -> Path:
    """Write a PNG: every object's position on the table with bands of two standard deviations, p(exists) and p(type),
    the number of objects, and effective sample size and explained shares. Frames that should be checked are shaded.

    Raises ValueError where there is no frame. Returns `path`.
    """
    frames = history.frames
    if not frames:
        raise ValueError("expected at least one parsed frame")
    figure = Figure(figsize=(16, 9.6), facecolor="white")
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=13, color=INK, y=0.985)
    tracks = _tracks(history)
    top = _head(figure, history, tracks)
    grid = figure.add_gridspec(3, 2, left=0.06, right=0.985, top=top - 0.035, bottom=0.06, hspace=0.32, wspace=0.14)
    axes = [figure.add_subplot(grid[row, column]) for column in (0, 1) for row in (0, 1, 2)]
    seconds = 1e-9 * np.array([frame.stamp_ns - frames[0].stamp_ns for frame in frames], float)
    if len(np.unique(seconds)) < len(seconds):  # a recording that repeats stamps
        seconds = np.arange(len(frames), dtype=float)
        unit = "frame"
    else:
        unit = "seconds after the first frame"
    for axis, k in zip(axes, range(3), strict=False):
        _position_panel(axis, seconds, tracks, k)
    _probability_panel(axes[3], seconds, tracks)
    _count_panel(axes[4], seconds, history)
    _health_panel(axes[5], seconds, history, tracks)
    for axis in axes:
        _shade(axis, seconds, history)
        axis.set_xlim(*_limits(seconds))
    axes[2].set_xlabel(unit, fontsize=9.5, color=INK)
    axes[5].set_xlabel(unit, fontsize=9.5, color=INK)
    figure.savefig(path, dpi=100)
    return path


def _tracks(history: SceneHistory) -> list[_ObjectLine]:
    """In the order in which objects appear."""
    facts: dict[str, dict[int, ObjectFacts]] = {}
    for k, frame in enumerate(history.frames):
        for thing in frame.objects:
            facts.setdefault(thing.id, {})[k] = thing
    return [_ObjectLine(number, own, len(history.frames)) for number, own in enumerate(facts.values(), 1)]


def _style(track: _ObjectLine, frames: int) -> dict[str, Any]:
    dots = frames <= _MANY or track.frames < 3
    return {
        "color": colour(track.number),
        "linestyle": "--" if track.unknown else "-",
        "marker": "o" if dots else "",
        "markersize": 4,
        "linewidth": 1.3,
    }


def _position_panel(axis: Axes, seconds: Float[np.ndarray, "N"], tracks: Sequence[_ObjectLine], k: int) -> None:
    frames = len(seconds)
    for track in tracks:
        away = 1e3 * (track.positions(k) - track.middle(k))
        band = 1e3 * _SIGMAS * track.sigmas(k)
        axis.fill_between(seconds, away - band, away + band, color=colour(track.number), alpha=0.15, linewidth=0)
        if frames <= _MANY:
            axis.errorbar(
                seconds, away, band, fmt="none", ecolor=colour(track.number), elinewidth=0.8, capsize=2, alpha=0.6
            )
        axis.plot(seconds, away, **_style(track, frames))
    _dress(axis, f"{'xyz'[k]} of each object's origin on the table, minus its median, mm (band: 2 σ)")


def _probability_panel(axis: Axes, seconds: Float[np.ndarray, "N"], tracks: Sequence[_ObjectLine]) -> None:
    for track in tracks:
        style = _style(track, len(seconds))
        axis.plot(seconds, track.values(lambda thing: thing.type_probability), **style)
        exists = track.values(lambda thing: thing.probability)
        axis.plot(seconds, exists, **(style | {"linestyle": ":", "marker": ""}))
        pose = track.values(lambda thing: thing.pose_probability)
        axis.plot(seconds, pose, **(style | {"linestyle": "", "marker": "x", "markersize": 5}))
    axis.set_ylim(-0.03, 1.05)
    _dress(axis, "p(type); dotted: p(exists); crosses: p(pose), of the reported pose among its alternatives")


def _count_panel(axis: Axes, seconds: Float[np.ndarray, "N"], history: SceneHistory) -> None:
    """A bar of height p(n) about every n."""
    most, width = 1, min(0.8 * _step(seconds), 0.5)
    for t, frame in zip(seconds, history.frames, strict=True):
        shown = {n: p for n, p in frame.num_objects.items() if p >= 0.005}
        most = max(most, *shown)
        for n, p in shown.items():
            axis.bar(t, 0.8 * p, width, n - 0.4 * p, color=INK, linewidth=0)
        if len(seconds) <= 12:
            best = max(shown, key=lambda n: shown[n])
            axis.annotate(
                f"{shown[best]:.2f}", (t, best - 0.45), (0, -2), textcoords="offset points", fontsize=8, color=FAINT,
                ha="center", va="top",
            )  # fmt: skip
    axis.set_ylim(-0.9, most + 0.8)
    axis.yaxis.set_major_locator(MaxNLocator(integer=True))
    _dress(axis, "number of objects (height of a bar: its probability)")


def _health_panel(
    axis: Axes, seconds: Float[np.ndarray, "N"], history: SceneHistory, tracks: Sequence[_ObjectLine]
) -> None:
    frames = len(seconds)
    for track in tracks:
        axis.plot(seconds, track.values(lambda thing: thing.explained), **_style(track, frames))
    ess = [frame.ess for frame in history.frames]
    axis.plot(seconds, ess, color=INK, linewidth=1.8, marker="s" if frames <= _MANY else "", markersize=4)
    for level, words in ((LEAST_EXPLAINED, "objects: check below"), (LEAST_ESS, "sample size: check below")):
        axis.axhline(level, color=BAD, linewidth=0.9, linestyle=(0, (5, 4)), alpha=0.7)
        axis.annotate(
            words, (0.995, level), (0, 2), xycoords=("axes fraction", "data"), textcoords="offset points", fontsize=8,
            color=BAD, ha="right",
        )  # fmt: skip
    axis.set_ylim(-0.03, 1.05)
    _dress(axis, "share of each object's pixels explained; black: effective sample size, share of the particles")


def _shade(axis: Axes, seconds: Float[np.ndarray, "N"], history: SceneHistory) -> None:
    """Frames whose verdict is not good."""
    half = _step(seconds) / 2
    for t, frame in zip(seconds, history.frames, strict=True):
        if not frame.verdict.healthy:
            axis.axvspan(t - half, t + half, color=BAD, alpha=0.08, linewidth=0, zorder=0)


def _step(seconds: Float[np.ndarray, "N"]) -> float:
    """The usual time between two frames."""
    return float(np.median(np.abs(np.diff(seconds)))) if len(seconds) > 1 else 1.0


def _limits(seconds: Float[np.ndarray, "N"]) -> tuple[float, float]:
    margin = max(0.6 * _step(seconds), 0.01 * float(np.ptp(seconds)))
    return float(seconds.min() - margin), float(seconds.max() + margin)


def _head(figure: Figure, history: SceneHistory, tracks: Sequence[_ObjectLine]) -> float:
    """The verdict on the recording, and the objects' names. Returns how far down they reach."""
    frames = history.frames
    wrong = [k for k, frame in enumerate(frames) if not frame.verdict.healthy]
    count = f"{len(frames)} frame{'s' * (len(frames) != 1)}"
    moved = jumps(history)
    told = []
    if wrong:
        first = frames[wrong[0]].verdict.words.removeprefix("Check: ")
        told.append(f"{len(wrong)} of {count} (shaded); first, frame {wrong[0] + 1}: {first}")
    if moved:
        told.append(f"{'; '.join(moved[:2])}: moved, or another mode of its pose")
    words = f"Check {'. Check '.join(told)}" if told else f"Healthy: {count}, no warning"
    if history.table_found:
        words += ". No camera pose: the table's frame is another one in every image, so positions may jump"
    lines = wrap(words, 160)[:3]
    figure.text(0.06, 0.955, "\n".join(lines), fontsize=10.5, fontweight="bold", color=BAD if told else GOOD, va="top")
    handles: list[Artist] = [
        Line2D([], [], **_style(track, 1), label=_told(track, len(frames))) for track in tracks[:_MOST_NAMED]
    ]
    if len(tracks) > _MOST_NAMED:
        handles.append(Line2D([], [], color="none", label=f"and {len(tracks) - _MOST_NAMED} more"))
    if wrong:
        handles.append(Patch(color=BAD, alpha=0.15, label="frames to check"))
    top = 0.955 - 0.02 * len(lines)
    if handles:
        figure.legend(
            handles=handles, loc="upper left", bbox_to_anchor=(0.055, top), ncols=3, fontsize=9, frameon=False,
            columnspacing=2.0,
        )  # fmt: skip
    return top - 0.02 - 0.0205 * -(-len(handles) // 3)


def _told(track: _ObjectLine, frames: int) -> str:
    x, y = 1e3 * track.middle(0), 1e3 * track.middle(1)
    seen = "" if track.frames == frames else f", in {track.frames} of {frames} frames"
    return f"{track.name}: x {x:.0f} y {y:.0f} mm{seen}"


def _dress(axis: Axes, title: str) -> None:
    axis.set_title(title, loc="left", fontsize=10, color=INK)
    axis.spines[["top", "right"]].set_visible(False)
    axis.grid(alpha=0.25)
    axis.tick_params(labelsize=8.5, colors=INK)
