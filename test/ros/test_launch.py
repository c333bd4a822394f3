# SPDX-License-Identifier: Apache-2.0

"""The launch files, run by the real `launch`, with a parser without a model."""

import os
import re
import signal
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray
from rcl_interfaces.srv import GetParameters
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from bayes3d_ros.io.bags import BagWriter, raw_messages
from bayes3d_ros.resources import share_directory
from bayes3d_ros.ros.from_messages import stamp_to_ns
from bayes3d_ros.ros.processes import NodeProcess, kill

pytest.importorskip("launch_ros", reason="launch comes with an installed ROS, and not from PyPI")
from ament_index_python.packages import PackageNotFoundError, get_package_prefix

HERE = Path(__file__).parent
FILES = {"scene_parser": "bayes3d", "object_learner": "object_learner", "camera_tracker": "camera_tracker"}
COMMANDS = {
    "scene_parser": HERE / "fake_scene_parser.py",
    "object_learner": "-m bayes3d_ros.ros.object_learner",
    "camera_tracker": HERE / "fake_camera_tracker.py",
    "bag_player": "-m bayes3d_ros.ros.bag_player",
}
Start = Callable[..., NodeProcess]


@pytest.fixture
def start(ros, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Start]:
    """start(FILE, *arguments): a launch of a file, where the package's executables are those of COMMANDS."""
    install(tmp_path, "bayes3d_ros", COMMANDS)
    before = [path for path in [os.environ.get("AMENT_PREFIX_PATH")] if path]
    monkeypatch.setenv("AMENT_PREFIX_PATH", os.pathsep.join([str(tmp_path / "prefix"), *before]))
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path / "log"))

    launches: list[NodeProcess] = []

    def start_launch(file: str, *arguments: str) -> NodeProcess:
        path = share_directory() / "launch" / f"{FILES[file]}.launch.py"
        launches.append(ros.start(str(HERE / "run_launch.py"), str(path), *arguments))
        return launches[-1]

    yield start_launch
    ros.leave()
    for launch in launches:
        for pid in pids(launch).values():
            if alive(pid):
                kill(pid)


def install(folder: Path, package: str, commands: dict) -> None:
    """Make a package with executables that run Python, as ament's index knows it."""
    marker = folder / "prefix" / "share" / "ament_index" / "resource_index" / "packages" / package
    marker.parent.mkdir(parents=True, exist_ok=True)
    marker.touch()
    executables = folder / "prefix" / "lib" / package
    executables.mkdir(parents=True)
    for name, command in commands.items():
        (executables / name).write_text(f'#!/bin/sh\nexec {sys.executable} {command} "$@"\n')
        (executables / name).chmod(0o755)


def pids(launch: NodeProcess) -> dict[str, int]:
    """The processes that a launch has started, by the names of the executables."""
    found = re.findall(r"\[(\w+)-\d+\]: process started with pid \[(\d+)\]", launch.output())
    return {name: int(pid) for name, pid in found}


def alive(pid: int) -> bool:
    """Whether a process runs; one that has ended and that nobody has asked for its status does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def wait_until_gone(*processes: int, seconds: float = 20.0) -> None:
    """Wait for the end of processes."""
    deadline = time.monotonic() + seconds
    while left := [pid for pid in processes if alive(pid)]:
        if time.monotonic() > deadline:
            for pid in left:
                kill(pid)
            pytest.fail(f"{len(left)} of {len(processes)} processes were left behind")
        time.sleep(0.1)


def record(folder: Path, frame, first: int, topics: dict[str, str] | None = None) -> Path:
    """A bag of three frames from a stamp on, with its topics renamed; and with a topic that nobody listens to."""
    bag = folder / f"bag{first}"
    with BagWriter(bag) as writer:
        for k in range(3):
            writer.write(frame(first + k * 10**8))
    store = get_typestore(Stores.ROS2_JAZZY)
    renamed = folder / f"renamed{first}"
    with Writer(renamed, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connections = {}
        for message in raw_messages(bag):
            for name in ((topics or {}).get(message.topic, message.topic), f"{message.topic}/unused"):
                if name not in connections:
                    connections[name] = writer.add_connection(name, message.msgtype, typestore=store)
                writer.write(connections[name], message.t_ns, message.data)
    return renamed


def parameters(ros, node: str, *names: str) -> list:
    """The values of a node's parameters."""
    values = ros.call(GetParameters, f"{node}/get_parameters", GetParameters.Request(names=names)).values
    return [v.string_value or v.double_value for v in values]


def test_bags_of_two_namespaces_do_not_mix(
    ros, start: Start, library_folder: Path, tmp_path: Path, depth_frame
) -> None:
    depth, info = "/camera/depth/image_rect_raw", "/camera/depth/camera_info"
    renamed = {"/depth/image_rect": depth, "/depth/camera_info": info}
    up = {topic: f"/up{name}" for topic, name in renamed.items()}  # recorded in the namespace that it is played in
    bags = {
        "left": (record(tmp_path, depth_frame, 10**9), []),
        "right": (record(tmp_path, depth_frame, 5 * 10**9, renamed), [f"depth:={depth}", f"camera_info:={info}"]),
        "up": (record(tmp_path, depth_frame, 9 * 10**9, up), [f"depth:=/up{depth}", f"camera_info:=/up{info}"]),
    }
    heard = {name: ros.listen(PoseArray, f"/{name}/scene_parser/poses") for name in bags}
    for name, (bag, arguments) in bags.items():
        # Again and again: the first frames may come out before this node has been discovered.
        words = [f"library:={library_folder}", f"namespace:={name}", f"bag:={bag}", "loop:=true"]
        start("scene_parser", *words, *arguments)
    last = {"left": 12 * 10**8, "right": 52 * 10**8, "up": 92 * 10**8}

    def ended() -> bool:
        return all(any(stamp_to_ns(m.header.stamp) == last[name] for m in heard[name]) for name in bags)

    ros.wait_for(ended, "the last frame of each", seconds=90)
    for name, messages in heard.items():
        assert {stamp_to_ns(m.header.stamp) for m in messages} <= {last[name] - k * 10**8 for k in range(3)}
    names = [name for name, _ in ros.node.get_topic_names_and_types() if "/depth/" in name]
    assert {name.split("/")[1] for name in names} == set(bags)


def test_arguments_win_over_the_file_and_the_file_over_defaults(
    ros, start: Start, library_folder: Path, tmp_path: Path
) -> None:
    file = tmp_path / "mine.yaml"
    everywhere = {"library": "nowhere", "far": 3.0, "near": 0.3, "table_frame": "desk"}
    mine = {"**": everywhere, "**/cook": {"near": 0.2, "library": "no"}}
    file.write_text(yaml.safe_dump({f"/{name}": {"ros__parameters": values} for name, values in mine.items()}))
    words = [f"library:={library_folder}", f"params_file:={file}"]
    start("scene_parser", *words, "namespace:=left", "node_name:=cook")
    names = ("library", "far", "near", "table_frame")
    assert parameters(ros, "/left/cook", *names) == [str(library_folder), 3.0, 0.2, "desk"]


@pytest.mark.parametrize(
    ("node", "parameter"), [("object_learner", "object_name:=007"), ("camera_tracker", "world:=1.5")]
)
def test_the_other_nodes_are_launched_alike(ros, start: Start, library_folder: Path, node: str, parameter: str) -> None:
    words = [f"library:={library_folder}", parameter, "table_frame:=12", "namespace:=left", "depth:=/front/depth"]
    start(node, *words)
    name, _, value = parameter.partition(":=")
    got = parameters(ros, f"/left/{node}", "library", name, "table_frame")
    assert got == [str(library_folder), value, "12"]
    ros.wait_for(lambda: ros.node.count_subscribers("/front/depth"), "a subscriber")


def test_rviz_gets_the_names_of_the_node(ros, start: Start, library_folder: Path, tmp_path: Path) -> None:
    (tmp_path / "rviz.py").write_text(f"import sys\nprint(sys.argv[1:], file=open('{tmp_path}/rviz.args', 'w'))")
    install(tmp_path, "rviz2", {"rviz2": tmp_path / "rviz.py"})
    words = [f"library:={library_folder}", "namespace:=left", "node_name:=cook", "depth:=front/depth"]
    start("scene_parser", *words, "camera_info:=/elsewhere/info", "rviz:=true", "rviz_frame:=front")
    told = tmp_path / "rviz.args"
    ros.wait_for(lambda: told.exists() and told.read_text(), "RViz")
    arguments = re.findall(r"'([^']*)'", told.read_text())
    text = Path(arguments[arguments.index("-d") + 1]).read_text()
    for name in ("/left/cook/objects", "/left/cook/posterior", "/left/front/depth", "Fixed Frame: front"):
        assert name in text
    assert "/left/front/camera_info:=/elsewhere/info" in arguments  # where RViz would look for it beside the image


def test_without_rviz2_it_goes_on(ros, start: Start, library_folder: Path) -> None:
    try:
        get_package_prefix("rviz2")
    except PackageNotFoundError:
        pass
    else:
        pytest.skip("rviz2 is installed")
    launch = start("scene_parser", f"library:={library_folder}", "rviz:=true")
    ros.wait_for_diagnosis(ros.listen(DiagnosticArray, "/diagnostics"), "no publisher on /depth/image_rect")
    assert launch.output().count("rviz2 is not installed") == 1
    launch.stop()
    wait_until_gone(*pids(launch).values())


@pytest.mark.parametrize("end", [signal.SIGINT])  # launch itself says that SIGTERM can leave processes
def test_no_process_outlives_launch(
    ros, start: Start, library_folder: Path, tmp_path: Path, depth_frame, end: int
) -> None:
    bag = record(tmp_path, depth_frame, 10**9)
    launch = start("scene_parser", f"library:={library_folder}", f"bag:={bag}", "depth:=/none")
    ros.wait_for(lambda: len(pids(launch)) == 2, "two processes", seconds=60)
    ros.wait_for_diagnosis(ros.listen(DiagnosticArray, "/diagnostics"), "no publisher on /none")
    launch.stop(end)
    wait_until_gone(*pids(launch).values())


def test_the_player_ends_with_the_node(ros, start: Start, tmp_path: Path, depth_frame) -> None:
    words = [f"bag:={record(tmp_path, depth_frame, 10**9)}"]
    launch = start("scene_parser", *words)  # without a library it subscribes to nothing, and the player waits
    ros.wait_for_diagnosis(ros.listen(DiagnosticArray, "/diagnostics"), "parameter library is not set")
    started = pids(launch)
    kill(started["scene_parser"])
    wait_until_gone(*started.values())
    ros.wait_for(lambda: launch.status is not None, "the end of launch")


@pytest.mark.parametrize("argument", ["bag:=/no/such/bag", "params_file:=/no/such/file", "rviz:=maybe"])
def test_a_bad_argument_starts_nothing(start: Start, argument: str) -> None:
    launch = start("scene_parser", argument)
    while launch.status is None:
        time.sleep(0.1)
    name, _, value = argument.partition(":=")
    assert launch.status == 1 and value in launch.output() and not pids(launch)
