"""The bounded queue between rollout actors and the learner (split placement).

    consumes       batches stamped with the update they are for and the version of the policy that acted
    produces       the batch of the update that the learner is at, all parts of it
    waits for      nothing: the controller puts what has arrived and takes when a batch is whole
    bound          two batches: the one the learner works on and the one being played. More would raise the lag

What does not fit the update or has another lag than promised is dropped and counted, never trained on.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

CAPACITY_BATCHES = 2


class WorkBufferFullError(RuntimeError):
    """A batch was added beyond the bound; the producer has to be held back instead."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Work:
    """A part of a batch: what one rollout actor played for one update. Its arrays are in the object store."""

    update: int  # the update it is for
    part: int  # which part of the worlds
    stamp: Mapping[str, Any]  # what the rollout actor says of it: "policy_version", "num_env_steps" and more

    @property
    def policy_version(self) -> int:
        """Of the policy that acted."""
        return self.stamp["policy_version"]

    @property
    def num_env_steps(self) -> int:
        return self.stamp["num_env_steps"]


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
