"""Attempts at one level by one policy: an evaluation in pieces, so that it can be watched and ended.

The numbers are those of `evaluate` on that level alone with the same key.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import Array
from kinetix_dist import prng
from kinetix_dist.env.environment import Environment
from kinetix_dist.env.records import PreparedLevels
from kinetix_dist.evaluation.evaluate import Playing, SolveRate, attempt_keys, begin_play, play_on, solve_rate
from kinetix_dist.evaluation.policies import NoopPolicy, Player, Policy, distinct_attempts
from kinetix_dist.level.level import Level
from kinetix_dist.studio.worker.programs import check_effects

MAX_ATTEMPTS = 1024
STEPS_AT_ONCE = 8  # between reports: 0.04 s of 64 worlds of size S, 0.25 s of L


@dataclasses.dataclass(frozen=True, kw_only=True)
class Progress:
    """Counts so far."""

    num_finished: int
    num_solved: int
    num_steps: int


def play_attempts(
    env: Environment,
    player: Player,
    level: Level,
    *,
    attempts: int,
    seed: int,
    report: Callable[[Progress], None],
) -> SolveRate:
    """Plays first episodes of `attempts` copies of a level (no leading axis); one where all would be the same.

    An exception of `report` ends it.
    """
    attempts = distinct_attempts(player.policy, attempts)
    prepared, keys = _prepare(env, level, prng.key(seed), attempts)
    check_effects(prepared)
    playing = _begin(env, player.policy, prepared)
    while True:
        playing = _play_on(env, *player, prepared, keys, playing)
        finished, solved, num_steps = jax.device_get(
            (playing.episodes.finished, playing.episodes.solved, playing.num_steps)
        )
        report(Progress(num_finished=int(finished.sum()), num_solved=int(solved.sum()), num_steps=int(num_steps)))
        if finished.all():
            return solve_rate("attempts", jax.tree.map(np.asarray, playing.episodes))


def steps_until_noop_solves(env: Environment, level: Level) -> int | None:
    """Environment steps after which a level is solved by doing nothing; None where it is not within its time limit."""
    player = Player(NoopPolicy(env.action_space))
    rate = play_attempts(env, player, level, attempts=1, seed=0, report=lambda progress: None)
    return round(rate.mean_length) if rate.solved else None


@functools.partial(jax.jit, static_argnums=(0, 3))
def _prepare(env: Environment, level: Level, key: Array, attempts: int) -> tuple[PreparedLevels, Array]:
    levels = jax.tree.map(lambda x: jnp.broadcast_to(x, (attempts, *jnp.shape(x))), level)
    return env.prepare(levels), attempt_keys(key, jnp.arange(attempts))


@functools.partial(jax.jit, static_argnums=(0, 1))
def _begin(env: Environment, policy: Policy, prepared: PreparedLevels) -> Playing:
    return begin_play(env, policy, prepared)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _play_on(
    env: Environment, policy: Policy, params: Any, prepared: PreparedLevels, keys: Array, playing: Playing
) -> Playing:
    return play_on(env, policy, params, prepared, keys, playing, STEPS_AT_ONCE)
