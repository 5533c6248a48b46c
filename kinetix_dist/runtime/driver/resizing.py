"""Number of workers (or rollout actors and learners) of a run: as many as requested, and fewer while nodes are lost.

consumes      nodes of the cluster
produces      a placement that they have resources for
waits for     a lost node, `run.node_wait_seconds`; then, where fewer than `run.min_workers` fit, for any
unblocked by  a node that comes, or a stop

A run of another size goes on from a checkpoint, and is not bit for bit the unbroken one.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Protocol

from kinetix_dist.config import TrainConfig
from kinetix_dist.runtime.driver.stopping import StopRequested, StopSignals
from kinetix_dist.runtime.processes.placement import (
    Placement,
    PlacementError,
    ProcessPlan,
    counted,
    needed_by,
    nodes_in_words,
    plan_placement,
)
from kinetix_dist.runtime.processes.ray_backend import RayBackend

POLL_S = 0.2
NOTE_AFTER_S = 3.0  # what ended processes held is free a little after their end


class _Trainer(Protocol):
    """The part of `roles.Trainer` that changes its size."""

    def stop(self) -> None: ...

    def place(self, placement: Placement) -> None: ...


class _InBackground(Protocol):
    """A role whose processes work in the background."""

    def stop(self) -> None: ...

    def place(self, plans: Sequence[ProcessPlan]) -> None: ...


class Resizing:
    """Resizing of a run on Ray. Where processes are lost and their nodes are not, it does nothing."""

    def __init__(
        self,
        config: TrainConfig,
        backend: RayBackend,
        placement: Placement,
        trainer: _Trainer,
        background: Mapping[str, _InBackground],
        *,
        on_event: Callable[..., None],
        on_note: Callable[[str], None],
    ) -> None:
        """placement: that of the run as it was requested. background: processes besides the trainer, by role."""
        self._backend = backend
        self._trainer = trainer
        self._background = background
        self._on_event = on_event
        self._on_note = on_note
        self._roles = ("rollout", "learner") if config.run.placement == "split" else ("worker",)
        # The request is fixed now: a cluster that has lost its GPUs is no reason to go on without them.
        device = "cpu" if placement.processes[0].gpu is None else "gpu"
        self._config = dataclasses.replace(config, run=dataclasses.replace(config.run, device=device))
        self._requested = self._placed = placement

    @property
    def size(self) -> int:
        """Workers, or rollout actors and learners, now."""
        return sum(_sizes(self._placed, self._roles).values())

    def fit(self, update: int, stop: StopSignals) -> None:
        """Before lost processes are started again: where a node was lost with them, waits for it or goes on smaller.

        Raises StopRequested where that comes while it waits.
        """
        if not self._backend.has_lost_resources:
            return
        wait_s = self._config.run.node_wait_seconds
        self._on_note(
            f"nodes were lost, and {self._in_words(self._placed)} do not fit: {nodes_in_words()}; waits {wait_s:g} s "
            "(run.node_wait_seconds)"
        )
        if self._came_back(wait_s, stop):
            return
        self.place(update, stop)

    def can_grow(self) -> bool:
        """Says whether a run that was made smaller can have more processes again."""
        if self.size == self._requested_size:
            return False
        return self._largest(least=self.size + 1) is not None

    def place(self, update: int, stop: StopSignals) -> None:
        """Ends all processes and gives the run as many processes as fit; waits where that is too few."""
        self._trainer.stop()
        for part in self._background.values():
            part.stop()
        self._backend.release()
        before, began, is_noted = self._placed, time.monotonic(), False
        while True:
            placement = self._largest(least=self._least)
            if placement is not None and self._is_reserved(placement):
                break
            if not is_noted and time.monotonic() > began + NOTE_AFTER_S:
                is_noted = True
                least = counted(
                    min(self._config.run.min_workers, len(self._requested.of(self._roles[0]))), self._roles[0]
                )
                self._on_note(f"{least} (run.min_workers) do not fit: {nodes_in_words()}; waits for a node")
            _pause(stop)
        self._placed = placement
        self._trainer.place(placement)
        for role, part in self._background.items():
            part.place(placement.of(role))
        for role in self._roles:
            was, now = len(before.of(role)), len(placement.of(role))
            if was != now:
                self._on_event("resized", role=role, before=was, now=now, update=update)
        words = f"{self._in_words(placement)} instead of {self._in_words(before)}"
        self._on_note(f"goes on with {words}: {nodes_in_words()}")

    def _came_back(self, wait_s: float, stop: StopSignals) -> bool:
        deadline = time.monotonic() + wait_s
        while self._backend.has_lost_resources:
            if time.monotonic() > deadline:
                return False
            _pause(stop)
        return True

    def _is_reserved(self, placement: Placement) -> bool:
        try:
            self._backend.reserve(placement)
        except PlacementError:  # free in all, not on nodes where a bundle fits, or taken in between
            return False
        return True

    def _largest(self, *, least: int) -> Placement | None:
        """The largest one that there is resources for, of `least` processes or more of the roles that change."""
        resources = self._backend.resources()
        for config in self._smaller_and_smaller(least):
            try:
                placement = plan_placement(config, num_gpus=resources.gpus)
            except PlacementError:
                continue
            if resources.holds(needed_by(placement)):
                return placement
        return None

    def _smaller_and_smaller(self, least: int) -> Iterator[TrainConfig]:
        """Configurations from the requested size down; of the same size, those with more learners first."""
        requested, run = _sizes(self._requested, self._roles), self._config.run
        first, *others = requested.values()
        least_first = min(run.min_workers, first)
        for size in range(self._requested_size, least - 1, -1):
            for num_learners in range(others[0], 0, -1) if others else [0]:
                number = size - num_learners
                if least_first <= number <= first:
                    if others:
                        on_cpu = min(run.num_cpu_rollout_actors, number)  # GPUs are rarer: they are given up first
                        smaller = dataclasses.replace(
                            run, num_rollout_actors=number, num_cpu_rollout_actors=on_cpu, num_learners=num_learners
                        )
                    else:
                        smaller = dataclasses.replace(run, num_workers=number)
                    yield dataclasses.replace(self._config, run=smaller)

    @property
    def _requested_size(self) -> int:
        return sum(_sizes(self._requested, self._roles).values())

    @property
    def _least(self) -> int:
        return min(self._config.run.min_workers, len(self._requested.of(self._roles[0]))) + len(self._roles) - 1

    def _in_words(self, placement: Placement) -> str:
        return " and ".join(counted(number, role) for role, number in _sizes(placement, self._roles).items())


def _sizes(placement: Placement, roles: Sequence[str]) -> dict[str, int]:
    return {role: len(placement.of(role)) for role in roles}


def _pause(stop: StopSignals) -> None:
    if stop.requested is not None:
        raise StopRequested
    time.sleep(POLL_S)
