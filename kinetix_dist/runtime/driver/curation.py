"""The controller's side of the curator: asks for refreshes, takes them, replaces a curator that was lost.

A refresh that was lost with its curator is asked for again with the same weights and key and gives the identical
answer, later. Training waits for a curator that is at work, and not for one that died or is silent.
"""

from __future__ import annotations

import time
from typing import Any

from kinetix_dist.config import TrainConfig
from kinetix_dist.runtime.cores.build import build_curator
from kinetix_dist.runtime.driver.roles import Refresh
from kinetix_dist.runtime.driver.weight_sync import resolve
from kinetix_dist.runtime.processes.backend import Backend, Handle, Ticket
from kinetix_dist.runtime.processes.failures import WorkerLostError
from kinetix_dist.runtime.processes.local import LocalBackend
from kinetix_dist.runtime.processes.losses import Loss
from kinetix_dist.runtime.processes.placement import ProcessPlan

POLL_S = 0.02


class CuratorClient:
    """A `roles.Curator`. Its process starts with the first request."""

    def __init__(self, config: TrainConfig, backend: Backend, plan: ProcessPlan) -> None:
        self._config = config
        self._backend = backend
        self._plan = plan
        self._handle: Handle | None = None
        self._asked: tuple[Ticket, int] | None = None  # weights, version of the refresh in flight
        self._answer: tuple[Ticket, Ticket] | None = None  # its seconds, what it worked out
        self._loss: Loss | None = None  # the first one since there was an answer
        self._is_late = False  # it was lost or waited for in vain, and has not answered since

    def request(self, weights: Any, policy_version: int) -> None:
        stored = weights if hasattr(weights, "fetch") else self._backend.put(weights)
        self._asked = (stored, policy_version)
        self._ask()

    def watch(self) -> None:
        if self._answer is not None:
            self._look()

    def take(self, *, patience_s: float | None) -> Refresh | None:
        while self._answer is not None:
            if (silence := self._look()) is not None and self._answer[0].is_ready():
                return self._taken()
            must_wait = patience_s is None
            if not must_wait and (self._is_late or silence is None or silence > patience_s):
                self._is_late = True
                return None
            time.sleep(POLL_S)
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

    def _look(self) -> float | None:
        """For how long (s) the curator has been silent; None where it is lost, and replaced by now."""
        assert self._handle is not None and self._answer is not None
        try:
            silence = self._backend.watch(self._handle, self._answer[0])
            if silence > self._config.run.heartbeat_seconds:
                raise WorkerLostError(
                    f"{self._plan.name} has not answered for {silence:.0f} s", since=time.monotonic() - silence
                )
            if self._backend.sections.is_overdue:
                limit_s = self._backend.sections.limit_s
                raise WorkerLostError(f"{self._plan.name} is not done within the {limit_s:g} s of run.limits.curate")
        except WorkerLostError as error:
            self._replace(error)
            return None
        return silence

    def _taken(self) -> Refresh:
        assert self._answer is not None
        stamp, refreshed = self._answer
        seconds = self._backend.gather([stamp])[0]["seconds"]
        self._answer = self._asked = None
        self._is_late = False
        if self._loss is not None:
            self._backend.losses.recovered(self._loss, update=self._backend.losses.update)
            self._loss = None
        return Refresh(refreshed=refreshed, seconds=seconds)

    def _ask(self) -> None:
        assert self._asked is not None
        if self._handle is None:
            self._handle = self._backend.spawn_beside(self._plan, build_curator, self._config)
        weights, policy_version = self._asked
        self._answer = self._handle.call_stamped("refresh", weights, policy_version)

    def _replace(self, error: WorkerLostError) -> None:
        """Starts another process and asks again, without waiting for either."""
        error.process, error.section = self._plan.name, "curate"
        loss = self._backend.losses.lost(error)
        self._loss = self._loss or loss
        self._is_late = True
        self.stop()
        assert self._asked is not None
        weights, policy_version = self._asked
        self._asked = (self._backend.put(resolve(weights)), policy_version)  # its first copy may be gone
        self._backend.sections.begin_again()
        self._ask()
