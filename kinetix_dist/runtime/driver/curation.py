"""The controller's side of the curators: asks for refreshes and takes them.

Where the curriculum can join parts of a refresh, `run.num_curators` processes work one out each. Training waits for a
curator that is at work, and not for one that died or is silent.

consumes      weights of a version
produces      a buffer, or whatever else the curriculum adopts, in as many parts as there are curators
bound         one refresh at a time; of one that is given up nothing is kept
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

from kinetix_dist.config import TrainConfig
from kinetix_dist.runtime.driver.curator_process import CuratorProcess
from kinetix_dist.runtime.driver.roles import Refresh
from kinetix_dist.runtime.processes.backend import Backend, Ticket
from kinetix_dist.runtime.processes.placement import ProcessPlan

POLL_S = 0.02


class CuratorClient:
    """A `roles.Curator`."""

    def __init__(self, config: TrainConfig, backend: Backend, plans: Sequence[ProcessPlan]) -> None:
        self._config = config
        self._backend = backend
        self.place(plans)

    @property
    def works_beside(self) -> bool:
        return self._backend.works_beside

    def place(self, plans: Sequence[ProcessPlan]) -> None:
        self.processes = [
            CuratorProcess(self._config, self._backend, plan, part=part, num_parts=len(plans))
            for part, plan in enumerate(plans)
        ]
        self.cancel()

    def request(self, weights: Any, policy_version: int, probe: Any, given: Any) -> None:
        stored, given = self._stored(weights), None if given is None else self._stored(given)
        for process in self.processes:
            # The last one has no more batches to score than the others.
            process.request(stored, policy_version, probe if process is self.processes[-1] else None, given)
        self._missing, self._parts = set(self.processes), {}

    def _stored(self, content: Any) -> Ticket:
        return content if hasattr(content, "fetch") else self._backend.put(content)

    def watch(self) -> None:
        for process in self.processes:
            process.watch()

    def take(self, *, patience_s: float | None, meanwhile: Callable[[], None] = lambda: None) -> Refresh | None:
        while self._missing:
            meanwhile()
            for process in [*self._missing]:
                if part := process.poll(patience_s):
                    self._parts[process] = part
                    self._missing.remove(process)
            if patience_s is not None and any(process.is_late for process in self._missing):
                return None
            if self._missing:
                time.sleep(POLL_S)
        if not self._parts:
            return None
        parts, stamps = zip(*(self._parts[process] for process in self.processes), strict=True)
        self._parts = {}
        return Refresh.of(parts, stamps)

    def cancel(self) -> None:
        for process in self.processes:
            process.cancel()
        self._missing: set[CuratorProcess] = set()  # of what was asked for last, those that have not answered
        self._parts: dict[CuratorProcess, tuple[Ticket, dict[str, Any]]] = {}  # those that have: parts, stamps

    def facts(self) -> list[dict[str, Any]]:
        return [fact for process in self.processes for fact in process.facts()]

    def stop(self) -> None:
        for process in self.processes:
            process.stop()
