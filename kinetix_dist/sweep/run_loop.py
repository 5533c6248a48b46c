"""Loop that trains runs in worker slots, each in a process of its own.

consumes      runs, worker slots, the goal of each run
produces      run directories arms/RUN/ and logs/RUN.log in a directory of results
waits for     runs in their slots
unblocked by  the end of a run; `must_stop`, upon which runs save and end

It holds no state that is not in the run directories: a run that has one is resumed.
"""

from __future__ import annotations

import dataclasses
import os
import signal
import subprocess
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

from kinetix_dist.errors import one_line
from kinetix_dist.studio.runs.run_files import CONFIG, read_object
from kinetix_dist.sweep.arms import Run, train_arguments
from kinetix_dist.sweep.results_directory import LOGS, directory_of, log_of
from kinetix_dist.sweep.slots import Slot, start_training

POLL_S = 0.5
STOP_GRACE_S = 30.0  # beyond run.stop_seconds, at which a run ends itself wherever it is
MAX_LOG_CHARACTERS = 300  # of a line of a log in a message


class RunsFailedError(Exception):
    """Runs that ended without their result: which and why, in one line."""


class RunsStoppedError(Exception):
    """Training was stopped; why, and what is left."""


class Goal(Protocol):
    """Condition that each run has to meet."""

    def is_reached(self, run: Run) -> bool:
        """True where the files of a run have all that is needed."""
        ...

    def must_end(self, run: Run) -> bool:
        """True where a run that still trains is to be stopped, be the goal reached or out of reach."""
        ...

    def why_out_of_reach(self, run: Run) -> str:
        """Clause about a run that had to end without reaching the goal."""
        ...

    def result(self, run: Run) -> str:
        """Clause about a run that reached it."""
        ...


@dataclasses.dataclass(frozen=True, kw_only=True)
class Callbacks:
    """Connections of the loop to its caller."""

    report: Callable[[str], None]  # of a line
    must_stop: Callable[[], str | None]  # why it is to end now; None: it goes on
    after_run: Callable[[], None] = lambda: None  # a run has reached its goal


@dataclasses.dataclass
class _Active:
    run: Run
    slot: Slot
    process: subprocess.Popen[bytes]
    stopped_at: float | None = None  # s of time.monotonic(), of SIGTERM


def seconds_to_stop(runs: Sequence[Run]) -> float:
    """Seconds after which all runs that were stopped have ended."""
    return max(run.config.run.stop_seconds for run in runs) + STOP_GRACE_S


class RunLoop:
    """Loop over runs of one recipe in the directory of results `path`."""

    def __init__(self, path: Path, recipe: str, goal: Goal, callbacks: Callbacks) -> None:
        self._path = path
        self._recipe = recipe
        self._goal = goal
        self._calls = callbacks

    def train(self, runs: Sequence[Run], slots: Sequence[Slot]) -> list[str]:
        """Trains the runs that have not reached the goal, in their order; returns failures, a line each.

        Raises RunsStoppedError where it was stopped before all were trained.
        """
        waiting = [run for run in runs if not self._goal.is_reached(run)]
        free, active, failures = list(slots), list[_Active](), list[str]()
        try:
            while waiting or active:
                if (reason := self._calls.must_stop()) is not None:
                    left = len(waiting) + len(active)
                    raise RunsStoppedError(f"{reason}, with {left} of {len(runs)} runs to go")
                while waiting and free:
                    active.append(self._start(waiting.pop(0), free.pop(0)))
                time.sleep(POLL_S)
                for one in list(active):
                    if one.process.poll() is None:
                        self._stop_if_due(one)
                        continue
                    active.remove(one)
                    free.append(one.slot)
                    failures += self._finished(one)
        finally:
            _end(active)
        return failures

    def _start(self, run: Run, slot: Slot) -> _Active:
        directory = directory_of(self._path, run)
        goes_on = (directory / CONFIG).is_file()
        arguments = ["--resume"] if goes_on else train_arguments(run, self._recipe, self._path / LOGS)
        self._calls.report(f"{run.name} {'goes on' if goes_on else 'begins'} on {slot.name}")
        command = ["--run", str(directory), *arguments]
        return _Active(run, slot, start_training(command, slot, log_of(self._path, run)))

    def _stop_if_due(self, one: _Active) -> None:
        if one.stopped_at is not None:
            if time.monotonic() - one.stopped_at > seconds_to_stop([one.run]):
                os.killpg(one.process.pid, signal.SIGKILL)
        elif self._goal.must_end(one.run):
            one.process.terminate()
            one.stopped_at = time.monotonic()

    def _finished(self, one: _Active) -> list[str]:
        """Failures of a run that has ended: none, or a line that says why."""
        run, log = one.run, log_of(self._path, one.run)
        is_reached = self._goal.is_reached(run)
        stored = read_object(directory_of(self._path, run) / CONFIG) or {}
        if is_reached and stored.get("hash") == run.config.hash:
            self._calls.report(f"{run.name} done: {self._goal.result(run)}")
            self._calls.after_run()
            return []
        if is_reached:
            why = f"it was trained with another configuration ({stored.get('hash')}, not {run.config.hash})"
        elif one.stopped_at is not None:
            why = self._goal.why_out_of_reach(run)
        else:
            why = f"exit status {one.process.returncode}: {_last_line(log)}"
        self._calls.report(f"{run.name} failed: {why}")
        return [f"{run.name} failed ({why}; see {log})"]


def _end(active: Sequence[_Active]) -> None:
    """Stops runs that are still there; each saves the update that it is at."""
    for one in active:
        if one.process.poll() is None and one.stopped_at is None:
            one.process.terminate()
    for one in active:
        try:
            one.process.wait(seconds_to_stop([one.run]))
        except subprocess.TimeoutExpired:
            os.killpg(one.process.pid, signal.SIGKILL)
            one.process.wait()


def _last_line(log: Path) -> str:
    lines = [line for line in log.read_text(errors="replace").splitlines() if line.strip()]
    return one_line(lines[-1])[:MAX_LOG_CHARACTERS] if lines else "it wrote nothing"
