"""Ends what a killed driver leaves behind.

    kinetix_dist.runtime.processes.watchdog PID        stdin is a pipe from the driver

Ray ends its servers and actors with the driver, but its agents can outlive a SIGKILL for minutes. This process
remembers the descendants of the driver; when the pipe closes, whichever way the driver went, it kills those that are
still there.

    consumes      nothing; the pipe is never written to
    waits for     the end of the pipe
    unblocked by  the end of the driver, or `Watchdog.stop`
"""

from __future__ import annotations

import contextlib
import select
import subprocess
import sys
import time

from kinetix_dist.child_python import command_of

LOOK_EVERY_S = 1.0
GRACE_S = 8.0  # for Ray to end its own processes in order


class Watchdog:
    """The driver's side: starts the process and keeps the pipe open."""

    def __init__(self, driver_pid: int) -> None:
        self._process = subprocess.Popen(
            command_of("kinetix_dist.runtime.processes.watchdog", driver_pid),
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # a Ctrl-C at the terminal is for the driver
        )

    def stop(self) -> None:
        """Tells it that everything was ended in order."""
        self._process.kill()
        self._process.wait()

    def end_what_is_left(self) -> None:
        """Ends the driver's descendants, though the driver goes on: Ray cannot, for one. Does not wait for it."""
        assert self._process.stdin is not None
        self._process.stdin.close()


def watch(driver_pid: int) -> None:
    """Returns when stdin has ended and the last descendant of the driver is gone."""
    import psutil

    seen: dict[int, psutil.Process] = {}
    is_over = False
    while not is_over:
        is_over = bool(select.select([sys.stdin], [], [], LOOK_EVERY_S)[0])
        with contextlib.suppress(psutil.Error):
            for process in psutil.Process(driver_pid).children(recursive=True):
                seen[process.pid] = process
    deadline = time.monotonic() + GRACE_S
    left = [process for process in seen.values() if process.pid != psutil.Process().pid]
    while left and time.monotonic() < deadline:
        time.sleep(0.2)
        left = [process for process in left if is_alive(process)]
    for process in left:
        with contextlib.suppress(psutil.Error):
            process.kill()  # psutil compares creation times: never another process that got the number


def is_alive(process: object) -> bool:
    import psutil

    assert isinstance(process, psutil.Process)
    try:
        return process.is_running() and process.status() != psutil.STATUS_ZOMBIE
    except psutil.Error:
        return False


if __name__ == "__main__":
    watch(int(sys.argv[1]))
