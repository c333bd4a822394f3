# SPDX-License-Identifier: Apache-2.0

"""Lines that commands print of what they work on and what came of it."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # --help must be quick
    from bayes3d_ros.io.bags import FrameReader
    from bayes3d_ros.posterior.types import ScenePosterior
    from bayes3d_ros.tracking.camera_estimate import CameraEstimate


def columns(rows: Sequence[Sequence[str]]) -> list[str]:
    """Rows of words as lines whose columns are aligned, two spaces apart."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(word.ljust(n) for word, n in zip(row, widths, strict=True)).rstrip() for row in rows]


def recording_line(frames: "FrameReader", every: int = 1) -> str:
    """The bag, how many frames are read of it, and from which topics. every: of the recorded images, each so many-th is
    read."""
    count = f"{len(frames)} depth image{'s' * (len(frames) != 1)} of {frames.depth_topic}"
    count += f" (1 of every {every})" if every > 1 else ""
    return f"{frames.bag}: {count}, CameraInfo of {frames.info_topic}, {frames.pose_told}"


def frame_line(posterior: "ScenePosterior") -> str:
    """A parsed frame: p(exists) of every listed object, and p(type) given that it exists; of unknown things also where
    they are, for `bayes3d learn --at X Y`."""
    objects = (
        f"{o.type} p(exists) {o.probability:.2f} p(type) {o.type_probabilities.get(o.type, 0.0):.2f}"
        + (" at x {:.3f} y {:.3f} m on the table".format(*posterior.table_position(o)) if o.is_unknown else "")
        for o in posterior.objects
    )
    found = ", ".join(objects) or f"no object p(n = 0) {posterior.num_objects.get(0, 0.0):.2f}"
    return f"{posterior.stamp_ns}  {posterior.seconds:.2f} s  {found}"


def note_lines(posterior: "ScenePosterior", before: tuple[str, ...]) -> list[str]:
    """The notes of a frame, without those that the frame before had as well; warnings are said of every frame."""
    again = posterior.warnings
    return [f"{posterior.stamp_ns}  note: {note}" for note in posterior.notes if note not in before or note in again]


def camera_line(estimate: "CameraEstimate") -> str:
    """A tracked frame: the camera's place in the world, and how sure it is."""
    place = " ".join(f"{v:.4f}" for v in estimate.T_world_camera[:3, 3])
    sure = 1e3 * estimate.covariance.diagonal()[:3].sum() ** 0.5
    told = f"lost: {estimate.lost}" if estimate.lost else f"sd {sure:.1f} mm, {estimate.explained:.0%} explained"
    again = ", searched for in the whole scene" if estimate.found_again else ""
    return f"{estimate.stamp_ns}  {estimate.seconds:.2f} s  {place} m  {told}{again}"
