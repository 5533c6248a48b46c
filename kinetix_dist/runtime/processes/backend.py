"""Calls from the controller to cores, wherever they are: `Handle.call` gives a `Future` of the answer.

Two backends: `local.LocalBackend` (the same process, no ray) and `ray_backend.RayBackend`. The rest of the runtime is
written once, against these protocols.

`BackgroundProcess` is one process that works while others do, one call at a time: the curator, the evaluator.
`Sections` says which section of the run waits for processes, and how long it may. There is one object for the whole
driver: the controller opens a section, the backend looks at its deadline while it waits.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Protocol

from kinetix_dist.config import TrainConfig
from kinetix_dist.runtime.processes.failures import Loss, Losses, WorkerLostError, silent
from kinetix_dist.runtime.processes.placement import ProcessPlan


class Future(Protocol):
    """An answer that may not be there yet. As an argument of a call it stands for the answer and is not copied."""

    def fetch(self) -> Any:
        """The answer; waits for it. Raises as `Backend.gather` does."""

    def fetch_in_thread(self) -> Any:
        """The same for other threads than that of the run: the process is not watched meanwhile, and a loss
        raises an error of the backend's own."""

    def is_ready(self) -> bool: ...


def resolve(weights: Any) -> Any:
    """Weights themselves, fetched first where they are a reference into the object store."""
    fetch = getattr(weights, "fetch", None)
    return fetch() if callable(fetch) else weights


class Handle(Protocol):
    """A core in some process."""

    plan: ProcessPlan

    def call(self, method: str, *arguments: Any) -> Future:
        """Calls `core.method(*arguments)`; calls of one handle are done in order."""

    def call_with_header(self, method: str, *arguments: Any) -> tuple[Future, Future]:
        """The same for a method that returns (header, content): the small header can be fetched without the content.

        The header, a dictionary, also gets "put": bytes of the content and seconds that storing it took.
        """

    def call_in_background(self, method: str, *arguments: Any) -> Future:
        """The same while another call runs; calls of this kind are done in order.

        A future as an argument stays one: the method fetches it. Its answer has to be there already.
        """


@dataclasses.dataclass(frozen=True)
class Group:
    """Processes of one role: a core `build(plan.index, number of plans, *arguments)` for each plan."""

    plans: Sequence[ProcessPlan]
    build: Callable[..., Any]
    arguments: tuple[Any, ...] = ()


class Backend(Protocol):
    """Starts processes and ends them."""

    sections: Sections  # which section of the run waits for processes, and how long it may
    losses: Losses  # of processes so far
    works_in_background: bool  # a call runs while others run, and the driver goes on

    def spawn(self, plans: Sequence[ProcessPlan], build: Callable[..., Any], *arguments: Any) -> list[Handle]:
        """One core a plan, as `Group` says; several that join a group form one JAX world, by rank."""

    def spawn_groups(self, groups: Sequence[Group]) -> list[list[Handle]]:
        """The same for several groups at the same time: no process waits for one that it does not join."""

    def spawn_in_background(self, plan: ProcessPlan, build: Callable[..., Any], *arguments: Any) -> Handle:
        """The same for one process, without waiting for it: calls are made once it has started."""

    def watch(self, handle: Handle, future: Future) -> float:
        """s for which the process of a handle has not answered a ping; 0 where it is well, or the answer is there.

        Raises as `gather` does where the answer is a loss or a failure. Does not wait.
        """

    @property
    def has_lost_resources(self) -> bool:
        """Says whether nodes were lost without which the processes of the run do not fit; the resources return with
        them."""
        ...

    def put(self, value: Any) -> Future:
        """A value that many calls are given, stored once."""

    def gather(self, futures: Sequence[Future]) -> list[Any]:
        """All answers. Raises WorkerLostError as soon as a process is lost, ProcessFailedError as soon as one fails."""

    def first_ready(self, futures: Sequence[Future], *, watched: Sequence[Handle] = ()) -> list[Future]:
        """Futures that are answered or lost: waits until there is one at least.

        Raises WorkerLostError where a process is silent for too long or the limit of the section is exceeded, and where
        one of `watched` is lost.
        """

    def check(self, handles: Sequence[Handle]) -> None:
        """Raises WorkerLostError where one of them is lost. Does not wait; a death is noticed within five seconds."""

    def check_limit(self, handles: Sequence[Handle]) -> None:
        """Raises WorkerLostError where these, who are waited for, exceed the limit of the section."""

    def facts(self, handles: Sequence[Handle]) -> list[dict[str, Any]]:
        """Facts of each process for the report: "process", "pid", "host", "device", on a GPU "gpu" and "memory_mib"."""

    def measures(self) -> dict[str, float]:
        """Metrics of all processes: idle shares, memory, what was compiled and moved. Does not wait."""

    def processes(self) -> list[dict[str, Any]]:
        """Rows of processes.jsonl, one a process, as old as `measures`."""

    def kill(self, handles: Sequence[Handle]) -> None:
        """Ends processes and returns when they are gone."""

    def stop(self) -> None: ...


class BackgroundProcess:
    """Process that works in the background, one call at a time. It starts with the first request."""

    def __init__(self, config: TrainConfig, backend: Backend, plan: ProcessPlan) -> None:
        self._config = config
        self._backend = backend
        self._plan = plan
        self._handle: Handle | None = None
        self._call: tuple[Future, Future] | None = None  # what the process is at: its seconds, what it gives
        self._losses: list[Loss] = []  # since something was taken

    def place(self, plans: Sequence[ProcessPlan]) -> None:
        """Another process from the next request on; the one there is has been stopped."""
        (self._plan,) = plans

    def stop(self) -> None:
        if self._handle is not None:
            self._backend.kill([self._handle])
        self._handle = self._call = None

    def _started(self, build: Callable[..., Any]) -> Handle:
        if self._handle is None:
            self._handle = self._backend.spawn_in_background(self._plan, build, self._config)
        return self._handle

    def _silence(self, *, is_waited_for: bool) -> float:
        """s for which it has not answered. Raises WorkerLostError where that, or what it is at, takes too long."""
        assert self._handle is not None and self._call is not None
        seconds = self._backend.watch(self._handle, self._call[0])
        if seconds > self._config.run.heartbeat_seconds:
            raise silent(self._plan.name, seconds)
        if is_waited_for:
            self._backend.check_limit([self._handle])
        return seconds

    def _note_recovery(self) -> None:
        """Something was taken from it."""
        for loss in self._losses:
            self._backend.losses.recovered(loss, update=self._backend.losses.update)
        self._losses = []


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
        self._last_deadline = _FOREVER  # however long a process compiles
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
        """Limits of the section that runs now, in words."""
        words = f"the {self.limit_s:g} s of run.limits.{self.name}"
        if self._last_deadline > self.since + self.limit_s:  # a pass that may compile
            words += f" and the {self.limits['compile']:g} s of run.limits.compile"
        return words

    def extend(self) -> bool:
        """Restarts the limit where a process compiles, at a first pass. False where that took too long already."""
        self._deadline = min(time.monotonic() + self.limits.get(self.name, _FOREVER), self._last_deadline)
        return not self.is_overdue

    def begin_again(self) -> None:
        """A process was replaced in the middle of a section: the new one has all of the time, and compiles."""
        self._begin(is_compiled=False)

    def reset(self) -> None:
        """All processes are started afresh: what they do first, they compile."""
        self._compiled.clear()

    def _begin(self, *, is_compiled: bool) -> None:
        self.since, self.limit_s = time.monotonic(), self.limits.get(self.name, _FOREVER)
        self._deadline = self._last_deadline = self.since + self.limit_s
        if self.name in _COMPILING and not is_compiled:
            self._last_deadline += self.limits.get("compile", 0.0)
