# SPDX-License-Identifier: Apache-2.0

"""Nodes in processes of their own, on a ROS domain that nobody else on this machine uses."""

import fcntl
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
from contextlib import suppress
from functools import cache
from pathlib import Path

START_SECONDS = 600.0  # how long to wait for a node: its first start on a machine compiles for minutes


def free_domain() -> int:
    """A ROS domain that no other process on this machine has taken by this function, and in which nobody listens for
    others on the usual port; the same one again for a process that asks again."""
    return _claim(os.getpid())


@cache
def _claim(process: int) -> int:
    for k in range(100):
        domain = 1 + (process + k) % 100
        try:
            # Held until the process ends. Nodes that keep to this machine need not bind a port that others could see.
            lock = os.open(Path(tempfile.gettempdir()) / f"bayes3d_ros_domain_{domain}.lock", os.O_RDWR | os.O_CREAT)
        except OSError:  # another user's
            continue
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
                probe.bind(("", 7400 + 250 * domain))
            return domain
        except OSError:
            os.close(lock)
    raise RuntimeError("expected a free ROS domain between 1 and 100, all are in use")


_LOCK = re.compile(r"(/dev/shm/fastrtps_[0-9a-f]{16})_el$")  # who makes a segment keeps its lock open


def shared_memory(pid: int) -> set[Path]:
    """Files of the shared memory that a process has made for what it sends through Fast DDS; none if it has ended."""
    segments: list[str] = []
    with suppress(OSError):  # the process ends, or closes a file
        for link in Path(f"/proc/{pid}/fd").iterdir():
            with suppress(OSError):
                segments += _LOCK.findall(os.readlink(link))
    return {Path(segment + end) for segment in segments for end in ("", "_el")}


def kill(pid: int) -> None:
    """kill -9, and give back what the process held of shared memory: 34 MB a node, which nobody else would."""
    held = shared_memory(pid)
    os.kill(pid, signal.SIGKILL)
    for path in held:
        path.unlink(missing_ok=True)


class NodeProcess:
    """`python ARGUMENTS...` on a domain, local to this machine; what it prints goes to a file."""

    def __init__(self, arguments: list[str], domain: int, log: Path) -> None:
        self.log = log
        package = str(Path(__file__).resolve().parents[2])  # the child imports the package that this process imports
        path = os.pathsep.join([package, *filter(None, [os.environ.get("PYTHONPATH")])])
        environment = {
            **os.environ,
            "PYTHONPATH": path,
            "ROS_DOMAIN_ID": str(domain),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        }
        with log.open("w") as file:
            self._process = subprocess.Popen(
                [sys.executable, *arguments], env=environment, stdout=file, stderr=subprocess.STDOUT
            )

    @property
    def pid(self) -> int:
        """The process's number."""
        return self._process.pid

    @property
    def status(self) -> int | None:
        """Exit status, None while it runs."""
        return self._process.poll()

    def stop(self, *signals: int, seconds: float = 30.0) -> int:
        """Send signals (default: SIGINT), wait for the end (by force after a while); the exit status."""
        for number in signals or (signal.SIGINT,):
            self._process.send_signal(number)
        try:
            return self._process.wait(seconds)
        except subprocess.TimeoutExpired:
            return self.kill()

    def kill(self) -> int:
        """End it by force, see `kill`; the exit status."""
        if self.status is None:
            kill(self.pid)
        return self._process.wait()

    def output(self) -> str:
        """Everything it has printed."""
        return self.log.read_text()
