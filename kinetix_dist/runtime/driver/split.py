"""Split placement: rollout actors play the next batch while the learners learn from the last. Lag 1, by construction.

    update u of the learner        uses batch u, played by version u - 1 (batch 0: by version 0)
    at the same time               batch u + 1 is played by version u

| role | consumes | produces | waits for | bound |
|---|---|---|---|---|
| rollout actor | weights of version u, state of the curriculum | its part of batch u + 1 | - | one batch ahead |
| learners | all parts of batch u | version u + 1 | the slowest rollout actor | two batches in the work buffer |

Every part of batch u + 1 goes to the learners as soon as it is played: they fetch it and lay it out on their devices
while they compute update u.

Learners form one JAX world, as the workers of the colocated placement do: each learns from its blocks of worlds, and
makes the same version.

Levels and random streams belong to world groups and update numbers, so a part that was lost with its actor is played
again by a new actor with the same weights and comes out the same.
"""

from __future__ import annotations

import functools
import operator
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Concatenate

import numpy as np

from kinetix_dist.checkpoint import flatten_arrays, select_arrays
from kinetix_dist.config import TrainConfig
from kinetix_dist.runtime.cores.build import build_learner, build_rollout
from kinetix_dist.runtime.cores.rollout_core import Batch
from kinetix_dist.runtime.cores.rollout_sums import BY_SOURCE
from kinetix_dist.runtime.cores.run_names import ACTING, PROPOSING, nested
from kinetix_dist.runtime.cores.split_core import RolloutWorker
from kinetix_dist.runtime.cores.worker import LearnerWorker
from kinetix_dist.runtime.driver.colocated import learning_devices
from kinetix_dist.runtime.driver.work_buffer import (
    Stragglers,
    WeightStore,
    Work,
    WorkBuffer,
    added,
    copy_metrics,
    straggler_metrics,
)
from kinetix_dist.runtime.processes.backend import Backend
from kinetix_dist.runtime.processes.calls import Future, Group, Handle, P, T, resolve
from kinetix_dist.runtime.processes.failures import InputLostError, Loss, WorkerLostError
from kinetix_dist.runtime.processes.placement import Placement

_Part = tuple[Future[dict[str, Any]], Future[tuple[Batch, Any]]]
_CopiesOfPart = dict[str, tuple[int, float]]

_MAX_REPLACEMENTS = 3  # of a rollout actor in a row, without a part of a batch from it


class SplitTrainer:
    """A `roles.Trainer` of rollout actors, a bounded work buffer and one or more learners."""

    policy_lag = 1

    def __init__(
        self,
        config: TrainConfig,
        backend: Backend,
        placement: Placement,
        *,
        on_event: Callable[..., None] = lambda kind, **details: None,
    ) -> None:
        """on_event: called with kind and details of rollout actors that are slower than the others."""
        self._config = config
        self._schedule = config.schedule
        self.backend = backend
        self._on_event = on_event
        self.place(placement)
        self._learners: list[Handle[LearnerWorker]] = []
        self._actors: list[Handle[RolloutWorker]] = []
        self._dropped_before = 0
        self._reset()

    @property
    def dropped_steps(self) -> int:
        return self._dropped_before + self._work.dropped_steps

    def start(self, num_updates: int, arrays: Mapping[str, np.ndarray] | None) -> None:
        self.stop()
        self._reset()
        learners, actors = self.backend.spawn_both(
            Group(self._learner_plans, build_learner, self._config),
            Group(self._rollout_plans, build_rollout, self._config, len(self._rollout_plans)),
        )
        self._learners, self._actors = [*learners], [*actors]
        start = None if arrays is None else self.backend.put(dict(arrays)).as_argument()
        self._from_learners(LearnerWorker.start, start)
        self._weights.publish(num_updates, self._learners[0].call(LearnerWorker.weights))
        if arrays is not None and num_updates > 0:
            # The batch that was being played when the checkpoint was taken: same weights, same state.
            acting = nested(select_arrays(arrays, ACTING))
            self._weights.publish(num_updates - 1, self.backend.put(acting))
            state = self._proposing(num_updates)
            if self._observes(num_updates):
                stored = self.backend.put(select_arrays(arrays, PROPOSING))
                state = self._learners[0].call(LearnerWorker.state_from, num_updates, stored.as_argument())
            self._issue(num_updates, num_updates - 1, state)

    def place(self, placement: Placement) -> None:
        self._learner_plans = placement.of("learner")
        self._rollout_plans = placement.of("rollout")

    def weights(self) -> Future[Any]:
        if self._config.ppo.average_updates:
            return self._learners[0].call(LearnerWorker.released)
        return self._weights.newest

    def adopt(self, parts: Sequence[Any]) -> None:
        self._from_learners(LearnerWorker.adopt, *parts)
        self._state_since = None

    def probe(self, num_levels: int) -> Future[Any]:
        return self._learners[0].call(LearnerWorker.probe, num_levels)

    def refresh_input(self) -> Future[Any]:
        return self._learners[0].call(LearnerWorker.refresh_input)

    def run_update(self, num_updates: int) -> tuple[dict[str, float], dict[str, float], dict[str, np.ndarray]]:
        began = time.monotonic()
        if num_updates not in self._orders:
            self._issue(num_updates, num_updates, self._proposing(num_updates))
        self._issue(num_updates + 1, num_updates, self._proposing(num_updates + 1))
        self._receive(num_updates)
        staged = [added(parts) for parts in zip(*self._staged(num_updates), strict=True)]
        waited, queue_length = time.monotonic() - began, len(self._work)
        works = self._work.take(num_updates)
        played = [work.header for work in works]
        # From the order to the answer: waiting for weights and storing the batch too.
        answered = [{**header, "seconds": header["answered"]} for header in played]
        self._stragglers.add(num_updates + 1, answered)
        sums = [header["sums"] for header in played]
        learning = [learner.call_with_header(LearnerWorker.learn, num_updates, *sums) for learner in self._learners]
        self._receive(num_updates + 1, until=[header for header, _ in learning])
        learned = self.backend.gather([header for header, _ in learning])
        del self._orders[num_updates]
        self._weights.publish(num_updates + 1, learning[0][1])
        if self._observes(num_updates):
            self._state_since = None
        lags = [num_updates - work.policy_version for work in works]
        metrics: dict[str, float] = {
            **learned[0]["metrics"],
            "runtime/policy_lag": float(np.mean(lags)),
            "runtime/policy_lag_max": float(max(lags)),
            "runtime/queue_length": float(queue_length),
            "runtime/batch_wait_seconds": waited,
            **straggler_metrics(answered),
            **copy_metrics([*staged, *(_copied(header, "store_put") for header in played)]),
            **copy_metrics([_copied(learned[0], "weights_put")]),
        }
        seconds = {"learn": learned, "rollout": played}
        slowest = {role: max(header["seconds"] for header in headers) for role, headers in seconds.items()}
        by_part = [part[BY_SOURCE] for part in sums]
        attempts = {name: functools.reduce(operator.add, [part[name] for part in by_part]) for name in by_part[0]}
        return metrics, slowest, attempts

    def check(self) -> None:
        """Checks the learners alone: a lost rollout actor is replaced where its part of a batch is waited for."""
        self.backend.check(self._learners)

    def snapshot(self) -> dict[str, np.ndarray]:
        arrays = self._from_first(LearnerWorker.snapshot)
        acting_version = max(self._weights_in_flight(), default=None)
        if acting_version is not None:
            arrays |= flatten_arrays({ACTING: resolve(self._weights.get(acting_version))})
        if self._orders and self._observes(batch := max(self._orders)):
            _, state = self._orders[batch]
            arrays |= flatten_arrays({PROPOSING: resolve(state)})
        return arrays

    def evaluate(self, *, use_policy: bool) -> dict[str, dict[str, Any]]:
        return self._from_first(LearnerWorker.evaluate, use_policy)

    def record(self, num_rollouts: int, num_updates: int) -> list[Any]:
        return self._from_first(LearnerWorker.record, num_rollouts, num_updates)

    def topology(self) -> dict[str, Any]:
        devices = learning_devices(self._from_first(LearnerWorker.facts))
        processes = len(self._learners) + len(self._actors)
        parts = {"learners": len(self._learners), "rollout_actors": self._actors_in_words()}
        return {"placement": "split", "processes": processes, **parts, **devices}

    def _actors_in_words(self) -> int | str:
        """Their number; where some compute on another kind of device than learners, which makes other bits, so many."""
        number = len(self._rollout_plans)
        num_on_cpu = sum(plan.gpu is None for plan in self._rollout_plans)
        return number if self._learner_plans[0].gpu is None or not num_on_cpu else f"{number} ({num_on_cpu} on CPU)"

    def facts(self) -> dict[str, Any]:
        return {
            **self._from_first(LearnerWorker.facts),
            "processes": self.backend.facts([*self._learners, *self._actors]),
        }

    def stop(self) -> None:
        handles = [*self._actors, *self._learners]
        self._actors, self._learners = [], []
        self.backend.kill(handles)

    def _reset(self) -> None:
        if hasattr(self, "_work"):
            # Batches in flight are lost with the learners, and are played again.
            self._work.drop(sum(self._schedule.at(update).config.rollout.steps_per_update for update in self._orders))
            self._dropped_before += self._work.dropped_steps
        self._work = WorkBuffer(num_parts=len(self._rollout_plans), lag=self.policy_lag)
        self._weights = WeightStore(keep_last=2)
        # By update: the policy version and the state of the curriculum that its batch is played with.
        self._orders: dict[int, tuple[int, Any]] = {}
        self._in_flight: dict[tuple[int, int], _Part] = {}  # (update, part) -> header, batch
        self._ordered_at: dict[tuple[int, int], float] = {}  # (update, part) -> time.monotonic()
        # By update: for each part that came, the answers of all learners.
        self._staging: dict[int, list[list[Future[_CopiesOfPart]]]] = {}
        self._losses: dict[int, list[Loss]] = {}  # by part: since its actor gave something
        self._num_replaced: Counter[int] = Counter()  # by part, since then
        self._state: Any = None  # of the curriculum, as it was last fetched
        self._state_since: int | None = None  # its `Phase.curriculum_since`; None: another one is to be fetched
        self._stragglers = Stragglers(self._on_event)

    def _observes(self, batch: int) -> bool:
        """The curriculum of a batch observes."""
        return self._schedule.at(batch).config.curriculum_class.observes

    def _proposing(self, batch: int) -> Any:
        """State of the curriculum that proposes a batch which is ordered now."""
        since = self._schedule.at(batch).curriculum_since
        if self._state_since != since:
            self._state, self._state_since = self._learners[0].call(LearnerWorker.curriculum_state, batch), since
        return self._state

    def _weights_in_flight(self) -> list[int]:
        return [version for version, _ in self._orders.values()]

    def _from_first(
        self, method: Callable[Concatenate[LearnerWorker, P], T], *arguments: P.args, **named: P.kwargs
    ) -> T:
        """Return the first learner's answer about state that all learners hold."""
        return self.backend.gather([self._learners[0].call(method, *arguments, **named)])[0]

    def _from_learners(
        self, method: Callable[Concatenate[LearnerWorker, P], T], *arguments: P.args, **named: P.kwargs
    ) -> list[T]:
        """Return the answers of all learners to a collective call."""
        return self.backend.gather([learner.call(method, *arguments, **named) for learner in self._learners])

    def _issue(self, update: int, policy_version: int, state: Any) -> None:
        """Orders batch `update` from all rollout actors, its levels proposed by `state` of the curriculum."""
        self._orders[update] = (policy_version, state)
        for part in range(len(self._actors)):
            self._issue_part(update, part)

    def _issue_part(self, update: int, part: int) -> None:
        policy_version, state = self._orders[update]
        weights = self._weights.get(policy_version)
        self._ordered_at[update, part] = time.monotonic()
        self._in_flight[update, part] = self._actors[part].call_with_header(
            RolloutWorker.play, update, policy_version, weights, state
        )

    def _receive(self, update: int, *, until: Sequence[Future[Any]] = ()) -> None:
        """Receive the parts of a batch, until all have come or a future of `until` is ready.

        Replaces lost actors, which play their parts again.
        """
        while missing := self._work.missing(update):
            headers = {part: self._in_flight[update, part][0] for part in missing}
            try:
                waited_for = [*until, *headers.values()]
                ready = {id(future) for future in self.backend.first_ready(waited_for, watched=self._learners)}
            except WorkerLostError as error:  # it is silent, or the section takes too long
                part = next((plan.index for plan in self._rollout_plans if plan.name == error.process), None)
                if part is None:
                    raise
                self._replace({part: error})
                continue
            lost = {}
            for part, header in headers.items():
                if id(header) in ready and (error := self._accept(update, part)) is not None:
                    lost[part] = error
            if lost:
                self._replace(lost)
            if any(id(future) in ready for future in until):
                return

    def _accept(self, update: int, part: int) -> WorkerLostError | None:
        """Takes a part that is answered and hands it on to all learners; or returns why there is none."""
        answer, content = self._in_flight[update, part]
        try:
            header = self.backend.gather([answer])[0]
        except InputLostError:  # the learner's: the actor is well
            raise
        except WorkerLostError as error:
            return error
        del self._in_flight[update, part]
        header |= {"answered": time.monotonic() - self._ordered_at.pop((update, part))}
        self._work.put(Work(update=update, part=part, header=header))
        staging = [
            learner.call_in_background(LearnerWorker.stage, update, part, len(self._actors), content)
            for learner in self._learners
        ]
        self._staging.setdefault(update, []).append(staging)
        self._num_replaced.pop(part, None)
        for loss in self._losses.pop(part, []):
            self.backend.losses.recovered(loss, update=self.backend.losses.update)
        return None

    def _staged(self, update: int) -> list[list[_CopiesOfPart]]:
        """Wait until a batch is on the devices of all learners. Returns the copies of each learner, by part."""
        by_part = self._staging.pop(update)
        answers = iter(self.backend.gather([future for futures in by_part for future in futures]))
        return [[next(answers) for _ in futures] for futures in by_part]

    def _replace(self, lost: Mapping[int, WorkerLostError]) -> None:
        """Replace lost rollout actors, all at the same time, and order their parts again."""
        for part, error in lost.items():
            if self.backend.has_lost_resources:  # it went with its node: the whole run is placed again
                raise error
            self._num_replaced[part] += 1
            if self._num_replaced[part] > _MAX_REPLACEMENTS:
                raise WorkerLostError(f"rollout actor {part} was lost {_MAX_REPLACEMENTS} times over one batch")
            error.section = self.backend.sections.name
            self._losses.setdefault(part, []).append(self.backend.losses.lost(error))
        again = sorted((update, part) for update, part in self._in_flight if part in lost)
        num_parts = len(self._rollout_plans)
        for update, part in again:
            steps_per_group = self._schedule.at(update).config.rollout.steps_per_group
            self._work.drop(len(self._config.groups_of_part(part, num_parts)) * steps_per_group)
        self.backend.kill([self._actors[part] for part in lost])
        plans = [self._rollout_plans[part] for part in lost]
        started = self.backend.spawn(plans, build_rollout, self._config, num_parts)
        for part, actor in zip(lost, started, strict=True):
            self._actors[part] = actor
            self._stragglers.reset(part)
        self.backend.sections.begin_again()
        for update, part in again:
            self._issue_part(update, part)


def _copied(header: Mapping[str, Any], put: str) -> dict[str, tuple[int, float]]:
    """Copies that a process made for an answer, storing it included."""
    return {**header["copies"], put: header["put"]}
