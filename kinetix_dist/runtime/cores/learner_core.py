"""Learning from a batch: advantages and PPO epochs on a mesh, parameters and optimiser replicated over it."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from jax2d.scene import Array
from kinetix_dist.checkpoint import flatten_arrays, select_arrays, unflatten_arrays
from kinetix_dist.config import TrainConfig
from kinetix_dist.env.environment import Environment
from kinetix_dist.learner.config import PpoConfig
from kinetix_dist.learner.division import Division
from kinetix_dist.learner.plasticity import Measure, make_measure
from kinetix_dist.learner.sharding import local_values, replicate, shapes_of_replicated
from kinetix_dist.learner.state import LearnerState, at_env_steps, clock
from kinetix_dist.learner.update import exported_update, make_update
from kinetix_dist.models.added_layers import with_added_layers
from kinetix_dist.models.policy import init_params
from kinetix_dist.runtime.cores.curriculum_state import some_observation
from kinetix_dist.runtime.cores.dataset_samples import checked_dataset, source_of_dataset
from kinetix_dist.runtime.cores.imitation import Imitated, Source, imitate, one_pool
from kinetix_dist.runtime.cores.programs import MAX_CACHED, settings_of_programs
from kinetix_dist.runtime.cores.proof_samples import levels_and_proofs, samples_of_proofs
from kinetix_dist.runtime.cores.run_names import INIT, LEARNER, OPTIMIZER, PARAMS, SHUFFLE, START, stream


class LearnerCore:
    """Parameters and optimiser, replicated over a mesh, and the update of them."""

    def __init__(self, config: TrainConfig, env: Environment, policy: Any, mesh: Mesh) -> None:
        config.check_batch()
        self._config = config
        self._env, self._policy, self._mesh = env, policy, mesh
        self.division = Division(config.num_blocks, mesh.devices.size)
        self._ppo: PpoConfig | None = None
        self.set_ppo(config.ppo)
        self.state: LearnerState | None = None
        self.num_updates = 0  # that led to it

    def start(self, arrays: Mapping[str, np.ndarray] | None) -> None:
        """Starts from a checkpoint's arrays, or afresh from the seed, or afresh with the parameters of another run."""
        self.state = self.started(arrays)
        self.num_updates = int(self.state.num_updates)

    def started(self, arrays: Mapping[str, np.ndarray] | None, *, seed: int | None = None) -> LearnerState:
        """State that `start` begins with. seed: another one than the configuration's."""
        given = select_arrays(arrays or {}, START)
        if arrays is not None and not given:
            state = unflatten_arrays(self.shapes, select_arrays(arrays, LEARNER))
        else:
            state = local_values(self._init_of(seed)())
            if given:  # counters, key and what the guard has left are those of a new run
                deep_enough = with_added_layers(select_arrays(given, PARAMS), flatten_arrays(state.params))
                params = unflatten_arrays(state.params, deep_enough)
                average = None if state.average is None else params
                state = dataclasses.replace(state, params=params, average=average)
            if optimizer := select_arrays(given, OPTIMIZER):  # else all zeros, whatever the parameters
                state = dataclasses.replace(state, opt_state=unflatten_arrays(state.opt_state, optimizer))
        return replicate(state, self._mesh)

    def _init_of(self, seed: int | None) -> Callable[[], LearnerState]:
        config = self._config
        if seed is not None:
            config = dataclasses.replace(config, run=dataclasses.replace(config.run, seed=seed))
        return _init_program(settings_of_programs(config), self._env, self._policy)

    def set_ppo(self, ppo: PpoConfig) -> None:
        """Sets the settings of updates from now on; an update of other settings is compiled when it is first made."""
        if ppo == self._ppo:
            return
        self._ppo = ppo
        parts = self._policy, self._env.observation, self._env.action_distribution
        make = make_update if self._config.run.plugins else exported_update  # their code may change
        self._update = make(*parts, ppo, self._mesh, division=self.division)

    @functools.cached_property
    def shapes(self) -> LearnerState:
        """Shapes of `state`, with its shardings; also before the start."""
        return shapes_of_replicated(_shapes_of_state(self._config, self._env, self._policy), self._mesh)

    @property
    def params(self) -> Any:
        assert self.state is not None, "start() comes first"
        return self.state.params

    @property
    def released(self) -> Any:
        assert self.state is not None, "start() comes first"
        return self.state.released

    def learn(self, static: Any, trajectory: Any, last_value: Array, *, env_steps: int) -> dict[str, Array]:
        """Learns from worlds in all slots of the division. env_steps: of the run before this update."""
        assert self.state is not None, "start() comes first"
        self.state, metrics = self.learned(self.state, static, trajectory, last_value, env_steps=env_steps)
        self.num_updates += 1
        if self._config.plasticity.is_due(self.num_updates):
            metrics = metrics | self._measure(self.params, static, trajectory)
        return metrics

    def learned(
        self, state: LearnerState, static: Any, trajectory: Any, last_value: Array, *, env_steps: int
    ) -> tuple[LearnerState, dict[str, Array]]:
        """(next state, metrics of the update) of a learner in this state, which is used up."""
        clocked = at_env_steps(state, replicate(clock(env_steps), self._mesh))
        return self._update(clocked, static, trajectory, last_value)

    def imitate(self, steps: int) -> tuple[Imitated, dict[str, Any]]:
        """Imitates proofs or a data set before the first update: (what came of it, without the parameters, and what
        was imitated)."""
        assert self.state is not None, "start() comes first"
        config, params = self._config, local_values(self.state.params)
        source = imitated_source(config, self._env)
        imitated = imitate(self._env, self._policy, params, source, config.imitation, steps=steps, seed=config.run.seed)
        params = local_values(imitated.params)
        average = None if self.state.average is None else params
        self.state = replicate(
            dataclasses.replace(local_values(self.state), params=params, average=average), self._mesh
        )
        return imitated._replace(params=None), source.about()

    @functools.cached_property
    def _measure(self) -> Measure:
        return make_measure(self._policy, self._env.observation, self._mesh, division=self.division)

    def compile(self, static: Any, trajectory: Any, last_value: Any) -> None:
        """Compiles `learn` for arrays like these, of which shapes and shardings are enough."""
        update: Any = self._update  # made by jax.jit; `Update` describes only its call
        update.lower(self.shapes, static, trajectory, last_value).compile()


def check_imitated(config: TrainConfig, env: Environment) -> None:
    """Raises ValueError or OSError, one line, where a run cannot imitate what it is to; looks at no sample yet."""
    if config.imitation.data:
        checked_dataset(config)
    else:
        levels_and_proofs(config, env)


def imitated_source(config: TrainConfig, env: Environment) -> Source:
    """Samples that a run imitates. Raises as `check_imitated`."""
    return source_of_dataset(config) if config.imitation.data else one_pool(samples_of_proofs(config, env))


@functools.lru_cache(maxsize=MAX_CACHED)
def _init_program(config: TrainConfig, env: Environment, policy: Any) -> Callable[[], LearnerState]:
    return jax.jit(lambda: initial_state(config, env, policy))


def initial_state(config: TrainConfig, env: Environment, policy: Any) -> LearnerState:
    """Parameters drawn from the seed."""
    return config.ppo.initial_state(_initial_params(config, env, policy), stream(config.run.seed, SHUFFLE))


def _initial_params(config: TrainConfig, env: Environment, policy: Any) -> Any:
    """The observation of any level gives the shapes."""
    obs = jax.eval_shape(lambda: some_observation(config, env))
    zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), obs)
    return init_params(policy, zeros, stream(config.run.seed, INIT))


def _shapes_of_state(config: TrainConfig, env: Environment, policy: Any) -> LearnerState:
    """Shapes of `initial_state`."""
    return jax.eval_shape(lambda: initial_state(config, env, policy))
