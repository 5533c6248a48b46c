"""A `kinetix-dist` command on the cores of a lane, that is told to stop when the sweep dies.

python -m kinetix_dist.sweep.lane_process CORES PARENT COMMAND...      CORES: "0,1" or "all"; PARENT: pid of the sweep

A program of its own, since what it sets is inherited by all threads only when it is set before the first of them.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys

from kinetix_dist.child_python import command_of

_PR_SET_PDEATHSIG = 1  # linux/prctl.h


def main(cores: str, parent: int, command: list[str]) -> None:
    """Becomes the command."""
    if cores != "all":
        os.sched_setaffinity(0, {int(core) for core in cores.split(",")})
    if ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM) != 0:
        sys.exit(f"prctl: {os.strerror(ctypes.get_errno())}")
    if os.getppid() != parent:  # it died before this was set
        sys.exit("the sweep is gone")
    os.execv(sys.executable, command_of("kinetix_dist.cli.main", *command))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), sys.argv[3:])
