"""Backends: start processes, call their cores, watch the processes and end them.

`local.LocalBackend` keeps all cores in this process, without Ray; `ray_backend.RayBackend` puts each into an actor. The
rest of the runtime uses only this interface and that of `calls.py`.

`BackgroundProcess` is a process that works while others do, on one call at a time: the curator, the evaluator.
`Sections` knows which section of the run waits for processes, and its time limit. The driver has a single object: the
controller opens sections, and the backend checks the deadline while it waits.
"""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Generic, TypeVar

from kinetix_dist.config import TrainConfig
from kinetix_dist.runtime.processes.calls import Core, Future, Group, Handle, T, Ts
from kinetix_dist.runtime.processes.failures import Loss, Losses, WorkerLostError, silent
from kinetix_dist.runtime.processes.placement import ProcessPlan

OtherCore = TypeVar("OtherCore")


class Backend(ABC):
    """Starts processes, watches them and ends them."""

    sections: Sections  # the section of the run that waits for processes, and its limit
    losses: Losses  # of processes so far
    works_in_background: bool  # calls of several processes run at the same time, and while the driver continues

    @abstractmethod
    def spawn(
        self, plans: Sequence[ProcessPlan], build: Callable[[int, int, *Ts], Core], *arguments: *Ts
    ) -> Sequence[Handle[Core]]:
        """Start a process for each plan, as `Group` describes it. Plans that join a group form a JAX world, by rank."""

    @abstractmethod
    def spawn_both(
        self, first: Group[Core], second: Group[OtherCore]
    ) -> tuple[Sequence[Handle[Core]], Sequence[Handle[OtherCore]]]:
        """Start two groups at the same time: a process waits only for processes that it joins."""

    @abstractmethod
    def spawn_in_background(
        self, plan: ProcessPlan, build: Callable[[int, int, *Ts], Core], *arguments: *Ts
    ) -> Handle[Core]:
        """Start a process without waiting for it; it answers calls once it has started."""

    @abstractmethod
    def watch(self, handle: Handle[Any], future: Future[Any]) -> float:
        """Return the seconds since a process last answered a ping; 0 if it is well, or if the future is ready.

        Does not wait. If the answer is a loss or a failure, raises as `gather` does.
        """

    @property
    @abstractmethod
    def has_lost_resources(self) -> bool:
        """True while nodes are missing without which the processes of the run do not fit."""

    @abstractmethod
    def put(self, value: T) -> Future[T]:
        """Store a value once, as an argument of many calls."""

    @abstractmethod
    def gather(self, futures: Sequence[Future[T]]) -> list[T]:
        """Wait for all answers.

        Raises:
            WorkerLostError: as soon as a process is lost.
            ProcessFailedError: as soon as a process fails.
        """

    @abstractmethod
    def first_ready(self, futures: Sequence[Future[Any]], *, watched: Sequence[Handle[Any]] = ()) -> list[Future[Any]]:
        """Wait until at least one future is answered or lost, and return all such futures.

        Raises:
            WorkerLostError: if a process is silent for too long, the section exceeds its limit, or one of `watched` is
                lost.
        """

    @abstractmethod
    def check(self, handles: Sequence[Handle[Any]]) -> None:
        """Raise WorkerLostError if a process is lost. Does not wait; a death is noticed within five seconds."""

    @abstractmethod
    def check_limit(self, handles: Sequence[Handle[Any]]) -> None:
        """Raise WorkerLostError if the processes, which the driver waits for, exceed the limit of the section."""

    @abstractmethod
    def facts(self, handles: Sequence[Handle[Any]]) -> list[dict[str, Any]]:
        """Return facts of each process for the report: "process", "pid", "host", "device", on a GPU "gpu" and
        "memory_mib"."""

    @abstractmethod
    def measures(self) -> dict[str, float]:
        """Return metrics of all processes: idle times, memory, compilations and transfers. Does not wait."""

    @abstractmethod
    def processes(self) -> list[dict[str, Any]]:
        """Return a row of processes.jsonl for each process, of the same age as `measures`."""

    @abstractmethod
    def kill(self, handles: Sequence[Handle[Any]]) -> None:
        """End processes, and return when they are gone."""

    @abstractmethod
    def stop(self) -> None: ...


class BackgroundProcess(Generic[Core]):
    """Process that works in the background, on one call at a time. It starts with the first request."""

    def __init__(self, config: TrainConfig, backend: Backend, plan: ProcessPlan) -> None:
        self._config = config
        self._backend = backend
        self._plan = plan
        self._handle: Handle[Core] | None = None
        self._call: tuple[Future[dict[str, Any]], Future[Any]] | None = None  # current call: its header and content
        self._losses: list[Loss] = []  # since the last answer

    def place(self, plans: Sequence[ProcessPlan]) -> None:
        """Use another process from the next request on; the current process has been stopped."""
        (self._plan,) = plans

    def stop(self) -> None:
        if self._handle is not None:
            self._backend.kill([self._handle])
        self._handle = self._call = None

    def _started(self, build: Callable[[int, int, TrainConfig], Core]) -> Handle[Core]:
        if self._handle is None:
            self._handle = self._backend.spawn_in_background(self._plan, build, self._config)
        return self._handle

    def _silence(self, *, is_waited_for: bool) -> float:
        """Return the seconds since its last sign of life. Raises WorkerLostError if they, or the call, exceed their
        limit."""
        assert self._handle is not None and self._call is not None
        seconds = self._backend.watch(self._handle, self._call[0])
        if seconds > self._config.run.heartbeat_seconds:
            raise silent(self._plan.name, seconds)
        if is_waited_for:
            self._backend.check_limit([self._handle])
        return seconds

    def _note_recovery(self) -> None:
        """Note that an answer has come, so that its losses are over."""
        for loss in self._losses:
            self._backend.losses.recovered(loss, update=self._backend.losses.update)
        self._losses = []


# Sections that compile in their first pass after a start.
_COMPILING = ("update", "curate", "evaluate", "record")
_FOREVER = math.inf


class Sections:
    """The current section. Without limits (local mode) it is never overdue."""

    def __init__(self) -> None:
        # s, by section; the first pass of a section that compiles has "compile" more
        self.limits: Mapping[str, float] = {}
        self.name = ""
        self.limit_s = _FOREVER
        self.since = 0.0  # time.monotonic() of its beginning
        self._deadline = _FOREVER
        self._last_deadline = _FOREVER  # the limit cannot be extended beyond it
        self._compiled: set[str] = set()

    @contextmanager
    def section(self, name: str) -> Generator[None]:
        """Apply the limit of a section to the block inside; a loss inside carries the name of the section."""
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
        """The limits of the current section, in words."""
        words = f"the {self.limit_s:g} s of run.limits.{self.name}"
        if self._last_deadline > self.since + self.limit_s:  # a pass that may compile
            words += f" and the {self.limits['compile']:g} s of run.limits.compile"
        return words

    def extend(self) -> bool:
        """Restart the limit because a process compiles. Returns False if this first pass has taken too long already."""
        self._deadline = min(time.monotonic() + self.limits.get(self.name, _FOREVER), self._last_deadline)
        return not self.is_overdue

    def begin_again(self) -> None:
        """Restart the section: a replaced process has the whole time again, and compiles."""
        self._begin(is_compiled=False)

    def reset(self) -> None:
        """Note that all processes start again, so that the first pass of each section compiles."""
        self._compiled.clear()

    def _begin(self, *, is_compiled: bool) -> None:
        self.since, self.limit_s = time.monotonic(), self.limits.get(self.name, _FOREVER)
        self._deadline = self._last_deadline = self.since + self.limit_s
        if self.name in _COMPILING and not is_compiled:
            self._last_deadline += self.limits.get("compile", 0.0)
