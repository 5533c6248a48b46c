"""Worlds that go on while the next chunk is computed.

Time is cut into segments of `execute` environment steps, s. A computation begins with each segment, from the
observation of its first step, and is ready `delay` steps later, d:

    step of the segment      0 ... d - 1                  d ... s - 1
    action                   of the chunk before          of the new chunk, from its d-th on

Of a chunk of H actions the first s are past when the next computation begins, so that H - s of the old plan are left,
of which d are executed: s >= d, since one computation runs at a time, and H >= s + d. The first chunk is there when an
episode begins. All of it is as in the public benchmark of RTC. With delay 0 the world waits for every chunk
(synchronous): what a delay costs then is time alone, d steps a chunk.

A policy of single actions is asked at every step, and each answer comes d steps later: it acts on what it saw d steps
ago. Its first action is there when an episode begins and is held for d steps.

Only first episodes count, as everywhere in evaluation. Delay and horizon are numbers of the program's input: one
compiled program plays all of them.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import Array
from kinetix_dist import prng
from kinetix_dist.delay.chunk_policy import ChunkPolicy, bound_dimensions
from kinetix_dist.delay.history import History, after, begun
from kinetix_dist.delay.history import seen as with_history
from kinetix_dist.delay.methods import Method, Params, Plan, Seen, sampled
from kinetix_dist.env.action_spaces import ActionSpace
from kinetix_dist.env.environment import Environment
from kinetix_dist.env.records import EnvState, PreparedLevels
from kinetix_dist.evaluation.evaluate import Episodes, attempt_keys, no_episodes, record_first
from kinetix_dist.evaluation.policies import Policy, act, first_memory
from kinetix_dist.level.level import Level

NOISE_STREAM = 0x4E4F4953  # "NOIS": keys of action noise, beside those of the policy


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Schedule:
    """When chunks are computed, in environment steps."""

    delay: int  # d
    execute: int = 1  # s
    horizon: int = 1  # H
    action_noise: float = 0.0  # standard deviation of normal noise on each action, in units of the action space

    def check_space(self, space: ActionSpace) -> None:
        """Raises ValueError for noise on whole numbers."""
        if self.action_noise and space.is_integer:
            raise ValueError(f"action noise is of numbers, but actions are {space.name!r}; leave the noise out")

    def check(self) -> None:
        """Raises ValueError, one line, for chunks that cannot be executed."""
        d, s, horizon = self.delay, self.execute, self.horizon
        if d < 0 or s < 1 or not 0 <= self.action_noise < math.inf:
            raise ValueError(f"a delay of {d}, an execution of {s} and noise {self.action_noise:g} are not possible")
        if s + d > horizon:
            raise ValueError(
                f"a delay of {d} steps is beyond the horizon: chunks of {horizon} actions, of which {s} are executed, "
                f"leave {horizon - s} for the meantime; execute fewer, or train a longer horizon"
            )
        if s < d:
            raise ValueError(
                f"a chunk is computed in {d} steps, but the next one would begin after {s}; execute {d} or more"
            )


class Play(NamedTuple):
    """Worlds so far, [W, ...] but for the number of steps."""

    num_steps: Array  # [] int32
    env_state: EnvState
    obs: Any
    episodes: Episodes


class Attempts(NamedTuple):
    """Attempts `index` [W], of which random numbers follow, each on level `level_index` [W] of `levels`."""

    levels: Level
    key: Array  # used up
    index: Array
    level_index: Array


@functools.partial(jax.jit, static_argnums=(0, 1, 2))
def play_chunks(
    env: Environment, policy: ChunkPolicy, method: Method, params: Params, attempts: Attempts, schedule: Schedule
) -> Episodes:
    """First episodes of attempts by chunks."""
    worlds = _Worlds.of(env, attempts, schedule.action_noise)
    bound = bound_dimensions(env, worlds.prepared.bound_heads, attempts.index.shape[0])

    def seen(play: Play, history: History, number: Array | int) -> Seen:
        keys = jax.vmap(prng.fold_in, (0, None))(worlds.keys, number)
        return Seen(with_history(env, worlds.prepared, play.obs, history), bound, keys)

    def segment(now: tuple[Array, Array, History, Play]) -> tuple[Array, Array, History, Play]:
        number, old, history, play = now
        known = schedule.horizon - schedule.execute
        new = method.plan(policy, params, seen(play, history, number), Plan(old, schedule.delay, known))

        def step(i: Array, now: tuple[History, Play]) -> tuple[History, Play]:
            history, play = now
            chosen = jnp.where(i < schedule.delay, old[:, i], new[:, i])
            return after(history, play.obs, chosen), worlds.step(play, policy.actions(chosen))

        history, play = jax.lax.fori_loop(0, schedule.execute, step, (history, play))
        return number + 1, rest_of(new, schedule), history, play

    begin = worlds.begin()
    none = begun(begin.obs, policy.history, policy.space.num_dimensions)
    first = sampled(policy, params, seen(begin, none, 0))
    state = jnp.int32(1), first, none, begin
    return jax.lax.while_loop(lambda now: some_play(now[-1]), segment, state)[-1].episodes


@functools.partial(jax.jit, static_argnums=(0, 1, 4))
def play_single(
    env: Environment, policy: Policy, params: Any, attempts: Attempts, max_delay: int, schedule: Schedule
) -> Episodes:
    """First episodes of attempts by a policy of single actions. max_delay: room for answers under way."""
    worlds = _Worlds.of(env, attempts, schedule.action_noise)

    def answer(play: Play, memory: Array | None) -> tuple[Array, Array | None]:
        keys = jax.vmap(prng.fold_in, (0, None))(worlds.keys, play.num_steps)
        return act(policy, params, env.observe(worlds.prepared, play.obs), keys, memory)

    def step(now: tuple[Array, Array | None, Play]) -> tuple[Array, Array | None, Play]:
        answers, memory, play = now
        newest, memory = answer(play, memory)
        answers = jnp.concatenate([newest[None], answers[:-1]])
        return answers, memory, worlds.step(play, answers[schedule.delay])

    begin = worlds.begin()
    memory = first_memory(policy, attempts.index.shape[0])
    first, _ = answer(begin, memory)
    answers = jnp.broadcast_to(first, (max_delay + 1, *first.shape))
    return jax.lax.while_loop(lambda now: some_play(now[2]), step, (answers, memory, begin))[2].episodes


def some_play(play: Play) -> Array:
    """A time limit finishes every episode."""
    return ~play.episodes.finished.all()


def rest_of(chunk: Array, schedule: Schedule) -> Array:
    """Rest of a chunk [W, H, A] after a segment, zeros behind."""
    index = jnp.arange(chunk.shape[1]) + schedule.execute
    rest = jnp.take(chunk, jnp.minimum(index, chunk.shape[1] - 1), axis=1)
    return jnp.where((index < schedule.horizon)[:, None], rest, 0.0)


@dataclasses.dataclass(frozen=True)
class _Worlds:
    """Levels of attempts, their random numbers, and noise on their actions."""

    env: Environment
    prepared: PreparedLevels
    keys: Array  # [W]
    action_noise: Array | float

    @classmethod
    def of(cls, env: Environment, attempts: Attempts, action_noise: Array | float) -> _Worlds:
        chosen = jax.tree.map(lambda x: jnp.asarray(x)[attempts.level_index], attempts.levels)
        return cls(env, env.prepare(chosen), attempt_keys(attempts.key, attempts.index), action_noise)

    def begin(self) -> Play:
        env_state, obs = self.env.reset(self.prepared)
        return Play(jnp.int32(0), env_state, obs, no_episodes(env_state.distance))

    def step(self, play: Play, actions: Array) -> Play:
        actions = self._with_noise(actions, play.num_steps)
        env_state, obs, _, done, info = self.env.step(self.prepared, play.env_state, actions)
        return Play(play.num_steps + 1, env_state, obs, record_first(play.episodes, done, info))

    def _with_noise(self, actions: Array, number: Array) -> Array:
        """Whole numbers get none (`Schedule.check_space`)."""
        space = self.env.action_space
        if space.is_integer:
            return actions

        def noise(key: Array) -> Array:
            return prng.normal(prng.fold_in(prng.fold_in(key, NOISE_STREAM), number), actions.shape[1:])

        noisy = actions + self.action_noise * jax.vmap(noise)(self.keys)
        return jnp.clip(noisy, np.asarray(space.low, np.float32), np.asarray(space.high, np.float32))
