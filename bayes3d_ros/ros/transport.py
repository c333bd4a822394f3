# SPDX-License-Identifier: Apache-2.0

"""Shared memory that is large enough for images, for Fast DDS in this process."""

import os

from bayes3d_ros.resources import share_directory

_CHOICES = (
    *("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE", "FASTDDS_BUILTIN_TRANSPORTS"),
    "RMW_FASTRTPS_USE_QOS_FROM_XML",
)


def chosen_transport() -> bool:
    """Whether the environment tells Fast DDS how to send."""
    return any(os.environ.get(name) for name in _CHOICES)


def use_large_messages() -> None:
    """Use config/fastdds.xml, unless the user has chosen something; to be called before rclpy.init.

    In the half megabyte that Fast DDS takes by default an image crowds out what is sent beside it: best-effort images
    are lost, and a reliable CameraInfo or pose of the same stamp comes seconds later, when it is asked for again.
    """
    if chosen_transport():
        return
    try:
        os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(share_directory() / "config" / "fastdds.xml")
    except FileNotFoundError:
        return
