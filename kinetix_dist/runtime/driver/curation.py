"""The controller's side of the curator: asks for refreshes, takes them, replaces a curator that was lost.

A lost curator costs time only: the refresh is asked for again with the same weights and key and gives the identical
answer.
"""

from __future__ import annotations

from typing import Any

from kinetix_dist.config import TrainConfig
from kinetix_dist.runtime.cores.build import build_curator
from kinetix_dist.runtime.driver.roles import Refresh
from kinetix_dist.runtime.driver.weight_sync import resolve
from kinetix_dist.runtime.processes.backend import Backend, Handle, Ticket
from kinetix_dist.runtime.processes.failures import WorkerLostError
from kinetix_dist.runtime.processes.local import LocalBackend
from kinetix_dist.runtime.processes.placement import ProcessPlan


class CuratorClient:
    """A `roles.Curator`. Its process starts with the first request."""

    def __init__(self, config: TrainConfig, backend: Backend, plan: ProcessPlan) -> None:
        self._config = config
        self._backend = backend
        self._plan = plan
        self._handle: Handle | None = None
        self._asked: tuple[Ticket, int] | None = None  # weights, version of the refresh in flight
        self._answer: tuple[Ticket, Ticket] | None = None  # its seconds, what it worked out
        self.num_restarts = 0

    def request(self, weights: Any, policy_version: int) -> None:
        stored = weights if hasattr(weights, "fetch") else self._backend.put(weights)
        self._asked = (stored, policy_version)
        self._ask()

    def take(self) -> Refresh | None:
        """Waits for the refresh; after `run.max_restarts` losses gives up on it."""
        while self._answer is not None:
            try:
                stamp, refreshed = self._answer
                seconds = self._backend.gather([stamp])[0]["seconds"]
                self._answer = self._asked = None
                return Refresh(refreshed=refreshed, seconds=seconds)
            except WorkerLostError:
                self._replace()
        return None

    def cancel(self) -> None:
        self._asked = self._answer = None

    def facts(self) -> list[dict[str, Any]]:
        """Of its process; that it was lost is a fact too, since training does not depend on it."""
        if self._handle is None or isinstance(self._backend, LocalBackend):
            return []
        try:
            return self._backend.facts([self._handle])
        except WorkerLostError as error:
            return [{"process": self._plan.name, "lost": str(error)}]

    def stop(self) -> None:
        if self._handle is not None:
            self._backend.kill([self._handle])
        self._handle = None

    def _ask(self) -> None:
        assert self._asked is not None
        if self._handle is None:
            self._handle = self._backend.spawn([self._plan], build_curator, self._config)[0]
        weights, policy_version = self._asked
        self._answer = self._handle.call_stamped("refresh", weights, policy_version)

    def _replace(self) -> None:
        self.stop()
        self._answer = None
        self.num_restarts += 1
        if self.num_restarts <= self._config.run.max_restarts and self._asked is not None:
            weights, policy_version = self._asked
            self._asked = (self._backend.put(resolve(weights)), policy_version)  # its first copy may be gone
            self._ask()
