"""Local mode: the same cores and the same controller in one process, without Ray."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Any

from kinetix_dist.runtime.processes.backend import Group, Sections
from kinetix_dist.runtime.processes.failures import Losses
from kinetix_dist.runtime.processes.measures import Meter, Reading, description, facts_of, summary
from kinetix_dist.runtime.processes.placement import ProcessPlan


@dataclasses.dataclass(frozen=True)
class LocalFuture:
    """An answer that is there already."""

    value: Any

    def fetch(self) -> Any:
        return self.value

    def fetch_in_thread(self) -> Any:
        return self.value

    def is_ready(self) -> bool:
        return True


class LocalHandle:
    """A core in this process: a call is done before it returns."""

    def __init__(self, plan: ProcessPlan, core: Any) -> None:
        self.plan = plan
        self._core = core

    def call(self, method: str, *arguments: Any) -> LocalFuture:
        values = [argument.value if isinstance(argument, LocalFuture) else argument for argument in arguments]
        return LocalFuture(getattr(self._core, method)(*values))

    def call_with_header(self, method: str, *arguments: Any) -> tuple[LocalFuture, LocalFuture]:
        header, content = self.call(method, *arguments).value
        return LocalFuture({**header, "put": (0, 0.0)}), LocalFuture(content)

    def call_in_background(self, method: str, *arguments: Any) -> LocalFuture:
        return LocalFuture(getattr(self._core, method)(*arguments))


class LocalBackend:
    """Cores share this process and its devices."""

    has_lost_resources = False
    works_in_background = False

    def __init__(self) -> None:
        self.sections = Sections()
        self.losses = Losses()
        self._meter = Meter("driver", "driver")
        self._reading: Reading | None = None

    def spawn(self, plans: Sequence[ProcessPlan], build: Callable[..., Any], *arguments: Any) -> list[LocalHandle]:
        return [LocalHandle(plan, build(plan.index, 1, *arguments)) for plan in plans]

    def spawn_groups(self, groups: Sequence[Group]) -> list[list[LocalHandle]]:
        return [self.spawn(group.plans, group.build, *group.arguments) for group in groups]

    def spawn_in_background(self, plan: ProcessPlan, build: Callable[..., Any], *arguments: Any) -> LocalHandle:
        return self.spawn([plan], build, *arguments)[0]

    def check(self, handles: Sequence[LocalHandle]) -> None:
        del handles

    def check_limit(self, handles: Sequence[LocalHandle]) -> None:
        del handles

    def watch(self, handle: LocalHandle, future: LocalFuture) -> float:
        del handle, future
        return 0.0

    def put(self, value: Any) -> LocalFuture:
        return LocalFuture(value)

    def gather(self, futures: Sequence[LocalFuture]) -> list[Any]:
        return [future.value for future in futures]

    def first_ready(self, futures: Sequence[LocalFuture], *, watched: Sequence[LocalHandle] = ()) -> list[LocalFuture]:
        del watched
        return list(futures)

    def facts(self, handles: Sequence[LocalHandle]) -> list[dict[str, Any]]:
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

    def kill(self, handles: Sequence[LocalHandle]) -> None:
        del handles

    def stop(self) -> None:
        pass
