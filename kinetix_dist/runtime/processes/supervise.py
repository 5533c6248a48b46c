"""Supervision of Ray actors: whether processes are alive, and making sure that dead ones are gone.

A process counts as lost when Ray says that it died, when it has not answered a ping for `heartbeat_seconds` (a stopped
process does not exit), or when the section of the run that waits for it exceeds its limit (a call that never returns,
while pings are answered). The remedy is always the same: kill the whole group, see that every process is gone, start
afresh from a checkpoint.

`Readings` are requested of all actors after every update and never waited for.
"""

from __future__ import annotations

import re
import time
from collections.abc import Sequence
from typing import Any

import psutil
import ray

from kinetix_dist.models.kernels.support import KernelError
from kinetix_dist.runtime.processes.backend import Sections
from kinetix_dist.runtime.processes.failures import InputLostError, ProcessFailedError, WorkerLostError, silent
from kinetix_dist.runtime.processes.measures import Meter, Reading, description, summary
from kinetix_dist.runtime.processes.watchdog import is_alive

POLL_S = 1.0
PING_EVERY_S = 5.0
DOING_TIMEOUT_S = 2.0  # for processes of an overdue section to say what they are at
CAUSE_GRACE_S = 3.0  # for the process that died or failed to be noticed, after another has lost it
FAILURE_GRACE_S = 0.5  # for a failure to be noticed, after another process died
GONE_TIMEOUT_S = 30.0  # for the kernel to end a killed process, GPU memory included


class Supervisor:
    """Waits for answers of processes and watches over them meanwhile."""

    def __init__(self, heartbeat_seconds: float, sections: Sections) -> None:
        self._limit_s = heartbeat_seconds
        self._sections = sections
        self._names: dict[Any, str] = {}  # of actors
        self._pings: dict[Any, tuple[Any, float]] = {}  # actor -> (reference to its answer, when it was requested)

    def add(self, actor: Any, name: str) -> None:
        self._names[actor] = name

    @property
    def num_watched(self) -> int:
        """Processes that were started and not forgotten."""
        return len(self._names)

    def remove(self, actors: Sequence[Any]) -> None:
        for actor in actors:
            self._pings.pop(actor, None)
            self._names.pop(actor, None)

    def gather(self, calls: Sequence[tuple[Any, Any]]) -> list[Any]:
        """Results of (reference, actor or None for what no actor works out), in order.

        Raises WorkerLostError as soon as a process died, has been silent for too long or exceeds the limit of the
        section, and ProcessFailedError as soon as one failed at its work.
        """
        actor_of = dict(calls)
        results: dict[Any, Any] = {}
        waiting = list(actor_of)
        while waiting:
            ready, waiting = ray.wait(waiting, num_returns=len(waiting), timeout=POLL_S)
            for reference in ready:
                try:  # a loss shows at once, while the rest of the group may hang in a collective
                    results[reference] = self._result(reference, actor_of[reference])
                except WorkerLostError as error:
                    others = {other: actor for other, actor in actor_of.items() if other not in (reference, *results)}
                    raise self._cause(error, others) from error.__cause__
            if waiting:
                self._check([actor_of[reference] for reference in waiting])
        return [results[reference] for reference, _ in calls]

    def first_ready(self, calls: Sequence[tuple[Any, Any]], *, watched: Sequence[Any] = ()) -> list[Any]:
        """References of those (reference, actor) whose result or loss is there: waits until it is one at least.

        Raises WorkerLostError where an actor has been silent for too long or the limit of the section is exceeded,
        and where one of `watched`, of whom nothing is waited for, is lost.
        """
        references = [reference for reference, _ in calls]
        while not ray.wait(references, num_returns=1, timeout=POLL_S)[0]:
            self.check_alive(watched)
            self._check([actor for _, actor in calls])
        return ray.wait(references, num_returns=len(references), timeout=0)[0]

    def silence(self, actor: Any, *, ping_every_s: float = PING_EVERY_S) -> float:
        """s for which a ping has not been answered; 0 where all are. Asks again when that is due.

        Raises WorkerLostError where the answer is that the actor died.
        """
        now = time.monotonic()
        if actor not in self._pings:
            self._pings[actor] = (actor.ping.remote(), now)
            return 0.0
        answer, requested_at = self._pings[actor]
        if not ray.wait([answer], timeout=0)[0]:
            return now - requested_at
        self._result(answer, actor)
        if now - requested_at >= ping_every_s:
            self._pings[actor] = (actor.ping.remote(), now)
        return 0.0

    def check_alive(self, actors: Sequence[Any]) -> None:
        """Raises WorkerLostError where one of them died, or has been silent for too long. Does not wait."""
        for actor in actors:
            if (silence := self.silence(actor)) > self._limit_s:
                raise silent(self._name(actor), silence)

    def _check(self, actors: Sequence[Any]) -> None:
        actors = [actor for actor in dict.fromkeys(actors) if actor is not None]
        self.check_alive(actors)
        self.check_limit(actors)

    def check_limit(self, actors: Sequence[Any]) -> None:
        """Raises WorkerLostError where these, who are waited for, exceed the limit of the section and do not compile.

        Names the processes to blame: those that do not answer, else those that do other than wait.
        """
        if not self._sections.is_overdue:
            return
        calls = {actor.doing.remote(): actor for actor in actors}
        ready, silent = ray.wait(list(calls), num_returns=len(calls), timeout=DOING_TIMEOUT_S) if calls else ([], [])
        to_blame = {calls[reference]: "does not answer" for reference in silent}
        said = {calls[reference]: self._result(reference, calls[reference]) for reference in ready}
        if any(doing.is_compiling for doing in said.values()) and self._sections.extend():
            return
        if not to_blame:
            to_blame = {actor: doing.what for actor, doing in said.items() if not doing.is_waiting}
        to_blame = to_blame or {actor: doing.what for actor, doing in said.items()}
        culprits = "; ".join(f"{self._name(actor)} {what}" for actor, what in to_blame.items())
        section = self._sections
        raise WorkerLostError(
            f"not done within {section.limits_in_words}: {culprits or 'no process waits'}",
            process=self._name(next(iter(to_blame), None)),
            since=section.since,
        )

    def _result(self, reference: Any, actor: Any) -> Any:
        name = self._name(actor)
        try:
            return ray.get(reference)
        except ray.exceptions.RayActorError as error:
            now = time.monotonic()
            if isinstance(error, ray.exceptions.RayTaskError):  # of one whose answer was an argument of this call
                lost = self._name_of_id(error.cause.actor_id)
                raise InputLostError(f"{lost} died before {name} had its answer", process=lost, since=now) from error
            raise WorkerLostError(f"{name} died{_exit_of(error)}", process=name, since=now) from error
        except ray.exceptions.ObjectLostError as error:
            raise WorkerLostError(f"what {name} answered was lost with its node", process=name) from error
        except ray.exceptions.RayTaskError as error:
            failure = error.cause
            if isinstance(failure, KernelError):  # of the configuration, as in one process
                raise failure from None
            if not isinstance(failure, ProcessFailedError):  # before its own methods were reached
                raise ProcessFailedError(name, f"failed: {type(failure).__name__}: {failure}", str(error)) from None
            if failure.is_loss_of_group:
                raise _GroupLostError(f"{name} lost its group in a collective", process=name) from None
            if failure.is_taken_port:
                text = f"{name} found the port of its group taken by another program"
                raise WorkerLostError(text, process=name) from None
            raise failure from None

    def _cause(self, error: WorkerLostError, others: dict[Any, Any]) -> Exception:
        """Cause of a loss in a group: a process that dies takes its group along, and another may be noticed first."""
        began = time.monotonic()
        grace = CAUSE_GRACE_S if isinstance(error, _GroupLostError) else FAILURE_GRACE_S
        found: Exception = error
        while others and (left := began + grace - time.monotonic()) > 0:
            ready, _ = ray.wait(list(others), num_returns=1, timeout=left)
            for reference in ready:
                try:
                    self._result(reference, others.pop(reference))
                except ProcessFailedError as failure:
                    return failure
                except WorkerLostError as loss:
                    if isinstance(found, _GroupLostError):
                        found = loss
                    if not isinstance(loss, _GroupLostError):
                        grace = min(grace, time.monotonic() - began + FAILURE_GRACE_S)
        return found

    def _name_of_id(self, actor_id: str) -> str:
        return next((name for actor, name in self._names.items() if actor._ray_actor_id.hex() == actor_id), "a process")

    def _name(self, actor: Any) -> str:
        return self._names.get(actor, "a process")


class _GroupLostError(WorkerLostError):
    """A process that is well, and lost another one of its group."""


def wait_until_gone(processes: Sequence[psutil.Process]) -> list[int]:
    """Polls until the processes have ended (a zombie holds no memory and no GPU); the pids of those that have not in
    time."""
    deadline = time.monotonic() + GONE_TIMEOUT_S
    left = list(processes)
    while left and time.monotonic() < deadline:
        left = [process for process in left if is_alive(process)]
        time.sleep(0.05 if left else 0.0)
    return [process.pid for process in left]


def _exit_of(error: Exception) -> str:
    """Reason of the end of a process as Ray knows it, in a few words: its texts are advice for the most part."""
    found = re.search(r"exit detail: (.+?)(?:\. |$)", " ".join(str(error).split()))
    return f" ({found[1][:100]})" if found else ""


class Readings:
    """Readings of all actors of a backend, and of the driver itself. They are as old as one update."""

    def __init__(self) -> None:
        self._driver = Meter("driver", "driver")
        self._requested: dict[Any, Any] = {}  # actor -> reference to its next reading, or None
        self._requested_at: dict[Any, float] = {}  # actor -> s of time.monotonic() here
        # Actor -> the one before, the last one, when that was requested.
        self._last: dict[Any, tuple[Reading | None, Reading, float]] = {}

    def add(self, actor: Any) -> None:
        self._requested[actor] = None

    def remove(self, actors: Sequence[Any]) -> None:
        for actor in actors:
            for known in (self._requested, self._requested_at, self._last):
                known.pop(actor, None)

    def metrics(self) -> dict[str, float]:
        """Metrics of what has been answered so far; requests the next of those that have answered."""
        for actor, reference in self._requested.items():
            if reference is not None and not ray.wait([reference], timeout=0)[0]:
                continue
            if reference is not None:
                self._take(actor, reference)
            self._requested[actor], self._requested_at[actor] = actor.read.remote(), time.monotonic()
        driver = self._driver.read(has_device=False)
        found = summary([*((before, last) for before, last, _ in self._last.values()), (None, driver)])
        del found["runtime/moved_mib_driver"]  # it passes references on
        return found

    def processes(self) -> list[dict[str, Any]]:
        """Last answer of each process, and the driver now, as `measures.description` gives them."""
        now = time.monotonic()
        found = [
            description(before, last, age_seconds=now - requested_at)
            for before, last, requested_at in self._last.values()
        ]
        return [*found, description(None, self._driver.read(has_device=False), age_seconds=0.0)]

    def _take(self, actor: Any, reference: Any) -> None:
        try:
            reading = ray.get(reference)
        except ray.exceptions.RayError:  # it is lost: the call that waits for its work reports that
            self._last.pop(actor, None)
            return
        before = self._last.get(actor)
        self._last[actor] = (before[1] if before else None, reading, self._requested_at[actor])
