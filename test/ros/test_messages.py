# SPDX-License-Identifier: Apache-2.0

import array
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import Pose, Quaternion
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointField
from std_msgs.msg import Header
from visualization_msgs.msg import Marker

from bayes3d_ros.geometry.compressed_depth import encode_compressed_depth
from bayes3d_ros.geometry.depth_image import encode_depth
from bayes3d_ros.geometry.poses import look_at
from bayes3d_ros.posterior.summarise import POSTERIOR_FIELDS, summarise
from bayes3d_ros.posterior.types import ScenePosterior, SceneSamples, UnexplainedPlace
from bayes3d_ros.ros import detections, from_messages, to_messages
from bayes3d_ros.ros.markers import SceneMarkers, principal_axes
from bayes3d_ros.ros.summary import summary_message


def image(depth: np.ndarray, encoding: str, big: bool = False, padding: int = 0) -> Image:
    step = depth.shape[1] * (2 if encoding == "16UC1" else 4) + padding
    message = Image(height=depth.shape[0], width=depth.shape[1], encoding=encoding, is_bigendian=big, step=step)
    message.data = array.array("B", encode_depth(depth, encoding, big, step))
    message.header = Header(stamp=to_messages.ns_to_stamp(1_700_000_000_123_456_789), frame_id="camera")
    return message


def camera_info(width: int, height: int) -> CameraInfo:
    info = CameraInfo(width=width, height=height)
    info.k = [100.0, 0.0, width / 2, 0.0, 100.0, height / 2, 0.0, 0.0, 1.0]
    return info


def depth_image() -> np.ndarray:
    depth = np.random.default_rng(0).integers(200, 4000, (6, 8)).astype(np.float32) * 1e-3
    depth[1, 2] = depth[5, 7] = np.nan
    return depth


@pytest.mark.parametrize("encoding", ["16UC1", "32FC1"])
@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("padding", [0, 4, 7])
def test_depth_survives_encoding_byte_order_and_padding(encoding: str, big: bool, padding: int) -> None:
    depth = depth_image()
    frame = from_messages.frame_from_messages(image(depth, encoding, big, padding), camera_info(8, 6))
    np.testing.assert_allclose(frame.depth, depth, atol=1e-6)
    assert frame.depth.dtype == np.float32
    assert (frame.stamp_ns, frame.frame_id) == (1_700_000_000_123_456_789, "camera")


@pytest.mark.parametrize("codec", ["png", "rvl"])
def test_compressed_depth_is_read(codec: str) -> None:
    depth, header = depth_image(), Header(stamp=to_messages.ns_to_stamp(5), frame_id="camera")
    text = f"16UC1; compressedDepth {codec}"
    message = CompressedImage(header=header, format=text, data=array.array("B", encode_compressed_depth(depth, text)))
    frame = from_messages.frame_from_messages(message, camera_info(8, 6))
    np.testing.assert_array_equal(frame.depth, depth)
    assert (frame.stamp_ns, frame.frame_id) == (5, "camera")
    with pytest.raises(ValueError, match="CameraInfo width, height: expected the image's 8x6, got 4x3"):
        from_messages.frame_from_messages(message, camera_info(4, 3))
    message.format = "8UC1; compressedDepth"
    with pytest.raises(ValueError, match="CompressedImage format: expected an encoding of 16UC1, mono16, 32FC1"):
        from_messages.frame_from_messages(message, camera_info(8, 6))


@pytest.mark.parametrize("ns", [0, 1, 999_999_999, 10**9, 1_700_000_000_123_456_789])
def test_stamps_survive(ns: int) -> None:
    assert from_messages.stamp_to_ns(to_messages.ns_to_stamp(ns)) == ns


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"encoding": "rgb8"}, "encoding"),
        ({"step": 3}, "step"),
        ({"height": 7}, "data: expected 112 bytes"),
        ({"data": array.array("B", b"123")}, "data"),
    ],
)
def test_a_wrong_image_is_refused_with_the_field_named(change: dict, named: str) -> None:
    message = image(depth_image(), "16UC1")
    for field, value in change.items():
        setattr(message, field, value)
    with pytest.raises(ValueError, match=named) as error:
        from_messages.frame_from_messages(message, camera_info(8, 6))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(("info", "named"), [(CameraInfo(width=8, height=6), r"K\[0\]"), (camera_info(4, 3), "8x6")])
def test_a_wrong_camera_info_is_refused(info: CameraInfo, named: str) -> None:
    with pytest.raises(ValueError, match=named):
        from_messages.frame_from_messages(image(depth_image(), "16UC1"), info)


def test_an_image_message_decodes_to_its_pixels() -> None:
    depth = depth_image()
    message = to_messages.image_message(depth, "32FC1", Header(frame_id="camera"))
    np.testing.assert_array_equal(from_messages.depth_from_image(message), depth)
    labels = np.arange(48, dtype=np.uint16).reshape(6, 8)
    message = to_messages.image_message(labels, "16UC1", Header())
    np.testing.assert_array_equal(np.frombuffer(message.data, np.uint16).reshape(6, 8), labels)
    assert (message.step, message.height, message.width, message.is_bigendian) == (16, 6, 8, 0)


def test_poses_and_matrices_are_inverse() -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        quaternion = rng.normal(size=4)
        quaternion /= np.linalg.norm(quaternion)
        pose = to_messages.pose_message(rng.normal(size=3), quaternion)
        T = from_messages.pose_to_matrix(pose)
        again = to_messages.matrix_to_pose(T)
        np.testing.assert_allclose(from_messages.pose_to_matrix(again), T, atol=1e-12)
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize("w", [0.0, 2.0, float("nan")])
def test_a_pose_without_a_unit_quaternion_is_refused(w: float) -> None:
    with pytest.raises(ValueError, match="pose"):
        from_messages.pose_to_matrix(Pose(orientation=Quaternion(w=w)))


def scene(names: tuple[str, ...]) -> ScenePosterior:
    """Two objects in most samples, one in some, none in one."""
    rng = np.random.default_rng(2)
    size, most = 30, 3
    num = np.array([2] * 20 + [1] * 9 + [0])
    type_ = np.full((size, most), -1)
    type_[:29, 0], type_[:20, 1] = 0, 1
    weight = rng.random(size)
    position = np.array([[-0.2, 0, 1.0], [0.2, 0, 1.1], [0, 0, 0]]) + 1e-3 * rng.normal(size=(size, most, 3))
    samples = SceneSamples(
        log_weight=np.log(weight / weight.sum()),
        num_objects=num,
        type=type_,
        face=np.where(type_ >= 0, 5, -1),
        position=position,
        orientation=np.broadcast_to([0.0, 0.0, 0.0, 1.0], (size, most, 4)),
        p_outlier=rng.random(size),
        sigma=0.005 * rng.random(size),
    )
    summary = summarise(samples, names, 0.5)
    shape = (6, 8)
    return ScenePosterior(
        stamp_ns=1_700_000_000_000_000_001,
        frame_id="camera",
        types=names,
        objects=summary.objects,
        num_objects=summary.num_objects,
        p_outlier=summary.p_outlier,
        sigma=summary.sigma,
        log_evidence=3.0,
        samples=samples,
        object_index=summary.object_index,
        reconstruction=np.full(shape, np.nan, np.float32),
        segmentation=np.zeros(shape, np.uint16),
        T_camera_table=np.eye(4),
        ess=(1.0, 0.6),
        seconds=0.25,
        notes=("table found in the depth",),
    )


def test_the_posterior_cloud_holds_the_samples(library) -> None:
    posterior = scene(library.names)
    cloud = to_messages.posterior_cloud(posterior)
    names = "x y z qx qy qz qw log_weight p_outlier sigma sample n object type face sx sy sz"
    assert " ".join(f.name for f in cloud.fields) == names
    assert [f.datatype for f in cloud.fields] == [PointField.FLOAT32] * 10 + [PointField.INT32] * 5 + [
        PointField.FLOAT32
    ] * 3
    assert len(cloud.data) == cloud.row_step == cloud.point_step * cloud.width
    rows = from_messages.rows_from_cloud(cloud)
    assert rows.dtype == np.dtype(list(POSTERIOR_FIELDS))
    _, first = np.unique(rows["sample"], return_index=True)
    assert np.exp(rows["log_weight"][first]).sum() == pytest.approx(1, abs=1e-5)
    assert (rows["object"] == -1).sum() == 1  # the sample without objects
    assert len(rows) == posterior.samples.num_objects.sum() + 1
    for k, estimate in enumerate(posterior.objects):  # object k is pose k, label k + 1
        mine = rows[rows["object"] == k]
        assert {posterior.types[t] for t in mine["type"]} == {estimate.type}
        np.testing.assert_allclose(mine["x"].mean(), estimate.position[0], atol=2e-3)
    assert (from_messages.stamp_to_ns(cloud.header.stamp), cloud.header.frame_id) == (posterior.stamp_ns, "camera")


def test_poses_are_in_the_order_of_labels(library) -> None:
    posterior = scene(library.names)
    poses = to_messages.pose_array(posterior)
    assert len(poses.poses) == len(posterior.objects) == 2
    for pose, estimate in zip(poses.poses, posterior.objects, strict=True):
        np.testing.assert_allclose(from_messages.pose_to_matrix(pose)[:3, 3], estimate.position)


def test_the_tables_transform_maps_table_coordinates_to_the_camera(library) -> None:
    T_camera_table = np.linalg.inv(look_at(np.array([0.1, -0.6, 0.5]), np.zeros(3)))
    message = to_messages.table_transform(replace(scene(library.names), T_camera_table=T_camera_table), "table")
    assert (message.header.frame_id, message.child_frame_id) == ("camera", "table")  # parent, child, as in tf
    np.testing.assert_allclose(from_messages.transform_to_matrix(message.transform), T_camera_table, atol=1e-12)


def test_markers_delete_the_old_ones_first_and_are_unique(library) -> None:
    posterior = scene(library.names)
    markers = SceneMarkers(library)(posterior).markers
    assert markers[0].action == Marker.DELETEALL
    assert len({(m.ns, m.id) for m in markers[1:]}) == len(markers) - 1 == 3 * len(posterior.objects)
    assert {m.header.frame_id for m in markers} == {"camera"}
    for marker in markers[1:]:
        if marker.ns == "voxels":
            assert len(marker.points) == len(library.models[0].surface_index) or marker.id == 2


def test_an_ellipsoid_has_the_covariance_it_was_made_from() -> None:
    A = np.random.default_rng(3).normal(size=(3, 3)) * 1e-2
    covariance = A @ A.T + 1e-6 * np.eye(3)
    quaternion, sigma = principal_axes(covariance)
    R = from_messages.matrix_from_values([0, 0, 0, *quaternion])[:3, :3]
    np.testing.assert_allclose(R @ np.diag(sigma**2) @ R.T, covariance, atol=1e-12)


def test_the_summary_says_what_a_person_asks(library) -> None:
    posterior = scene(library.names)
    message = summary_message(posterior)
    assert [s.name for s in message.status] == ["scene", "1 brick", "2 cube"]
    values = {v.key: v.value for v in message.status[0].values}
    assert values["ms"] == "250" and values["log evidence"] == "3.00" and "2: " in values["p n"]
    assert values["note"] == "table found in the depth"
    assert message.status[0].level == DiagnosticStatus.OK and "unexplained" not in values
    values = {v.key: v.value for v in message.status[1].values}
    assert values["p face"] == "5: 1.000" and values["p mode"] == "1: 1.000" and "mode 1" not in values
    place = [float(v) for v in values["table position m"].split()]
    np.testing.assert_allclose(place, posterior.table_position(posterior.objects[0]), atol=1e-4)
    assert "brick: 1.000" in values["p type"] and len(values["sigma position mm"].split()) == 3


def test_the_summary_does_not_say_that_a_table_is_empty_where_something_stands(library) -> None:
    posterior = replace(scene(library.names), objects=(), unexplained=(UnexplainedPlace(0.12, -0.05, 0.06, 240),))
    (status,) = summary_message(posterior).status
    assert status.level == DiagnosticStatus.WARN
    assert status.message == "no object of the library, but something unexplained"
    assert {v.key: v.value for v in status.values}["unexplained"] == "x 0.120 y -0.050 z 0.060 m, 240 pixels"


def two_modes(names: tuple[str, ...]) -> ScenePosterior:
    """The first object's pose has a second mode, turned by 180 degrees."""
    posterior = scene(names)
    first = posterior.objects[0]
    (mode,) = first.modes
    turned = mode._replace(weight=0.3, orientation=np.array([0.0, 0.0, 1.0, 0.0]))
    changed = replace(first, modes=(mode._replace(weight=0.7), turned))
    return replace(posterior, objects=(changed, *posterior.objects[1:]))


def test_the_summary_and_the_markers_say_where_else_an_object_may_be(library) -> None:
    posterior = two_modes(library.names)
    values = {v.key: v.value for v in summary_message(posterior).status[1].values}
    assert values["p mode"] == "1: 0.700 2: 0.300" and values["mode weight"] == "0.700"
    wide = replace(posterior.objects[0], covariance_all=np.diag([0.132**2] * 6), modes_dropped=2, weight_dropped=0.012)
    told = summary_message(replace(posterior, objects=(wide,))).status[1].values
    told = {v.key: v.value for v in told}
    assert told["sigma position mm"] == values["sigma position mm"]
    assert told["sigma position all mm"] == "132.00 132.00 132.00" and told["modes dropped"] == "2, together p 0.0120"
    assert values["mode 2"].startswith("p 0.300, m -0.2") and "xyzw 0.0000 0.0000 1.0000 0.0000" in values["mode 2"]
    (other,) = [m for m in SceneMarkers(library)(posterior).markers if m.ns == "modes"]
    assert other.pose.orientation.z == 1.0 and other.color.a == pytest.approx(0.24)


def test_detections_are_hypotheses_of_types_and_modes(library, monkeypatch) -> None:
    """vision_msgs may not be installed: its messages are stood in for by objects that take any field."""

    class Message(SimpleNamespace):
        def __getattr__(self, name: str):
            value = [] if name in ("results", "detections") else Message()
            setattr(self, name, value)
            return value

    kinds = ("Detection3DArray", "Detection3D", "ObjectHypothesisWithPose")
    monkeypatch.setattr(detections, "vision", SimpleNamespace(**dict.fromkeys(kinds, Message)))
    posterior = scene(library.names)
    samples = posterior.samples
    turned = samples.orientation.copy()
    turned[:12, 0] = [0, 0, 1, 0]
    kind = samples.type.copy()
    kind[25:28, 0] = 1  # as well a cube
    samples = samples._replace(orientation=turned, type=kind)
    summary = summarise(samples, library.names, 0.5)
    posterior = replace(posterior, samples=samples, objects=summary.objects, object_index=summary.object_index)
    first, second = detections.detection_array(posterior, library, ("brick_3", "cube_1")).detections
    assert (first.id, second.id) == ("brick_3", "cube_1")
    assert [d.id for d in detections.detection_array(posterior, library).detections] == ["1", "2"]
    scores = [result.hypothesis.score for result in first.results]
    assert scores == sorted(scores, reverse=True)
    assert sum(scores) == pytest.approx(posterior.objects[0].probability)
    assert sorted(result.hypothesis.class_id for result in first.results) == ["brick", "brick", "cube"]
    turns = sorted(abs(r.pose.pose.orientation.z) for r in first.results if r.hypothesis.class_id == "brick")
    np.testing.assert_allclose(turns, [0, 1], atol=1e-9)
    assert all(len(r.pose.covariance) == 36 for r in first.results)
    assert len(second.results) == 1


def test_the_library_message_lists_names() -> None:
    assert to_messages.library_message(("a", "b")).data == "a\nb"
