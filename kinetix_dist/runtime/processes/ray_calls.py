"""Calls of cores in Ray actors: futures are references into the object store, handles hold an actor."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Sequence
from typing import Any

import psutil
import ray

from kinetix_dist.runtime.processes.actor import InStore
from kinetix_dist.runtime.processes.backend import Backend
from kinetix_dist.runtime.processes.calls import Call, Core, Future, Handle, T_co
from kinetix_dist.runtime.processes.placement import ProcessPlan


@dataclasses.dataclass(frozen=True)
class RayFuture(Future[T_co]):
    """A reference into the object store."""

    reference: Any
    actor: Any = None
    backend: Backend | None = None

    def fetch(self) -> T_co:
        if self.backend is None:
            return ray.get(self.reference)
        return self.backend.gather([self])[0]

    def fetch_in_thread(self) -> T_co:
        return ray.get(self.reference)

    def is_ready(self) -> bool:
        return bool(ray.wait([self.reference], timeout=0)[0])


class RayHandle(Handle[Core]):
    """A core in an actor."""

    def __init__(self, plan: ProcessPlan, actor: Any, backend: Backend) -> None:
        self.plan = plan
        self.actor = actor
        self.pid: int | None = None  # None while it starts
        self.process: psutil.Process | None = None  # the same process, if it is known and on this machine
        self.starting: list[Any] = []  # references to its first calls, if no call waits for them
        self._backend = backend

    def started_as(self, pid: int, *, is_here: bool) -> None:
        """Note the process id. is_here: the process is on this machine."""
        self.pid = pid
        if is_here:
            with contextlib.suppress(psutil.NoSuchProcess):  # it has ended already
                self.process = psutil.Process(pid)

    def _call(self, call: Call) -> RayFuture[Any]:
        return self._future(_send(self.actor.call, call.with_each(_reference_of)))

    def _call_with_header(self, call: Call) -> tuple[RayFuture[dict[str, Any]], RayFuture[Any]]:
        method = self.actor.call_with_header.options(num_returns=2)
        content, header = _send(method, call.with_each(_reference_of))
        return self._future(header), self._future(content)

    def _call_in_background(self, call: Call) -> RayFuture[Any]:
        return self._future(_send(self.actor.call_in_background, call.with_each(_in_store)))

    def _future(self, reference: Any) -> RayFuture[Any]:
        return RayFuture(reference, self.actor, self._backend)


def handle_of_ray(handle: Handle[Any]) -> RayHandle[Any]:
    if not isinstance(handle, RayHandle):
        raise TypeError(f"{type(handle).__name__} belongs to another backend")
    return handle


def future_of_ray(future: Future[Any]) -> RayFuture[Any]:
    if not isinstance(future, RayFuture):
        raise TypeError(f"{type(future).__name__} belongs to another backend")
    return future


def actors_of(handles: Sequence[Handle[Any]]) -> list[Any]:
    return [handle_of_ray(handle).actor for handle in handles]


def _send(method: Any, call: Call) -> Any:
    """Return the reference to the answer of an actor's method, or references if it has several."""
    return method.remote(call.method, *call.arguments, **call.named)


def _reference_of(argument: Any) -> Any:
    return argument.reference if isinstance(argument, RayFuture) else argument


def _in_store(argument: Any) -> Any:
    return InStore(argument.reference) if isinstance(argument, RayFuture) else argument
