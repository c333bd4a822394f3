# SPDX-License-Identifier: Apache-2.0

"""~/parse and mode: on_request, by clients over DDS, around a parser without a model."""

import itertools
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseArray
from lifecycle_msgs.srv import GetState
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rclpy.task import Future
from std_srvs.srv import Trigger
from test_scene_parser import depth_frame, state

from bayes3d_ros.ros.from_messages import stamp_to_ns
from bayes3d_ros.ros.parse_requests import ParseAnswer
from bayes3d_ros.ros.parse_service import ParseService

PARSE = "/scene_parser/parse"
FOUND = r"1 object: brick_\d+ \(p 0\.75\); image of stamp (\d+)\.(\d{9})"
OK, WARN = DiagnosticStatus.OK, DiagnosticStatus.WARN


class Robot:
    """Clients of one scene_parser, and its camera, whose images are numbered."""

    def __init__(self, ros, library_folder: Path, *arguments: str, **parameters: object) -> None:
        self.ros = ros
        self.diagnostics = ros.listen(DiagnosticArray, "/diagnostics")
        self.poses = ros.listen(PoseArray, "/scene_parser/poses")
        self.process = ros.start_parser(library_folder, *arguments, **parameters)
        self.camera = ros.camera()
        self._numbers = itertools.count()
        self.shown = -1

    def show(self, **changes: object) -> None:
        """Publish the next image."""
        self.shown = next(self._numbers)
        image, info = self.camera.messages(depth_frame(self.shown))
        for name, value in changes.items():
            setattr(image, name, value)
        self.camera.send(image, info)

    def ask(self) -> Future:
        return self.ros.ask(Trigger, PARSE, Trigger.Request())[1]

    def answers(self, *futures: Future, **changes: object) -> list[Trigger.Response]:
        """The answers, with images coming in until all are there."""
        done = lambda: self.show(**changes) or all(future.done() for future in futures)  # noqa: E731
        self.ros.wait_for(done, "the answers", pause=0.1)
        return [future.result() for future in futures]

    def counts(self) -> dict[str, int]:
        del self.diagnostics[:]
        self.ros.wait_for(lambda: self.diagnostics, "a report")
        return {key: int(v) for key, v in state(self.diagnostics[-1]).items() if key in ("parsed", "unasked")}

    def wait_for_calls(self, count: int) -> None:
        """Wait until the node has so many calls that wait."""
        del self.diagnostics[:]
        self.ros.wait_for(lambda: any(state(d)["requests"] == str(count) for d in self.diagnostics), "the calls")

    def set_parameter(self, name: str, value: object) -> None:
        request = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
        assert self.ros.call(SetParameters, "/scene_parser/set_parameters", request).results[0].successful

    def change_state(self, transition: int) -> None:
        assert self.ros.change_state("/scene_parser", transition)


def stamp_of(answer: Trigger.Response) -> int:
    """The stamp in nanoseconds of the image that an answer tells of."""
    assert answer.success, answer.message
    found = re.fullmatch(FOUND, answer.message)
    assert found, answer.message
    return int(found[1] + found[2])


@pytest.fixture
def waiting(ros, library_folder: Path) -> Iterator[Robot]:
    """A node that waits for requests, and whose images come in."""
    robot = Robot(ros, library_folder, mode="on_request")
    robot.camera.wait_for_subscriber()
    robot.show()
    report = ros.wait_for_diagnosis(robot.diagnostics, "waiting for a request (~/parse)")
    assert report.status[0].level == OK
    yield robot
    assert robot.process.stop() == 0, robot.process.output()
    assert "Traceback" not in robot.process.output()


def test_two_clients_at_once_share_one_image_that_came_after_them(waiting: Robot) -> None:
    before = waiting.shown
    futures = waiting.ask(), waiting.ask()
    waiting.wait_for_calls(2)
    waiting.ros.call(GetState, "/scene_parser/get_state", GetState.Request())  # it goes on answering others
    assert not any(future.done() for future in futures)  # the image of before is not parsed
    one, other = waiting.answers(*futures)
    assert one.message == other.message and stamp_of(one) > depth_frame(before).stamp_ns
    assert [stamp_to_ns(pose.header.stamp) for pose in waiting.poses] == [stamp_of(one)]  # published before the answer
    counts = waiting.counts()
    assert counts["parsed"] == 1 and counts["unasked"] > 0


def test_it_is_not_ok_when_no_image_can_be_used(waiting: Robot) -> None:
    """Said before anybody asks: the CameraInfo of another camera."""
    camera, ros = waiting.camera, waiting.ros
    image, info = camera.messages(depth_frame(10_000))
    info.width = 32
    why = "no image for a request: /depth/camera_info: CameraInfo width, height: expected the image's 64x48"
    send = lambda: camera.send(image, info) or any(why in d.status[0].message for d in waiting.diagnostics)  # noqa: E731
    ros.wait_for(send, "the line", pause=0.2)


def test_it_is_not_ok_when_images_stop(waiting: Robot) -> None:
    report = waiting.ros.wait_for_diagnosis(waiting.diagnostics, "no message on /depth/image_rect")
    assert report.status[0].level == WARN


def test_what_is_wrong_with_the_image_is_the_answer(waiting: Robot) -> None:
    (answer,) = waiting.answers(waiting.ask(), encoding="rgb8")
    assert not answer.success and answer.message.startswith("/depth/image_rect: Image encoding: expected one of")
    waiting.show()
    report = waiting.ros.wait_for_diagnosis(
        waiting.diagnostics, "waiting for a request (~/parse); the last request had"
    )
    assert report.status[0].level == WARN
    assert waiting.answers(waiting.ask())[0].success


def test_a_call_ends_in_time_without_an_image(ros, library_folder: Path) -> None:
    robot = Robot(ros, library_folder, mode="on_request", parse_timeout=0.3)
    robot.camera.wait_for_subscriber()
    answer = ros.call(Trigger, PARSE, Trigger.Request())
    assert not answer.success
    assert answer.message == "no result within 0.3 s: no message yet on /depth/image_rect (1 publisher)"


def test_a_call_ends_in_time_when_the_parse_is_long(ros, library_folder: Path) -> None:
    robot = Robot(ros, library_folder, "--seconds", "60", parse_timeout=0.5)
    robot.camera.wait_for_subscriber()
    future = robot.ask()
    (answer,) = robot.answers(future)
    assert not answer.success and answer.message.startswith("no result within 0.5 s: busy, parsing")


def test_a_node_that_is_not_active_says_so_at_once(ros, library_folder: Path) -> None:
    robot = Robot(ros, library_folder, autostart="false")
    answer = ros.call(Trigger, PARSE, Trigger.Request())
    assert (answer.success, answer.message) == (False, "the node is unconfigured; configure and activate it")
    robot.change_state(1)
    robot.change_state(3)
    future = robot.ask()
    robot.wait_for_calls(1)
    robot.change_state(4)
    ros.wait_for(future.done, "the answer")
    assert (future.result().success, future.result().message) == (False, "the node was deactivated")


def test_the_mode_may_change_and_continuous_mode_answers_too(ros, library_folder: Path) -> None:
    robot = Robot(ros, library_folder)
    robot.camera.wait_for_subscriber()
    ros.wait_for(lambda: robot.show() or robot.poses, "an output", pause=0.1)
    before = robot.shown
    (answer,) = robot.answers(robot.ask())
    assert stamp_of(answer) > depth_frame(before).stamp_ns
    robot.set_parameter("mode", "on_request")
    parsed = robot.counts()["parsed"]
    robot.show()
    ros.wait_for_diagnosis(robot.diagnostics, "waiting for a request (~/parse)")
    assert robot.counts()["parsed"] == parsed
    robot.set_parameter("mode", "continuous")
    ros.wait_for(lambda: robot.show() or robot.counts()["parsed"] > parsed, "an output", pause=0.1)


def test_a_client_that_goes_away_does_not_hurt_the_node(waiting: Robot) -> None:
    client, _ = waiting.ros.ask(Trigger, PARSE, Trigger.Request())
    waiting.wait_for_calls(1)
    waiting.ros.node.destroy_client(client)
    assert waiting.answers(waiting.ask())[0].success
    assert waiting.process.status is None


def test_a_node_ends_cleanly_while_a_call_waits(waiting: Robot) -> None:
    waiting.ask()
    waiting.wait_for_calls(1)


def test_an_answer_that_comes_while_calls_are_looked_at_is_not_lost(ros) -> None:
    """The worker settles a request between two looks of the executor at it."""
    service = ParseService(ros.node, lambda: 10.0, lambda: "", lambda: "")

    class Settled:
        looks = 0

        @property
        def answer(self) -> ParseAnswer | None:
            self.looks += 1
            return ParseAnswer(True, "found") if self.looks > 1 else None

    call = Settled(), Future()
    service._calls = [call]
    service._respond()
    service._respond()
    assert call[1].done() and call[1].result() == ParseAnswer(True, "found")
