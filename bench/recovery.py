"""Seconds from the end of a process to the first new update, seen from outside of the run.

    python -m bench.recovery --losses worker rollout driver --repeats 3 --json runs/recovery.json

A tiny run on the CPU with programs that are compiled already: SIGKILL for a worker of two (colocated), for one of two
rollout actors (split), or for the command, which is started again with --resume. Each record has wall seconds, CPU
seconds of all processes of the run in that time, and the load of the machine: on a machine that others use, CPU seconds
divided by the cores are what it would take alone.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Generator
from pathlib import Path
from typing import Any

from bench.drill_run import STEPS_PER_UPDATE, DrillRun, machine
from bench.program import exit_code, output_file, parser_of, report_each
from kinetix_dist.errors import UserError

PLACEMENTS = {"worker": "colocated", "rollout": "split", "driver": "colocated"}
SETTLED_UPDATES = 20  # after a start, until all that compiles has compiled
OPTIONS = ("--run.max_restarts", "1000", "--run.checkpoint_every", "5", "--recording.num_rollouts", "0")
FOR_EVER = str(1_000_000_000 * STEPS_PER_UPDATE)


def measure(options: argparse.Namespace) -> Generator[dict[str, Any]]:
    """A record a loss."""
    for lost in options.losses:
        folder = Path(tempfile.mkdtemp(prefix="kinetix-recovery-"))
        run = DrillRun(folder / "run", PLACEMENTS[lost], OPTIONS)
        run.start("--run.total_env_steps", FOR_EVER)
        try:
            for _ in range(options.repeats):
                _settle(run)
                yield _recovery(run, lost)
        finally:
            run.end(signal.SIGKILL)
            run.left_processes()
            shutil.rmtree(folder)


def _settle(run: DrillRun) -> None:
    last = max(run.updates(), default=0)
    run.wait(lambda: max(run.updates(), default=0) >= last + SETTLED_UPDATES, f"{SETTLED_UPDATES} updates")


def _recovery(run: DrillRun, lost: str) -> dict[str, Any]:
    before, reached, num_events = machine(), max(run.updates()), len(run.events("process_started"))
    cpu, began = run.cpu_now(), time.monotonic()
    if lost == "driver":
        run.end(signal.SIGKILL)
        run.start(resume=True)
    else:
        pid = next(pid for pid, name in run.living().items() if name == f"{lost} 1")
        os.kill(pid, signal.SIGKILL)
    run.wait(lambda: len(run.events("process_started")) > num_events and run.wait_for_update() > 0, "an update")
    seconds = time.monotonic() - began
    return {
        "benchmark": "recovery",
        "lost": lost,
        "placement": run.placement,
        "at_update": reached,
        "seconds": round(seconds, 2),
        "cpu_seconds": round(run.cpu_now() - cpu, 2),
        **before,
    }


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--losses", nargs="+", choices=sorted(PLACEMENTS), default=list(PLACEMENTS))
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--json", type=output_file)
    arguments = parser.parse_args()
    return exit_code(parser, lambda: run(arguments))


def run(options: argparse.Namespace) -> int:
    if options.repeats < 1:
        raise UserError(f"--repeats is {options.repeats}; give 1 or more")
    report_each(measure(options), options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
