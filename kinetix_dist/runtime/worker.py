"""The work itself, in plain JAX: playing, learning, scoring. Knows nothing of processes, Ray or files.

    RolloutCore   draw levels for an update, prepare, unroll           (worlds sharded over a mesh)
    LearnerCore   advantages and PPO epochs                            (the same mesh, or one of its own)
    Worker        both, for the colocated placement and local mode
    CuratorCore   a buffer of learnable levels, from parameters and a key

Everything random follows from (seed, stream, update, world): there is no generator state to keep, and no result
depends on how worlds are spread over devices.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from jax2d.scene import Array
from kinetix_dist.actors.unroll import score, unroll
from kinetix_dist.checkpoint import flatten_arrays, select_arrays, unflatten_arrays
from kinetix_dist.config import TrainConfig
from kinetix_dist.curator.curriculum import make_propose
from kinetix_dist.curator.domain_randomization import fresh_levels
from kinetix_dist.curator.level_buffer import LevelBuffer, buffer_metrics, keep_best
from kinetix_dist.curator.sfl import SflScorer
from kinetix_dist.env.environment import Environment
from kinetix_dist.env.noop import noop_solved
from kinetix_dist.env.observations.entities import observe
from kinetix_dist.learner.sharding import DATA_AXIS, data_mesh, local_values, replicate, shard_worlds
from kinetix_dist.learner.state import LearnerState, init_learner_state
from kinetix_dist.learner.update import make_update
from kinetix_dist.level.level import Level
from kinetix_dist.level.sets import load_level_set
from kinetix_dist.messages import LevelOutcome
from kinetix_dist.models.policy import init_params, make_policy
from kinetix_dist.runtime.compile_cache import enable_compile_cache
from kinetix_dist.runtime.evaluator import Evaluator
from kinetix_dist.runtime.placement import ProcessPlan

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
            fixed_levels=_fixed_levels(config),
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


class Worker:
    """Worlds and a learner shard on the same devices: one process of the colocated placement, or all of local mode."""

    def __init__(self, config: TrainConfig, mesh: Mesh) -> None:
        self._config = config
        self._mesh = mesh
        env = Environment(config.env)
        policy = make_policy(config.policy, env.action_head_sizes)
        self._learner = LearnerCore(config, env, policy, mesh)
        self._rollout = RolloutCore(config, env, policy, mesh, first_group=0, num_groups=config.rollout.num_groups)
        self._evaluator = Evaluator(config, env, policy)
        self._buffer: LevelBuffer | None = None

    def start(self, num_updates: int, arrays: Mapping[str, np.ndarray] | None) -> None:
        del num_updates  # it is in the learner's state
        self._learner.start(arrays)
        self._buffer = None
        if (buffer := stored_buffer(self._config, arrays)) is not None:
            self.adopt(buffer)

    def weights(self) -> Any:
        return local_values(self._learner.params)

    def adopt(self, buffer: LevelBuffer) -> None:
        self._buffer = replicate(buffer, self._mesh)

    def run_update(self, num_updates: int) -> tuple[dict[str, float], dict[str, float]]:
        """(metrics, seconds of "rollout" and "learn")."""
        began = time.monotonic()
        static_obs, trajectory, last_value, sums = self._rollout.play(self._learner.params, self._buffer, num_updates)
        sums = local_values(sums)  # waits for the rollout
        played = time.monotonic()
        learner_metrics = local_values(self._learner.learn(static_obs, trajectory, last_value))
        learned = time.monotonic()
        metrics = training_metrics(sums, learner_metrics)
        if self._buffer is not None:
            metrics |= {name: float(np.asarray(value)) for name, value in self._buffer_metrics(num_updates).items()}
        return metrics, {"rollout": played - began, "learn": learned - played}

    def snapshot(self) -> dict[str, np.ndarray]:
        state: dict[str, Any] = {LEARNER: local_values(self._learner.state)}
        if self._buffer is not None:
            state[BUFFER] = local_values(self._buffer)
        return flatten_arrays(state)

    def evaluate(self, use_policy: bool) -> dict[str, dict[str, float]]:
        return self._evaluator.evaluate(self.weights() if use_policy else None)

    def record(self, num_rollouts: int, num_updates: int) -> list[Any]:
        return self._evaluator.record(self.weights(), num_rollouts, num_updates)

    def device(self) -> dict[str, Any]:
        return describe_devices(self._mesh)

    def _buffer_metrics(self, num_updates: int) -> dict[str, Any]:
        assert self._buffer is not None
        return buffer_metrics(local_values(self._buffer), num_updates)


class RolloutWorker:
    """Part `index` of the worlds: one rollout actor of the split placement. Stateless between calls."""

    def __init__(self, config: TrainConfig, mesh: Mesh, *, index: int, num_parts: int) -> None:
        self._mesh = mesh
        self._num_env_steps = config.rollout.steps_per_update // num_parts
        env = Environment(config.env)
        policy = make_policy(config.policy, env.action_head_sizes)
        num_groups = config.rollout.num_groups // num_parts
        self._rollout = RolloutCore(config, env, policy, mesh, first_group=index * num_groups, num_groups=num_groups)

    def play(
        self, update: int, policy_version: int, params: Any, buffer: LevelBuffer | None
    ) -> tuple[dict[str, Any], tuple[Any, ...]]:
        """(stamp, batch as numpy) of this part of batch `update`."""
        began = time.monotonic()
        params, buffer = replicate(params, self._mesh), replicate(buffer, self._mesh)
        batch = jax.device_get(self._rollout.play(params, buffer, update))
        stamp = {
            "update": update,
            "policy_version": policy_version,
            "num_env_steps": self._num_env_steps,
            "seconds": time.monotonic() - began,
        }
        return stamp, batch


class LearnerWorker:
    """The learner process of the split placement: what `Worker` does, with batches that come from elsewhere."""

    def __init__(self, config: TrainConfig, mesh: Mesh) -> None:
        self._config = config
        self._mesh = mesh
        env = Environment(config.env)
        policy = make_policy(config.policy, env.action_head_sizes)
        self._learner = LearnerCore(config, env, policy, mesh)
        self._evaluator = Evaluator(config, env, policy)
        self._buffer: LevelBuffer | None = None

    def start(self, num_updates: int, arrays: Mapping[str, np.ndarray] | None) -> LevelBuffer | None:
        """Returns the buffer in use, which the rollout actors draw from."""
        del num_updates
        self._learner.start(arrays)
        self._buffer = stored_buffer(self._config, arrays)
        return self._buffer

    def weights(self) -> Any:
        return local_values(self._learner.params)

    def adopt(self, buffer: LevelBuffer) -> None:
        self._buffer = buffer

    def learn(self, num_updates: int, *parts: tuple[Any, ...]) -> tuple[dict[str, float], dict[str, float]]:
        """Learns from the parts of a batch, in the order of their worlds: (metrics, seconds)."""
        began = time.monotonic()
        static_obs, trajectory, last_value, sums = zip(*parts, strict=True)
        join = lambda axis: lambda *xs: np.concatenate(xs, axis=axis)  # noqa: E731
        static_obs = shard_worlds(jax.tree.map(join(0), *static_obs), self._mesh)
        trajectory = shard_worlds(jax.tree.map(join(1), *trajectory), self._mesh, axis=1)
        last_value = shard_worlds(np.concatenate(last_value), self._mesh)
        learner_metrics = local_values(self._learner.learn(static_obs, trajectory, last_value))
        metrics = training_metrics(jax.tree.map(lambda *xs: sum(xs), *sums), learner_metrics)
        if self._buffer is not None:
            metrics |= {name: float(np.asarray(v)) for name, v in buffer_metrics(self._buffer, num_updates).items()}
        return metrics, {"learn": time.monotonic() - began}

    def snapshot(self) -> dict[str, np.ndarray]:
        state: dict[str, Any] = {LEARNER: local_values(self._learner.state)}
        if self._buffer is not None:
            state[BUFFER] = self._buffer
        return flatten_arrays(state)

    def evaluate(self, use_policy: bool) -> dict[str, dict[str, float]]:
        return self._evaluator.evaluate(self.weights() if use_policy else None)

    def record(self, num_rollouts: int, num_updates: int) -> list[Any]:
        return self._evaluator.record(self.weights(), num_rollouts, num_updates)

    def device(self) -> dict[str, Any]:
        return describe_devices(self._mesh)


class CuratorCore:
    """Scores fresh levels with given parameters. The same (parameters, version) give the same buffer, bit for bit."""

    def __init__(self, config: TrainConfig) -> None:
        curriculum = config.curriculum
        env = Environment(config.env)
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


# What a backend spawns


def build_worker(plan: ProcessPlan, num_processes: int, config: TrainConfig) -> Worker:
    del plan, num_processes
    enable_compile_cache(config.run.compile_cache)
    return Worker(config, data_mesh())


def build_learner(plan: ProcessPlan, num_processes: int, config: TrainConfig) -> LearnerWorker:
    del plan, num_processes
    enable_compile_cache(config.run.compile_cache)
    return LearnerWorker(config, data_mesh())


def build_rollout(plan: ProcessPlan, num_processes: int, config: TrainConfig) -> RolloutWorker:
    del num_processes
    enable_compile_cache(config.run.compile_cache)
    return RolloutWorker(config, data_mesh(), index=plan.index, num_parts=config.run.num_rollout_actors)


def build_curator(plan: ProcessPlan, num_processes: int, config: TrainConfig) -> CuratorCore:
    del plan, num_processes
    enable_compile_cache(config.run.compile_cache)
    return CuratorCore(config)


# Pieces


def _fixed_levels(config: TrainConfig) -> Level | None:
    """The levels of curriculum `fixed`."""
    if not config.curriculum.levels:
        return None
    return load_level_set(config.curriculum.levels, config.env.size)[0]


def describe_devices(mesh: Mesh) -> dict[str, Any]:
    """What a report says of the devices that learn."""
    device = mesh.devices.flat[0]
    return {"platform": device.platform, "kind": device.device_kind, "count": int(mesh.devices.size)}


def _initial_state(config: TrainConfig, env: Environment, policy: Any) -> LearnerState:
    """Parameters drawn from the seed; the observation of any level gives the shapes."""
    key = stream(config.run.seed, _INIT)
    obs = jax.eval_shape(lambda: _some_observation(config, env))
    zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), obs)
    params = init_params(policy, zeros, key)
    return init_learner_state(params, config.ppo.optimizer(), stream(config.run.seed, _SHUFFLE))


def _some_observation(config: TrainConfig, env: Environment) -> Any:
    prepared = env.prepare(_one_level(config, env))
    _, obs = env.reset(prepared)
    return observe(prepared.static_obs, obs)


def _one_level(config: TrainConfig, env: Environment) -> Level:
    from kinetix_dist.level.generator import generate_level

    level = generate_level(jax.random.key(0), env.capacity, config.curriculum.generator)
    return jax.tree.map(lambda x: x[None], level)


def stored_buffer(config: TrainConfig, arrays: Mapping[str, np.ndarray] | None) -> LevelBuffer | None:
    """The level buffer of a checkpoint; None when there is none in it."""
    stored = select_arrays(arrays or {}, BUFFER)
    if not stored:
        return None
    curriculum = config.curriculum

    def template() -> LevelBuffer:
        level = _one_level(config, Environment(config.env))
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


def training_metrics(sums: Mapping[str, Any], learner_metrics: Mapping[str, Any]) -> dict[str, float]:
    """Metrics of one update, by the names of `telemetry.names`."""
    finished = float(sums["finished"])

    def per_episode(name: str) -> float:
        return float(sums[name]) / finished if finished else float("nan")

    metrics = {
        "train/episodes": finished,
        "train/solve_rate": per_episode("solved"),
        "train/failed_rate": per_episode("failed"),
        "train/mean_return": per_episode("return"),
        "train/mean_reward": float(sums["reward"]) / float(sums["steps"]),
    }
    return metrics | {f"learner/{name}": float(value) for name, value in learner_metrics.items()}
