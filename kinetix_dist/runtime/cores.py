"""Playing, learning and scoring in plain JAX. Knows nothing of processes, Ray or files.

    RolloutCore   draw levels for an update, prepare, unroll           (worlds sharded over a mesh)
    LearnerCore   advantages and PPO epochs                            (the same mesh, or one of its own)
    CuratorCore   a buffer of learnable levels, from parameters and a key

Everything random follows from (seed, stream, update, world): there is no generator state to keep, and no result depends
on how worlds are spread over devices.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from jax2d.scene import Array
from kinetix_dist.actors.unroll import score, unroll
from kinetix_dist.checkpoint import select_arrays, unflatten_arrays
from kinetix_dist.config import TrainConfig
from kinetix_dist.curator.curriculum import make_propose
from kinetix_dist.curator.domain_randomization import fresh_levels
from kinetix_dist.curator.level_buffer import LevelBuffer, keep_best
from kinetix_dist.curator.sfl import SflScorer
from kinetix_dist.env.environment import Environment
from kinetix_dist.env.noop import noop_solved
from kinetix_dist.env.observations.entities import observe
from kinetix_dist.learner.sharding import DATA_AXIS, local_values, replicate
from kinetix_dist.learner.state import LearnerState, init_learner_state
from kinetix_dist.learner.update import make_update
from kinetix_dist.level.generator import generate_level
from kinetix_dist.level.level import Level
from kinetix_dist.messages import LevelOutcome
from kinetix_dist.models.policy import init_params, make_policy
from kinetix_dist.runtime.levels import fixed_levels, make_environment

# Names in a checkpoint
LEARNER, BUFFER, ACTING = "learner", "buffer", "acting"

# Streams of random numbers: folded into the key of the seed, then whatever varies within a stream.
_INIT, _LEVELS, _PLAY, _SHUFFLE, _CURATE = range(5)


def stream(seed: int, number: int) -> Array:
    return jax.random.fold_in(jax.random.key(seed), number)


class RolloutCore:
    """Plays the worlds of groups [first_group, first_group + num_groups) of every update."""

    def __init__(
        self, config: TrainConfig, env: Environment, policy: Any, mesh: Mesh, *, first_group: int, num_groups: int
    ) -> None:
        num_devices = mesh.devices.size
        if num_groups % num_devices:
            raise ValueError(
                f"{num_groups} world groups cannot be divided over {num_devices} devices; change rollout.num_groups"
            )
        self._config = config
        self._env = env
        self._policy = policy
        self._first_group = first_group
        self._groups_per_device = num_groups // num_devices
        self._propose = make_propose(
            config.curriculum,
            capacity=env.capacity,
            worlds_per_group=config.rollout.worlds_per_group,
            noop_solved=lambda levels: noop_solved(env, levels),
            fixed_levels=fixed_levels(config),
        )
        whole, worlds = PartitionSpec(), PartitionSpec(DATA_AXIS)
        self._play = jax.jit(
            jax.shard_map(
                self._play_shard,
                mesh=mesh,
                in_specs=(whole, whole, whole),
                out_specs=(worlds, PartitionSpec(None, DATA_AXIS), worlds, whole),
                check_vma=False,
            )
        )

    def play(
        self, params: Any, buffer: LevelBuffer | None, num_updates: int
    ) -> tuple[Any, Any, Array, dict[str, Array]]:
        """(static_obs [W, ...], trajectory [T, W, ...], last_value [W], sums over all worlds) of one update."""
        return self._play(params, buffer, jnp.uint32(num_updates))

    def _play_shard(
        self, params: Any, buffer: LevelBuffer | None, num_updates: Array
    ) -> tuple[Any, Any, Array, dict[str, Array]]:
        config, env = self._config, self._env
        worlds_per_group = config.rollout.worlds_per_group
        device = jax.lax.axis_index(DATA_AXIS)
        groups = self._first_group + device * self._groups_per_device + jnp.arange(self._groups_per_device)
        level_key = jax.random.fold_in(stream(config.run.seed, _LEVELS), num_updates)
        play_key = jax.random.fold_in(stream(config.run.seed, _PLAY), num_updates)

        levels = self._propose(jax.vmap(lambda group: jax.random.fold_in(level_key, group))(groups), groups, buffer)
        prepared = env.prepare(levels)
        env_state, obs = env.reset(prepared)
        trajectory, _, _, last_value, outcome = unroll(
            self._policy,
            params,
            env,
            prepared,
            env_state,
            obs,
            play_key,
            config.rollout.num_steps,
            first_world=groups[0] * worlds_per_group,
        )
        return prepared.static_obs, trajectory, last_value, _sums(outcome, trajectory.rewards)


class LearnerCore:
    """Parameters and optimiser, replicated over a mesh, and the update of them."""

    def __init__(self, config: TrainConfig, env: Environment, policy: Any, mesh: Mesh) -> None:
        config.ppo.check_batch(
            num_steps=config.rollout.num_steps, num_worlds=config.rollout.num_envs, num_devices=mesh.devices.size
        )
        self._config = config
        self._mesh = mesh
        self._update = make_update(policy, observe, config.ppo, mesh)
        self._init = jax.jit(lambda: _initial_state(config, env, policy))
        self.state: LearnerState | None = None

    def start(self, arrays: Mapping[str, np.ndarray] | None) -> None:
        """From a checkpoint's arrays, or afresh from the seed."""
        if arrays is None:
            state = local_values(self._init())
        else:
            state = unflatten_arrays(jax.eval_shape(self._init), select_arrays(arrays, LEARNER))
        self.state = replicate(state, self._mesh)

    @property
    def params(self) -> Any:
        assert self.state is not None, "start() comes first"
        return self.state.params

    def learn(self, static_obs: Any, trajectory: Any, last_value: Array) -> dict[str, Array]:
        self.state, metrics = self._update(self.state, static_obs, trajectory, last_value)
        return metrics


class CuratorCore:
    """Scores fresh levels with given parameters. The same (parameters, version) give the same buffer, bit for bit."""

    def __init__(self, config: TrainConfig) -> None:
        curriculum = config.curriculum
        env = make_environment(config)
        policy = make_policy(config.policy, env.action_head_sizes)

        def draw_levels(key: Array, num_levels: int) -> Level:
            return fresh_levels(
                key[None],
                num_levels,
                capacity=env.capacity,
                generator=curriculum.generator,
                noop_solved=lambda levels: noop_solved(env, levels),
            )

        def play(params: Any, levels: Level, key: Array) -> tuple[Array, Array]:
            outcome = score(policy, params, env, env.prepare(levels), key, curriculum.scoring_steps)
            return outcome.num_solved, outcome.num_finished

        self._seed = config.run.seed
        self._scorer = SflScorer(
            num_candidates=curriculum.num_candidates,
            batch=curriculum.scoring_batch,
            buffer_size=curriculum.buffer_size,
            draw_levels=draw_levels,
            play=play,
        )

    def refresh(self, params: Any, policy_version: int) -> LevelBuffer:
        """A new buffer, as numpy."""
        key = jax.random.fold_in(stream(self._seed, _CURATE), policy_version)
        return jax.device_get(self._scorer.refresh(jax.device_put(params), policy_version, key))


# Pieces


def _initial_state(config: TrainConfig, env: Environment, policy: Any) -> LearnerState:
    """Parameters drawn from the seed; the observation of any level gives the shapes."""
    key = stream(config.run.seed, _INIT)
    obs = jax.eval_shape(lambda: _some_observation(config, env))
    zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), obs)
    params = init_params(policy, zeros, key)
    return init_learner_state(params, config.ppo.optimizer(), stream(config.run.seed, _SHUFFLE))


def _some_observation(config: TrainConfig, env: Environment) -> Any:
    prepared = env.prepare(_one_level(config))
    _, obs = env.reset(prepared)
    return observe(prepared.static_obs, obs)


def _one_level(config: TrainConfig) -> Level:
    level = generate_level(jax.random.key(0), config.env.capacity, config.curriculum.generator)
    return jax.tree.map(lambda x: x[None], level)


def stored_buffer(config: TrainConfig, arrays: Mapping[str, np.ndarray] | None) -> LevelBuffer | None:
    """The level buffer of a checkpoint; None when there is none in it."""
    stored = select_arrays(arrays or {}, BUFFER)
    if not stored:
        return None
    curriculum = config.curriculum

    def template() -> LevelBuffer:
        level = _one_level(config)
        count = jnp.zeros(curriculum.buffer_size, jnp.int32)
        levels = jax.tree.map(lambda x: jnp.broadcast_to(x, (curriculum.buffer_size, *x.shape[1:])), level)
        return keep_best(levels, count, count, size=curriculum.buffer_size, policy_version=0)

    return unflatten_arrays(jax.eval_shape(template), stored)


def _sums(outcome: LevelOutcome, rewards: Array) -> dict[str, Array]:
    """What the metrics need, over the worlds of all devices."""
    local = {
        "finished": outcome.num_finished.sum(),
        "solved": outcome.num_solved.sum(),
        "failed": outcome.num_failed.sum(),
        "return": outcome.return_sum.sum(),
        "reward": rewards.sum(),
        "steps": jnp.int32(rewards.size),
    }
    return jax.lax.psum(local, DATA_AXIS)
