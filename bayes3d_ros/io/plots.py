# SPDX-License-Identifier: Apache-2.0

"""Pictures of a parsed frame."""

from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import Normalize, to_rgb
from matplotlib.figure import Figure

from bayes3d_ros.geometry.camera import Intrinsics, unproject
from bayes3d_ros.posterior.types import ObjectEstimate, ScenePosterior

# Okabe and Ito's colours, then Tol's muted ones that differ from them: told apart with any colour vision.
COLOURS = (
    "#E69F00", "#0072B2", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#F0E442",
    "#332288", "#999933", "#882255", "#88CCEE", "#117733",
)  # fmt: skip
NO_RETURN_COLOUR, OTHER_COLOUR, INK = "#d8d8d8", "#555555", "#222222"
MOST_LISTED, MOST_POINTS = 12, 4000
RESIDUAL_MM = 10.0  # millimetres at the ends of the residual's colours


def plot_scene(
    depth: Float[np.ndarray, "height width"],
    posterior: ScenePosterior,
    path: Path,
    title: str = "",
    intrinsics: Intrinsics | None = None,
) -> Path:
    """Write a PNG: input depth, reconstruction, the one less the other, segmentation, overlay, posterior samples from
    above, and what they say.

    depth in metres, NaN where there is no return. With intrinsics given the view from above also shows the surfaces
    that the camera sees of every object. Returns `path`.
    """
    figure = Figure(figsize=(19.2, 8.2), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    if title:
        figure.suptitle(title, fontsize=13, color=INK)
    axes = figure.subplots(2, 4, width_ratios=(1, 1, 1, 1.05))
    scale = _depth_scale(depth, posterior)

    image = _depth_panel(axes[0, 0], depth, scale, "input depth (grey: no return)")
    _depth_panel(axes[0, 1], posterior.reconstruction, scale, "reconstruction")
    _scale_below(figure, image, axes[0, :2].tolist(), "depth, m")
    _segmentation_panel(axes[1, 0], posterior)
    _overlay_panel(axes[1, 1], depth, posterior, scale)
    residual = _residual_panel(axes[0, 2], depth, posterior)
    _scale_below(figure, residual, [axes[0, 2]], "input less reconstruction, mm")
    _samples_panel(axes[0, 3], depth, posterior, intrinsics)
    words = axes[1, 2].get_gridspec()[1, 2:]
    for axis in axes[1, 2:]:
        axis.remove()
    _words_panel(figure.add_subplot(words), posterior)
    figure.savefig(path, dpi=100)
    return path


def _depth_scale(depth: Float[np.ndarray, "height width"], posterior: ScenePosterior) -> Normalize:
    """Over the table and what stands on it: a room behind it would leave no contrast for them."""
    with np.errstate(invalid="ignore"):
        tabletop = depth[depth < posterior.reconstruction + 0.05]
    valid = tabletop if tabletop.size > 0.1 * depth.size else depth[np.isfinite(depth)]
    low, high = np.percentile(valid, (1, 98)) if valid.size else (0.0, 1.0)
    return Normalize(float(low), float(max(high, low + 0.05)))


def _view_from_above(posterior: ScenePosterior, intrinsics: Intrinsics | None) -> Float[np.ndarray, "4 4"]:
    """T_table_camera; where the posterior does not know the table, from the plane that the reconstruction shows."""
    if np.isfinite(posterior.T_camera_table).all():
        return np.linalg.inv(posterior.T_camera_table)
    T_table_camera = np.eye(4)
    bare = (posterior.segmentation == 0) & np.isfinite(posterior.reconstruction)
    if intrinsics is None or bare.sum() < 3:  # along the camera's y
        T_table_camera[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
        return T_table_camera
    points = unproject(posterior.reconstruction, intrinsics)[bare].astype(float)
    up = np.linalg.lstsq(points, np.ones(len(points)), rcond=None)[0]  # the plane's points have up . x = 1
    up = -up / np.linalg.norm(up)
    x = np.array([1.0, 0, 0]) - up[0] * up
    x /= np.linalg.norm(x)
    T_table_camera[:3, :3] = np.stack([x, np.cross(up, x), up])
    T_table_camera[:3, 3] = -T_table_camera[:3, :3] @ points.mean(0)
    return T_table_camera


def colour(label: int) -> str:
    """Colour of the object with this label (1, 2, ...)."""
    return COLOURS[(label - 1) % len(COLOURS)]


def _depth_panel(axis: Axes, depth: Float[np.ndarray, "height width"], scale: Normalize, title: str) -> Any:
    image = axis.imshow(depth, cmap=colormaps["cividis_r"].with_extremes(bad=NO_RETURN_COLOUR), norm=scale)
    _bare(axis, title)
    return image


def _scale_below(figure: Figure, image: Any, axes: list[Axes], label: str) -> None:
    scale = figure.colorbar(image, ax=axes, location="bottom", shrink=0.6, aspect=40, pad=0.02, extend="both")
    scale.set_label(label, fontsize=9, color=INK)
    scale.ax.tick_params(labelsize=8, colors=INK)


def _residual_panel(axis: Axes, depth: Float[np.ndarray, "height width"], posterior: ScenePosterior) -> Any:
    """Input less reconstruction: what the scene explains is white."""
    ends = Normalize(-RESIDUAL_MM, RESIDUAL_MM)
    tones = colormaps["RdBu"].with_extremes(bad=NO_RETURN_COLOUR)
    image = axis.imshow(1e3 * (depth - posterior.reconstruction), cmap=tones, norm=ends)
    _bare(axis, "what the scene does not explain (red: nearer, blue: farther)")
    return image


def _segmentation_panel(axis: Axes, posterior: ScenePosterior) -> None:
    picture = np.ones((*posterior.segmentation.shape, 3))
    for label in range(1, len(posterior.objects) + 1):
        picture[posterior.segmentation == label] = to_rgb(colour(label))
    axis.imshow(picture)
    _number_objects(axis, posterior)
    _bare(axis, "segmentation")


def _overlay_panel(
    axis: Axes, depth: Float[np.ndarray, "height width"], posterior: ScenePosterior, scale: Normalize
) -> None:
    axis.imshow(depth, cmap=colormaps["gray_r"].with_extremes(bad="#f2f2f2"), norm=scale)
    for label in range(1, len(posterior.objects) + 1):
        mask = np.pad(posterior.segmentation == label, 1).astype(float)  # closed at the image's edge
        if mask.any():
            extent = (-1.0, mask.shape[1] - 2.0, -1.0, mask.shape[0] - 2.0)
            axis.contour(mask, levels=[0.5], colors=[INK], linewidths=3.2, extent=extent)
            axis.contour(mask, levels=[0.5], colors=[colour(label)], linewidths=1.8, extent=extent)
    axis.set(xlim=(-0.5, depth.shape[1] - 0.5), ylim=(depth.shape[0] - 0.5, -0.5))
    _bare(axis, "masks on the input depth")


def _number_objects(axis: Axes, posterior: ScenePosterior) -> None:
    for label in range(1, len(posterior.objects) + 1):
        v, u = np.nonzero(posterior.segmentation == label)
        if len(v):
            # The pixel of the mask nearest to its middle: on the object even where it is bent or cut in two.
            k = int(np.argmin(np.square(v - v.mean()) + np.square(u - u.mean())))
            _place_number(axis, u[k], v[k], label)


def _samples_panel(
    axis: Axes, depth: Float[np.ndarray, "height width"], posterior: ScenePosterior, intrinsics: Intrinsics | None
) -> None:
    """Origins of every sample's objects on the table's plane."""
    samples = posterior.samples
    T_table_camera = _view_from_above(posterior, intrinsics)
    sample, slot = np.nonzero(samples.type >= 0)
    weight = np.exp(samples.log_weight[sample] - samples.log_weight.max()) if len(sample) else np.zeros(0)
    if len(sample) > MOST_POINTS:
        kept = np.argsort(-weight, kind="stable")[:MOST_POINTS]
        sample, slot, weight = sample[kept], slot[kept], weight[kept]
    place = (samples.position[sample, slot] @ T_table_camera[:3, :3].T + T_table_camera[:3, 3])[:, :2]
    kind = samples.type[sample, slot]
    centres = np.array([T_table_camera[:3, :3] @ o.position + T_table_camera[:3, 3] for o in posterior.objects])
    centres = centres.reshape(-1, 3)[:, :2]

    if intrinsics is not None:
        points = unproject(posterior.reconstruction, intrinsics) @ T_table_camera[:3, :3].T + T_table_camera[:3, 3]
        for label in range(1, len(posterior.objects) + 1):
            seen = points[posterior.segmentation == label][::7]
            axis.scatter(seen[:, 0], seen[:, 1], s=3, color=colour(label), alpha=0.12, linewidths=0)
            centres = np.concatenate([centres, seen[np.isfinite(seen).all(1), :2]])  # keeps them in view
    owner = np.full(len(sample), -1)
    for k, found in enumerate(posterior.objects):
        owner[(posterior.object_index[sample, slot] == k) & (kind == posterior.types.index(found.type))] = k
    for k in range(-1, len(posterior.objects)):
        own = owner == k
        if own.any():
            alpha = np.clip(weight[own] / weight[own].max(), 0.08, 1.0) if k >= 0 else np.clip(weight[own], 0.08, 1.0)
            tone, marker = (colour(k + 1), "o") if k >= 0 else (OTHER_COLOUR, "x")
            size = 9 if k >= 0 else 22
            axis.scatter(place[own, 0], place[own, 1], s=size, c=tone, marker=marker, alpha=alpha, linewidths=0.8)
    for k in range(len(posterior.objects)):
        _place_number(axis, centres[k, 0], centres[k, 1], k + 1, offset=(13, 13))
    if np.isfinite(posterior.T_camera_table).all():  # else the axes are not those of the table's frame
        for place in posterior.unexplained:
            axis.text(place.x, place.y, "?", fontsize=14, fontweight="bold", color=INK, ha="center", va="center")
            centres = np.concatenate([centres, [[place.x, place.y]]])

    # The listed objects fill the view: samples of the prior may lie anywhere on the table.
    around = centres if len(centres) else place
    around = around if len(around) else np.zeros((1, 2))
    middle = (around.min(0) + around.max(0)) / 2
    half = max(float((around.max(0) - around.min(0)).max()) / 2 * 1.25, 0.1)
    axis.set(xlim=middle[0] + np.array([-half, half]), ylim=middle[1] + np.array([-half, half]), aspect="equal")
    axis.locator_params(nbins=5)
    axis.grid(color="#e6e6e6", linewidth=0.7)
    axis.set_axisbelow(True)
    axis.tick_params(labelsize=8, colors=INK)
    axis.set_xlabel("x on the table, m", fontsize=9, color=INK)
    axis.set_ylabel("y on the table, m", fontsize=9, color=INK)
    axis.set_title("from above (dots: origins; pale: seen; x: not listed; ?: unexplained)", fontsize=10, color=INK)


def _words_panel(axis: Axes, posterior: ScenePosterior) -> None:
    """A row an object, in its colour, then what is said of the whole scene."""
    axis.axis("off")
    axis.set(xlim=(0, 1), ylim=(0, 1))
    columns = ((0.0, "object"), (0.36, "p(type)"), (0.48, "p(exists)"), (0.61, "explained"), (0.76, "σ"))
    shown = posterior.objects[:MOST_LISTED]
    step = min(0.085, 0.7 / (len(shown) + 1))
    y = 0.97
    for x, text in columns:
        axis.text(x, y, text, fontsize=9, color="#666666", va="top")
    for k, found in enumerate(shown):
        y -= step
        _place_number(axis, 0.02, y - 0.02, k + 1)
        words = (
            _shorten(found.type, 24),
            f"{found.type_probabilities[found.type]:.3f}",
            f"{found.probability:.3f}",
            f"{found.explained:.0%}" if np.isfinite(found.explained) else "",
            _spread_words(found),
        )
        for (x, _), text in zip(columns, words, strict=True):
            axis.text(x + 0.055 if x == 0 else x, y, text, fontsize=9.5, color=INK, va="top")
    if len(posterior.objects) > MOST_LISTED:
        y -= step
        axis.text(0.055, y, f"and {len(posterior.objects) - MOST_LISTED} more", fontsize=9.5, color=INK, va="top")
    if not shown:
        y -= step
        nothing = "nothing of the library, but something" if posterior.unexplained else "no objects"
        axis.text(0.0, y, nothing, fontsize=11, color=INK, va="top")
    counts = "   ".join(f"{n}: {p:.2f}" for n, p in posterior.num_objects.items() if p >= 0.005)
    lines = (
        f"p(number of objects)   {counts}",
        *(line for note in posterior.notes[:2] for line in wrap(note, 110)),  # whole: they say what to make of p(n)
        f"depth noise σ {1e3 * posterior.sigma:.2f} mm    outliers {100 * posterior.p_outlier:.1f} %",
        f"log evidence over the empty table {posterior.log_evidence:.1f}    {posterior.seconds:.2f} s",
    )
    axis.text(0.0, y - step - 0.02, "\n".join(lines), fontsize=9, color="#444444", va="top", linespacing=1.6)


def _spread_words(found: ObjectEstimate) -> str:
    """Of the mode that is reported, with its weight where it is one of several."""
    place = 1e3 * np.sqrt(np.trace(found.covariance[:3, :3]))
    turn = np.degrees(np.sqrt(np.trace(found.covariance[3:, 3:])))
    weight = f"  p {found.mode_weight:.2f}" if len(found.modes) > 1 else ""
    return f"{_short(place)} mm  {_short(turn)}°{weight}"


def _short(value: float) -> str:
    """Two digits, without an exponent."""
    return f"{value:.2g}" if 0.01 <= value < 99.5 else f"{value:.0f}" if value >= 99.5 else "<0.01"


def _shorten(text: str, length: int) -> str:
    return text if len(text) <= length else text[: length - 1] + "…"


def _place_number(axis: Axes, x: float, y: float, label: int, offset: tuple[float, float] = (0.0, 0.0)) -> None:
    axis.annotate(
        str(label), (x, y), offset, textcoords="offset points", ha="center", va="center", fontsize=8.5,
        fontweight="bold", color=INK, annotation_clip=False,
        bbox={"boxstyle": "circle,pad=0.22", "facecolor": "white", "edgecolor": colour(label), "linewidth": 2},
    )  # fmt: skip


def _bare(axis: Axes, title: str) -> None:
    axis.set_xticks([])
    axis.set_yticks([])
    axis.set_title(title, fontsize=10, color=INK)
    for spine in axis.spines.values():
        spine.set_color("#bbbbbb")
