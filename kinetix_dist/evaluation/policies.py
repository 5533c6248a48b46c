"""Who acts in an evaluation: a network, or one of two baselines that need none.

A policy here is a hashable function `(params, obs [W], keys [W]) -> actions`. One key a world, so that a world acts
the same whichever others it shares a batch with. Frozen dataclasses: two equal policies share what was compiled.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax

from jax2d.scene import Array
from kinetix_dist.env.actions import noop_actions
from kinetix_dist.env.observations.entities import EntityObs
from kinetix_dist.env.spaces import ActionSpace
from kinetix_dist.models import heads

Policy = Callable[[Any, EntityObs, Array], Array]


@dataclasses.dataclass(frozen=True)
class RandomPolicy:
    """Uniform actions; parameters are not used."""

    space: ActionSpace

    def __call__(self, params: Any, obs: EntityObs, keys: Array) -> Array:
        return jax.vmap(lambda key: self.space.sample(key, 1)[0])(keys)


@dataclasses.dataclass(frozen=True)
class NoopPolicy:
    """Never acts; what it solves solves itself."""

    space: ActionSpace

    def __call__(self, params: Any, obs: EntityObs, keys: Array) -> Array:
        return noop_actions(self.space, keys.shape[0])


@dataclasses.dataclass(frozen=True)
class NetworkPolicy:
    """Multi-discrete actions of a network: `module.apply(params, obs) -> (logits of each head [W, k], value [W])`."""

    module: Any  # flax module, hashable
    greedy: bool = False  # most likely action of each head instead of a sample

    def __call__(self, params: Any, obs: EntityObs, keys: Array) -> Array:
        logits, _ = self.module.apply(params, obs)
        if self.greedy:
            return heads.mode(logits)
        uniforms = jax.vmap(lambda key: jax.random.uniform(key, (len(logits),)))(keys)
        return heads.sample(logits, uniforms)[0]
