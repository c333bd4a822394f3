# SPDX-License-Identifier: Apache-2.0

from dataclasses import replace

import numpy as np
import pytest

from bayes3d_ros.geometry.poses import look_at
from bayes3d_ros.posterior.reframe import in_frame, table_frame
from bayes3d_ros.posterior.summarise import posterior_rows
from bayes3d_ros.posterior.types import UnexplainedPlace
from bayes3d_ros.ros import to_messages
from bayes3d_ros.ros.posterior_from_messages import posterior_from_messages, samples_from_rows
from bayes3d_ros.ros.summary import summary_message

PLACES = (UnexplainedPlace(0.125, -0.05, 0.0, 240), UnexplainedPlace(-1.5, 0.25, 0.062, 31))


def test_samples_survive_rows(depth_frame, fake_posterior, library) -> None:
    posterior = fake_posterior(depth_frame(), library.names)
    samples, index = samples_from_rows(posterior_rows(posterior.samples, posterior.object_index))
    most = samples.type.shape[1]
    for name in ("type", "face"):
        np.testing.assert_array_equal(getattr(samples, name), getattr(posterior.samples, name)[:, :most])
    np.testing.assert_array_equal(index, posterior.object_index[:, :most])
    held = samples.type >= 0
    for name in ("position", "orientation"):
        expected = getattr(posterior.samples, name)[:, :most]
        np.testing.assert_allclose(getattr(samples, name)[held], expected[held], atol=1e-6)
    for name in ("log_weight", "num_objects", "p_outlier", "sigma"):
        np.testing.assert_allclose(getattr(samples, name), getattr(posterior.samples, name), rtol=1e-6)


@pytest.mark.parametrize("told_in", [None, "table"])
def test_a_posterior_survives_its_messages(depth_frame, fake_posterior, library, told_in: str | None) -> None:
    posterior = fake_posterior(depth_frame(12_345), library.names)
    explained = tuple(replace(found, explained=0.25 * k) for k, found in enumerate(posterior.objects, start=1))
    T_camera_table = np.linalg.inv(look_at(np.array([0.1, -0.6, 0.5]), np.zeros(3)))
    posterior = replace(posterior, objects=explained, unexplained=PLACES, T_camera_table=T_camera_table)
    told = in_frame(posterior, table_frame(posterior) if told_in else None)
    messages = {
        "posterior": to_messages.posterior_cloud(told),
        "poses": to_messages.pose_array(told),
        "T_camera_table": to_messages.table_transform(told, "table"),
        "summary": summary_message(told),
        "segmentation": to_messages.segmentation_image(told),
        "depth_reconstruction": to_messages.reconstruction_image(told),
    }
    assert {name for name, m in messages.items() if m.header.frame_id == "table"} == (
        {"posterior", "poses", "summary"} if told_in else set()
    )
    again = posterior_from_messages(messages, library)
    assert (again.stamp_ns, again.frame_id, again.types) == (12_345, "camera", library.names)
    assert [o.type for o in again.objects] == [o.type for o in posterior.objects]
    for mine, other in zip(again.objects, posterior.objects, strict=True):
        np.testing.assert_allclose(mine.position, other.position, atol=1e-5)
        np.testing.assert_allclose(mine.probability, other.probability, atol=1e-5)
        np.testing.assert_allclose(mine.covariance, other.covariance, atol=1e-7)
    np.testing.assert_allclose(again.T_camera_table, T_camera_table, atol=1e-12)
    np.testing.assert_array_equal(again.segmentation, posterior.segmentation)
    np.testing.assert_allclose(again.reconstruction, posterior.reconstruction)
    np.testing.assert_array_equal(again.object_index, posterior.object_index[:, : again.object_index.shape[1]])
    assert again.num_objects == pytest.approx(posterior.num_objects)
    assert (again.p_outlier, again.sigma) == pytest.approx((posterior.p_outlier, posterior.sigma))
    assert [o.explained for o in again.objects] == [o.explained for o in posterior.objects]
    assert again.unexplained == PLACES and again.warnings == posterior.warnings
    assert again.notes == posterior.notes and again.seconds == posterior.seconds
    if told_in:
        messages["T_camera_table"].child_frame_id = "bench"
        with pytest.raises(ValueError, match="the frame of images, 'camera', or in the table's, got 'table'"):
            posterior_from_messages(messages, library)
