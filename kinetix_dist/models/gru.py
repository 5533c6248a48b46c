"""Memory of a policy: a gated recurrent unit between the embedding of an observation and the towers (Cho et al. 2014).

    r = sigmoid(x W_r + b_r + h U_r)     n  = tanh(x W_n + b_n + r (h U_n + c))
    z = sigmoid(x W_z + b_z + h U_z)     h' = (1 - z) n + z h

h' is the memory and what the towers are given. It is zero at the start of every episode. As in the public package; in
float32 throughout, whatever the type of the activations.

A policy with a memory is applied in one of two ways:

    policy.apply(params, obs, memory)              one step of B worlds -> (outputs, value, next memory)
    policy.apply(params, obs, is_first=is_first)   T steps of B worlds, T B rows of obs -> (outputs, value)

The second starts from zero, or from a `memory` that is given too: that of the policy which acted, where worlds go on
from the update before (a stored state: Kapturowski et al. 2019, R2D2). `initial_memory`, `act` and `reset_memory` are
for playing; they take policies without memory too.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn

from jax2d.scene import Array
from kinetix_dist.models.towers import Towers, stacked


class Gru(nn.Module):
    """See above. size: of the memory."""

    size: int

    @nn.compact
    def __call__(self, x: Array, memory: Array | None, is_first: Array | None) -> Array:
        """The memory after x [B, E]: [B, size] float32; with is_first [T, B], after each step of x [T B, E]."""
        input_kernel = self.param(
            "input_kernel", nn.initializers.lecun_normal(), (x.shape[-1], 3 * self.size), jnp.float32
        )
        input_bias = self.param("input_bias", nn.initializers.zeros, (3 * self.size,), jnp.float32)
        memory_kernel = self.param("memory_kernel", _orthogonal_gates, (self.size, 3 * self.size), jnp.float32)
        memory_bias = self.param("memory_bias", nn.initializers.zeros, (self.size,), jnp.float32)
        given = x.astype(jnp.float32) @ input_kernel + input_bias

        def step(memory: Array, given: Array) -> Array:
            kept = memory @ memory_kernel
            given_r, given_z, given_n = jnp.split(given, 3, axis=-1)
            kept_r, kept_z, kept_n = jnp.split(kept, 3, axis=-1)
            z = jax.nn.sigmoid(given_z + kept_z)
            n = jnp.tanh(given_n + jax.nn.sigmoid(given_r + kept_r) * (kept_n + memory_bias))
            return (1.0 - z) * n + z * memory

        if is_first is not None:

            def next_step(memory: Array, at: tuple[Array, Array]) -> tuple[Array, Array]:
                given, is_first = at
                memory = step(reset_memory(memory, is_first), given)
                return memory, memory

            start = jnp.zeros((is_first.shape[1], self.size), jnp.float32) if memory is None else memory
            rows = given.reshape(*is_first.shape, 3 * self.size)
            return jax.lax.scan(next_step, start, (rows, is_first))[1].reshape(-1, self.size)
        if memory is None:
            if not self.is_initializing():
                raise ValueError("a recurrent policy acts with its memory; see kinetix_dist/models/gru.py")
            memory = jnp.zeros((x.shape[0], self.size), jnp.float32)
        return step(memory, given)


def _orthogonal_gates(key: Array, shape: tuple[int, int], dtype: Any = jnp.float32) -> Array:
    """[size, 3 size]: three orthogonal matrices side by side."""
    parts = stacked(nn.initializers.orthogonal())(key, (3, shape[0], shape[1] // 3), dtype)
    return jnp.concatenate(list(parts), axis=1)


def apply_towers(
    towers: Callable[..., Any], embedding: Array, memory: Array | None, is_first: Array | None, size: int
) -> Any:
    """Outputs of a network for its embedding: (outputs, value), and after one step the next memory where one was given.

    size: of the memory; 0: none. Towers without heads: the embedding itself, as `make_encoder` has it. Called inside of
    a compact network.
    """
    if isinstance(towers, Towers) and not towers.head_sizes:
        return embedding
    if not size:
        return towers(embedding)
    after = Gru(size, name="gru")(embedding, memory, is_first)
    outputs, value = towers(after.astype(embedding.dtype))
    return (outputs, value) if memory is None or is_first is not None else (outputs, value, after)


def has_memory(policy: Any) -> bool:
    """The network has a memory; False for one of a plugin that does not say."""
    return getattr(policy, "memory_size", 0) > 0


def initial_memory(policy: Any, num_worlds: int) -> Array | None:
    """[W, size] zeros, at the start of an episode; None for a policy without memory."""
    return jnp.zeros((num_worlds, policy.memory_size), jnp.float32) if has_memory(policy) else None


def act(policy: Any, params: Any, obs: Any, memory: Array | None) -> tuple[Any, Array, Array | None]:
    """(outputs of the actor, value, next memory) of one step."""
    if memory is None:
        return *policy.apply(params, obs), None
    return policy.apply(params, obs, memory)


def reset_memory(memory: Array | None, done: Array) -> Array | None:
    """Zero for the worlds [W] whose episode ended."""
    return None if memory is None else jnp.where(done[:, None], 0.0, memory)
