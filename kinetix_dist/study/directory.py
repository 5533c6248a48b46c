"""Study in a directory of results: its runs are worked off there, and results are written again after each."""

from __future__ import annotations

import abc
import contextlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from kinetix_dist.config import to_dict
from kinetix_dist.studio.runs.run_files import read_object
from kinetix_dist.sweep.results_directory import ResultsDirectory
from kinetix_dist.sweep.run_loop import Callbacks, Goal, Named, RunLoop, RunsFailedError, Work
from kinetix_dist.sweep.slots import Slot

RESULTS = "study.json"


class Described(Protocol):
    """Study as its file says it, a dataclass."""

    @property
    def name(self) -> str: ...


class PlanOf(Protocol):
    """Runs of a study and those to be run now."""

    @property
    def study(self) -> Described: ...

    @property
    def hash(self) -> str: ...

    @property
    def chosen(self) -> tuple[Named, ...]: ...


AnyPlan = TypeVar("AnyPlan", bound=PlanOf)


class StudyDirectory(abc.ABC, Generic[AnyPlan]):
    """Study in the directory `path`. It holds no state that is not in the files of its runs."""

    def __init__(self, plan: AnyPlan, path: Path) -> None:
        self.plan = plan
        self.path = path

    @abc.abstractmethod
    def seconds_left(self) -> dict[str, float]:
        """Predicted seconds of each chosen run that is left, by its name."""

    @abc.abstractmethod
    def seconds_to_stop(self) -> float:
        """Seconds after which all runs that were stopped have ended."""

    @abc.abstractmethod
    def write(self) -> list[Path]:
        """Writes the results of what is done; returns the files. Raises UserError where that cannot be."""

    @abc.abstractmethod
    def _work_and_goal(self) -> tuple[Work[Any], Goal[Any]]:
        """Processes of the runs, and when one of them is done."""

    @contextlib.contextmanager
    def taken(self) -> Iterator[None]:
        """Holds the directory. Raises UserError for one of another study, or in use."""
        with contextlib.closing(ResultsDirectory(self.path, self.plan.hash, to_dict(self.plan.study))):
            yield

    def train(
        self, slots: Sequence[Slot], *, report: Callable[[str], None], must_stop: Callable[[], str | None]
    ) -> None:
        """Works off the chosen runs that are left. must_stop: why it is to end now; None: it goes on.

        Raises RunsStoppedError, and RunsFailedError once all others have ended.
        """
        callbacks = Callbacks(report=report, must_stop=must_stop, after_run=self.write)
        if failures := RunLoop(self.path, *self._work_and_goal(), callbacks).train(self.plan.chosen, slots):
            raise RunsFailedError("; ".join(failures))


def read_results(path: Path) -> dict[str, Any] | None:
    """{state, finding, minutes} of a directory of results; None where there are none. Raises RunFileError."""
    return read_object(path / RESULTS)
