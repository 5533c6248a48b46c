"""Playing the worlds of an update: draws levels, prepares them, unrolls the policy. Worlds are sharded over a mesh.

    reset_every 1    one program: levels, prepare, reset, unroll
    reset_every k    every k-th update  levels, prepare, reset  --> worlds
                     every update       worlds, prepare, unroll --> worlds, which go on (`ongoing_worlds.py`)

Attempts are counted in the update that ends with a reset, over all steps since the last one.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jax2d.scene import Array
from kinetix_dist import prng
from kinetix_dist.actors.outcomes import joined
from kinetix_dist.actors.unroll import Played, Worlds, unroll
from kinetix_dist.config import TrainConfig
from kinetix_dist.curator.buffer_share import members
from kinetix_dist.curator.curriculum import Curriculum, Proposal
from kinetix_dist.env.environment import Environment
from kinetix_dist.env.records import EnvState, PreparedLevels
from kinetix_dist.learner.division import Division
from kinetix_dist.learner.sharding import DATA_AXIS, on_devices
from kinetix_dist.level.fit import size_numbers
from kinetix_dist.level.level import SIZES
from kinetix_dist.messages import LevelOutcome, StaticInput
from kinetix_dist.models.kernels.cuda_kernel import CUSTOM_CALLS
from kinetix_dist.models.kernels.support import traced_for
from kinetix_dist.program_cache import ProgramKey, exported_on_mesh, is_cacheable
from kinetix_dist.runtime.cores.ongoing_worlds import (
    Episodes,
    OngoingWorlds,
    begun,
    source_of,
    with_worlds_first,
    with_worlds_last,
)
from kinetix_dist.runtime.cores.programs import MAX_CACHED, settings_of_programs
from kinetix_dist.runtime.cores.rollout_sums import (
    BY_SOURCE,
    FRESH_PAIRS,
    SIZES_PLAYED,
    attempt_sums,
    attempts_by,
    pairs_by_solved,
    step_sums,
)
from kinetix_dist.runtime.cores.run_names import LEVELS, PLAY, stream

CACHE = "rollouts"  # folder in the program cache
BUILDER = f"{__package__}.playing"  # makes the players; it reaches the functions that a curriculum is given, too
Seen = tuple[Proposal, LevelOutcome]  # what a curriculum observes


class Batch(NamedTuple):
    """Batch that the learner takes: [W, ...], [T, W, ...] and [W]; arrays, or how each is sharded.

    Worlds lie in all slots of a division, see `Division.spread`.
    """

    static: Any  # `StaticInput`
    trajectory: Any
    last_value: Any


class Rollout(NamedTuple):
    """Result of `RolloutCore.play`. The first two lie in all slots of the division; repeated worlds are in no sum."""

    batch: Batch  # what is learned from
    seen: Seen | None  # what the curriculum sees, if it observes
    sums: dict[str, Any]  # over all worlds
    worlds: OngoingWorlds | None  # that go on; None: they are reset before the next update


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
        self._batch_specs = batch = Batch(worlds, PartitionSpec(None, DATA_AXIS), worlds)
        if config.rollout.reset_every == 1:
            self.program = self._on_mesh(self._play_shard, key, (whole, whole, whole), (batch, worlds, whole))
        else:
            inputs = whole, whole, worlds, whole
            self.program = self._on_mesh(self._go_on_shard, key, inputs, (batch, worlds, whole))
            if key is not None:
                assert isinstance(key.depends_on, tuple), "see `rollout_core`"
                key = dataclasses.replace(key, depends_on=(*key.depends_on, "reset"))
            self._reset = self._on_mesh(self._reset_shard, key, (whole, whole), worlds)

    def _on_mesh(
        self, shard: Callable[..., Any], key: ProgramKey | None, in_specs: tuple[Any, ...], out_specs: Any
    ) -> Any:
        on_mesh = on_devices(shard, self._mesh, in_specs=in_specs, out_specs=out_specs)

        def rollout(*inputs: Any) -> Any:
            return on_mesh(*inputs)

        if key is None:
            return jax.jit(rollout)
        return exported_on_mesh(rollout, key, self._mesh, in_specs=in_specs, out_specs=out_specs)

    def play(self, params: Any, state: Any, num_updates: int, worlds: OngoingWorlds | None = None) -> Rollout:
        """One update. state: of the curriculum; worlds: those of the update before, see `Rollout`."""
        resets, number = self._config.rollout.resets_before, jnp.uint32(num_updates)
        if self._config.rollout.reset_every == 1:
            return Rollout(*self.program(params, state, number), worlds=None)
        if resets(num_updates):
            worlds = self._reset(state, number)
        if worlds is None:
            raise ValueError(f"update {num_updates} goes on with the worlds of the one before, which are not there")
        batch, episodes, sums = self.program(params, state, worlds, number)
        after = None if resets(num_updates + 1) else dataclasses.replace(worlds, episodes=episodes)
        return Rollout(batch, None, sums, after)

    def traced(self, params: Any, state: Any) -> tuple[list[Any], Batch]:
        """(the programs of `play` for such arrays, to be lowered, shapes and shardings of the batch that it gives)."""
        number, worlds, programs = jnp.uint32(0), [], []
        if self._config.rollout.reset_every > 1:
            programs = [self._reset.trace(state, number)]
            sharded = functools.partial(self._shape, spec=PartitionSpec(DATA_AXIS))
            worlds = [jax.tree.map(sharded, programs[0].out_info)]
        programs.append(self.program.trace(params, state, *worlds, number))
        batch = programs[-1].out_info[0]
        specs = jax.tree.broadcast(self._batch_specs, batch, is_leaf=lambda x: isinstance(x, PartitionSpec))
        return programs, jax.tree.map(self._shape, batch, specs)

    def _shape(self, array: Any, spec: PartitionSpec) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(array.shape, array.dtype, sharding=NamedSharding(self._mesh, spec))

    def _play_shard(self, params: Any, state: Any, num_updates: Array) -> tuple[Batch, Seen | None, dict[str, Any]]:
        proposal = self._proposed(state, num_updates)
        prepared = self._env.prepare(proposal.levels)
        start = *self._env.reset(prepared), None
        batch, played = self._unrolled(params, state, prepared, start, num_updates)
        seen = None
        if self._curriculum.observes:
            seen = dataclasses.replace(proposal, source=None), self._summarised(played)
        is_counted = self._is_counted(played)
        sums = step_sums(played.outcome, played.trajectory.rewards, is_counted)
        return batch, seen, sums | self._attempts(proposal, played.outcome, is_counted)

    def _reset_shard(self, state: Any, num_updates: Array) -> OngoingWorlds:
        return begun(self._env, self._policy, self._proposed(state, num_updates))

    def _go_on_shard(
        self, params: Any, state: Any, worlds: OngoingWorlds, num_updates: Array
    ) -> tuple[Batch, Episodes, dict[str, Any]]:
        before = worlds.episodes
        prepared = self._env.prepare(worlds.levels)
        start = with_worlds_last(before.env_state), before.obs, before.memory
        batch, played = self._unrolled(params, state, prepared, start, num_updates)
        outcome, is_counted = joined(before.outcome, played.outcome), self._is_counted(played)
        sums = step_sums(played.outcome, played.trajectory.rewards, is_counted)
        is_last = (num_updates + 1) % self._config.rollout.reset_every == 0
        proposal = Proposal(levels=worlds.levels, source=worlds.source, copy_of=worlds.copy_of)
        sums |= self._attempts(proposal, outcome, is_counted & is_last)
        env_state = with_worlds_first(played.env_state)
        return batch, Episodes(env_state=env_state, obs=played.obs, memory=played.memory, outcome=outcome), sums

    @property
    def group_numbers(self) -> Array:
        """Numbers of the world groups in the slots of this device, of which levels and actions are drawn."""
        parts = jnp.asarray(self.division.parts)[jax.lax.axis_index(DATA_AXIS)]
        return self._first_group + members(parts, self._groups_per_part)

    def _is_counted(self, played: Played) -> Array:
        """[W] bool: false where a world is there once more."""
        is_counted = jnp.asarray(self.division.is_counted)[jax.lax.axis_index(DATA_AXIS)]
        return jnp.repeat(is_counted, played.last_value.shape[0] // self.division.slots)

    def _proposed(self, state: Any, num_updates: Array) -> Proposal:
        config, groups = self._config, self.group_numbers
        level_key = prng.fold_in(stream(config.run.seed, LEVELS), num_updates)
        group_keys = jax.vmap(lambda group: prng.fold_in(level_key, group))(groups)
        proposal = self._curriculum.propose(state, group_keys, groups)
        worlds_per_group = config.rollout.worlds_per_group
        expected, found = groups.size * worlds_per_group, proposal.levels.position.shape[0]
        if found != expected:
            raise ValueError(
                f"curriculum {config.curriculum.name!r} proposed {found} levels for {groups.size} groups "
                f"of {worlds_per_group} worlds; propose must return {expected}"
            )
        return proposal

    def _unrolled(
        self,
        params: Any,
        state: Any,
        prepared: PreparedLevels,
        start: tuple[EnvState, Any, Array | None],
        num_updates: Array,
    ) -> tuple[Batch, Played]:
        """start: state, observation and the policy's memory, None where that begins with an episode."""
        config, groups = self._config, self.group_numbers
        env_state, obs, memory = start
        policy, params = self._curriculum.players(self._policy, params, state)
        bound_heads = prepared.bound_heads if config.ppo.mask_unbound_heads else None
        static = StaticInput(obs=prepared.static_obs, bound_heads=bound_heads, memory=memory)
        numbers = members(groups, config.rollout.worlds_per_group)
        played = unroll(
            policy,
            params,
            self._env,
            Worlds(prepared, env_state, obs, numbers, bound_heads, memory),
            self.play_key(state, num_updates),
            config.rollout.num_steps,
            keep_timeouts=config.ppo.bootstrap_timeouts,
        )
        batch = Batch(static, played.trajectory, played.last_value)
        return worlds_trained(batch, groups.size, config.num_trained_envs // config.rollout.num_groups), played

    def play_key(self, state: Any, num_updates: Array) -> Array:
        """Key of the actions of an update: of all worlds, or [W]. state: of the curriculum."""
        del state
        return prng.fold_in(stream(self._config.run.seed, PLAY), num_updates)

    def _attempts(self, proposal: Proposal, outcome: LevelOutcome, is_counted: Array) -> dict[str, Any]:
        """Sums of the first episodes of the worlds that count."""
        sums = attempt_sums(outcome, is_counted)
        # Also where no outcomes.jsonl is written: another program may round otherwise.
        sums[BY_SOURCE] = attempts_by(source_of(proposal), outcome, is_counted, self._num_counted)
        if proposal.copy_of is not None:
            size = self._config.rollout.worlds_per_group
            sums[BY_SOURCE][FRESH_PAIRS] = pairs_by_solved(proposal.copy_of, outcome, is_counted, size)
        if self._config.curriculum.sizes:
            sums[SIZES_PLAYED] = attempts_by(size_numbers(proposal.levels), outcome, is_counted, len(SIZES))
        return sums

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
