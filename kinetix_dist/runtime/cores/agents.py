"""What learns beside the policy: PPO agents of a curriculum, with the update of the learner (`curator/agents.py`)."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn
from jax.sharding import Mesh

from jax2d.scene import Array
from kinetix_dist import prng
from kinetix_dist.config import TrainConfig
from kinetix_dist.env.action_spaces import ActionDistribution
from kinetix_dist.env.environment import Environment
from kinetix_dist.env.observations import Moving, Observation
from kinetix_dist.learner.config import PpoConfig
from kinetix_dist.learner.division import Division
from kinetix_dist.learner.state import LearnerState
from kinetix_dist.learner.update import Update, make_update
from kinetix_dist.level.level import Level
from kinetix_dist.messages import StaticInput, Trajectory
from kinetix_dist.models.policy import init_params
from kinetix_dist.runtime.cores.stored import one_level
from kinetix_dist.runtime.cores.streams import ANTAGONIST, TEACHER, stream


class PpoAgents:
    """Those of one run, which learn on the devices of a mesh."""

    def __init__(self, config: TrainConfig, env: Environment, policy: nn.Module, mesh: Mesh) -> None:
        self._config = config
        self._env = env
        self._policy = policy
        self._mesh = mesh

    def student(self) -> PpoAgent:
        env = self._env
        obs = jax.eval_shape(lambda: some_observation(self._config, env))
        return self._agent(
            self._policy, env.observation, env.action_distribution, obs, self._config.ppo, stream_number=ANTAGONIST
        )

    def teacher(self, policy: nn.Module, distribution: ActionDistribution, obs: Any, **ppo: Any) -> PpoAgent:
        settings = dataclasses.replace(self._config.ppo, **ppo)
        return self._agent(policy, _OfNoEnvironment(), distribution, obs, settings, stream_number=TEACHER)

    def static_input(self, levels: Level) -> StaticInput:
        env, is_masked = self._env, self._config.ppo.mask_unbound_heads
        bound = env.action_space.bound_heads(levels) if is_masked else None
        return StaticInput(obs=env.observation.static(levels), bound_heads=bound)

    def _agent(
        self,
        policy: nn.Module,
        observation: Observation,
        distribution: ActionDistribution,
        obs: Any,
        ppo: PpoConfig,
        *,
        stream_number: int,
    ) -> PpoAgent:
        key = stream(self._config.run.seed, stream_number)
        return PpoAgent(
            policy, observation, distribution, obs, ppo, self._mesh, num_blocks=self._config.num_blocks, key=key
        )


class PpoAgent:
    """See `Agent`. obs: shapes; num_blocks: of worlds, see `TrainConfig.num_blocks`; key: typed, consumed."""

    def __init__(
        self,
        policy: nn.Module,
        observation: Observation,
        distribution: ActionDistribution,
        obs: Any,
        ppo: PpoConfig,
        mesh: Mesh,
        *,
        num_blocks: int,
        key: Array,
    ) -> None:
        self._policy = policy
        self._observation = observation
        self._distribution = distribution
        self._obs = obs
        self._ppo = ppo
        self._mesh = mesh
        self._num_blocks = num_blocks
        self._keys = prng.split(key)

    def init(self) -> LearnerState:
        zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), self._obs)
        return self._ppo.initial_state(init_params(self._policy, zeros, self._keys[0]), self._keys[1])

    def learn(
        self, state: LearnerState, static: StaticInput, trajectory: Trajectory, last_value: Array
    ) -> tuple[LearnerState, dict[str, Array]]:
        if self._division.is_even:
            return self._update(state, static, trajectory, last_value)
        places = self._division.spread(last_value.shape[0])
        static, trajectory = (
            jax.tree.map(lambda x: x[places], static),
            jax.tree.map(lambda x: x[:, places], trajectory),
        )
        return self._update(state, static, trajectory, last_value[places])

    # Made by those alone who learn: rollout actors may have more devices than there are blocks.

    @functools.cached_property
    def _division(self) -> Division:
        return Division(self._num_blocks, self._mesh.devices.size)

    @functools.cached_property
    def _update(self) -> Update:
        return make_update(
            self._policy, self._observation, self._distribution, self._ppo, self._mesh, division=self._division
        )


class _OfNoEnvironment(Observation):
    """All that a teacher sees changes from step to step, and no physics moves it."""

    gives = "construction"

    def static(self, levels: Level) -> None:
        raise NotImplementedError("a teacher sees no finished levels")

    def dynamic(self, moving: Moving) -> None:
        raise NotImplementedError("a teacher sees no physics")

    def join(self, static: None, dynamic: Any) -> Any:
        return dynamic


def some_observation(config: TrainConfig, env: Environment) -> Any:
    """What a policy takes, of any level of the run: [1, ...], for shapes."""
    prepared = env.prepare(one_level(config))
    return env.observe(prepared, prepared.initial_obs)
