# SPDX-License-Identifier: Apache-2.0

"""bag_player BAG: publish a recorded bag's messages as they were recorded, for machines without rosbag2."""

import importlib
import math
import sys
import time
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any

import click
import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.time import Time
from rclpy.utilities import remove_ros_args
from rosgraph_msgs.msg import Clock

from bayes3d_ros.io.bags import BagDamage, BagError, RawMessage, raw_messages, topics
from bayes3d_ros.ros.input_topics import full_name, played
from bayes3d_ros.ros.spinning import shut_down, until_stopped
from bayes3d_ros.ros.transport import use_large_messages

CLOCK_PERIOD = 0.01  # seconds of real time
ACKNOWLEDGED_SECONDS = 4.0  # a little longer than Fast DDS takes to ask again for what was lost
REPORT_PERIOD = 10.0  # seconds between two lines about loops
SETTLE_SECONDS = 0.5  # from a node's first subscription to the last that it makes at the same time


class BagPlayer(Node):
    """Publishes the recorded CDR bytes, reliable, at the times they were recorded; latched where the recorded publisher
    was (transient_local), and /tf_static always.

    A player in a namespace (-r __ns:=/left) publishes in it: recorded /depth/image_rect as /left/depth/image_rect.
    """

    def __init__(self, bag: Path, only: Collection[str], clock: bool) -> None:
        super().__init__("bag_player")
        self._bag = bag
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self)
        self.publishers_of: dict[str, Publisher] = {}
        for name, topic in topics(bag).items():
            if only and name not in only:
                continue
            try:
                kind = message_class(topic.msgtype)
            except ImportError:
                self.get_logger().warning(f"{name} is left out: {topic.msgtype} is not installed")
                continue
            static = name.split("/")[-1] == "tf_static"  # of several publishers, each with transforms of its own
            latched = topic.latched or static
            qos = QoSProfile(
                depth=1 if topic.latched and not static else 100,
                reliability=ReliabilityPolicy.RELIABLE,
                durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
            )
            self.publishers_of[name] = self.create_publisher(kind, played(name, self.get_namespace()), qos)
        if not self.publishers_of:
            has = ", ".join(topics(bag)) or "none"
            raise BagError(f"{bag}: expected topics to play{': ' + ', '.join(only) if only else ''}; the bag has {has}")
        self._clock_publisher = self.create_publisher(Clock, "/clock", 10) if clock else None

    def unheard(self) -> list[str]:
        """The topics that nobody subscribes to."""
        return [p.topic_name for p in self.publishers_of.values() if p.get_subscription_count() == 0]

    def wait_for_subscribers(self, seconds: float, node: str = "") -> None:
        """Wait until every topic has a subscriber, or a node of this full name has subscribed, but not longer."""
        deadline = time.monotonic() + seconds
        while (unheard := not self._hears(node) if node else bool(self.unheard())) and time.monotonic() < deadline:
            self._spin(0.05)
        if node and not unheard:
            self._spin(SETTLE_SECONDS)
        elif unheard:
            who, what = (node, "any topic") if node else ("nobody", ", ".join(self.unheard()))
            does = "does not subscribe" if node else "subscribes"
            self.get_logger().warning(f"{who} {does} to {what}; playing all the same")

    def _hears(self, node: str) -> bool:
        """Whether a node subscribes to a topic of the bag."""
        topics = [publisher.topic_name for publisher in self.publishers_of.values()]
        ends = [end for topic in topics for end in self.get_subscriptions_info_by_topic(topic)]
        return any(full_name(end.node_namespace, end.node_name) == node for end in ends)

    def _spin(self, seconds: float) -> None:
        """Answer parameter services and the like for so long."""
        deadline = time.monotonic() + seconds
        while (left := deadline - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=left)

    def play(self, rate: float) -> int:
        """Publish every message once; the number published. Raises BagDamage at the damaged end of a bag."""
        published = 0
        first: int | None = None
        start = time.monotonic()
        for message in self._chosen():
            first = message.t_ns if first is None else first
            self._wait_until(start, first, message.t_ns, rate)
            self.publishers_of[message.topic].publish(message.data)
            published += 1
        return published

    def finish(self, seconds: float) -> None:
        """Let subscribers acknowledge what was sent, but wait no longer than this."""
        deadline = time.monotonic() + seconds
        for publisher in self.publishers_of.values():
            left = max(deadline - time.monotonic(), 0.0)
            publisher.wait_for_all_acked(rclpy.duration.Duration(seconds=left))

    def _chosen(self) -> Iterator[RawMessage]:
        return (message for message in raw_messages(self._bag) if message.topic in self.publishers_of)

    def _wait_until(self, start: float, first_ns: int, t_ns: int, rate: float) -> None:
        """Spin until a recorded time is due, keeping the clock going."""
        due = start + (t_ns - first_ns) * 1e-9 / rate
        while (left := due - time.monotonic()) > 0:
            if not rclpy.ok():
                raise ExternalShutdownException
            self._publish_clock(t_ns - int(left * rate * 1e9))
            self._spin(min(left, CLOCK_PERIOD if self._clock_publisher else 0.1))
        self._executor.spin_once(timeout_sec=0.0)  # also where messages are due faster than they can be published
        self._publish_clock(t_ns)

    def _publish_clock(self, t_ns: int) -> None:
        if self._clock_publisher is not None:
            self._clock_publisher.publish(Clock(clock=Time(nanoseconds=max(t_ns, 0)).to_msg()))


def message_class(msgtype: str) -> Any:
    """The class of a message type such as sensor_msgs/msg/Image. Raises ImportError where it is not installed."""
    package, _, name = msgtype.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except AttributeError:
        raise ImportError(f"{package}.msg has no {name}") from None


class _Number(click.ParamType):
    """A finite number that `fits`; anything else is told as `expected`."""

    name = "number"

    def __init__(self, expected: str, fits: Callable[[float], bool]) -> None:
        self._expected, self._fits = expected, fits

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        name = param.opts[0] if param is not None else self.name
        try:
            number = float(value)
        except ValueError:
            raise click.UsageError(f"argument {name}: expected a number, got {value}", ctx) from None
        if not (math.isfinite(number) and self._fits(number)):
            raise click.UsageError(f"argument {name}: expected {self._expected}, got {value}", ctx)
        return number


class _SeveralTopics(click.Command):
    """Takes several words after --topics, which click does not: an option of its own is made of each."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        words: list[str] = []
        taking = False
        for k, word in enumerate(args):
            taking = taking and not word.startswith("-")
            if word == "--topics":
                taking = True
                if not args[k + 1 : k + 2] or args[k + 1].startswith("-"):
                    raise click.UsageError("argument --topics: expected at least one topic", ctx)
            else:
                words += ["--topics", word] if taking else [word]
        return super().parse_args(ctx, words)


@click.command(cls=_SeveralTopics, help=__doc__, context_settings={"help_option_names": ["-h", "--help"]})
@click.argument("bag", type=click.Path(path_type=Path))
@click.option(
    "--rate", type=_Number("a positive number", lambda v: v > 0), default=1.0, help="times the recorded speed"
)
@click.option("--loop", is_flag=True, help="start again at the end; stamps go backwards then")
@click.option("--clock", is_flag=True, help="publish /clock, for nodes with use_sim_time")
@click.option(
    "--wait",
    type=_Number("a number of seconds >= 0", lambda v: v >= 0),
    default=1.0,
    metavar="SECONDS",
    help="how long to wait for a subscriber on every topic",
)
@click.option("--wait-for", default="", metavar="NODE", help="wait so long for this node's subscriptions instead")
@click.option("--topics", multiple=True, metavar="TOPIC ...", help="play only these")
@click.pass_obj
def play(
    argv: list[str],
    bag: Path,
    rate: float,
    loop: bool,
    clock: bool,
    wait: float,
    wait_for: str,
    topics: tuple[str, ...],
) -> int:
    """Play a bag; the exit status. `argv` is the whole command line, for ROS."""
    status = 0
    try:
        with until_stopped():
            use_large_messages()
            rclpy.init(args=argv)
            player = BagPlayer(bag, topics, clock)
            player.wait_for_subscribers(wait, wait_for)
            loops, told = 0, float("-inf")
            while True:
                count, loops = player.play(rate), loops + 1
                if time.monotonic() - told >= REPORT_PERIOD:
                    told = time.monotonic()
                    again = f", {loops} times so far" if loops > 1 else ""
                    player.get_logger().info(f"played {count} messages of {bag}{again}")
                if not loop:
                    break
            player.finish(ACKNOWLEDGED_SECONDS)
    except BagError as error:
        sys.stderr.write(f"bag_player: {error}\n")
        status = 1 if isinstance(error, BagDamage) else 2
    finally:
        shut_down()
    return status


def main(args: list[str] | None = None) -> int:
    """Play a bag; 0 at its end or when told to stop, 1 if its end is damaged, 2 for bad usage or a bad bag."""
    argv = sys.argv if args is None else ["bag_player", *args]
    try:
        return play.main(remove_ros_args(argv)[1:], prog_name="bag_player", standalone_mode=False, obj=argv)
    except click.UsageError as error:  # click would add two lines of usage
        sys.stderr.write(f"bag_player: {error.format_message().rstrip('.')}; see bag_player --help\n")
        return 2


if __name__ == "__main__":
    sys.exit(main())
