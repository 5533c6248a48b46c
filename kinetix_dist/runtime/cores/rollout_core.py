"""Playing the worlds of an update: draws levels, prepares them, unrolls the policy. Worlds are sharded over a mesh."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import Mesh, PartitionSpec

from jax2d.scene import Array
from kinetix_dist.actors.unroll import unroll
from kinetix_dist.config import TrainConfig
from kinetix_dist.curator.curriculum import make_propose
from kinetix_dist.curator.level_buffer import LevelBuffer
from kinetix_dist.env.environment import Environment
from kinetix_dist.env.noop import noop_solved
from kinetix_dist.learner.sharding import DATA_AXIS
from kinetix_dist.messages import LevelOutcome
from kinetix_dist.runtime.cores.levels import fixed_levels
from kinetix_dist.runtime.cores.streams import LEVELS, PLAY, stream


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

    def play(self, params: Any, buffer: LevelBuffer | None, num_updates: int) -> tuple[Any, Any, Array, dict[str, Any]]:
        """(static_obs [W, ...], trajectory [T, W, ...], last_value [W], sums over all worlds) of one update."""
        return self._play(params, buffer, jnp.uint32(num_updates))

    def _play_shard(
        self, params: Any, buffer: LevelBuffer | None, num_updates: Array
    ) -> tuple[Any, Any, Array, dict[str, Any]]:
        config, env = self._config, self._env
        worlds_per_group = config.rollout.worlds_per_group
        device = jax.lax.axis_index(DATA_AXIS)
        groups = self._first_group + device * self._groups_per_device + jnp.arange(self._groups_per_device)
        level_key = jax.random.fold_in(stream(config.run.seed, LEVELS), num_updates)
        play_key = jax.random.fold_in(stream(config.run.seed, PLAY), num_updates)

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


def _sums(outcome: LevelOutcome, rewards: Array) -> dict[str, Any]:
    """What the metrics need, over the worlds of all devices."""
    local = {
        "finished": outcome.num_finished.sum(),
        "solved": outcome.num_solved.sum(),
        "failed": outcome.num_failed.sum(),
        "return": outcome.return_sum.sum(),
        "reward": rewards.sum(),
        "steps": jnp.int32(rewards.size),
        "physics": jax.tree.map(lambda count: count.sum(dtype=jnp.float32), outcome.physics),  # beyond an int32
    }
    return jax.lax.psum(local, DATA_AXIS)
