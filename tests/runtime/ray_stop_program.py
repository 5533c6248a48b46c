"""`ray stop --force` next to a run, in a process namespace of its own: it ends every Ray process that it can see.

unshare --pid --fork --mount-proc --kill-child python -m tests.runtime.ray_stop_program RUN        a line of JSON
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import psutil

from tests.runtime.raylets import RAY
from tests.runtime.train_process import LIMIT_S, STEPS_PER_UPDATE, TINY, rows, start, wait_for

GONE_S = 30.0  # for what a run leaves behind to be ended
OPTIONS = [*TINY, "--run.placement", "colocated", "--run.num_workers", "2", "--run.checkpoint_every", "5"]


def main(run: Path) -> None:
    process = start(run, *OPTIONS, "--run.total_env_steps", str(10**6 * STEPS_PER_UPDATE))
    wait_for(lambda: len(rows(run)) >= 7, process, "update 7")
    stopped = subprocess.run([RAY, "stop", "--force"], capture_output=True, text=True, check=True)
    began = time.monotonic()
    said, errors = process.communicate(timeout=LIMIT_S)
    seconds = time.monotonic() - began
    while (left := _others()) and time.monotonic() < began + seconds + GONE_S:
        time.sleep(0.2)
    outcome = {"status": process.returncode, "seconds": seconds, "left": left, "errors": errors, "said": said}
    print(json.dumps(outcome | {"ray_stop": stopped.stdout + stopped.stderr}))


def _others() -> list[str]:
    """Command lines of all processes of this namespace but this one."""
    there = (process for process in psutil.process_iter(["cmdline", "status"]) if process.pid != os.getpid())
    return [" ".join(one.info["cmdline"] or []) for one in there if one.info["status"] != psutil.STATUS_ZOMBIE]


if __name__ == "__main__":
    main(Path(sys.argv[1]))
