"""A process that works beside training, one call at a time: the curator, the evaluator."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from kinetix_dist.config import TrainConfig
from kinetix_dist.runtime.processes.backend import Backend, Handle, Ticket
from kinetix_dist.runtime.processes.failures import silent
from kinetix_dist.runtime.processes.losses import Loss
from kinetix_dist.runtime.processes.placement import ProcessPlan


class ProcessBeside:
    """It starts with the first request."""

    def __init__(self, config: TrainConfig, backend: Backend, plan: ProcessPlan) -> None:
        self._config = config
        self._backend = backend
        self._plan = plan
        self._handle: Handle | None = None
        self._call: tuple[Ticket, Ticket] | None = None  # what the process is at: its seconds, what it gives
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
            self._handle = self._backend.spawn_beside(self._plan, build, self._config)
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
