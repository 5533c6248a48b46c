"""Learning from a batch: advantages and PPO epochs on a mesh, parameters and optimiser replicated over it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from jax2d.scene import Array
from kinetix_dist.checkpoint import select_arrays, unflatten_arrays
from kinetix_dist.config import TrainConfig
from kinetix_dist.env.environment import Environment
from kinetix_dist.learner.division import Division
from kinetix_dist.learner.sharding import local_values, replicate
from kinetix_dist.learner.state import LearnerState, init_learner_state
from kinetix_dist.learner.update import make_update
from kinetix_dist.models.gru import has_memory
from kinetix_dist.models.policy import init_params
from kinetix_dist.runtime.cores.agents import some_observation
from kinetix_dist.runtime.cores.stored import LEARNER, START
from kinetix_dist.runtime.cores.streams import INIT, SHUFFLE, stream


class LearnerCore:
    """Parameters and optimiser, replicated over a mesh, and the update of them."""

    def __init__(self, config: TrainConfig, env: Environment, policy: Any, mesh: Mesh) -> None:
        config.ppo.check_batch(
            num_steps=config.rollout.num_steps, num_worlds=config.num_trained_envs, whole_worlds=has_memory(policy)
        )
        self._config = config
        self._mesh = mesh
        self.division = Division(config.num_blocks, mesh.devices.size)
        self._update = make_update(
            policy, env.observation, env.action_distribution, config.ppo, mesh, division=self.division
        )
        self._init = jax.jit(lambda: _initial_state(config, env, policy))
        self.state: LearnerState | None = None

    def start(self, arrays: Mapping[str, np.ndarray] | None) -> None:
        """From a checkpoint's arrays, or afresh from the seed, or afresh with the parameters of another run."""
        given = select_arrays(arrays or {}, START)
        if arrays is not None and not given:
            state = unflatten_arrays(jax.eval_shape(self._init), select_arrays(arrays, LEARNER))
        else:
            state = local_values(self._init())
            if given:  # the optimiser of a new run is all zeros, whatever the parameters
                params = unflatten_arrays(state.params, given)
                average = None if state.average is None else params
                state = dataclasses.replace(state, params=params, average=average)
        self.state = replicate(state, self._mesh)

    @property
    def params(self) -> Any:
        assert self.state is not None, "start() comes first"
        return self.state.params

    @property
    def released(self) -> Any:
        assert self.state is not None, "start() comes first"
        return self.state.released

    def learn(self, static: Any, trajectory: Any, last_value: Array) -> dict[str, Array]:
        """From worlds in all places of the division."""
        self.state, metrics = self._update(self.state, static, trajectory, last_value)
        return metrics


def _initial_state(config: TrainConfig, env: Environment, policy: Any) -> LearnerState:
    """Parameters drawn from the seed; the observation of any level gives the shapes."""
    key = stream(config.run.seed, INIT)
    obs = jax.eval_shape(lambda: some_observation(config, env))
    zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), obs)
    params = init_params(policy, zeros, key)
    ppo = config.ppo
    return init_learner_state(
        params, ppo.optimizer(), stream(config.run.seed, SHUFFLE), has_average=ppo.average_updates > 0
    )
