"""Checks that the rows of a shard are transitions of their data set: one vectorised pass over the columns.

A shard whose SHA-256 is right can still hold anything, since whoever writes the file also writes the index.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import jax
import numpy as np

from kinetix_dist.data.columns import Transitions
from kinetix_dist.data.rollout import ChosenBy
from kinetix_dist.data.shards import Shard
from kinetix_dist.env.action_spaces import ActionSpace

MAX_LOG_PROBABILITY = 1e-5  # 0 to the rounding of float32 over all dimensions


def fault_of_rows(
    rows: Transitions, shard: Shard, space: ActionSpace, first_row: int, *, is_policy_known: bool
) -> str | None:
    """Return the first thing that is wrong, in words; `None` if the rows are valid.

    Args:
        rows: [N], with `static_obs` of all levels of the data set.
        shard: line of the index.
        space: of the actions.
        first_row: number of the first row in the whole data set.
        is_policy_known: the rows have log-probabilities. Without them, `log_prob` is NaN.
    """
    log_prob_checks = _log_prob_checks(rows, space) if is_policy_known else _unknown_log_prob_checks(rows)
    for is_wrong, text in itertools.chain(_checks(rows, space, first_row), log_prob_checks):
        if is_wrong.any():
            return f"row {int(np.argmax(is_wrong))} {text}"
    counts = {"episodes": int(rows.done.sum()), "solved": int(rows.solved.sum())}
    for name, count in counts.items():
        if getattr(shard, name) != count:
            return f"it has {count:,} {name}, and {getattr(shard, name):,} in the index"
    return None


def _checks(rows: Transitions, space: ActionSpace, first_row: int) -> Iterator[tuple[np.ndarray, str]]:
    """Yield for each rule which rows break it, [N] bool, and how."""
    num_rows, num_levels = len(rows.level), len(jax.tree.leaves(rows.static_obs)[0])
    yield (rows.level < 0) | (rows.level >= num_levels), f"is of a level that is not one of 0 to {num_levels - 1}"
    yield _of_rows(~np.asarray(space.in_range(rows.actions))), f"has an action that {space.name} actions cannot have"
    yield ~np.isfinite(rows.rewards), "has a reward that is not finite"
    for leaf in jax.tree.leaves(rows.dynamic_obs):
        if leaf.dtype.kind == "f":
            yield _of_rows(~np.isfinite(leaf)), "has an observation that is not finite"
    yield ~np.isin(rows.chosen_by, list(ChosenBy)), "has a chosen_by that does not exist"
    yield (rows.solved | rows.timed_out) & ~rows.done, "ends an episode that goes on"
    yield rows.policy_version < -1, "is of a negative policy_version"
    place = first_row + np.arange(num_rows)
    yield (rows.step < 0) | (rows.episode + rows.step != place), f"is not row {first_row:,} and so on of the data set"
    yield rows.first != (rows.step == 0), "is a first step by only one of first and step"
    continues = np.append(rows.episode[1:] == rows.episode[:-1], False)
    yield rows.done & continues, "ends an episode, and the next row continues it"


def _log_prob_checks(rows: Transitions, space: ActionSpace) -> Iterator[tuple[np.ndarray, str]]:
    """Yield the rules of `log_prob`, as `_checks` does."""
    yield np.isnan(rows.log_prob) | (rows.log_prob == np.inf), "has a log_prob that is not finite"
    is_impossible = np.isneginf(rows.log_prob)  # noise may choose an action that the policy never takes
    yield is_impossible & (rows.chosen_by == ChosenBy.POLICY), "has an action of the policy with probability 0"
    if space.is_integer:
        yield rows.log_prob > MAX_LOG_PROBABILITY, "has a log_prob above 0, a probability above 1"


def _unknown_log_prob_checks(rows: Transitions) -> Iterator[tuple[np.ndarray, str]]:
    yield ~np.isnan(rows.log_prob), "has a log_prob, and the policy is unknown"


def _of_rows(is_wrong: np.ndarray) -> np.ndarray:
    """Reduce [N, ...] to [N]."""
    return np.any(is_wrong.reshape(len(is_wrong), -1), axis=1)
