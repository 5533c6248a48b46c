"""A trained policy as a pure function: `load_policy`, `PolicyFunction`.

policy = load_policy("generalist")                      or the path of a checkpoint or of a run
action, memory = policy(observation, key)
action, memory = policy(observation, key, memory)       of a recurrent policy, from the second step on
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn

from jax2d import after_fork
from jax2d.scene import Array
from kinetix_dist import prng
from kinetix_dist.env.env_config import EnvConfig
from kinetix_dist.env.environment import Environment
from kinetix_dist.evaluation.policies import NetworkPolicy, act
from kinetix_dist.level.walls import empty_level
from kinetix_dist.models.gru import initial_memory, reset_memory
from kinetix_dist.trained_policy import trained_at


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class PolicyFunction:
    """A network with its parameters; a pytree, so that `jit` takes it as an argument too."""

    params: Any
    network_policy: NetworkPolicy = dataclasses.field(metadata={"static": True})
    env_config: EnvConfig = dataclasses.field(metadata={"static": True})  # of its training: observation, action space
    observation_structure: Any = dataclasses.field(metadata={"static": True})  # pytree of an observation

    def __call__(self, observation: Any, key: Array, memory: Array | None = None) -> tuple[Array, Array | None]:
        """(actions of a batch of worlds, next memory). Pure; consumes the key.

        memory: of a recurrent policy, as the last call gave it; None at the start of episodes. Policies without memory
        take and give None. Raises ValueError for another kind of observation than the policy was trained with.
        """
        after_fork.check()
        if jax.tree.structure(observation) != self.observation_structure:
            kind = self.env_config.observation
            raise ValueError(
                f"observation is of type {type(observation).__name__}; this policy takes {kind!r} observations: make "
                f"the environment with EnvConfig(observation={kind!r})"
            )
        return _act(self, observation, key, memory)

    @property
    def network(self) -> nn.Module:
        """The flax module: `network.apply(params, observation)` gives logits and value."""
        return self.network_policy.module

    def initial_memory(self, num_worlds: int) -> Array | None:
        """Memory at the start of episodes, [W, size] zeros; None for a policy without."""
        return initial_memory(self.network, num_worlds)

    def reset_memory(self, memory: Array | None, done: Array) -> Array | None:
        """Memory after a step: zeros in worlds whose episode ended, where `done` [W]."""
        return reset_memory(memory, done)


@jax.jit  # compiled also where a caller is not
def _act(policy: PolicyFunction, observation: Any, key: Array, memory: Array | None) -> tuple[Array, Array | None]:
    num_worlds = jax.tree.leaves(observation)[0].shape[0]
    memory = policy.initial_memory(num_worlds) if memory is None else memory
    return act(policy.network_policy, policy.params, observation, prng.split(key, num_worlds), memory)


def load_policy(name: str | Path = "generalist", *, greedy: bool = False) -> PolicyFunction:
    """The policy of a checkpoint.

    Args:
      name: of a bundled policy, or the path of a checkpoint, or of a run, whose newest checkpoint is taken.
      greedy: takes the most likely actions instead of drawing them.
    """
    after_fork.check()
    trained = trained_at(Path(name))
    config = trained.config.env
    env = Environment(config)
    one_level = jax.tree.map(lambda x: jnp.asarray(x)[None], empty_level(config.capacity))
    player = trained.player(env, one_level, greedy=greedy)
    assert isinstance(player.policy, NetworkPolicy)  # of a checkpoint, always
    return PolicyFunction(
        params=player.params,
        network_policy=player.policy,
        env_config=config,
        observation_structure=jax.tree.structure(env.observation_space),
    )
