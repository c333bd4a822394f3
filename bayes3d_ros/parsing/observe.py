# SPDX-License-Identifier: Apache-2.0

"""From a depth frame to the image that is scored: find the table, and decide which returns belong to the workspace."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from bayes3d_ros.geometry.camera import Intrinsics, unproject
from bayes3d_ros.geometry.depth_frame import DepthFrame, reduced, scored_size
from bayes3d_ros.likelihood.density import BEYOND, IN_WORKSPACE, Likelihood
from bayes3d_ros.likelihood.error_nodes import sensor_scale
from bayes3d_ros.likelihood.scored_image import ScoredImage, scored_image
from bayes3d_ros.likelihood.shared_errors import Amplitudes, SharedErrorImage, shared_error_image
from bayes3d_ros.objects.placement import Table
from bayes3d_ros.parsing.support_plane import depth_of_table, find_plane, table_frame, usable_share, workspace
from bayes3d_ros.parsing.table_fit import SeenTable, seen_table
from bayes3d_ros.parsing.tuning import SEARCH
from bayes3d_ros.posterior.types import ParseError
from bayes3d_ros.settings import ParserSettings


class Observation(NamedTuple):
    """What the model is given of a frame."""

    image: ScoredImage
    errors: SharedErrorImage | None  # None unless `likelihood: depth`
    table: Table
    camera: Intrinsics  # of the image as it is scored; depth and pixel_class have its size
    depth: Float[np.ndarray, "height width"]  # metres, 0 where there is no return
    pixel_class: Int[np.ndarray, "height width"]
    seen_table: SeenTable
    usable_share: float  # of the scored pixels on the table (`support_plane.py`)
    notes: list[str]  # on where the table comes from
    found: bool = False  # whether the table was found in the image, and not given by a pose
    error_scale: float = 1.0  # of errors that no return shows, see `error_nodes.sensor_scale`

    @property
    def T_camera_table(self) -> Float[np.ndarray, "4 4"]:
        """Of the plane that the returns show."""
        return self.seen_table.T_camera_table


def observe(frame: DepthFrame, settings: ParserSettings) -> Observation:
    """Reduce a frame to the image that is scored, and find the table in it. Raises ParseError if nothing returned
    in range, or if no table is in sight."""
    camera, depth, in_range, returned = reduced(frame, settings.score_width, settings.near, settings.far)
    if not in_range.any():
        raise ParseError(
            f"the depth image has no return between {settings.near} and {settings.far} m "
            f"({np.isfinite(frame.depth).mean():.0%} of its pixels hold a value)"
        )
    points = unproject(np.where(returned, depth, np.nan), camera)
    T_given, found = _find_table(frame, points[returned], settings.table)
    table = seen_table(points[returned], T_given, found, settings)
    T_camera_table = table.T_camera_table
    table_size = (settings.table_width, settings.table_depth)
    pixel_class = workspace(points, T_camera_table, table_size, settings.workspace_height)
    depth = np.where(returned, depth, 0.0)
    image, errors = _as_scored(camera, depth, pixel_class, T_camera_table, settings)
    scale = 1.0 if errors is None else sensor_scale(errors.nodes, settings.surface_waves)
    table = table._replace(image_sd=scale * table.image_sd)
    usable = usable_share(pixel_class, camera.rays(), T_camera_table, table_size, settings.far)
    placed = table_of(T_camera_table, settings)
    notes = ["table found in the depth image"] if found else []
    return Observation(image, errors, placed, camera, depth, pixel_class, table, usable, notes, found, scale)


def table_of(T_camera_table: Float[np.ndarray, "4 4"], settings: ParserSettings) -> Table:
    """The table of a frame, with the area that the prior allows; a region is cut to the table's rectangle."""
    size = np.array((settings.table_width, settings.table_depth), np.float32)
    low, high = np.full(2, -np.inf, np.float32), np.full(2, np.inf, np.float32)
    if settings.region:
        low, high = (np.clip(settings.region[end::2], -size / 2, size / 2) for end in (0, 1))
    region = jnp.asarray(np.stack([low, high]), jnp.float32)
    return Table(jnp.asarray(T_camera_table, jnp.float32), jnp.asarray(size), region)


def bare_table(width: int, height: int, settings: ParserSettings) -> tuple[ScoredImage, SharedErrorImage | None, Table]:
    """A made-up image of a bare table, seen by a camera 0.8 m above it whose images have this size. Scoring it
    compiles everything that a frame needs, without a search."""
    across, down = scored_size(width, height, settings.score_width)
    camera = Intrinsics(float(across), float(across), (across - 1) / 2, (down - 1) / 2, across, down)
    above, c, s = 0.8, np.cos(0.6), np.sin(0.6)
    T_table_camera = np.array([[1, 0, 0, 0], [0, -s, c, -above * c / s], [0, -c, -s, above], [0, 0, 0, 1]])
    depth = above / np.maximum(camera.rays()[..., 1] * c + s, 0.2)
    pixel_class = np.full(depth.shape, IN_WORKSPACE)
    T_camera_table = np.linalg.inv(T_table_camera)
    return *_as_scored(camera, depth, pixel_class, T_camera_table, settings), table_of(T_camera_table, settings)


def _find_table(
    frame: DepthFrame, points: Float[np.ndarray, "N 3"], source: str
) -> tuple[Float[np.ndarray, "4 4"], bool]:
    """T_camera_table, and whether it was found in the depth image; source: the setting `table`."""
    if source != "depth" and frame.T_table_camera is not None:
        return np.linalg.inv(frame.T_table_camera), False
    if source == "pose":
        raise ParseError("no camera pose for this frame, and table:=pose expects one")
    return table_frame(find_plane(points), points), True


def _as_scored(
    camera: Intrinsics,
    depth: Float[np.ndarray, "height width"],
    pixel_class: Int[np.ndarray, "height width"],
    T_camera_table: Float[np.ndarray, "4 4"],
    settings: ParserSettings,
) -> tuple[ScoredImage, SharedErrorImage | None]:
    """The image and its errors, of numpy arrays, from depth in metres, 0 where there is no return."""
    bare = np.where(pixel_class != BEYOND, depth_of_table(camera.rays(), T_camera_table, settings.far), np.inf)
    shared = settings.shares_errors
    likelihood = Likelihood("points" if settings.likelihood == "points" else "independent")
    weight = np.float32(
        SEARCH.pixel_weight if shared else 1.0
    )  # under shared errors only the search scores pixels alone
    near, far, sigma_max = settings.near, settings.far, settings.sigma_max
    image = scored_image(camera, depth, pixel_class, bare, near, far, sigma_max, likelihood=likelihood, weight=weight)
    return image, shared_error_image(image, amplitudes_of(settings), sigma_max) if shared else None


def amplitudes_of(settings: ParserSettings) -> Amplitudes:
    known = (
        settings.surface_bias,
        settings.surface_waves,
        settings.wave_length,
        settings.model_error,
        settings.bad_share,
        settings.edge_share,
        settings.edge_blur,
        settings.object_lean,
    )
    bias, waves, length, model, bad, edge, blur, lean = map(np.float32, known)
    return Amplitudes(bias, waves, length, model, bad, edge, blur, lean, np.bool_(settings.unknown))
