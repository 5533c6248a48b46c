"""Which section of a run waits for other processes, and how long it may take.

One object for the whole driver: who drives the run opens a section, who waits for an answer looks at its deadline.
"""

from __future__ import annotations

import math
import time
from collections.abc import Generator, Mapping
from contextlib import contextmanager

from kinetix_dist.runtime.processes.failures import WorkerLostError

# Sections whose first pass after a start compiles. What is started is not compiled yet.
_COMPILING = ("update", "curate", "evaluate", "record")
_FOREVER = math.inf


class Sections:
    """The section that runs now. Without limits (local mode) nothing is ever overdue."""

    def __init__(self) -> None:
        # s, by section; in the first pass after a start those who compile have "compile" more
        self.limits: Mapping[str, float] = {}
        self.name = ""
        self.limit_s = _FOREVER
        self.since = 0.0  # time.monotonic() of its beginning
        self._deadline = _FOREVER
        self._last_deadline = _FOREVER  # however long somebody compiles
        self._compiled: set[str] = set()

    @contextmanager
    def section(self, name: str) -> Generator[None]:
        """Everything inside has the limit of this section; a loss inside carries its name."""
        before = self.name, self.limit_s, self.since, self._deadline, self._last_deadline
        self.name = name
        self._begin(is_compiled=name in self._compiled)
        try:
            yield
            self._compiled.add(name)
        except WorkerLostError as error:
            error.section = error.section or name
            raise
        finally:
            self.name, self.limit_s, self.since, self._deadline, self._last_deadline = before

    @property
    def is_overdue(self) -> bool:
        return time.monotonic() > self._deadline

    @property
    def limits_in_words(self) -> str:
        """Which the section that runs now has."""
        words = f"the {self.limit_s:g} s of run.limits.{self.name}"
        if self._last_deadline > self.since + self.limit_s:  # a pass that may compile
            words += f" and the {self.limits['compile']:g} s of run.limits.compile"
        return words

    def extend(self) -> bool:
        """Somebody compiles, at a first pass: the limit counts from now. False where that took too long already."""
        self._deadline = min(time.monotonic() + self.limits.get(self.name, _FOREVER), self._last_deadline)
        return not self.is_overdue

    def begin_again(self) -> None:
        """A process was replaced in the middle of a section: the new one has all of the time, and compiles."""
        self._begin(is_compiled=False)

    def forget(self) -> None:
        """All processes are started afresh: what they do first, they compile."""
        self._compiled.clear()

    def _begin(self, *, is_compiled: bool) -> None:
        self.since, self.limit_s = time.monotonic(), self.limits.get(self.name, _FOREVER)
        self._deadline = self._last_deadline = self.since + self.limit_s
        if self.name in _COMPILING and not is_compiled:
            self._last_deadline += self.limits.get("compile", 0.0)
