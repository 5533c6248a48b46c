"""Levels with a solution, each begun so many stages before its end: what a reverse curriculum plays.

    stage s of S     an episode begins where (S - s) / S of the steps of the solution are done; S is the true start
    played           a stage that is solved often enough is followed by the next, one that is hardly solved by the one
                     before it. A level leaves when its true start is solved, or when it does not come on
    with_proofs      new levels take free slots first, then those of the oldest levels

(Salimans and Chen 2018, learning from a single demonstration; Florensa et al. 2017, reverse curriculum generation.)
Counts are integers, added in any order: an update that is repeated gives the same bits.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import Array
from kinetix_dist.curator.config import BackwardConfig
from kinetix_dist.curator.replay_buffer import NEVER
from kinetix_dist.env.held_actions import STATE_NUMBERS, starting_from
from kinetix_dist.level.level import Level


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Proofs:
    """`N` levels with the states of a solution of each."""

    candidate: Array  # [N] int32, number of the level among the candidates of its refresh
    levels: Level  # [N, ...]
    states: Array  # [N, S, n, 6] float32, the starts of the stages, see `held_actions.STATE_NUMBERS`
    keys: Array  # [N, 2] uint32, data of the key of the episode of held actions that is the solution
    num_steps: Array  # [N] int32, environment steps of the solution


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class ProofBank:
    """`M` slots for levels, with their progress, and counts of all that left."""

    levels: Level  # [M, ...]
    states: Array  # [M, S, n, 6] float32
    keys: Array  # [M, 2] uint32, of the solution
    born: Array  # [M] int32, policy version whose refresh brought the level, NEVER without one
    stage: Array  # [M] int32, 1..S
    num_plays: Array  # [M] int32, of this stage since it was last judged
    num_solved: Array  # [M] int32, of these
    num_stuck: Array  # [M] int32, how often it was judged since it last came on
    num_learned: Array  # [] int32, levels that left since their true start was solved
    num_given_up: Array  # [] int32, levels that left since they did not come on

    @property
    def is_filled(self) -> Array:
        return self.born != NEVER


def empty_bank(level: Level, config: BackwardConfig) -> ProofBank:
    """level: any, for shapes and types."""
    size = config.num_levels
    count = jnp.zeros(size, jnp.int32)
    num_shapes = jnp.shape(level.angle)[0]
    return ProofBank(
        levels=jax.tree.map(lambda x: jnp.broadcast_to(x, (size, *jnp.shape(x))), level),
        states=jnp.zeros((size, config.num_stages, num_shapes, STATE_NUMBERS), jnp.float32),
        keys=jnp.zeros((size, 2), jnp.uint32),
        born=count + NEVER,
        stage=count + 1,
        num_plays=count,
        num_solved=count,
        num_stuck=count,
        num_learned=jnp.int32(0),
        num_given_up=jnp.int32(0),
    )


def stage_times(num_steps: Array, num_stages: int) -> Array:
    """[W, S] int32: steps of solutions of `num_steps` [W] that are done where stages 1 to S begin."""
    left = np.arange(num_stages - 1, -1, -1, dtype=np.int32)
    return num_steps[:, None] * left // num_stages


def levels_of(bank: ProofBank, slot: Array, stage: Array) -> Level:
    """Levels of slots [...] that start where their stages [...] do."""
    levels = jax.tree.map(lambda x: x[slot], bank.levels)
    return starting_from(levels, bank.states[slot, stage - 1])


def played(bank: ProofBank, slot: Array, is_there: Array, is_solved: Array, config: BackwardConfig) -> ProofBank:
    """Bank after attempts, worlds [W]: is_there, the world played the stage that the level in its slot is at."""
    size = bank.born.shape[0]
    into = jnp.where(is_there, slot, size)
    plays = bank.num_plays.at[into].add(1, mode="drop")
    solved = bank.num_solved.at[into].add(is_solved.astype(jnp.int32), mode="drop")
    is_judged = bank.is_filled & (plays >= config.min_plays)
    advances = is_judged & (solved >= config.advance_above * plays)
    retreats = is_judged & (solved <= config.retreat_below * plays) & (bank.stage > 1)
    is_learned = advances & (bank.stage == config.num_stages)
    stuck = jnp.where(advances, 0, bank.num_stuck + is_judged)
    is_given_up = stuck > config.patience
    return dataclasses.replace(
        bank,
        born=jnp.where(is_learned | is_given_up, NEVER, bank.born),
        stage=jnp.clip(bank.stage + advances - retreats, 1, config.num_stages),
        num_plays=jnp.where(is_judged, 0, plays),
        num_solved=jnp.where(is_judged, 0, solved),
        num_stuck=stuck,
        num_learned=bank.num_learned + is_learned.sum(dtype=jnp.int32),
        num_given_up=bank.num_given_up + is_given_up.sum(dtype=jnp.int32),
    )


def with_proofs(bank: ProofBank, proofs: Proofs, policy_version: int) -> ProofBank:
    """Bank with new levels at their first stages, as numpy; those that find no slot are left out."""
    born = np.asarray(bank.born)
    number = min(len(proofs.candidate), len(born))
    slot = np.argsort(born, kind="stable")[:number]  # NEVER comes first

    def put(old: Any, new: Any) -> np.ndarray:
        changed = np.array(old)
        changed[slot] = np.asarray(new)[:number] if np.ndim(new) else new
        return changed

    return dataclasses.replace(
        bank,
        levels=jax.tree.map(put, bank.levels, proofs.levels),
        states=put(bank.states, proofs.states),
        keys=put(bank.keys, proofs.keys),
        born=put(bank.born, np.int32(policy_version)),
        stage=put(bank.stage, np.int32(1)),
        num_plays=put(bank.num_plays, np.int32(0)),
        num_solved=put(bank.num_solved, np.int32(0)),
        num_stuck=put(bank.num_stuck, np.int32(0)),
    )
