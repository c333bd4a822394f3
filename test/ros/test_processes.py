# SPDX-License-Identifier: Apache-2.0

"""Test sessions that run at the same time do not hear each other."""

import subprocess
import sys

from bayes3d_ros.ros.processes import free_domain

CLAIM = "from bayes3d_ros.ros.processes import _claim; print(_claim({}), flush=True); input()"


def test_two_processes_never_take_the_same_domain() -> None:
    mine = free_domain()
    assert free_domain() == mine
    taken = [mine]
    others = []
    for _ in range(3):  # all begin where this process has begun
        program = CLAIM.format(mine - 1)
        other = subprocess.Popen([sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        others.append(other)
        assert other.stdout is not None
        taken.append(int(other.stdout.readline()))
    assert len(set(taken)) == 4
    for other in others:
        other.communicate(b"\n")
