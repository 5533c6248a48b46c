"""Playing several levels in one program, each by a policy of its own: the worlds of `Specialists`.

Worlds lie specialist by specialist, with the random numbers that each has when it plays alone with its seed, so that a
specialist is the same whichever others it trains beside.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from jax2d.scene import Array
from kinetix_dist import prng
from kinetix_dist.config import TrainConfig
from kinetix_dist.curator.curriculum import Curriculum, CurriculumTools, Proposal
from kinetix_dist.evaluation.evaluate import play_attempts
from kinetix_dist.evaluation.policies import NetworkPolicy
from kinetix_dist.level.level import Level
from kinetix_dist.models.several_policies import SeveralPolicies
from kinetix_dist.runtime import EVALUATION_STREAM, PLAY, Batch, Players, RolloutCore, check_memory, stream


class SeededLevels(NamedTuple):
    """Level and seed of each specialist, which programs take as arguments."""

    levels: Level  # [specialists, ...]
    seeds: Array  # [specialists] uint32


class _OneLevelEach(Curriculum):
    """Specialist i plays level i of the state, `SeededLevels`, alone."""

    draws_levels = False
    sources = ()  # all levels are counted one by one

    def __init__(self, tools: CurriculumTools, num_specialists: int, num_envs: int) -> None:
        """num_envs: worlds of each specialist."""
        super().__init__(tools)
        self._num_specialists = num_specialists
        self._num_envs = num_envs

    @property
    def num_slots(self) -> int:
        """Levels."""
        return self._num_specialists

    def players(self, policy: Any, params: Sequence[Any], state: Any) -> tuple[SeveralPolicies, Sequence[Any]]:
        """params: of each specialist."""
        del state
        return SeveralPolicies(policy, self._num_specialists, self._num_specialists * self._num_envs), params

    def propose(self, state: Any, group_keys: Array, groups: Array) -> Proposal:
        del group_keys, groups
        index = jnp.repeat(jnp.arange(self._num_specialists), self._num_envs)
        return Proposal(levels=jax.tree.map(lambda x: jnp.asarray(x)[index], state.levels), source=index)


class _RepeatedGroups(RolloutCore):
    """Rollout in which the groups of each specialist have the numbers of the first one's, and so the actions of a run
    with its seed."""

    def __init__(self, config: TrainConfig, players: Players, mesh: Mesh, *, groups: range, repeats: int) -> None:
        self._num_groups = len(groups)
        super().__init__(config, players, mesh, groups=range(repeats * len(groups)))

    @property
    def group_numbers(self) -> Array:
        return super().group_numbers % self._num_groups

    def play_key(self, state: SeededLevels, num_updates: Array) -> Array:
        """[W], specialist by specialist."""
        keys = jax.vmap(lambda seed: prng.fold_in(stream(seed, PLAY), num_updates))(state.seeds)
        return jnp.repeat(keys, self._num_groups * self._config.rollout.worlds_per_group)


class JointRollout:
    """Programs that play and evaluate `num_specialists` levels at once, one level a specialist, on one device."""

    def __init__(self, config: TrainConfig, players: Players, mesh: Mesh, num_specialists: int) -> None:
        """config, players: of one specialist. Raises ValueError, DeviceMemoryError for what cannot run."""
        env, policy, curriculum = players
        self._config, self._env, self._policy = config, env, policy
        self.num_specialists = num_specialists
        worlds = config.rollout
        joint = dataclasses.replace(
            config,
            rollout=dataclasses.replace(
                worlds, num_envs=num_specialists * worlds.num_envs, num_groups=num_specialists * worlds.num_groups
            ),
            ppo=dataclasses.replace(config.ppo, minibatches=num_specialists * config.ppo.minibatches),
        )
        check_memory(joint, 1)
        levels = _OneLevelEach(curriculum.tools, num_specialists, worlds.num_envs)
        self._rollout = _RepeatedGroups(
            joint, Players(env, policy, levels), mesh, groups=range(worlds.num_groups), repeats=num_specialists
        )

    def play(self, params: Sequence[Any], seeded: SeededLevels, num_updates: int) -> tuple[list[Batch], dict[str, Any]]:
        """(batch of each specialist, sums over all worlds). params: of each."""
        played = self._rollout.play(tuple(params), seeded, num_updates)
        return _batches(played.batch, self.num_specialists), played.sums

    def evaluate(self, params: Sequence[Any], levels: Level, attempts: int) -> list[tuple[int, int]]:
        """(solved, attempts) of each specialist. Levels, attempts and keys are the same every time, so that evaluations
        are paired."""
        count = self.num_specialists
        policy = NetworkPolicy(SeveralPolicies(self._policy, count, count * attempts), self._env.action_distribution)
        index = jnp.arange(count * attempts)
        key, number = prng.key(EVALUATION_STREAM), index % attempts
        solved = play_attempts(self._env, policy, tuple(params), levels, key, number, index // attempts).solved
        return [(int(own), attempts) for own in np.asarray(solved).reshape(count, attempts).sum(axis=1)]


@functools.partial(jax.jit, static_argnums=1)
def _batches(batch: Batch, count: int) -> list[Batch]:
    """Batch of each specialist, of whose worlds all lie side by side."""

    def part(x: Array, number: int, axis: int) -> Array:
        size = x.shape[axis] // count
        return jax.lax.slice_in_dim(x, number * size, (number + 1) * size, axis=axis)

    def of(number: int) -> Batch:
        first, second = (functools.partial(part, number=number, axis=axis) for axis in (0, 1))
        static, trajectory, last_value = batch
        return Batch(jax.tree.map(first, static), jax.tree.map(second, trajectory), first(last_value))

    return [of(number) for number in range(count)]
