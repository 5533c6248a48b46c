"""Local mode: the same cores and the same controller in one process, without Ray."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Any

from kinetix_dist.runtime.processes.backend import Backend, OtherCore, Sections
from kinetix_dist.runtime.processes.calls import Call, Core, Future, Group, Handle, T, T_co, Ts, resolve
from kinetix_dist.runtime.processes.failures import Losses
from kinetix_dist.runtime.processes.measures import Meter, Reading, description, facts_of, summary
from kinetix_dist.runtime.processes.placement import ProcessPlan


@dataclasses.dataclass(frozen=True)
class LocalFuture(Future[T_co]):
    """An answer, ready from the start."""

    value: T_co

    def fetch(self) -> T_co:
        return self.value

    def fetch_in_thread(self) -> T_co:
        return self.value

    def is_ready(self) -> bool:
        return True


class LocalHandle(Handle[Core]):
    """A core in this process. A call runs at once, before `call` returns."""

    def __init__(self, plan: ProcessPlan, core: Core) -> None:
        self.plan = plan
        self.core = core

    def _call(self, call: Call) -> LocalFuture[Any]:
        return LocalFuture(call.with_each(resolve).on(self.core))

    def _call_with_header(self, call: Call) -> tuple[LocalFuture[dict[str, Any]], LocalFuture[Any]]:
        header, content = call.with_each(resolve).on(self.core)
        return LocalFuture({**header, "put": (0, 0.0)}), LocalFuture(content)

    def _call_in_background(self, call: Call) -> LocalFuture[Any]:
        return LocalFuture(call.on(self.core))


class LocalBackend(Backend):
    """Cores share this process and its devices."""

    has_lost_resources = False
    works_in_background = False

    def __init__(self) -> None:
        self.sections = Sections()
        self.losses = Losses()
        self._meter = Meter("driver", "driver")
        self._reading: Reading | None = None

    def spawn(
        self, plans: Sequence[ProcessPlan], build: Callable[[int, int, *Ts], Core], *arguments: *Ts
    ) -> list[LocalHandle[Core]]:
        return [LocalHandle(plan, build(plan.index, 1, *arguments)) for plan in plans]

    def spawn_both(
        self, first: Group[Core], second: Group[OtherCore]
    ) -> tuple[list[LocalHandle[Core]], list[LocalHandle[OtherCore]]]:
        return (
            self.spawn(first.plans, first.build, *first.arguments),
            self.spawn(second.plans, second.build, *second.arguments),
        )

    def spawn_in_background(
        self, plan: ProcessPlan, build: Callable[[int, int, *Ts], Core], *arguments: *Ts
    ) -> LocalHandle[Core]:
        return self.spawn([plan], build, *arguments)[0]

    def check(self, handles: Sequence[Handle[Any]]) -> None:
        del handles

    def check_limit(self, handles: Sequence[Handle[Any]]) -> None:
        del handles

    def watch(self, handle: Handle[Any], future: Future[Any]) -> float:
        del handle, future
        return 0.0

    def put(self, value: T) -> LocalFuture[T]:
        return LocalFuture(value)

    def gather(self, futures: Sequence[Future[T]]) -> list[T]:
        return [future.fetch() for future in futures]

    def first_ready(self, futures: Sequence[Future[Any]], *, watched: Sequence[Handle[Any]] = ()) -> list[Future[Any]]:
        del watched
        return list(futures)

    def facts(self, handles: Sequence[Handle[Any]]) -> list[dict[str, Any]]:
        """Facts of this process, once: all of its cores share it."""
        return [facts_of("local", None)] if handles else []

    def measures(self) -> dict[str, float]:
        """Measures of this process. `time/idle` says how busy it is; nothing is moved between processes."""
        self._reading = self._meter.read(has_device=True)
        found = summary([(None, self._reading)])
        return {name: value for name, value in found.items() if not name.startswith("runtime/moved_mib")}

    def processes(self) -> list[dict[str, Any]]:
        reading = self._reading or self._meter.read(has_device=True)
        return [description(None, reading, age_seconds=time.monotonic() - reading.at)]

    def kill(self, handles: Sequence[Handle[Any]]) -> None:
        del handles

    def stop(self) -> None:
        pass
