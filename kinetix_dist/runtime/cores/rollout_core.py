"""Playing the worlds of an update: draws levels, prepares them, unrolls the policy. Worlds are sharded over a mesh."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.sharding import Mesh, PartitionSpec

from jax2d.scene import Array
from kinetix_dist.actors.unroll import Played, Worlds, unroll
from kinetix_dist.config import TrainConfig
from kinetix_dist.curator.curriculum import Curriculum, Proposal
from kinetix_dist.env.environment import Environment
from kinetix_dist.learner.sharding import DATA_AXIS
from kinetix_dist.messages import LevelOutcome
from kinetix_dist.runtime.cores.streams import LEVELS, PLAY, stream

Seen = tuple[Proposal, LevelOutcome]  # what a curriculum observes


class Batch(NamedTuple):
    """What the learner takes: [W, ...], [T, W, ...] and [W]; arrays, or how each is sharded."""

    static_obs: Any
    trajectory: Any
    last_value: Any


class RolloutCore:
    """Plays the worlds of `groups` of every update."""

    def __init__(
        self,
        config: TrainConfig,
        env: Environment,
        policy: Any,
        curriculum: Curriculum,
        mesh: Mesh,
        *,
        groups: range,
    ) -> None:
        num_groups = len(groups)
        num_devices = mesh.devices.size
        if num_groups % num_devices:
            raise ValueError(
                f"{num_groups} world groups cannot be divided over {num_devices} devices; change rollout.num_groups"
            )
        self._config = config
        self._env = env
        self._policy = policy
        self._curriculum = curriculum
        self._first_group = groups.start
        self._groups_per_device = num_groups // num_devices
        whole, worlds = PartitionSpec(), PartitionSpec(DATA_AXIS)
        self._play = jax.jit(
            jax.shard_map(
                self._play_shard,
                mesh=mesh,
                in_specs=(whole, whole, whole),
                out_specs=(Batch(worlds, PartitionSpec(None, DATA_AXIS), worlds), worlds, whole),
                check_vma=False,
            )
        )

    def play(self, params: Any, state: Any, num_updates: int) -> tuple[Batch, Seen | None, dict[str, Any]]:
        """(what is learned from, what the curriculum sees if it observes, sums over all worlds) of one update.

        state: of the curriculum.
        """
        return self._play(params, state, jnp.uint32(num_updates))

    def _play_shard(self, params: Any, state: Any, num_updates: Array) -> tuple[Batch, Seen | None, dict[str, Any]]:
        config, env = self._config, self._env
        worlds_per_group = config.rollout.worlds_per_group
        device = jax.lax.axis_index(DATA_AXIS)
        groups = self._first_group + device * self._groups_per_device + jnp.arange(self._groups_per_device)
        level_key = jax.random.fold_in(stream(config.run.seed, LEVELS), num_updates)
        play_key = jax.random.fold_in(stream(config.run.seed, PLAY), num_updates)

        group_keys = jax.vmap(lambda group: jax.random.fold_in(level_key, group))(groups)
        proposal = self._curriculum.propose(state, group_keys, groups)
        expected, found = self._groups_per_device * worlds_per_group, proposal.levels.position.shape[0]
        if found != expected:
            raise ValueError(
                f"curriculum {config.curriculum.name!r} proposed {found} levels for {self._groups_per_device} groups "
                f"of {worlds_per_group} worlds; propose must return {expected}"
            )
        prepared = env.prepare(proposal.levels)
        played = unroll(
            self._policy,
            params,
            env,
            Worlds(prepared, *env.reset(prepared)),
            play_key,
            config.rollout.num_steps,
            first_world=groups[0] * worlds_per_group,
        )
        seen = (proposal, self._summarised(played)) if self._curriculum.observes else None
        batch = Batch(prepared.static_obs, played.trajectory, played.last_value)
        batch = worlds_trained(batch, self._groups_per_device, config.num_trained_envs // config.rollout.num_groups)
        return batch, seen, _sums(played.outcome, played.trajectory.rewards)

    def _summarised(self, played: Played) -> LevelOutcome:
        summary = self._curriculum.summarise(played.trajectory, played.last_value)
        return dataclasses.replace(played.outcome, summary=summary)


def worlds_trained(batch: Batch, num_groups: int, kept: int) -> Batch:
    """Of each group the first `kept` worlds, those that the policy learns from."""
    size = batch.last_value.shape[0] // num_groups
    if kept == size:
        return batch
    world = (jnp.arange(num_groups)[:, None] * size + jnp.arange(kept)).reshape(-1)
    return Batch(
        jax.tree.map(lambda x: x[world], batch.static_obs),
        jax.tree.map(lambda x: x[:, world], batch.trajectory),
        batch.last_value[world],
    )


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
