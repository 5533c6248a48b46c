"""Queue between rollout actors and learners (split placement), with the timing of what passes through it.

    consumes       parts of batches, each with its update and the version of the policy that acted
    produces       the batch of the update that the learner is at, all parts of it
    waits for      nothing: the controller puts what has arrived and takes when a batch is whole
    bound          two batches: the one the learner works on and the one being played. More would raise the lag

A part that does not fit the update, or has another lag than promised, is dropped and counted, never trained on.

`WeightStore` holds the versions of the policy that rollout actors act with: weights are put into the object store once
and passed on by reference. `Stragglers` finds rollout actors that are slower than the others, update after update. One
slow batch says little: a new actor compiles, a machine is busy for a moment. An actor is a straggler after
UPDATES_IN_A_ROW batches, each of which took it more than TIMES_THE_OTHERS the median of the others. That is noted once,
and again only after as many batches in a row that were not slow.
"""

from __future__ import annotations

import dataclasses
import statistics
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from kinetix_dist.runtime.processes.measures import MIB

CAPACITY_BATCHES = 2


class WorkBufferFullError(RuntimeError):
    """A batch was added beyond the bound; the producer has to be held back instead."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Work:
    """A part of a batch: what one rollout actor played for one update. Its arrays are in the object store."""

    update: int  # the update it is for
    part: int  # which part of the worlds
    header: Mapping[str, Any]  # what the rollout actor says of it: "policy_version", "num_env_steps" and more

    @property
    def policy_version(self) -> int:
        """Version of the policy that acted."""
        return self.header["policy_version"]

    @property
    def num_env_steps(self) -> int:
        return self.header["num_env_steps"]


class WorkBuffer:
    """Parts of batches by update. `lag` is the promise: version of the policy = update - lag (or 0 at the start)."""

    def __init__(self, *, num_parts: int, lag: int, capacity: int = CAPACITY_BATCHES) -> None:
        self._num_parts = num_parts
        self._lag = lag
        self._capacity = capacity
        self._batches: dict[int, dict[int, Work]] = {}
        self._next_update = 0
        self.dropped_steps = 0

    def __len__(self) -> int:
        return len(self._batches)

    def put(self, work: Work) -> bool:
        """Adds a part; False when it was dropped (for a past update, of another lag, or there already)."""
        parts = self._batches.get(work.update, {})
        is_late = work.update < self._next_update
        has_promised_lag = work.policy_version == max(work.update - self._lag, 0)
        if is_late or not has_promised_lag or work.part in parts:
            self.drop(work.num_env_steps)
            return False
        if work.update not in self._batches and len(self._batches) >= self._capacity:
            raise WorkBufferFullError(
                f"{len(self._batches)} batches of {self._capacity} wait; batch {work.update} does not fit"
            )
        self._batches.setdefault(work.update, {})[work.part] = work
        return True

    def drop(self, num_env_steps: int) -> None:
        """Counts steps that were played and will not be trained on."""
        self.dropped_steps += num_env_steps

    def missing(self, update: int) -> list[int]:
        """Parts of a batch that have not arrived."""
        return [part for part in range(self._num_parts) if part not in self._batches.get(update, {})]

    def take(self, update: int) -> list[Work]:
        """The whole batch of `update`, parts in order. Raises LookupError while parts are missing."""
        if missing := self.missing(update):
            raise LookupError(f"batch {update} lacks parts {missing}")
        self._next_update = update + 1
        parts = self._batches.pop(update)
        return [parts[part] for part in range(self._num_parts)]


class WeightStore:
    """Published versions by number. Holds whatever stands for weights: arrays or references to them."""

    def __init__(self, *, keep_last: int = 2) -> None:
        self._keep_last = keep_last
        self._weights: dict[int, Any] = {}

    def publish(self, version: int, weights: Any) -> None:
        """Adds a version and forgets those that are not recent."""
        self._weights[version] = weights
        recent = sorted(self._weights)[-self._keep_last :]
        self._weights = {v: w for v, w in self._weights.items() if v in recent}

    def __contains__(self, version: int) -> bool:
        return version in self._weights

    @property
    def newest(self) -> Any:
        return self._weights[max(self._weights)]

    def get(self, version: int) -> Any:
        if version not in self._weights:
            raise LookupError(f"policy version {version} is not stored; stored are {sorted(self._weights)}")
        return self._weights[version]


Copied = Mapping[str, tuple[int, float]]  # {copy: (bytes, seconds)} of one process


def copy_metrics(processes: Sequence[Copied]) -> dict[str, float]:
    """MiB of all processes together and seconds of the one that took longest, by copy (`telemetry.names.COPIES`)."""
    found: dict[str, float] = {}
    for name in dict.fromkeys(name for copied in processes for name in copied):
        of_all = [copied[name] for copied in processes if name in copied]
        found[f"copies/{name}_mib"] = sum(num_bytes for num_bytes, _ in of_all) / MIB
        found[f"copies/{name}_seconds"] = max(seconds for _, seconds in of_all)
    return found


def added(parts: Sequence[Copied]) -> dict[str, tuple[int, float]]:
    """Copies of one process summed: it made several, one after another."""
    names = dict.fromkeys(name for copied in parts for name in copied)
    of = {name: [copied[name] for copied in parts if name in copied] for name in names}
    return {name: (sum(size for size, _ in found), sum(s for _, s in found)) for name, found in of.items()}


def straggler_metrics(headers: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """The slowest rollout actor of a batch; nothing where there is one only. headers: in the order of actors."""
    if len(headers) < 2:
        return {}
    seconds = [header["seconds"] for header in headers]
    slowest = seconds.index(max(seconds))
    others = statistics.median(seconds[:slowest] + seconds[slowest + 1 :])
    return {"runtime/slowest_actor": float(slowest), "runtime/slowest_actor_lag_seconds": seconds[slowest] - others}


TIMES_THE_OTHERS = 2.0
UPDATES_IN_A_ROW = 5


class Stragglers:
    """Among the rollout actors of a run."""

    def __init__(self, on_event: Callable[..., None]) -> None:
        """`on_event(kind, **details)`"""
        self._on_event = on_event
        self._found: dict[int, _Found] = {}  # by number of the actor

    def add(self, update: int, headers: Sequence[Mapping[str, Any]]) -> None:
        """Takes what the actors say of a batch, in their order: "seconds" and "num_env_steps"."""
        for actor, header in enumerate(headers):
            others = [*headers[:actor], *headers[actor + 1 :]]
            if not others:
                return
            seconds = statistics.median(other["seconds"] for other in others)
            found = self._found.setdefault(actor, _Found())
            is_slow = header["seconds"] > TIMES_THE_OTHERS * seconds * _more_work(header, others)
            if found.becomes_straggler(is_slow=is_slow):
                self._on_event(
                    "straggler",
                    process=f"rollout {actor}",
                    update=update,
                    in_a_row=UPDATES_IN_A_ROW,
                    seconds=round(header["seconds"], 3),
                    seconds_of_others=round(seconds, 3),
                )

    def reset(self, actor: int) -> None:
        """Another process, perhaps on another machine, has taken its place."""
        self._found.pop(actor, None)


@dataclasses.dataclass
class _Found:
    """State of one actor."""

    is_straggler: bool = False
    in_a_row: int = 0  # batches that say the contrary

    def becomes_straggler(self, *, is_slow: bool) -> bool:
        """Says whether it has become a straggler with this batch."""
        self.in_a_row = self.in_a_row + 1 if is_slow != self.is_straggler else 0
        if self.in_a_row < UPDATES_IN_A_ROW:
            return False
        self.is_straggler, self.in_a_row = is_slow, 0
        return is_slow


def _more_work(header: Mapping[str, Any], others: Sequence[Mapping[str, Any]]) -> float:
    """Times the steps of the others that an actor plays, where it plays more: parts need not be of one size.

    Never below 1: a part of half the size takes more than half the time, on GPUs nearly as much.
    """
    return max(header["num_env_steps"] / statistics.median(other["num_env_steps"] for other in others), 1.0)
