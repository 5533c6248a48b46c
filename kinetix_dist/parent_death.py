"""Processes that end with the one that started them.

    python -m kinetix_dist.parent_death PARENT NICE PROGRAM ARGUMENTS...

becomes the program at a lower priority, and gets SIGTERM when the process PARENT dies, however that ends.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys

_PR_SET_PDEATHSIG = 1  # linux/prctl.h


def end_with_parent(parent: int, name: str) -> None:
    """Requests SIGTERM for this process when its parent dies, also after `exec`. Ends it where that is gone already.

    name: what the parent is, for that line.
    """
    if ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM) != 0:
        sys.exit(f"prctl: {os.strerror(ctypes.get_errno())}")
    if os.getppid() != parent:  # it died before this was set
        sys.exit(f"{name} is gone")


if __name__ == "__main__":
    end_with_parent(int(sys.argv[1]), f"process {sys.argv[1]}")
    os.nice(int(sys.argv[2]))
    os.execv(sys.argv[3], sys.argv[3:])
