# SPDX-License-Identifier: Apache-2.0

"""The object_learner node: captures views of an unknown object, and builds a model of it that scene_parser can use."""

import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from bayes3d_ros.geometry.depth_frame import DepthFrame
from bayes3d_ros.io.captures import CaptureError, CaptureStore
from bayes3d_ros.learning.learn import (
    MOST_VIEWS_A_MODEL,
    Learned,
    LearningError,
    choose_thing,
    learn,
    new_share,
)
from bayes3d_ros.learning.segment import Thing, ViewError, middle, segment
from bayes3d_ros.objects.model import LibraryError
from bayes3d_ros.objects.store import learned_from, load_model, model_path, refuse_existing, save_model
from bayes3d_ros.ros.arguments import check_arguments
from bayes3d_ros.ros.depth_inputs import DepthMessages
from bayes3d_ros.ros.depth_node import DepthNodeParts
from bayes3d_ros.ros.diagnostics import (
    ERROR,
    OK,
    WARN,
    InputView,
    diagnostic_array,
    input_notes,
    input_warnings,
    where_images_are,
    why_no_input,
)
from bayes3d_ros.ros.from_messages import stamp_to_ns
from bayes3d_ros.ros.node_settings import DEPTH_INPUT_PARAMETERS, OBJECT_LEARNER_SETTINGS, ObjectLearnerNodeSettings
from bayes3d_ros.ros.parameters import Settings
from bayes3d_ros.ros.qos import LATCHED
from bayes3d_ros.ros.spinning import run_node
from bayes3d_ros.ros.summary import key_values
from bayes3d_ros.ros.to_messages import cloud_message, ns_to_stamp
from bayes3d_ros.settings import LearnerSettings

_Service = Callable[[Trigger.Request, Trigger.Response], Trigger.Response]

_PURPOSE = "Captures views of an unknown object and builds a model of it that scene_parser can use."


class Refusal(Exception):
    """Why a service did not do what it was asked for; one line."""


class ObjectLearnerNode(Node):
    """Services ~/capture, ~/build and ~/reset. What was captured is on disk, so that a node that was killed goes on
    where it was."""

    def __init__(self) -> None:
        super().__init__("object_learner")
        self._parts = DepthNodeParts(
            self, OBJECT_LEARNER_SETTINGS, report=self._report, changed=self._parameters_changed
        )
        self._newest: DepthMessages | None = None
        self._seen: dict[int, Thing] = {}  # what the captures of `_seen_of` show, by stamp
        self._unusable: list[str] = []  # of its other captures, why they cannot be used
        self._seen_of: Path | None = None
        self._last = ""
        self._model = self.create_publisher(PointCloud2, "~/model", LATCHED)
        for name, action in (("capture", self._capture), ("build", self._build), ("reset", self._reset)):
            self.create_service(Trigger, f"~/{name}", self._answer(name, action))
        self._listen()

    def stop(self, timeout: float) -> bool:
        """There is no thread to wait for."""
        return self._parts.stop(timeout)

    # Services

    def _answer(self, name: str, action: Callable[[], str]) -> _Service:
        """A service that says what was done, or in one line why not; it never takes the node down."""

        def answer(request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            try:
                response.success, response.message = True, action()
            except (Refusal, LearningError, CaptureError, ViewError, LibraryError) as error:
                response.success, response.message = False, str(error)
            except OSError as error:
                why = f"{error.filename or 'disk'}: {error.strerror or error}"
                response.success, response.message = False, f"cannot write: {why}"
            except Exception as error:
                told = " ".join(str(error).split())
                response.success, response.message = False, f"internal error, please report it: {told}"
                self.get_logger().debug(traceback.format_exc())
            self._last = f"{name}: {response.message}"
            if response.success:
                self.get_logger().info(self._last)
            else:
                self.get_logger().warning(self._last)
            return response

        return answer

    def _capture(self) -> str:
        store, settings = self._store(), self._read(LearnerSettings)
        seen = self._captured(store, settings)
        if len(seen) >= MOST_VIEWS_A_MODEL:
            raise Refusal(f"{len(seen)} views are captured already, more would not be used: build or reset")
        frame = self._newest_frame()
        if frame.stamp_ns in seen:
            raise Refusal(f"the newest image (stamp {frame.stamp_ns}) is captured already: move the camera, or wait")
        view = segment(frame, settings)
        thing = choose_thing(view, list(seen.values()), settings)
        fresh = new_share(thing, list(seen.values()), settings.voxel_size)
        store.add(frame)
        seen[frame.stamp_ns] = thing
        others = len(view.things) - 1
        beside = f", {others} other thing{'s' * (others > 1)} left out" if others else ""
        cut = f", which {thing.cut_off} cuts off" if thing.cut_off else ""
        x, y = middle(thing.points)
        return (
            f"view {len(seen)} of {store.folder.name}: {len(thing.points)} points on the object at "
            f"x {x:.2f} y {y:.2f} m{cut}, {fresh:.0%} of its surface not seen before{beside}"
        )

    def _build(self) -> str:
        store, settings = self._store(), self._read(LearnerSettings)
        frames, problems = store.load()
        if not frames:
            raise Refusal("; ".join(["nothing is captured yet: call ~/capture first", *problems]))
        replace = self._may_replace(store.folder.name, {frame.stamp_ns for frame in frames})
        seen = self._captured(store, settings)
        usable = [frame for frame in frames if frame.stamp_ns in seen][:MOST_VIEWS_A_MODEL]
        problems = [*self._unusable, *problems]
        if not usable:
            raise Refusal("; ".join([f"none of {len(frames)} views can be used", *problems]))
        self.get_logger().info(f"building {store.folder.name} from {len(usable)} view{'s' * (len(usable) != 1)}")
        learned = learn(usable, store.folder.name, settings)
        path = save_model(learned.model, self._library(), replace=replace)
        self._publish(learned, usable[-1].stamp_ns)
        used = sum(not view.refused for view in learned.views)
        size = " x ".join(f"{v:.3f}" for v in learned.model.box_size)
        refused = [f"view {k} left out: {v.refused}" for k, v in enumerate(learned.views, 1) if v.refused]
        off = max((view.shift for view in learned.views if not view.refused), default=0.0)
        done = (
            f"{path}: {used} view{'s' * (used != 1)}, {size} m, {learned.coverage:.0%} of the surface seen, "
            f"camera poses corrected by up to {1e3 * off:.0f} mm"
        )
        return "; ".join([done, *learned.notes, *refused, *problems])

    def _may_replace(self, name: str, captured: set[int]) -> bool:
        """Whether a model may be written over: where `replace` says so, or where it was learned from views that are all
        among the captures (stamps), so that nothing is lost. Raises LibraryError for another one."""
        if self._node_settings().replace:
            return True
        library = self._library()
        path = model_path(library, name)
        before = learned_from(load_model(path)) if path.exists() else set()
        if before and before <= captured:
            return True
        refuse_existing(library, name)
        return False

    def _reset(self) -> str:
        store = self._store()
        self._seen_of = None  # first: a capture that cannot be deleted leaves others deleted
        count = store.clear()
        return f"{count} captures of {store.folder.name} deleted"

    # What they need

    def _read(self, kind: type[Settings]) -> Settings:
        try:
            return self._parts.settings.read(kind)
        except ValueError as error:
            raise Refusal(str(error)) from None

    def _node_settings(self) -> ObjectLearnerNodeSettings:
        return self._read(ObjectLearnerNodeSettings)

    def _library(self) -> Path:
        library = self._node_settings().library
        if not library:
            raise Refusal("parameter library is not set: expected a folder for object models")
        return Path(library).expanduser()

    def _store(self) -> CaptureStore:
        name = self._node_settings().object_name
        if not name:
            raise Refusal("parameter object_name is not set: expected what to call the object")
        return CaptureStore(self._library() / "captures" / name)

    def _captured(self, store: CaptureStore, settings: LearnerSettings) -> dict[int, Thing]:
        """What is captured of this object; after a restart, or of another object, read from the disk."""
        if self._seen_of != store.folder:
            frames, problems = store.load()
            for problem in problems:
                self.get_logger().warning(problem)
            self._seen, self._unusable = {}, []
            for frame in frames:
                try:
                    thing = choose_thing(segment(frame, settings), list(self._seen.values()), settings)
                    self._seen[frame.stamp_ns] = thing
                except ViewError as error:
                    self._unusable.append(f"the capture of stamp {frame.stamp_ns} is not used: {error}")
                    self.get_logger().warning(self._unusable[-1])
            self._seen_of = store.folder
        return self._seen

    def _newest_frame(self) -> DepthFrame:
        settings, messages = self._node_settings(), self._newest
        assert self._parts.inputs is not None
        if messages is None:
            view = self._parts.inputs.view()
            raise Refusal(why_no_input(view) or f"no image is complete yet: {where_images_are(view)}")
        age = time.monotonic() - messages.arrived
        if age > settings.max_age:
            why = why_no_input(self._parts.inputs.view())
            raise Refusal(f"the newest image came {age:.1f} s ago" + (f": {why}" if why else ""))
        try:
            frame = messages.frame()
        except ValueError as error:
            raise Refusal(str(error)) from None
        if frame.T_table_camera is None and messages.pose.problem:
            raise Refusal(f"no camera pose for this view, a learner needs one: {messages.pose.problem}")
        return frame

    def _publish(self, learned: Learned, stamp_ns: int) -> None:
        """The model's surface where it stood, in table_frame."""
        model = learned.model
        fields = [(name, np.float32) for name in ("x", "y", "z", "nx", "ny", "nz")]
        rows = np.zeros(len(model.surface_index), [*fields, ("views", np.int32)])
        for k, axis in enumerate("xyz"):
            rows[axis] = (model.surface_points + learned.T_table_object[:3, 3])[:, k]
            rows[f"n{axis}"] = model.surface_normal[:, k]
        rows["views"] = model.surface_views
        frame = self._node_settings().table_frame
        self._model.publish(cloud_message(rows, Header(stamp=ns_to_stamp(stamp_ns), frame_id=frame)))

    # Inputs and parameters

    def _listen(self) -> None:
        if self._parts.settings.problems:
            self.get_logger().error("; ".join(self._parts.settings.problems.values()))
        self._parts.listen(self._keep, use_pose="required")

    def _keep(self, messages: DepthMessages) -> None:
        self._newest = messages

    def _parameters_changed(self, names: set[str]) -> None:
        if names & DEPTH_INPUT_PARAMETERS:
            self._newest = None
            self._listen()
        self._seen_of = None

    # Diagnostics

    def _report(self) -> DiagnosticArray:
        assert self._parts.inputs is not None
        view = self._parts.inputs.view()
        level, message = self._why(view)
        stamp = "none" if self._newest is None else str(stamp_to_ns(self._newest.image.header.stamp))
        if self._newest is not None and self._newest.pose.T_table_camera is None:
            stamp += ", without a camera pose"
        name = f"{self.get_fully_qualified_name()}: object learning"
        status = DiagnosticStatus(name=name, level=level, message=message, hardware_id="none")
        status.values = key_values(
            newest_stamp=stamp,
            received=str(self._parts.received),
            complete=str(self._parts.delivered),
            dropped=str(self._parts.dropped),
            waiting=str(view.waiting),
            camera_pose=view.pose_source,
            notes="; ".join([*input_warnings(view), *input_notes(view)]),
            last=self._last,
        )
        return diagnostic_array(status)

    def _why(self, view: InputView) -> tuple[bytes, str]:
        """The level and the one line that says whether a view can be captured, and if not, why."""
        if self._parts.settings.problems:
            return ERROR, "; ".join(self._parts.settings.problems.values())
        if why := why_no_input(view):
            return WARN, why
        if self._newest is None or not view.delivering:
            return WARN, f"no image is complete: {where_images_are(view)}"
        try:
            self._newest.frame()
        except ValueError as error:
            return WARN, str(error)
        if self._newest.pose.T_table_camera is None:
            why = self._newest.pose.problem or "expected one from the camera_pose topic, tf or the parameter"
            return WARN, f"no camera pose for the newest image: {why}"
        try:
            place = self._parts.settings.read(LearnerSettings).place
        except ValueError as error:
            return WARN, str(error)
        ready = "ready to capture" + ("" if place is None else f" the thing at x {place[0]:.3f} y {place[1]:.3f} m")
        told = input_warnings(view)
        return (WARN, f"{ready}; {'; '.join(told)}") if told else (OK, ready)


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    check_arguments("object_learner", _PURPOSE, args)
    return run_node(ObjectLearnerNode, args)


if __name__ == "__main__":
    sys.exit(main())
