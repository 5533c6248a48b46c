"""Colocated placement: every worker holds worlds and a learner shard, so a rollout never leaves its device. Lag 0.

One worker in this process is local mode; N workers in Ray actors form one JAX world and run the same programs in the
same order.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Concatenate

import numpy as np

from kinetix_dist.config import TrainConfig
from kinetix_dist.runtime.cores.build import build_worker
from kinetix_dist.runtime.cores.imitation import Imitated
from kinetix_dist.runtime.cores.worker import Worker
from kinetix_dist.runtime.driver.roles import Refresh
from kinetix_dist.runtime.processes.backend import Backend
from kinetix_dist.runtime.processes.calls import Future, Handle, P, T
from kinetix_dist.runtime.processes.placement import Placement, ProcessPlan


def learning_devices(facts: Mapping[str, Any]) -> dict[str, Any]:
    """Devices that learn, from the facts of a process that does."""
    device = facts["device"]
    return {"devices": device["count"], "platform": device["platform"], "kind": device["kind"]}


class ColocatedTrainer:
    """A `roles.Trainer` of one or more workers that do everything together."""

    policy_lag = 0
    dropped_steps = 0  # what is played is always learned from

    def __init__(self, config: TrainConfig, backend: Backend, plans: Sequence[ProcessPlan]) -> None:
        self._config = config
        self.backend = backend
        self._plans = plans
        self._handles: Sequence[Handle[Worker]] = []

    def start(self, num_updates: int, arrays: Mapping[str, np.ndarray] | None) -> None:
        """A group is started as a whole: the processes of a broken one are ended first, whichever still live."""
        self.backend.kill(self._handles)
        self._handles = []
        # While they compile, a checkpoint gets to them, the first evaluation is worked out, or curators work out a
        # refresh that was in flight.
        ahead_of = num_updates if self.backend.works_in_background else None
        self._handles = self.backend.spawn(self._plans, build_worker, self._config, ahead_of)
        self._all(Worker.start, None if arrays is None else self.backend.put(dict(arrays)).as_argument())

    def place(self, placement: Placement) -> None:
        self._plans = placement.of("worker")

    def weights(self) -> Future[Any]:
        return self._handles[0].call(Worker.released)

    def adopt(self, parts: Sequence[Any]) -> None:
        self._all(Worker.adopt, *parts)

    def probe(self, num_levels: int) -> Future[Any]:
        return self._handles[0].call(Worker.probe, num_levels)

    def refresh_input(self) -> Future[Any]:
        return self._handles[0].call(Worker.refresh_input)

    def refresh(self, weights: Any, policy_version: int, probe: Any, given: Any) -> Refresh:
        """Refreshes on the workers, as a curator would (see `Curator.request`); waits for it."""
        times = self._config.refresh_times
        config = self._config.schedule.at(times.adopted_at(policy_version)).config
        has_parts = config.curriculum_class.shares_refresh
        num_parts = min(len(self._handles), config.curriculum.num_batches) if has_parts else 1
        last = num_parts - 1  # it has no more batches to score than the others
        calls = [
            handle.call_with_header(
                Worker.refresh, weights, policy_version, part, num_parts, probe if part == last else None, given
            )
            for part, handle in enumerate(self._handles[:num_parts])
        ]
        headers = self.backend.gather([header for header, _ in calls])
        later = times.next(policy_version + 1)
        has_probes = self._config.curriculum_log.probe_levels > 0 and later is not None and not times.is_first(later)
        if probe is None and has_probes and self.backend.works_in_background:
            # A later one has. Its program is compiled, once, while updates go on; what fails there fails again.
            self._handles[last].call_in_background(Worker.prepare_refresh, later)
        return Refresh.of([part for _, part in calls], headers)

    def run_update(self, num_updates: int) -> tuple[dict[str, float], dict[str, float], dict[str, np.ndarray]]:
        answers = self._all(Worker.run_update, num_updates)
        metrics, _, attempts = answers[0]
        slowest = {role: max(seconds[role] for _, seconds, _ in answers) for role in answers[0][1]}
        return metrics | {"runtime/policy_lag": 0.0, "runtime/policy_lag_max": 0.0}, slowest, attempts

    def imitate(self, steps: int) -> tuple[Imitated, dict[str, Any]]:
        return self._first(Worker.imitate, steps)

    def check(self) -> None:
        self.backend.check(self._handles)

    def snapshot(self) -> dict[str, np.ndarray]:
        worlds = self._all(Worker.ongoing_worlds)
        return self._first(Worker.snapshot) | {
            name: np.concatenate([part[name] for part in worlds]) for name in worlds[0]
        }

    def evaluate(self, *, use_policy: bool) -> dict[str, dict[str, Any]]:
        return self._first(Worker.evaluate, use_policy)

    def record(self, num_rollouts: int, num_updates: int) -> list[Any]:
        return self._first(Worker.record, num_rollouts, num_updates)

    def topology(self) -> dict[str, Any]:
        return {
            "placement": self._config.run.placement,
            "processes": len(self._handles),
            **learning_devices(self._first(Worker.facts)),
        }

    def facts(self) -> dict[str, Any]:
        return {**self._first(Worker.facts), "processes": self.backend.facts(self._handles)}

    def stop(self) -> None:
        self.backend.kill(self._handles)
        self._handles = []

    def _first(self, method: Callable[Concatenate[Worker, P], T], *arguments: P.args, **named: P.kwargs) -> T:
        return self.backend.gather([self._handles[0].call(method, *arguments, **named)])[0]

    def _all(self, method: Callable[Concatenate[Worker, P], T], *arguments: P.args, **named: P.kwargs) -> list[T]:
        return self.backend.gather([handle.call(method, *arguments, **named) for handle in self._handles])
