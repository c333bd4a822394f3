# SPDX-License-Identifier: Apache-2.0

"""A scene as people read it with `ros2 topic echo`: what stands where, how sure, and what the sampler did."""

from collections.abc import Sequence

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from bayes3d_ros.objects.model import UNKNOWN
from bayes3d_ros.posterior.types import ObjectEstimate, PoseMode, ScenePosterior, UnexplainedPlace
from bayes3d_ros.ros.to_messages import header

UNEXPLAINED = "unexplained"  # key of a place in the scene's status


def key_values(**values: str) -> list[KeyValue]:
    """Key-value pairs in the order given; underscores in keys are read as spaces."""
    return [KeyValue(key=key.replace("_", " "), value=value) for key, value in values.items()]


def summary_message(posterior: ScenePosterior, ids: Sequence[str] = ()) -> DiagnosticArray:
    """One status for the scene, then one per object, in the order of their labels, with its id if `ids` are given."""
    nothing = "no object of the library, but something unexplained" if posterior.unexplained else "no object"
    names = ", ".join(o.type for o in posterior.objects) or nothing
    level = DiagnosticStatus.WARN if posterior.warnings else DiagnosticStatus.OK
    scene = DiagnosticStatus(level=level, name="scene", hardware_id=posterior.frame_id, message=names)
    scene.values = key_values(
        pose_frame=posterior.pose_frame_id,
        p_n=" ".join(f"{n}: {p:.3f}" for n, p in posterior.num_objects.items()),
        log_evidence=f"{posterior.log_evidence:.2f}",
        p_outlier=f"{posterior.p_outlier:.4f}",
        sigma_mm=f"{posterior.sigma * 1e3:.3f}",
        ess=" ".join(f"{e:.2f}" for e in posterior.ess),
        ms=f"{posterior.seconds * 1e3:.0f}",
        usable_share=f"{posterior.usable_share:.2f}",
    )
    if UNKNOWN in posterior.types:
        unknown = " ".join(f"{n}: {p:.3f}" for n, p in posterior.num_unknown.items())
        scene.values.insert(1, KeyValue(key="p n unknown", value=unknown))
    scene.values += [KeyValue(key=UNEXPLAINED, value=place_words(place)) for place in posterior.unexplained]
    scene.values += [KeyValue(key="note", value=note) for note in posterior.notes]
    objects = [_object_status(k, o, posterior) for k, o in enumerate(posterior.objects, start=1)]
    for status, name in zip(objects, ids, strict=False):
        status.values.insert(0, KeyValue(key="id", value=name))
    return DiagnosticArray(header=header(posterior), status=[scene, *objects])


def found_words(posterior: ScenePosterior, ids: Sequence[str], warnings: Sequence[str]) -> str:
    """What was found in an image, in one line: its objects, by their ids, and what to be warned of."""
    listed = ", ".join(f"{name} (p {o.probability:.2f})" for name, o in zip(ids, posterior.objects, strict=True))
    count = len(posterior.objects)
    found = f"{count} object{'s' * (count != 1)}: {listed}" if count else "no object"
    seconds, nanoseconds = divmod(posterior.stamp_ns, 10**9)
    image = f"image of stamp {seconds}.{nanoseconds:09d}"
    return "; ".join([f"{found}; {image}", *(f"warning: {warning}" for warning in warnings)])


def place_words(place: UnexplainedPlace) -> str:
    """A place where something stands that the scene does not hold."""
    return f"x {place.x:.3f} y {place.y:.3f} z {place.z:.3f} m, {place.pixels} pixels"


def place_from_words(words: str) -> UnexplainedPlace:
    """The place that `place_words` put into words."""
    _, x, _, y, _, z, _, pixels, _ = words.split()
    return UnexplainedPlace(float(x), float(y), float(z), int(pixels))


def _object_status(label: int, estimate: ObjectEstimate, posterior: ScenePosterior) -> DiagnosticStatus:
    sigma_position, sigma_rotation = _sigmas(estimate.covariance)
    status = DiagnosticStatus(name=f"{label} {estimate.type}", hardware_id=posterior.frame_id)
    status.message = f"p(exists) {estimate.probability:.3f}"
    status.values = key_values(
        p_exists=f"{estimate.probability:.4f}",
        explained=f"{estimate.explained:.3f}",
        p_type=" ".join(f"{name}: {p:.3f}" for name, p in estimate.type_probabilities.items()),
        position_m=spaced(estimate.position, 4),
        table_position_m=spaced(posterior.table_position(estimate), 4),
        orientation_xyzw=spaced(estimate.orientation, 4),
        sigma_position_mm=sigma_position,
        sigma_rotation_deg=sigma_rotation,
        mode_weight=f"{estimate.mode_weight:.3f}",
        contact_face=str(estimate.contact_face) if estimate.contact_face >= 0 else "",
        p_face=" ".join(f"{face}: {p:.3f}" for face, p in enumerate(estimate.face_probabilities) if p >= 5e-4),
        p_mode=" ".join(f"{k}: {mode.weight:.3f}" for k, mode in enumerate(estimate.modes, start=1)),
    )
    if estimate.size is not None and estimate.size_sigma is not None:
        status.values += key_values(
            size_m=spaced(estimate.size, 4), size_sigma_mm=spaced(np.asarray(estimate.size_sigma) * 1e3, 1)
        )
    if estimate.modes and np.isfinite(estimate.modes[0].weight_error):
        status.values.append(KeyValue(key="mode weight sd", value=f"{estimate.modes[0].weight_error:.3f}"))
    if estimate.modes_dropped:
        told = f"{estimate.modes_dropped}, together p {estimate.weight_dropped:.4f}"
        status.values.append(KeyValue(key="modes dropped", value=told))
    if len(estimate.modes) > 1:  # else it is what stands above
        position_all, rotation_all = _sigmas(estimate.covariance_all)
        status.values += key_values(sigma_position_all_mm=position_all, sigma_rotation_all_deg=rotation_all)
        status.values += [KeyValue(key=f"mode {k}", value=_mode(m)) for k, m in enumerate(estimate.modes, start=1)]
    return status


def _mode(mode: PoseMode) -> str:
    sigma_position, sigma_rotation = _sigmas(mode.covariance)
    return (
        f"p {mode.weight:.3f}, m {spaced(mode.position, 4)}, xyzw {spaced(mode.orientation, 4)}, "
        f"sigma mm {sigma_position}, sigma deg {sigma_rotation}, face {mode.contact_face}"
        + (f", p sd {mode.weight_error:.3f}" if np.isfinite(mode.weight_error) else "")
    )


def _sigmas(covariance: np.ndarray) -> tuple[str, str]:
    """Standard deviations in millimetres and degrees."""
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return spaced(sigma[:3] * 1e3, 2), spaced(np.degrees(sigma[3:]), 2)


def spaced(values: np.ndarray, digits: int) -> str:
    """Numbers with so many decimals, with spaces between them."""
    return " ".join(f"{v:.{digits}f}" for v in values)
