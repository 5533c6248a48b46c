"""State of a learner between two updates: parameters, optimizer state, key and counters.

Everything is a plain array (the key as its two words, the step count as two words), so that checkpoints, hashes and
comparisons need no special cases. The optimizer sees parameters as one flat vector: an update is a few large
operations instead of a few for each of some fifty arrays.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.flatten_util import ravel_pytree

from jax2d.scene import Array
from kinetix_dist import prng


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class LearnerState:
    """Replicated over devices and equal on all of them."""

    params: Any  # float32
    average: Any  # as `params`, over updates, see step_size.py; None: there is no average
    opt_state: Any  # of the flattened parameters, see `adam`
    key: Array  # [2] uint32, `prng.key_data` of the learner's key; constant, updates fold in their number
    num_updates: Array  # [] int32, calls of update(); the policy version
    num_gradient_steps: Array  # [] int32, applied (skipped ones are not counted)
    env_steps: Array  # [2] uint32, low and high word of the run's steps before the update: `at_env_steps`
    rate_factor: Array  # [] float32, what the guard on KL has left of the learning rate

    @property
    def released(self) -> Any:
        """The parameters for evaluation, scoring and use: the average, where there is one."""
        return self.params if self.average is None else self.average


def adam(learning_rate: float, *, epsilon: float) -> optax.GradientTransformation:
    """Adam on a flat parameter vector. Clipping by norm is done by the update, which needs the norm anyway."""
    return optax.adam(learning_rate, eps=epsilon)


def init_learner_state(
    params: Any, optimizer: optax.GradientTransformation, key: Array, *, has_average: bool = False
) -> LearnerState:
    """key: a typed key (`prng.key`), from which all shuffling of this learner follows."""
    flat, _ = ravel_pytree(params)
    return LearnerState(
        params=params,
        average=params if has_average else None,
        opt_state=optimizer.init(flat),
        key=prng.key_data(key),
        num_updates=jnp.zeros((), jnp.int32),
        num_gradient_steps=jnp.zeros((), jnp.int32),
        env_steps=jnp.zeros(2, jnp.uint32),
        rate_factor=jnp.ones((), jnp.float32),
    )


def at_env_steps(tree: Any, env_steps: Array) -> Any:
    """`tree` with the clock of every `LearnerState` in it at `env_steps`, as `clock` gives them.

    The clock is that of the run, progress/env_steps before an update: a curriculum may let the policy
    learn from a part of what is played, and other agents from games of other lengths.
    """

    def set_clock(node: Any) -> Any:
        return dataclasses.replace(node, env_steps=env_steps) if isinstance(node, LearnerState) else node

    return jax.tree.map(set_clock, tree, is_leaf=lambda node: isinstance(node, LearnerState))


def clock(env_steps: int) -> np.ndarray:
    """[2] uint32, low and high word: long runs pass 2^32 steps, and JAX has no int64 here."""
    if not 0 <= env_steps < 2**64:
        raise ValueError(f"{env_steps} environment steps; a run has from 0 to {2**64 - 1}")
    return np.array([env_steps % 2**32, env_steps // 2**32], np.uint32)
