"""Split placement inside processes: the rollout actor, and batches on their way to the devices of a learner.

    rollout actor   play -> device_to_host -> store_put
    learner         store_get -> host_layout -> host_to_device; weights_to_host -> weights_put
    rollout actor   weights_to_device

| Staging | |
|---|---|
| consumes | parts of a batch, one of each rollout actor, in any order |
| produces | the batch of an update, laid out on the devices of this process |
| waits for | nothing: the call that stages the last part of a batch lays it out |
| bound | two batches: the one that is being learned from and the next one, on the devices too |

A part is fetched and put into the rows of this process as soon as it is there, so that only the last one is left to
do when the slowest actor is done. Parts that hold no worlds of this process are not fetched, unless the curriculum
observes: then every learner sees the outcomes of all. `Copies` measures bytes and seconds of each copy.
"""

from __future__ import annotations

import time
from collections.abc import Generator
from contextlib import contextmanager
from typing import Any, Protocol

import jax
import numpy as np
from jax.sharding import Mesh

from kinetix_dist.config import TrainConfig
from kinetix_dist.learner.division import Division
from kinetix_dist.learner.sharding import own_rows, replicate, shard_worlds
from kinetix_dist.runtime.cores.playing import Playing
from kinetix_dist.runtime.cores.rollout_core import Batch
from kinetix_dist.telemetry.sizes import bytes_of


class Copies:
    """Adds up by name, in one process: {name: (bytes, seconds)}."""

    def __init__(self) -> None:
        self.found: dict[str, tuple[int, float]] = {}

    @contextmanager
    def timed(self, name: str) -> Generator[list[Any]]:
        """Around a copy; what is copied is appended to the list that it gives."""
        copied: list[Any] = []
        began = time.monotonic()
        yield copied
        num_bytes, seconds = self.found.get(name, (0, 0.0))
        self.found[name] = (num_bytes + bytes_of(copied), seconds + time.monotonic() - began)


class RolloutWorker:
    """Part `index` of the worlds: one rollout actor of the split placement. Stateless between calls but for programs of
    the phase it is in."""

    def __init__(self, config: TrainConfig, mesh: Mesh, *, index: int, num_parts: int) -> None:
        self._mesh = mesh
        self._schedule = config.schedule
        self._groups = config.groups_of_part(index, num_parts)
        self._playing = Playing(config, mesh, groups=self._groups)
        self._playing.rollout(
            config
        )  # groups that cannot be divided, or levels that cannot be loaded, are found before the first call

    def play(
        self, update: int, policy_version: int, params: Any, state: Any
    ) -> tuple[dict[str, Any], tuple[Batch, Any]]:
        """(header, (batch, what the curriculum observes of it or None) as numpy) of this part of batch `update`.

        state: of the curriculum.
        """
        began, copies = time.monotonic(), Copies()
        config = self._schedule.at(update).config
        rollout = self._playing.rollout(config)
        with copies.timed("weights_to_device") as copied:
            params, state = replicate(params, self._mesh), replicate(state, self._mesh)
            copied += jax.block_until_ready([params, state])
        batch, seen, sums, _ = jax.block_until_ready(rollout.play(params, state, update))
        with copies.timed("device_to_host") as copied:
            batch, seen, sums = jax.device_get((batch, seen, sums))
            copied += [batch, seen]
        content = _each_world_once(rollout.division, batch, seen)
        header = {
            "update": update,
            "policy_version": policy_version,
            "num_env_steps": len(self._groups) * config.rollout.steps_per_group,
            "sums": sums,
            "copies": copies.found,
            "seconds": time.monotonic() - began,
        }
        return header, content


def _each_world_once(division: Division, batch: Batch, seen: Any) -> tuple[Batch, Any]:
    if division.is_even:
        return batch, seen

    def once(x: Any, axis: int = 0) -> Any:
        return np.take(x, division.gathered(x.shape[axis]), axis=axis)

    static, seen = jax.tree.map(once, (batch.static, seen))
    trajectory = jax.tree.map(lambda x: once(x, axis=1), batch.trajectory)
    return Batch(static, trajectory, once(batch.last_value)), seen


class Stored(Protocol):
    """(batch, what the curriculum observes of it or None) of one part, as numpy, in the object store or here."""

    def fetch(self) -> tuple[Batch, Any]: ...


class Staging:
    """Batches on their way in one learner process. `add` may be called in another thread than `take`."""

    def __init__(self, config: TrainConfig, mesh: Mesh, division: Division) -> None:
        self._config = config
        self._mesh = mesh
        self._division = division
        self._coming: dict[int, _Coming] = {}
        self._ready: dict[int, tuple[Batch, Any]] = {}

    def add(self, update: int, part: int, num_parts: int, content: Stored) -> dict[str, tuple[int, float]]:
        """Part `part` of batch `update`. Returns {copy: (bytes, seconds)}."""
        copies = Copies()
        coming = self._coming.setdefault(update, _Coming())
        worlds = self._config.schedule.at(update).config
        own = self._own_rows(worlds)
        slots, rows = _here(own, worlds, part, num_parts)
        if slots.size or worlds.curriculum_class.observes:
            with copies.timed("store_get") as copied:
                batch, seen = content.fetch()
                copied += [batch, seen]
            if slots.size:
                with copies.timed("host_layout") as copied:
                    copied += coming.put(batch, slots, rows, len(own))
            if worlds.curriculum_class.observes:
                coming.seen[part] = seen
        coming.num_parts += 1
        if coming.num_parts == num_parts:
            with copies.timed("host_to_device") as copied:
                coming = self._coming.pop(update)
                batch, seen = coming.batch, coming.seen_in_order()
                self._ready[update] = self._placed(batch, seen)
                copied += [batch, seen]  # of this process alone: what lies on devices says the size of all learners'
        return copies.found

    def take(self, update: int) -> tuple[Batch, Any]:
        """(batch on the devices, in the slots of the division; what the curriculum observes, replicated, or None)."""
        return self._ready.pop(update)

    def _own_rows(self, config: TrainConfig) -> np.ndarray:
        """Numbers of the worlds in the slots of this process."""
        return own_rows(self._mesh, self._division, config.num_trained_envs)

    def _placed(self, batch: Batch, seen: Any) -> tuple[Batch, Any]:
        """The batch on the devices, once it is there."""
        static, trajectory, last_value = batch
        placed = Batch(
            shard_worlds(static, self._mesh),
            shard_worlds(trajectory, self._mesh, axis=1),
            shard_worlds(last_value, self._mesh),
        )
        return jax.block_until_ready((placed, replicate(seen, self._mesh)))


def _here(own: np.ndarray, config: TrainConfig, part: int, num_parts: int) -> tuple[np.ndarray, np.ndarray]:
    """Worlds of a part that are among `own`, as (slots there, rows of the part)."""
    worlds_per_group = config.num_trained_envs // config.rollout.num_groups
    groups = config.groups_of_part(part, num_parts)
    first = groups.start * worlds_per_group
    slots = np.flatnonzero((own >= first) & (own < groups.stop * worlds_per_group))
    return slots, own[slots] - first


class _Coming:
    """A batch whose parts are coming."""

    def __init__(self) -> None:
        self.num_parts = 0  # so far
        self.seen: dict[int, Any] = {}  # by part
        self._leaves: list[np.ndarray] = []  # of the batch, with worlds in the slots of this process
        self._tree: Any = None

    @property
    def batch(self) -> Batch:
        return jax.tree.unflatten(self._tree, self._leaves)

    def seen_in_order(self) -> Any:
        """Observation of the curriculum, its parts in order; None where it does not observe."""
        seen = [self.seen[part] for part in sorted(self.seen)]
        return jax.tree.map(lambda *xs: np.concatenate(xs), *seen) if seen else None

    def put(self, batch: Batch, slots: np.ndarray, rows: np.ndarray, num_slots: int) -> list[np.ndarray]:
        """Rows of a part into these slots. Returns what was copied: nothing where the part is all there is."""
        leaves, self._tree = jax.tree.flatten(batch)
        if np.array_equal(rows, np.arange(num_slots)) and len(batch.last_value) == num_slots:
            self._leaves = leaves
            return []
        axes = jax.tree.leaves(_axis_of_worlds(batch))
        if not self._leaves:
            shapes = [_with_length(leaf.shape, axis, num_slots) for leaf, axis in zip(leaves, axes, strict=True)]
            self._leaves = [np.empty(shape, leaf.dtype) for shape, leaf in zip(shapes, leaves, strict=True)]
        copied = [leaf[_at(axis, rows)] for leaf, axis in zip(leaves, axes, strict=True)]
        for whole, axis, piece in zip(self._leaves, axes, copied, strict=True):
            whole[_at(axis, slots)] = piece
        return copied


def _axis_of_worlds(batch: Batch) -> Batch:
    return Batch(jax.tree.map(lambda x: 0, batch.static), jax.tree.map(lambda x: 1, batch.trajectory), 0)


def _with_length(shape: tuple[int, ...], axis: int, length: int) -> tuple[int, ...]:
    return (*shape[:axis], length, *shape[axis + 1 :])


def _at(axis: int, numbers: np.ndarray) -> tuple[Any, ...]:
    """An index of these numbers along an axis; of consecutive ones a slice, which copies faster."""
    first = int(numbers[0])
    is_run = np.array_equal(numbers, np.arange(first, first + len(numbers)))
    return (*[slice(None)] * axis, slice(first, first + len(numbers)) if is_run else numbers)
