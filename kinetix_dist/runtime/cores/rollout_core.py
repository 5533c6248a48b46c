"""Playing the worlds of an update: draws levels, prepares them, unrolls the policy. Worlds are sharded over a mesh."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jax2d.scene import Array
from kinetix_dist import prng
from kinetix_dist.actors.unroll import Played, Worlds, unroll
from kinetix_dist.config import TrainConfig
from kinetix_dist.curator.buffer_share import members
from kinetix_dist.curator.curriculum import Curriculum, Proposal
from kinetix_dist.env.environment import Environment
from kinetix_dist.learner.division import Division
from kinetix_dist.learner.sharding import DATA_AXIS, on_devices
from kinetix_dist.level.fit import size_numbers
from kinetix_dist.level.level import SIZES
from kinetix_dist.messages import LevelOutcome, StaticInput
from kinetix_dist.models.kernels.cuda_kernel import CUSTOM_CALLS
from kinetix_dist.models.kernels.support import traced_for
from kinetix_dist.program_cache import ProgramKey, exported_on_mesh, is_cacheable
from kinetix_dist.runtime.cores.programs import MAX_CACHED, settings_of_programs
from kinetix_dist.runtime.cores.run_names import LEVELS, PLAY, stream

CACHE = "rollouts"  # folder in the program cache
BUILDER = f"{__package__}.playing"  # makes the players; it reaches the functions that a curriculum is given, too
Seen = tuple[Proposal, LevelOutcome]  # what a curriculum observes
SIZES_PLAYED = "sizes"  # in the sums of an update where sizes are mixed: by size, in the order of `SIZES`
BY_SOURCE = "by_source"  # in the sums of an update: attempts of each source and slot of `Proposal.source`


class Batch(NamedTuple):
    """Batch that the learner takes: [W, ...], [T, W, ...] and [W]; arrays, or how each is sharded.

    Worlds lie in all slots of a division, see `Division.spread`.
    """

    static: Any  # `StaticInput`
    trajectory: Any
    last_value: Any


class Players(NamedTuple):
    """Objects that play an update, of one configuration."""

    env: Environment
    policy: Any
    curriculum: Curriculum


class RolloutCore:
    """Plays the worlds of `groups` of every update.

    division: of blocks of these groups over the devices of the mesh, by default of single ones. key: of its
    program in the program cache; None: it is traced in every process.
    """

    def __init__(
        self,
        config: TrainConfig,
        players: Players,
        mesh: Mesh,
        *,
        groups: range,
        division: Division | None = None,
        key: ProgramKey | None = None,
    ) -> None:
        env, policy, curriculum = players
        self.division = division or Division(len(groups), mesh.devices.size)
        self._config = config
        self._env = env
        self._policy = policy
        self._curriculum = curriculum
        self._num_counted = len(curriculum.sources) + curriculum.num_slots  # see `Proposal.source`
        self._first_group = groups.start
        self._groups_per_part = len(groups) // self.division.num_parts
        # Here: a program that is read prepares no levels.
        env.check_memory(self.division.slots * self._groups_per_part * config.rollout.worlds_per_group)
        whole, worlds = PartitionSpec(), PartitionSpec(DATA_AXIS)
        self._mesh = mesh
        self._batch_specs = Batch(worlds, PartitionSpec(None, DATA_AXIS), worlds)
        specs: dict[str, Any] = {
            "in_specs": (whole, whole, whole),
            "out_specs": (self._batch_specs, worlds, whole),
        }
        on_mesh = on_devices(self._play_shard, mesh, **specs)

        def rollout(params: Any, state: Any, num_updates: Array) -> tuple[Batch, Seen | None, dict[str, Any]]:
            return on_mesh(params, state, num_updates)

        self.program = jax.jit(rollout) if key is None else exported_on_mesh(rollout, key, mesh, **specs)

    def play(self, params: Any, state: Any, num_updates: int) -> tuple[Batch, Seen | None, dict[str, Any]]:
        """(what is learned from, what the curriculum sees if it observes, sums over all worlds) of one update.

        state: of the curriculum. The first two lie in all slots of the division; repeated worlds are in no sum.
        """
        return self.program(params, state, jnp.uint32(num_updates))

    def traced(self, params: Any, state: Any) -> tuple[Any, Batch]:
        """(the program of `play` for such arrays, to be lowered, shapes and shardings of the batch that it gives)."""
        traced = self.program.trace(params, state, jnp.uint32(0))
        batch, _, _ = traced.out_info
        specs = jax.tree.broadcast(self._batch_specs, batch, is_leaf=lambda x: isinstance(x, PartitionSpec))
        return traced, jax.tree.map(self._shape, batch, specs)

    def _shape(self, array: Any, spec: PartitionSpec) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(array.shape, array.dtype, sharding=NamedSharding(self._mesh, spec))

    def _play_shard(self, params: Any, state: Any, num_updates: Array) -> tuple[Batch, Seen | None, dict[str, Any]]:
        config, env = self._config, self._env
        worlds_per_group = config.rollout.worlds_per_group
        device = jax.lax.axis_index(DATA_AXIS)
        parts = jnp.asarray(self.division.parts)[device]
        groups = self._first_group + members(parts, self._groups_per_part)
        num_groups = groups.size
        level_key = prng.fold_in(stream(config.run.seed, LEVELS), num_updates)
        play_key = prng.fold_in(stream(config.run.seed, PLAY), num_updates)

        group_keys = jax.vmap(lambda group: prng.fold_in(level_key, group))(groups)
        proposal = self._curriculum.propose(state, group_keys, groups)
        expected, found = num_groups * worlds_per_group, proposal.levels.position.shape[0]
        if found != expected:
            raise ValueError(
                f"curriculum {config.curriculum.name!r} proposed {found} levels for {num_groups} groups "
                f"of {worlds_per_group} worlds; propose must return {expected}"
            )
        prepared = env.prepare(proposal.levels)
        policy, params = self._curriculum.players(self._policy, params, state)
        static = StaticInput(
            obs=prepared.static_obs, bound_heads=prepared.bound_heads if config.ppo.mask_unbound_heads else None
        )
        worlds = Worlds(prepared, *env.reset(prepared), members(groups, worlds_per_group), static.bound_heads)
        played = unroll(
            policy,
            params,
            env,
            worlds,
            play_key,
            config.rollout.num_steps,
            keep_timeouts=config.ppo.bootstrap_timeouts,
        )
        seen = None
        if self._curriculum.observes:
            seen = dataclasses.replace(proposal, source=None), self._summarised(played)
        batch = Batch(static, played.trajectory, played.last_value)
        batch = worlds_trained(batch, num_groups, config.num_trained_envs // config.rollout.num_groups)
        is_counted = jnp.repeat(jnp.asarray(self.division.is_counted)[device], expected // self.division.slots)
        sums = sums_of(played.outcome, played.trajectory.rewards, is_counted)
        # Also where no outcomes.jsonl is written: another program may round otherwise.
        source = proposal.source if proposal.source is not None else jnp.zeros(is_counted.shape, jnp.int32)
        sums[BY_SOURCE] = attempts_by(source, played.outcome, is_counted, self._num_counted)
        if config.curriculum.sizes:
            sums[SIZES_PLAYED] = attempts_by(size_numbers(proposal.levels), played.outcome, is_counted, len(SIZES))
        return batch, seen, sums

    def _summarised(self, played: Played) -> LevelOutcome:
        summary = self._curriculum.summarise(played.trajectory, played.last_value)
        return dataclasses.replace(played.outcome, summary=summary)


def rollout_core(
    config: TrainConfig,
    players: Players,
    mesh: Mesh,
    *,
    groups: range,
    division: Division | None = None,
) -> RolloutCore:
    """A `RolloutCore`, the same for runs of equal settings and the same players: it holds no state but its program.

    players: of the configuration. Code from outside of this project may change, and so may levels
    that a curriculum is given: then the program is traced in every process.
    """
    settings = settings_of_programs(config)
    env, policy, curriculum = players
    parts = env.observation, env.action_space, env.action_distribution, policy, type(curriculum)
    key = None
    if is_cacheable(*parts) and not config.run.plugins and not config.curriculum.levels:
        key = ProgramKey(
            kind=CACHE,
            module=BUILDER,
            parts=parts,
            depends_on=(settings, groups, division),
            at_trace=traced_for,
            custom_calls=CUSTOM_CALLS,
        )
    return _cached(settings, players, mesh, groups=groups, division=division, key=key)


_cached = functools.lru_cache(maxsize=MAX_CACHED)(RolloutCore)


def worlds_trained(batch: Batch, num_groups: int, num_trained: int) -> Batch:
    """The first `num_trained` worlds of each group, those that the policy learns from."""
    size = batch.last_value.shape[0] // num_groups
    if num_trained == size:
        return batch
    world = members(jnp.arange(num_groups), size, num_trained)
    return Batch(
        jax.tree.map(lambda x: x[world], batch.static),
        jax.tree.map(lambda x: x[:, world], batch.trajectory),
        batch.last_value[world],
    )


def sums_of(outcome: LevelOutcome, rewards: Array, is_counted: Array) -> dict[str, Any]:
    """Sums that the metrics need, over the worlds of all devices, each once. An attempt is the first episode of a
    world."""
    outcome, rewards = jax.tree.map(lambda x: jnp.where(is_counted, x, 0), (outcome, rewards))
    local = {
        "finished": outcome.num_finished.sum(),
        "attempts": is_counted.sum(dtype=jnp.int32),
        "solved": outcome.first_solved.sum(),
        "failed": outcome.first_failed.sum(),
        "return": outcome.first_return.sum(),
        "reward": rewards.sum(),
        "steps": rewards.shape[0] * is_counted.sum(dtype=jnp.int32),
        "physics": jax.tree.map(lambda count: count.sum(dtype=jnp.float32), outcome.physics),  # beyond an int32
    }
    return jax.lax.psum(local, DATA_AXIS)


def attempts_by(group: Array, outcome: LevelOutcome, is_counted: Array, num_groups: int) -> dict[str, Array]:
    """Attempts by the group of a world, and those solved, over all devices, each world once: [num_groups] int32."""
    # Ones that depend on the outcome: a count that needs no rollout is compiled together with what does, which then
    # rounds otherwise for another number of groups (tests/finetune/test_specialists.py, with the flags of the tests).
    attempts = jnp.where(outcome.num_finished < 0, 0, 1)
    counts = {"solved": outcome.first_solved, "attempts": attempts}
    return {name: _totals_by(group, jnp.where(is_counted, count, 0), num_groups) for name, count in counts.items()}


def _totals_by(group: Array, count: Array, num_groups: int) -> Array:
    """Over the worlds of all devices: [num_groups] int32."""
    return jax.lax.psum(jnp.zeros(num_groups, jnp.int32).at[group].add(count), DATA_AXIS)
