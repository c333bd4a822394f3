# SPDX-License-Identifier: Apache-2.0

"""A posterior put together again from the messages of one stamp: what a subscriber can know."""

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from bayes3d_ros.objects.model import UNKNOWN, Library
from bayes3d_ros.posterior.reframe import moved_samples
from bayes3d_ros.posterior.summarise import number_of_unknown, object_estimates
from bayes3d_ros.posterior.types import ScenePosterior, SceneSamples
from bayes3d_ros.ros.from_messages import (
    depth_from_image,
    labels_from_image,
    rows_from_cloud,
    stamp_to_ns,
    transform_to_matrix,
)
from bayes3d_ros.ros.summary import UNEXPLAINED, place_from_words


def stamp_of(message: Any) -> int:
    """The stamp of an output in nanoseconds; a marker array has it in its markers."""
    header = message.header if hasattr(message, "header") else message.markers[0].header
    return stamp_to_ns(header.stamp)


def samples_from_rows(rows: np.ndarray) -> tuple[SceneSamples, np.ndarray]:
    """Weighted scenes, and which object every slot holds, from the rows of ~/posterior.

    An object's slot is its place among its sample's rows.
    """
    sample, first, size = np.unique(rows["sample"], return_index=True, return_counts=True)
    count, most = len(sample), int(max(rows["n"].max(initial=0), 1))
    slot = np.arange(len(rows)) - np.repeat(first, size)  # rows are in the order of samples
    kind, face, index = (np.full((count, most), -1) for _ in range(3))
    position, orientation = np.zeros((count, most, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (count, most, 1))
    box = np.zeros((count, most, 3))
    held = rows["object"] >= 0
    where = np.repeat(np.arange(count), size)[held], slot[held]
    kind[where], face[where], index[where] = rows["type"][held], rows["face"][held], rows["object"][held]
    position[where] = np.stack([rows[name][held] for name in ("x", "y", "z")], -1)
    orientation[where] = np.stack([rows[name][held] for name in ("qx", "qy", "qz", "qw")], -1)
    if "sx" in (rows.dtype.names or ()):  # older recordings know no unknown things
        box[where] = np.stack([rows[name][held] for name in ("sx", "sy", "sz")], -1)
    per_sample = {name: rows[name][first] for name in ("log_weight", "p_outlier", "sigma")}
    samples = SceneSamples(
        num_objects=rows["n"][first],
        type=kind,
        face=face,
        position=position,
        orientation=orientation,
        size=box,
        **per_sample,
    )
    return samples, index


def _T_camera_table(messages: dict[str, Any]) -> Float[np.ndarray, "4 4"]:
    told = messages.get("T_camera_table")
    return np.full((4, 4), np.nan) if told is None else transform_to_matrix(told.transform)


def _T_camera_pose(messages: dict[str, Any]) -> Float[np.ndarray, "4 4"]:
    """From the frame that poses are told in to the camera's."""
    camera, frame = (messages[name].header.frame_id for name in ("depth_reconstruction", "posterior"))
    if frame == camera:
        return np.eye(4)
    if "T_camera_table" not in messages or frame != messages["T_camera_table"].child_frame_id:
        raise ValueError(
            f"posterior: expected poses in the frame of images, {camera!r}, or in the table's, got {frame!r}"
        )
    return _T_camera_table(messages)


def posterior_from_messages(messages: dict[str, Any], library: Library) -> ScenePosterior:
    """The posterior in the camera's frame from one stamp's messages, by topic name without `~/`. Poses may have been
    told in the table's frame; ValueError where they are in yet another one.

    Which draws samples descend from is not published: weights of modes have no Monte Carlo error.
    Where `T_camera_table` is not among them, as in older recordings, T_camera_table is NaN.
    """
    cloud, depth = messages["posterior"], messages["depth_reconstruction"]
    samples, object_index = samples_from_rows(rows_from_cloud(cloud))
    samples = moved_samples(samples, _T_camera_pose(messages))
    weights = samples.weight
    scene, *told = messages["summary"].status
    values = {pair.key: pair.value for pair in scene.values}
    types = (*library.names, UNKNOWN) if "p n unknown" in values else library.names
    objects = object_estimates(samples, object_index, types, len(messages["poses"].poses))
    explained = [next(float(pair.value) for pair in status.values if pair.key == "explained") for status in told]
    return ScenePosterior(
        stamp_ns=stamp_of(cloud),
        frame_id=depth.header.frame_id,
        types=types,
        objects=tuple(replace(found, explained=share) for found, share in zip(objects, explained, strict=True)),
        num_objects={n: float(weights[samples.num_objects == n].sum()) for n in range(samples.num_objects.max() + 1)},
        num_unknown=number_of_unknown(samples, weights, types),
        p_outlier=float(weights @ samples.p_outlier),
        sigma=float(weights @ samples.sigma),
        log_evidence=float(values["log evidence"]),
        samples=samples,
        object_index=object_index,
        reconstruction=depth_from_image(depth),
        segmentation=labels_from_image(messages["segmentation"]),
        T_camera_table=_T_camera_table(messages),
        ess=tuple(float(e) for e in values["ess"].split()),
        seconds=float(values["ms"]) / 1e3,
        usable_share=float(values["usable share"]),
        unexplained=tuple(place_from_words(pair.value) for pair in scene.values if pair.key == UNEXPLAINED),
        notes=tuple(pair.value for pair in scene.values if pair.key == "note"),
    )
