"""Sums over the worlds of an update, each world once, of which `update_metrics.py` makes metrics.

An attempt is the first episode of a world on its level: see `actors/outcomes.py`.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from jax2d.scene import Array
from kinetix_dist.curator.fresh_pairs import NO_COPY
from kinetix_dist.learner.sharding import DATA_AXIS
from kinetix_dist.messages import LevelOutcome

SIZES_PLAYED = "sizes"  # in the sums of an update where sizes are mixed: by size, in the order of `SIZES`
# In the sums of an update: "solved" and "attempts" of each source and slot of `Proposal.source`, and FRESH_PAIRS.
BY_SOURCE = "by_source"
FRESH_PAIRS = "fresh_pairs"  # pairs of `Proposal.copy_of` with 0, 1 and 2 attempts solved; absent where there are none


def step_sums(outcome: LevelOutcome, rewards: Array, is_counted: Array) -> dict[str, Any]:
    """Sums that the metrics need of the steps of an update, over the worlds of all devices, each once."""
    outcome, rewards = jax.tree.map(lambda x: jnp.where(is_counted, x, 0), (outcome, rewards))
    local = {
        "finished": outcome.num_finished.sum(),
        "reward": rewards.sum(),
        "steps": rewards.shape[0] * is_counted.sum(dtype=jnp.int32),
        "physics": jax.tree.map(lambda count: count.sum(dtype=jnp.float32), outcome.physics),  # beyond an int32
    }
    return jax.lax.psum(local, DATA_AXIS)


def attempt_sums(outcome: LevelOutcome, is_counted: Array) -> dict[str, Any]:
    """Sums over the first episodes of the worlds of all devices, each once: an attempt is one."""
    outcome = jax.tree.map(lambda x: jnp.where(is_counted, x, 0), outcome)
    local = {
        "attempts": is_counted.sum(dtype=jnp.int32),
        "solved": outcome.first_solved.sum(),
        "failed": outcome.first_failed.sum(),
        "return": outcome.first_return.sum(),
    }
    return jax.lax.psum(local, DATA_AXIS)


def attempts_by(group: Array, outcome: LevelOutcome, is_counted: Array, num_groups: int) -> dict[str, Array]:
    """Attempts by the group of a world, and those solved, over all devices, each world once: [num_groups] int32."""
    # Ones that depend on the outcome: a count that needs no rollout is compiled together with what does, which then
    # rounds otherwise for another number of groups (tests/finetune/test_specialists.py, with the flags of the tests).
    attempts = jnp.where(outcome.num_finished < 0, 0, 1)
    counts = {"solved": outcome.first_solved, "attempts": attempts}
    return {name: _totals_by(group, jnp.where(is_counted, count, 0), num_groups) for name, count in counts.items()}


def pairs_by_solved(copy_of: Array, outcome: LevelOutcome, is_counted: Array, worlds_per_group: int) -> Array:
    """Pairs of worlds with 0, 1 and 2 attempts solved, over all devices, each pair once: [3] int32. copy_of: as in
    `Proposal`, of the worlds of this device, group by group."""
    world, is_copy = jnp.arange(copy_of.shape[0]), copy_of != NO_COPY
    original = world - world % worlds_per_group + jnp.where(is_copy, copy_of, 0)
    num_solved = outcome.first_solved + outcome.first_solved[original]
    return _totals_by(num_solved, (is_copy & is_counted).astype(jnp.int32), 3)


def _totals_by(group: Array, count: Array, num_groups: int) -> Array:
    """Over the worlds of all devices: [num_groups] int32."""
    return jax.lax.psum(jnp.zeros(num_groups, jnp.int32).at[group].add(count), DATA_AXIS)
