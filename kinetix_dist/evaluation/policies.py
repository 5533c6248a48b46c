"""Policies of an evaluation: a network, or one of two baselines.

A policy here is a hashable function `(params, obs [W], keys [W]) -> actions`. One key a world, so that a world acts
the same whichever others it shares a batch with. Frozen dataclasses: two equal policies share what was compiled.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import jax

from jax2d.scene import Array
from kinetix_dist import prng
from kinetix_dist.env.action_spaces import ActionDistribution, ActionSpace
from kinetix_dist.models.gru import initial_memory

Policy = Callable[[Any, Any, Array], Array]


class Player(NamedTuple):
    """A policy and what it plays with."""

    policy: Policy
    params: Any = None  # the baselines take none


@dataclasses.dataclass(frozen=True)
class RandomPolicy:
    """Uniform actions; parameters are not used."""

    space: ActionSpace
    draws: ClassVar[bool] = True

    def __call__(self, params: Any, obs: Any, keys: Array) -> Array:
        return jax.vmap(lambda key: self.space.sample(key, 1)[0])(keys)


@dataclasses.dataclass(frozen=True)
class NoopPolicy:
    """Never acts; what it solves solves itself."""

    space: ActionSpace
    draws: ClassVar[bool] = False

    def __call__(self, params: Any, obs: Any, keys: Array) -> Array:
        return self.space.noop_actions(keys.shape[0])


@dataclasses.dataclass(frozen=True)
class NetworkPolicy:
    """Actions of a network: `module.apply(params, obs) -> (outputs of the actor, value [W])`."""

    module: Any  # flax module, hashable
    distribution: ActionDistribution
    greedy: bool = False  # the most likely actions instead of a sample

    @property
    def draws(self) -> bool:
        return not self.greedy

    def __call__(self, params: Any, obs: Any, keys: Array) -> Array:
        outputs, _ = self.module.apply(params, obs)
        return self.choose(outputs, keys)

    def act_with_memory(self, params: Any, obs: Any, keys: Array, memory: Array) -> tuple[Array, Array]:
        """(actions, next memory [W, size]) of a recurrent network."""
        outputs, _, memory = self.module.apply(params, obs, memory)
        return self.choose(outputs, keys), memory

    def choose(self, outputs: Any, keys: Array) -> Array:
        """Actions [W, ...] from outputs of the actor."""
        if self.greedy:
            return self.distribution.mode(outputs)
        uniforms = jax.vmap(lambda key: prng.uniform(key, (self.distribution.num_uniforms,)))(keys)
        return self.distribution.sample(outputs, uniforms)[0]


def distinct_attempts(policy: Policy, attempts: int) -> int:
    """Number of attempts at a level that can differ: one where the policy draws nothing, since a level begins the
    same way every time and the physics is deterministic. A policy that does not say (`draws`) may draw."""
    return attempts if getattr(policy, "draws", True) else min(attempts, 1)


def first_memory(policy: Policy, num_worlds: int) -> Array | None:
    """Memory of a policy at the start of episodes; None for one without memory."""
    return initial_memory(policy.module, num_worlds) if isinstance(policy, NetworkPolicy) else None


def act(policy: Policy, params: Any, obs: Any, keys: Array, memory: Array | None) -> tuple[Array, Array | None]:
    """(actions, next memory). Only first episodes count, so that no memory is reset here."""
    if memory is None:
        return policy(params, obs, keys), None
    assert isinstance(policy, NetworkPolicy)  # no other has a memory
    return policy.act_with_memory(params, obs, keys, memory)
