"""Loop that works runs off in worker slots, each in a process of its own.

consumes      runs, worker slots, the work and the goal of each run
produces      what the processes write, and logs/RUN.log in a directory of results
waits for     runs in their slots
unblocked by  the end of a run; `must_stop`, upon which runs save and end

It holds no state that is not in the files of runs: a run that was begun goes on.
"""

from __future__ import annotations

import dataclasses
import os
import signal
import subprocess
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Generic, Protocol, TypeVar

from kinetix_dist.errors import one_line
from kinetix_dist.sweep.results_directory import LOGS
from kinetix_dist.sweep.slots import Slot, start_command

POLL_S = 0.5
MAX_LOG_CHARACTERS = 300  # of a line of a log in a message


class RunsFailedError(Exception):
    """Runs that ended without their result: which and why, in one line."""


class RunsStoppedError(Exception):
    """Runs were stopped; why, and what is left."""


class Named(Protocol):
    """Run: one process, or several of which each goes on where the last one ended."""

    @property
    def name(self) -> str: ...


Run = TypeVar("Run", bound=Named)
AnyRun = TypeVar("AnyRun", bound=Named, contravariant=True)


class Work(Protocol[AnyRun]):
    """Processes of runs."""

    def command(self, run: AnyRun, /) -> tuple[list[str], bool]:
        """Words of `kinetix-dist`, and whether a run goes on that was begun before."""
        ...

    def seconds_to_stop(self, run: AnyRun, /) -> float:
        """Seconds after SIGTERM in which its process has ended."""
        ...

    def ended(self, run: AnyRun, /, status: int) -> str:
        """Notes that its process has ended; why its files are none of this run, "" where they are."""
        ...


class Goal(Protocol[AnyRun]):
    """Condition that each run has to meet."""

    def is_reached(self, run: AnyRun, /) -> bool:
        """True where the files of a run have all that is needed."""
        ...

    def must_end(self, run: AnyRun, /) -> bool:
        """True where a run that still goes on is to be stopped, be the goal reached or out of reach."""
        ...

    def why_out_of_reach(self, run: AnyRun, /) -> str:
        """Clause about a run that had to end without reaching the goal."""
        ...

    def result(self, run: AnyRun, /) -> str:
        """Clause about a run that reached it."""
        ...


@dataclasses.dataclass(frozen=True, kw_only=True)
class Callbacks:
    """Connections of the loop to its caller."""

    report: Callable[[str], None]  # of a line
    must_stop: Callable[[], str | None]  # why it is to end now; None: it goes on
    after_run: Callable[[], object] = lambda: None  # a run has reached its goal


@dataclasses.dataclass
class _Active(Generic[Run]):
    run: Run
    slot: Slot
    process: subprocess.Popen[bytes]
    stopped_at: float | None = None  # s of time.monotonic(), of SIGTERM


class RunLoop(Generic[Run]):
    """Loop over runs in the directory of results `path`."""

    def __init__(self, path: Path, work: Work[Run], goal: Goal[Run], callbacks: Callbacks) -> None:
        self._path = path
        self._work = work
        self._goal = goal
        self._calls = callbacks

    def train(self, runs: Sequence[Run], slots: Sequence[Slot]) -> list[str]:
        """Works off the runs that have not reached the goal, in their order; returns failures, a line each.

        Raises RunsStoppedError where it was stopped before all were done.
        """
        waiting = [run for run in runs if not self._goal.is_reached(run)]
        free, active, failures = list(slots), list[_Active[Run]](), list[str]()
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
            self._end(active)
        return failures

    def _start(self, run: Run, slot: Slot) -> _Active[Run]:
        words, goes_on = self._work.command(run)
        self._calls.report(f"{run.name} {'goes on' if goes_on else 'begins'} on {slot.name}")
        return _Active(run, slot, start_command(words, slot, self._log(run)))

    def _stop_if_due(self, one: _Active[Run]) -> None:
        if one.stopped_at is not None:
            if time.monotonic() - one.stopped_at > self._work.seconds_to_stop(one.run):
                os.killpg(one.process.pid, signal.SIGKILL)
        elif self._goal.must_end(one.run):
            one.process.terminate()
            one.stopped_at = time.monotonic()

    def _finished(self, one: _Active[Run]) -> list[str]:
        """Failures of a run that has ended: none, or a line that says why."""
        run, status = one.run, one.process.returncode
        not_own = self._work.ended(run, status)
        if self._goal.is_reached(run) and not not_own:
            self._calls.report(f"{run.name} done: {self._goal.result(run)}")
            self._calls.after_run()
            return []
        if one.stopped_at is not None and not not_own:
            why = self._goal.why_out_of_reach(run)
        else:
            why = not_own or f"exit status {status}: {_last_line(self._log(run))}"
        self._calls.report(f"{run.name} failed: {why}")
        return [f"{run.name} failed ({why}; see {self._log(run)})"]

    def _log(self, run: Run) -> Path:
        """File with the command of a run and its output."""
        return self._path / LOGS / f"{run.name}.log"

    def _end(self, active: Sequence[_Active[Run]]) -> None:
        """Stops runs that are still there; each saves what it has."""
        for one in active:
            if one.process.poll() is None and one.stopped_at is None:
                one.process.terminate()
        for one in active:
            try:
                one.process.wait(self._work.seconds_to_stop(one.run))
            except subprocess.TimeoutExpired:
                os.killpg(one.process.pid, signal.SIGKILL)
                one.process.wait()


def _last_line(log: Path) -> str:
    lines = [line for line in log.read_text(errors="replace").splitlines() if line.strip()]
    return one_line(lines[-1])[:MAX_LOG_CHARACTERS] if lines else "it wrote nothing"
