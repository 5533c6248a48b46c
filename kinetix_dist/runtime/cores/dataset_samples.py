"""Samples for imitation from a data set: what the policy chose itself, with returns, some levels held out.

Rows whose action was drawn by noise or repeated say nothing about the policy and are left out. The end of the last
episode of a world in a shard was not seen: its rows have actions, and no return.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np

from kinetix_dist.config import ImitationConfig, TrainConfig
from kinetix_dist.data import Dataset, DatasetError, Transitions, open_dataset
from kinetix_dist.data.rollout import ChosenBy
from kinetix_dist.runtime.cores.imitation import IMITATION_STREAM, Samples, Source

POOL_ROWS = 1 << 22  # transitions on the device at a time: 1.5 GB at M
HELD_OUT_ROWS = 1 << 14  # that an evaluation plays at most: a share of them is known to a percent


def checked_dataset(config: TrainConfig) -> Dataset:
    """The data set of `imitation.data`. Raises DatasetError where it is not one of this run."""
    data = open_dataset(config.imitation.data, skip_damaged=config.imitation.skip_damaged)
    data.check_env(config.env)
    return data


def source_of_dataset(config: TrainConfig, *, pool_rows: int = POOL_ROWS) -> Source:
    """Samples of the data set of a run, `pool_rows` of them at a time. Raises DatasetError as its reader does."""
    data, settings = checked_dataset(config), config.imitation
    groups = _groups(data, pool_rows)
    size = max(sum(data.shards[number].rows for number in group) for group in groups)
    rng = np.random.default_rng((config.run.seed, IMITATION_STREAM))

    def samples_of(group: list[int]) -> Samples:
        return usable_samples(data, data.read(group), config.ppo.discount)

    first = samples_of(groups[0])
    held_out = held_out_levels(settings, np.unique(first.level), len(data.levels.names), rng)
    evaluated = np.flatnonzero(held_out[first.level])
    evaluated = np.sort(rng.permutation(evaluated)[:HELD_OUT_ROWS])

    def pools() -> Iterator[tuple[Samples, int]]:
        learned = _picked(first, ~held_out[first.level])
        if len(groups) == 1:
            yield from itertools.repeat((learned, len(learned.level)))
        for turn in itertools.count():
            for number in rng.permutation(len(groups)) if turn else range(len(groups)):
                samples = samples_of(groups[number])
                yield _padded(_picked(samples, ~held_out[samples.level]), size)

    def about() -> dict[str, Any]:
        return {
            "data": str(data.folder),
            "transitions": len(data),
            "held_out_levels": int(held_out.sum()),
            "skipped_shards": len(data.skipped),
        }

    return Source(
        pools(),
        steps_per_pool=0 if len(groups) == 1 else max(size // settings.batch_size, 1),
        held_out=_picked(first, evaluated) if settings.held_out else None,
        about=about,
    )


def _groups(data: Dataset, pool_rows: int) -> list[list[int]]:
    """Shards that are in memory at a time."""
    per_group = max(pool_rows // max(shard.rows for shard in data.shards), 1)
    numbers = list(range(len(data.shards)))
    return [numbers[start : start + per_group] for start in range(0, len(numbers), per_group)]


def held_out_levels(
    config: ImitationConfig, there: np.ndarray, num_levels: int, rng: np.random.Generator
) -> np.ndarray:
    """[L] bool. there: numbers of the levels to choose from. Raises DatasetError where none would be left."""
    number = math.ceil(config.held_out * len(there))
    if number == len(there):
        raise DatasetError(
            f"imitation.held_out {config.held_out:g} of {len(there)} levels leaves none to learn from; set it to 0, "
            "or collect more levels"
        )
    mask = np.zeros(num_levels, bool)
    mask[rng.permutation(there)[:number]] = True
    return mask


def usable_samples(data: Dataset, rows: Transitions, discount: float) -> Samples:
    """Rows to learn from. Raises DatasetError where there are none."""
    returns, is_known = returns_of(rows, discount)
    is_usable = rows.chosen_by == ChosenBy.POLICY
    if not is_usable.any():
        raise DatasetError(f"data set {data.folder} has nothing that its policy chose; collect it with less noise")
    samples = Samples(
        static_obs=rows.static_obs,
        dynamic_obs=rows.dynamic_obs,
        level=rows.level,
        actions=rows.actions,
        returns=returns,
        has_return=is_known.astype(np.float32),
        bound_heads=data.levels.bound_heads,
    )
    return _picked(samples, is_usable)


def returns_of(rows: Transitions, discount: float) -> tuple[np.ndarray, np.ndarray]:
    """(discounted return [N] float32 from each row to the end of its episode, [N] bool that this end was seen).

    From the last step of the longest episode to the first ones, all episodes at once.
    """
    number = len(rows.step)
    goes_on = np.zeros(number, bool)
    goes_on[:-1] = (rows.episode[1:] == rows.episode[:-1]) & (np.diff(rows.step) == 1)
    returns, is_known = rows.rewards.astype(np.float32), rows.done.copy()
    order = np.argsort(rows.step, kind="stable")
    starts = np.searchsorted(rows.step[order], np.arange(int(rows.step.max(initial=0)) + 2))
    for step in range(len(starts) - 2, -1, -1):
        here = order[starts[step] : starts[step + 1]]
        here = here[goes_on[here]]
        returns[here] += np.float32(discount) * returns[here + 1]
        is_known[here] = is_known[here + 1]
    return returns, is_known


def _picked(samples: Samples, index: np.ndarray) -> Samples:
    of_levels = {"static_obs": samples.static_obs, "bound_heads": samples.bound_heads}
    rows = samples._replace(static_obs=None, bound_heads=None)
    return jax.tree.map(lambda x: x[index], rows)._replace(**of_levels)


def _padded(samples: Samples, size: int) -> tuple[Samples, int]:
    """Samples of one shape, so that they are learned from by one program; and how many of them there are."""
    number = len(samples.level)
    return _picked(samples, np.minimum(np.arange(size), number - 1)), number
