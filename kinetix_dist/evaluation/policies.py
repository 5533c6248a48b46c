"""Who acts in an evaluation: a network, or one of two baselines that need none.

A policy here is a hashable function `(params, obs [W], keys [W]) -> actions`. One key a world, so that a world acts
the same whichever others it shares a batch with. Frozen dataclasses: two equal policies share what was compiled.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax

from jax2d.scene import Array
from kinetix_dist.env.action_spaces import ActionDistribution, ActionSpace

Policy = Callable[[Any, Any, Array], Array]


class Player(NamedTuple):
    """A policy and what it plays with."""

    policy: Policy
    params: Any = None  # the baselines take none


@dataclasses.dataclass(frozen=True)
class RandomPolicy:
    """Uniform actions; parameters are not used."""

    space: ActionSpace

    def __call__(self, params: Any, obs: Any, keys: Array) -> Array:
        return jax.vmap(lambda key: self.space.sample(key, 1)[0])(keys)


@dataclasses.dataclass(frozen=True)
class NoopPolicy:
    """Never acts; what it solves solves itself."""

    space: ActionSpace

    def __call__(self, params: Any, obs: Any, keys: Array) -> Array:
        return self.space.noop_actions(keys.shape[0])


@dataclasses.dataclass(frozen=True)
class NetworkPolicy:
    """Actions of a network: `module.apply(params, obs) -> (outputs of the actor, value [W])`."""

    module: Any  # flax module, hashable
    distribution: ActionDistribution
    greedy: bool = False  # the most likely actions instead of a sample

    def __call__(self, params: Any, obs: Any, keys: Array) -> Array:
        outputs, _ = self.module.apply(params, obs)
        if self.greedy:
            return self.distribution.mode(outputs)
        uniforms = jax.vmap(lambda key: jax.random.uniform(key, (self.distribution.num_uniforms,)))(keys)
        return self.distribution.sample(outputs, uniforms)[0]
