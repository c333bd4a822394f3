# SPDX-License-Identifier: Apache-2.0

"""The .msg texts of message types, which a recording has to hold."""

from pathlib import Path
from typing import Any

from ament_index_python.packages import get_package_share_directory
from rosbags.typesys import Stores, get_types_from_msg, get_typestore


class MessageDefinitions:
    """Texts of Jazzy's own message types, and of those of any other package that is installed."""

    def __init__(self) -> None:
        self._store = get_typestore(Stores.ROS2_JAZZY)

    def text(self, msgtype: str) -> str:
        """The definition of PACKAGE/msg/NAME with those of all types in it, as MCAP's ros2msg has them."""
        if msgtype not in self._store.fielddefs:
            self._learn(msgtype.split("/")[0])
        return self._store.generate_msgdef(msgtype, ros_version=2)[0]

    def _learn(self, package: str) -> None:
        """Read the definitions of an installed package."""
        types: dict[str, Any] = {}
        for file in sorted((Path(get_package_share_directory(package)) / "msg").glob("*.msg")):
            types |= get_types_from_msg(file.read_text(), f"{package}/msg/{file.stem}")
        self._store.register(types)


def type_name(kind: type) -> str:
    """PACKAGE/msg/NAME of a message class."""
    return f"{kind.__module__.split('.')[0]}/msg/{kind.__name__}"
