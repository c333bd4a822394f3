# SPDX-License-Identifier: Apache-2.0

"""The numbers of a parsed frame as a table, with a verdict."""

from textwrap import wrap

import numpy as np
from matplotlib.axes import Axes

from bayes3d_ros.io.image_panels import place_number
from bayes3d_ros.io.palette import BAD, FAINT, GOOD, INK
from bayes3d_ros.io.table_view import camera_on_table
from bayes3d_ros.io.verdict import scene_verdict
from bayes3d_ros.posterior.output_frame import OutputFrame
from bayes3d_ros.posterior.reframe import in_frame
from bayes3d_ros.posterior.types import ObjectEstimate, ScenePosterior

MOST_LISTED = 12
_COLUMNS = (  # where they begin, as a share of the width, and two lines of heading
    (0.0, "object", ""),
    (0.28, "p(exists)", ""),
    (0.37, "p(type)", ""),
    (0.45, "explained", "% of pixels"),
    (0.555, "x, y of its origin", "mm on the table"),
    (0.70, "σ position", "mm"),
    (0.79, "σ yaw", "degrees"),
    (0.87, "p(pose)", ""),
)
_WRAP, _WRAP_BOLD = 112, 86  # characters in a line


def draw_words(axis: Axes, posterior: ScenePosterior) -> None:
    """A verdict, then a row an object, then what is said of the whole scene."""
    axis.axis("off")
    axis.set(xlim=(0, 1), ylim=(0, 1))
    verdict = scene_verdict(posterior)
    lines = wrap(verdict.words, _WRAP_BOLD)
    tone = GOOD if verdict.healthy else BAD
    axis.text(0.0, 1.0, "\n".join(lines), fontsize=10.5, fontweight="bold", color=tone, va="top")
    y = 1.0 - 0.075 * len(lines) - 0.03
    y = _rows(axis, posterior, y)
    counts = "   ".join(f"{n}: {p:.2f}" for n, p in posterior.num_objects.items() if p >= 0.005)
    told = (
        f"p(number of objects)   {counts}",
        *(line for note in posterior.notes[:2] for line in wrap(note, _WRAP)),  # whole: they say what to make of p(n)
        f"depth noise σ {1e3 * posterior.sigma:.2f} mm    outliers {100 * posterior.p_outlier:.1f} %    "
        f"log evidence over the empty table {posterior.log_evidence:.1f}    {posterior.seconds:.2f} s",
    )
    axis.text(0.0, y - 0.02, "\n".join(told), fontsize=9.5, color="#444444", va="top", linespacing=1.5)


def _rows(axis: Axes, posterior: ScenePosterior, y: float) -> float:
    """Heading and rows; returns how far down they reach."""
    shown = posterior.objects[:MOST_LISTED]
    if not shown:
        nothing = "nothing of the library, but something" if posterior.unexplained else "no objects"
        axis.text(0.0, y, nothing, fontsize=11, color=INK, va="top")
        return y - 0.1
    for x, name, unit in _COLUMNS:
        axis.text(x, y, f"{name}\n{unit}", fontsize=9, color=FAINT, va="top", linespacing=1.2)
    known = bool(np.isfinite(posterior.T_camera_table).all())
    on_table = in_frame(posterior, OutputFrame("table", camera_on_table(posterior, None))).objects if known else shown
    step = min(0.08, (y - 0.35) / (len(shown) + 1))
    y -= 0.115
    for k, found in enumerate(shown):
        place_number(axis, 0.012, y - 0.025, k + 1, unknown=found.is_unknown)
        words = (_shorten(found.type, 24), *_numbers(found, on_table[k], known))
        for (x, *_), text in zip(_COLUMNS, words, strict=True):
            axis.text(x + 0.035 if x == 0 else x, y, text, fontsize=10, color=INK, va="top")
        y -= step
    if len(posterior.objects) > MOST_LISTED:
        axis.text(0.035, y, f"and {len(posterior.objects) - MOST_LISTED} more", fontsize=10, color=INK, va="top")
        y -= step
    return y


def _numbers(found: ObjectEstimate, on_table: ObjectEstimate, known: bool) -> tuple[str, ...]:
    """The columns but the first. Of the pose that is reported, with its weight where it is one of several."""
    sigma = 1e3 * np.sqrt(np.trace(found.covariance[:3, :3]))
    yaw = np.degrees(np.sqrt(on_table.covariance[5, 5])) if known else float("nan")
    x, y = 1e3 * np.asarray(on_table.position)[:2]
    return (
        f"{found.probability:.3f}",
        f"{found.type_probabilities.get(found.type, 0.0):.3f}",
        f"{found.explained:.0%}" if np.isfinite(found.explained) else "–",
        f"{x:.0f}, {y:.0f}" if known else "–",
        short(sigma),
        short(yaw) if known else "–",
        _weight_of_pose(found),
    )


def _weight_of_pose(found: ObjectEstimate) -> str:
    """The weight of the reported pose; where there are several, with its standard deviation from seed to seed."""
    error = found.modes[0].weight_error if len(found.modes) > 1 else float("nan")
    return f"{found.mode_weight:.2f}" + (f" ± {error:.2f}" if error >= 0.005 else "")


def short(value: float) -> str:
    """Two digits, without an exponent."""
    return f"{value:#.2g}".rstrip(".") if 0.01 <= value < 99.5 else f"{value:.0f}" if value >= 99.5 else "<0.01"


def _shorten(text: str, length: int) -> str:
    return text if len(text) <= length else text[: length - 1] + "…"
