"""Sweep of one design: the stages of its runs, each trained by `run_loop.py`, and sweep.json after each run.

It holds no state that is not in the run directories: a run is done when its curve reaches its last second, which is
also how the same command goes on where another one stopped.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Generator, Sequence
from pathlib import Path

from kinetix_dist.config import to_dict
from kinetix_dist.sweep.arms import Run, hash_of
from kinetix_dist.sweep.design import Design
from kinetix_dist.sweep.objective import Curve, read_curve, score, seconds_so_far
from kinetix_dist.sweep.results import results
from kinetix_dist.sweep.results_directory import ResultsDirectory, directory_of, write_json
from kinetix_dist.sweep.run_loop import Callbacks, RunLoop, RunsFailedError
from kinetix_dist.sweep.rungs import Stage, stages
from kinetix_dist.sweep.slots import Slot
from kinetix_dist.sweep.training_work import TrainingWork

RESULTS = "sweep.json"
# s of training after the end of a run, until its last evaluation has to be there. It comes from a background
# process, which starts and compiles when the first one is due.
LATE_AFTER_S = 120.0


class Sweep:
    """Sweep of one design in one directory. `close` gives the directory back."""

    def __init__(self, design: Design, runs: Sequence[Run], path: Path) -> None:
        """Takes the directory. Raises UserError for one of another design, or in use."""
        self.design = design
        self.runs = list(runs)
        self.path = path
        self.hash = hash_of(design, self.runs)
        self._directory = ResultsDirectory(path, self.hash, to_dict(design))

    def close(self) -> None:
        self._directory.close()

    def directory(self, run: Run) -> Path:
        return directory_of(self.path, run)

    def train(
        self, slots: Sequence[Slot], *, report: Callable[[str], None], must_stop: Callable[[], str | None]
    ) -> None:
        """Trains what is left. must_stop: why it is to end now; None: it goes on.

        Raises RunsStoppedError, and RunsFailedError once all others of a stage are trained.
        """
        callbacks = Callbacks(report=report, must_stop=must_stop, after_run=self.write)
        for stage in self._stages():
            goal = _CurveGoal(self.path, self.design, stage.seconds)
            try:
                failures = RunLoop(self.path, TrainingWork(self.path, self.design.recipe), goal, callbacks).train(
                    stage.runs, slots
                )
            finally:
                self.write()
            if failures:
                raise RunsFailedError("; ".join(failures))
        self.write(is_complete=True)

    def write(self, *, is_complete: bool = False) -> None:
        """Writes sweep.json from the run directories. Raises UserError where it cannot be written."""
        curves = {run.name: self._curve(run) for run in self.runs}
        content = results(
            self.design, self.runs, curves, self._targets(curves), design_hash=self.hash, is_complete=is_complete
        )
        write_json(self.path / RESULTS, content)

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


@dataclasses.dataclass(frozen=True)
class _CurveGoal:
    """A curve that reaches a second; the run is stopped there, or where no evaluation has come long after it."""

    path: Path
    design: Design
    until: float  # s of training

    def is_reached(self, run: Run) -> bool:
        return self._curve(run).reaches(self.until)

    def must_end(self, run: Run) -> bool:
        seconds = seconds_so_far(directory_of(self.path, run))
        is_late = seconds >= self.until + LATE_AFTER_S
        return is_late or (seconds >= self.until and self.is_reached(run))

    def why_out_of_reach(self, run: Run) -> str:
        del run
        return (
            f"no evaluation came within {LATE_AFTER_S:g} s after second {self.until:g}; raise objective.every_seconds"
        )

    def result(self, run: Run) -> str:
        curve = self._curve(run)
        found = score(curve, self.design.objective, self.until)
        return f"area {found.area:.4f}, last {found.last:.4f}, {curve.updates[-1]} updates"

    def _curve(self, run: Run) -> Curve:
        return read_curve(directory_of(self.path, run), self.design.objective)
