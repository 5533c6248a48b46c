"""The loop of a sweep.

consumes      a design, worker slots
produces      runs/NAME/: design.json, arms/RUN/ (run directories), logs/RUN.log, sweep.json after each run
waits for     runs in their slots
unblocked by  the end of a run; SIGTERM, Ctrl-C or the end of the minutes, upon which runs save and end

It holds no state that is not in the run directories: a run is done when its curve reaches its last second, which is
also how the same command goes on where another one stopped.
"""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import subprocess
import time
from collections.abc import Callable, Generator, Sequence
from pathlib import Path

from kinetix_dist.atomic_files import replace_file
from kinetix_dist.config import to_dict
from kinetix_dist.errors import UserError, one_line, user_errors
from kinetix_dist.runtime import RunDirectoryError, lock_directory
from kinetix_dist.studio.runs.run_files import CONFIG, read_object
from kinetix_dist.sweep.arms import Run, hash_of, train_arguments
from kinetix_dist.sweep.design import Design
from kinetix_dist.sweep.objective import Curve, read_curve, score, seconds_so_far
from kinetix_dist.sweep.results import results
from kinetix_dist.sweep.rungs import Stage, stages
from kinetix_dist.sweep.slots import Slot, start_training

DESIGN, RESULTS, ARMS, LOGS = "design.json", "sweep.json", "arms", "logs"
POLL_S = 0.5
STOP_GRACE_S = 30.0  # beyond run.stop_seconds, at which a run ends itself wherever it is
# s of training after the end of a run, until its last evaluation has to be there. It comes from a background
# process, which starts and compiles when the first one is due.
LATE_AFTER_S = 120.0
MAX_LOG_CHARACTERS = 300  # of a line of a log in a message


def directory_of(path: Path, run: Run) -> Path:
    """Directory of a run of the sweep in `path`."""
    return path / ARMS / run.name


def done_so_far(path: Path, runs: Sequence[Run]) -> dict[str, float]:
    """Seconds of training that each run has, by its name."""
    return {run.name: seconds_so_far(directory_of(path, run)) for run in runs}


def check_design(path: Path, design_hash: str) -> bool:
    """True where results of this design are in `path`. Raises UserError for those of another."""
    with user_errors(ValueError, OSError, prefix=f"{path}: "):
        known = read_object(path / DESIGN)
    if known is not None and known.get("hash") != design_hash:
        raise UserError(
            f"{path} holds results of another design (hash {known.get('hash')}, this one has {design_hash}); "
            "name another directory with --out"
        )
    return known is not None


def seconds_to_stop(runs: Sequence[Run]) -> float:
    """Seconds after which all runs that were stopped have ended."""
    return max(run.config.run.stop_seconds for run in runs) + STOP_GRACE_S


class RunsFailedError(Exception):
    """Runs that ended without their result: which and why, in one line."""


class SweepStoppedError(Exception):
    """The sweep was stopped; why, and what is left."""


@dataclasses.dataclass
class _Active:
    run: Run
    slot: Slot
    process: subprocess.Popen[bytes]
    stopped_at: float | None = None  # s of time.monotonic(), of SIGTERM


class Sweep:
    """Sweep of one design in one directory. `close` gives the directory back."""

    def __init__(self, design: Design, runs: Sequence[Run], path: Path) -> None:
        """Takes the directory. Raises UserError for one of another design, or in use."""
        self.design = design
        self.runs = list(runs)
        self.path = path
        self.hash = hash_of(design, self.runs)
        with user_errors(OSError, RunDirectoryError):
            if (path / CONFIG).exists():
                raise UserError(f"{path} holds a run of `kinetix-dist train`; name another directory with --out")
            for folder in (path, path / ARMS, path / LOGS):
                folder.mkdir(parents=True, exist_ok=True)
            self._lock = lock_directory(path, "--out")
        try:
            self._claim()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        self._lock.close()

    def directory(self, run: Run) -> Path:
        return directory_of(self.path, run)

    def train(
        self, slots: Sequence[Slot], *, report: Callable[[str], None], must_stop: Callable[[], str | None]
    ) -> None:
        """Trains what is left. must_stop: why it is to end now; None: it goes on.

        Raises SweepStoppedError, and RunsFailedError once all others of a stage are trained.
        """
        for stage in self._stages():
            failures = self._train_stage(stage, slots, report, must_stop)
            if failures:
                raise RunsFailedError("; ".join(failures))
        self.write(is_complete=True)

    def write(self, *, is_complete: bool = False) -> None:
        """Writes sweep.json from the run directories. Raises UserError where it cannot be written."""
        curves = {run.name: self._curve(run) for run in self.runs}
        content = results(
            self.design, self.runs, curves, self._targets(curves), design_hash=self.hash, is_complete=is_complete
        )
        file = self.path / RESULTS
        with user_errors(OSError, prefix=f"{file} cannot be written: "):
            replace_file(file, (json.dumps(content, indent=1) + "\n").encode())

    def _claim(self) -> None:
        """Writes the design, or compares it with the one that is there."""
        if not check_design(self.path, self.hash):
            content = {"hash": self.hash, "design": to_dict(self.design)}
            with user_errors(OSError, prefix=f"{self.path / DESIGN} cannot be written: "):
                replace_file(self.path / DESIGN, (json.dumps(content, indent=1) + "\n").encode())

    def _curve(self, run: Run) -> Curve:
        return read_curve(self.directory(run), self.design.objective)

    def _area(self, run: Run, until: float) -> float:
        return score(self._curve(run), self.design.objective, until).area

    def _stages(self) -> Generator[Stage]:
        return stages(self.design, self.runs, self._area)

    def _targets(self, curves: dict[str, Curve]) -> dict[str, float]:
        """Second until which each run is to be trained, by its name, as far as is known."""
        targets: dict[str, float] = {}
        for stage in self._stages():
            targets |= {run.name: stage.seconds for run in stage.runs}
            if not all(curves[run.name].reaches(stage.seconds) for run in stage.runs):
                break
        return targets

    def _train_stage(
        self, stage: Stage, slots: Sequence[Slot], report: Callable[[str], None], must_stop: Callable[[], str | None]
    ) -> list[str]:
        """Failures, a line each."""
        waiting = [run for run in stage.runs if not self._curve(run).reaches(stage.seconds)]
        free, active, failures = list(slots), list[_Active](), list[str]()
        try:
            while waiting or active:
                if (reason := must_stop()) is not None:
                    left = len(waiting) + len(active)
                    raise SweepStoppedError(f"{reason}, with {left} of {len(stage.runs)} runs to go")
                while waiting and free:
                    active.append(self._start(waiting.pop(0), free.pop(0), report))
                time.sleep(POLL_S)
                for one in list(active):
                    if one.process.poll() is None:
                        self._stop_if_due(one, stage.seconds)
                        continue
                    active.remove(one)
                    free.append(one.slot)
                    failures += self._finished(one, stage.seconds, report)
        finally:
            self._end(active)
            self.write()
        return failures

    def _start(self, run: Run, slot: Slot, report: Callable[[str], None]) -> _Active:
        directory, log = self.directory(run), self.path / LOGS / f"{run.name}.log"
        goes_on = (directory / CONFIG).is_file()
        arguments = ["--resume"] if goes_on else train_arguments(run, self.design.recipe, self.path / LOGS)
        report(f"{run.name} {'goes on' if goes_on else 'begins'} on {slot.name}")
        return _Active(run, slot, start_training(["--run", str(directory), *arguments], slot, log))

    def _stop_if_due(self, one: _Active, until: float) -> None:
        if one.stopped_at is not None:
            if time.monotonic() - one.stopped_at > seconds_to_stop([one.run]):
                os.killpg(one.process.pid, signal.SIGKILL)
            return
        seconds = seconds_so_far(self.directory(one.run))
        is_late = seconds >= until + LATE_AFTER_S
        if is_late or (seconds >= until and self._curve(one.run).reaches(until)):
            one.process.terminate()
            one.stopped_at = time.monotonic()

    def _finished(self, one: _Active, until: float, report: Callable[[str], None]) -> list[str]:
        """Failures of a run that has ended: none, or a line that says why."""
        run, log = one.run, self.path / LOGS / f"{one.run.name}.log"
        curve = self._curve(run)
        stored = read_object(self.directory(run) / CONFIG) or {}
        if curve.reaches(until) and stored.get("hash") == run.config.hash:
            found = score(curve, self.design.objective, until)
            report(f"{run.name} done: area {found.area:.4f}, last {found.last:.4f}, {curve.updates[-1]} updates")
            self.write()
            return []
        if curve.reaches(until):
            why = f"it was trained with another configuration ({stored.get('hash')}, not {run.config.hash})"
        elif one.stopped_at is not None:
            why = f"no evaluation came within {LATE_AFTER_S:g} s after second {until:g}; raise objective.every_seconds"
        else:
            why = f"exit status {one.process.returncode}: {_last_line(log)}"
        report(f"{run.name} failed: {why}")
        return [f"{run.name} failed ({why}; see {log})"]

    def _end(self, active: Sequence[_Active]) -> None:
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
