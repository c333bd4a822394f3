# SPDX-License-Identifier: Apache-2.0

"""What a node says of itself: why nothing comes in, why nothing goes out, and what floods no log."""

import pytest

from bayes3d_ros.ros import diagnostics
from bayes3d_ros.ros.diagnostics import (
    LOOK,
    OK,
    WARN,
    Health,
    InputView,
    LogThrottle,
    TopicView,
    input_warnings,
    judge,
    judge_on_request,
    why_no_input,
)

KEYS = ("received", "parsed", "refused", "dropped", "unasked", "waiting")
DEPTH, INFO = "/rig/depth", "/rig/info"


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The time, as the module sees it."""
    now = [100.0]
    monkeypatch.setattr(diagnostics.time, "monotonic", lambda: now[0])
    return now


def view(image_age: float | None = 0.1, info_age: float | None = 0.1, **more: object) -> InputView:
    publishers = more.pop("publishers", ("/driver",))
    image, info = TopicView(DEPTH, publishers, image_age), TopicView(INFO, publishers, info_age)
    return InputView(image, info, **{"delivered_age": 0.1, **more})


@pytest.mark.parametrize(
    ("seen", "why"),
    [
        (view(), ""),
        (view(None, None, publishers=()), f"no publisher on {DEPTH}; start it, or remap the topic"),
        (view(9.0, 0.1, publishers=()), f"no publisher on {DEPTH} any more; start it, or remap the topic"),
        (view(None, 0.1), f"no message yet on {DEPTH} (1 publisher)"),
        (view(0.1, None, publishers=("/a", "/b")), f"no message yet on {INFO} (2 publishers)"),
        (view(7.0, 7.0), f"no message on {DEPTH} for 7 s"),
        (view(0.1, 500.0), ""),  # CameraInfo that is sent once goes on to serve,
        (view(0.1, 500.0, publishers=()), ""),  # also when its sender has gone
    ],
)
def test_why_nothing_comes_in(seen: InputView, why: str) -> None:
    assert why_no_input(seen) == why


def test_what_to_do_without_a_publisher_may_be_known() -> None:
    image = TopicView(DEPTH, remedy=f"set depth_transport to compressedDepth: {DEPTH}/compressedDepth has a publisher")
    expected = f"no publisher on {DEPTH}; set depth_transport to compressedDepth: {DEPTH}/compressedDepth has a publ"
    assert why_no_input(InputView(image, TopicView(INFO))).startswith(expected)


def test_it_is_ok_only_while_outputs_come(clock: list[float]) -> None:
    health = Health()

    def told(seen: InputView) -> tuple[bytes, str]:
        return judge(health, seen, idle=True, good="parsing")

    clock[0] += 1
    stuck = view(waiting=4, delivered_age=None, pose_topic="/pose")
    where = f"4 images wait for CameraInfo of their stamp on {INFO}, or the camera's pose (/pose, tf)"
    assert told(stuck) == (WARN, f"no output yet, for 1 s: {where}")
    health.problem("the depth image has no return")
    assert told(view()) == (WARN, "the depth image has no return")
    health.output(0.1, [1.0], 0.2)
    assert told(view()) == (OK, "parsing")
    clock[0] += 2.9
    assert told(view()) == (OK, "parsing")
    clock[0] += 0.2
    assert told(view()) == (WARN, "no output any more, for 3 s: the last image is being worked on")
    health.output(0.1, [1.0], 0.2, ["only 20% of the pixels on the table can be used"])
    assert told(view()) == (WARN, "parsing; only 20% of the pixels on the table can be used")
    health.output(0.1, [1.0], 0.2)
    with health.doing("compiling for images of 848x480"):
        clock[0] += 12
        assert told(view()) == (WARN, "compiling for images of 848x480, 12 s so far")
    with health.doing("parsing one frame", usual=3.0):
        health.output(0.1, [1.0], 0.2)
        clock[0] += 2.5
        assert told(view()) == (OK, "parsing")
        clock[0] += 1
        assert told(view()) == (WARN, "parsing one frame, 4 s so far")


def test_on_request_it_is_ok_to_wait_only_while_complete_images_come(clock: list[float]) -> None:
    health = Health()

    def told(seen: InputView, idle: bool = True) -> tuple[bytes, str]:
        return judge_on_request(health, seen, idle=idle)

    clock[0] += 100
    assert told(view()) == (OK, "waiting for a request (~/parse)")
    assert told(view(), idle=False) == (OK, "parsing on request")
    for idle in (True, False):
        assert told(view(9.0), idle) == (WARN, f"no message on {DEPTH} for 9 s")
        stuck = view(waiting=1, delivered_age=9.0, pose_topic="/pose")
        where = f"1 image waits for CameraInfo of their stamp on {INFO}, or the camera's pose (/pose, tf)"
        assert told(stuck, idle) == (WARN, f"no image for a request: {where}")
    assert told(view(pose_problem="late")) == (WARN, "waiting for a request (~/parse); no camera pose: late")
    health.problem("no table in sight")
    failed = "waiting for a request (~/parse); the last request had no result: no table in sight"
    assert told(view()) == (WARN, failed)
    clock[0] += 1
    health.output(0.1, [1.0], 0.2)
    assert told(view()) == (OK, "waiting for a request (~/parse)")
    with health.doing("compiling for images of 848x480"):
        clock[0] += 12
        assert told(view(), idle=False) == (WARN, "compiling for images of 848x480, 12 s so far")


def test_what_is_wrong_beside_an_output_is_a_warning() -> None:
    health = Health()
    health.output(0.1, [1.0], 0.2)
    seen = view(publishers=("/driver", "/player"), pose_topic="/pose", pose_publishers=("/arm",), pose_problem="late")
    level, message = judge(health, seen, idle=True, good="parsing")
    assert level == WARN and message == (
        f"parsing; no camera pose: late; 2 publishers on {DEPTH}, expected one: /driver, /player; "
        f"2 publishers on {INFO}, expected one: /driver, /player"
    )


@pytest.mark.parametrize(
    ("seen", "told"),
    [
        ({"frame_id": "camera"}, []),
        ({"frame_id": ""}, [f"images on {DEPTH} have an empty frame_id, expected the camera's optical frame"]),
        ({"distorted": True}, [f"{INFO} has lens distortion (D), and {DEPTH} is taken for rectified (image_proc)"]),
    ],
)
def test_images_that_cannot_be_what_they_are_taken_for(seen: dict[str, object], told: list[str]) -> None:
    assert input_warnings(view(**seen)) == told


def test_lines_of_a_kind_are_logged_once_in_ten_seconds(clock: list[float]) -> None:
    throttle = LogThrottle()
    assert throttle.lets("no pose: the nearest is 0.31 s away, of 'a'")
    assert not throttle.lets("no pose: the nearest is 1e-05 s away, of 'another'")
    assert throttle.lets("no table in sight")
    assert not throttle.lets("no pose: the nearest is -7 s away, of 'a'")  # two kinds in turn
    clock[0] += 10.1
    assert throttle.lets("no pose: the nearest is 0.31 s away, of 'a'")


def test_every_image_is_accounted_for() -> None:
    health = Health()
    for _ in range(3):
        health.output(0.1, [1.0], 0.2)
    health.problem("no table")
    health.discard()
    health.pass_over(lambda: "")
    report = health.report("n", OK, "m", state="s", received=12, dropped=5, view=None)
    values = {pair.key: pair.value for pair in report.status[0].values}
    assert [values[k] for k in KEYS] == ["12", "3", "1", "6", "1", "1"]


def test_frames_that_nobody_asked_for_are_looked_at_once_in_a_while(clock: list[float]) -> None:
    health, looks = Health(), []

    def why() -> str:
        looks.append(clock[0])
        return "K[0]: expected a focal length" if len(looks) < 2 else ""

    for _ in range(3):
        health.pass_over(why)
    assert len(looks) == 1 and health.unusable.startswith("K[0]")
    clock[0] += LOOK
    health.pass_over(why)
    assert len(looks) == 2 and not health.unusable and health.unasked == 4
