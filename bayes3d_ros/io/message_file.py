# SPDX-License-Identifier: Apache-2.0

"""Messages into one MCAP file, as `ros2 bag play`, RViz and Foxglove read it: CDR, with definitions as ros2msg."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import yaml
from mcap.writer import CompressionType, Writer

from bayes3d_ros.files.atomic import whole_file

_FOREVER = {"sec": 9223372036, "nsec": 854775807}


class MessageFile:
    """Writes an MCAP file (zstd), whole: a context manager. A file of this name is replaced at the end.

    What was written before an error is kept. Raises OSError where the file cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._open = path, ExitStack()
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._count = 0

    def __enter__(self) -> "MessageFile":
        self._path.parent.mkdir(parents=True, exist_ok=True)
        file = self._open.enter_context(whole_file(self._path))
        self._writer = Writer(file, compression=CompressionType.ZSTD)
        self._writer.start(profile="ros2")
        return self

    def __exit__(self, *error: Any) -> None:
        with self._open, self._naming_the_file():
            self._writer.finish()

    def add_topic(self, topic: str, msgtype: str, definition: str, latched: bool = False) -> None:
        """Announce a topic before its first message. definition: the .msg text of `msgtype` with those of all types in
        it. latched: who subscribes late gets the last message."""
        if msgtype not in self._schemas:
            self._schemas[msgtype] = self._writer.register_schema(msgtype, "ros2msg", definition.encode())
        offered = {"offered_qos_profiles": yaml.safe_dump([_profile(latched)], sort_keys=False)}
        self._channels[topic] = self._writer.register_channel(topic, "cdr", self._schemas[msgtype], offered)

    def write(self, topic: str, data: bytes, stamp_ns: int) -> None:
        """Append a message of a topic that was announced: its CDR bytes, and the stamp that it is logged at."""
        with self._naming_the_file():
            self._writer.add_message(self._channels[topic], stamp_ns, data, stamp_ns, self._count)
        self._count += 1

    @contextmanager
    def _naming_the_file(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:  # a full disk; its error does not say where
            raise OSError(error.errno, error.strerror, str(self._path)) from error


def _profile(latched: bool) -> dict[str, Any]:
    """A QoS profile as rosbag2 of Jazzy writes it."""
    return {
        "history": "keep_last",
        "depth": 1 if latched else 10,
        "reliability": "reliable",
        "durability": "transient_local" if latched else "volatile",
        "deadline": _FOREVER,
        "lifespan": _FOREVER,
        "liveliness": "automatic",
        "liveliness_lease_duration": _FOREVER,
        "avoid_ros_namespace_conventions": False,
    }
