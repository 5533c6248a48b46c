"""Solve rates: every level is tried several times, and the first episode of each attempt counts.

    levels x attempts -> worlds, in chunks of bounded size -> first finished episode of each world -> rates

An attempt ends at its first `done`; whatever its world does after that is ignored, so that quick failures weigh as
much as long successes. Keys are folded with level and attempt: results do not depend on the chunk size.
The physics is deterministic and a level always begins the same way, so attempts on a level differ by the policy's
samples only. A policy that draws nothing (greedy, no actions) is tried once per level: further attempts would be
the same.
Intervals are Wilson's at 95 % and take attempts as independent; over a whole set they speak of these levels, not of all
that might be drawn.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import Array, index_worlds
from kinetix_dist import prng
from kinetix_dist.env.environment import Environment
from kinetix_dist.env.records import EnvState, PreparedLevels, StepInfo
from kinetix_dist.evaluation.intervals import interval_over_levels, wilson_interval
from kinetix_dist.evaluation.policies import Player, Policy, act, distinct_attempts, first_memory
from kinetix_dist.evaluation.summary import best_of, worst_share
from kinetix_dist.level.level import Level

MAX_WORLDS = 4096  # worlds at once: enough to fill a GPU, and under 1 GB of memory at size L


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Episodes:
    """First episode of each world. [W] on every field."""

    finished: Array  # bool
    solved: Array  # bool
    failed: Array  # bool
    timed_out: Array  # bool
    unstable: Array  # bool
    episode_return: Array  # float32, undiscounted, dense reward included
    episode_length: Array  # int32, environment steps


@dataclasses.dataclass(frozen=True, kw_only=True)
class SolveRate:
    """A share of solved attempts with its 95 % interval, and how the others ended."""

    name: str
    rate: float
    attempts: int
    low: float
    high: float
    solved: int
    failed: int
    timed_out: int
    unstable: int
    mean_return: float
    mean_length: float  # environment steps


@dataclasses.dataclass(frozen=True, kw_only=True)
class SolveRates:
    """Solve rates of a set of levels: of all attempts together, and of each level."""

    total: SolveRate
    levels: tuple[SolveRate, ...]

    @property
    def rate(self) -> float:
        return self.total.rate

    @property
    def attempts(self) -> int:
        return self.total.attempts

    @property
    def low(self) -> float:
        return self.total.low

    @property
    def high(self) -> float:
        return self.total.high

    @property
    def attempts_per_level(self) -> int:
        return self.levels[0].attempts

    @property
    def worst_tenth(self) -> float:
        """`summary.worst_share`."""
        return worst_share([level.solved for level in self.levels], self.attempts_per_level)

    @property
    def best_of(self) -> dict[int, float]:
        """`summary.best_of` for k = 1, 2, 4 and so on, and for all attempts."""
        solved, attempts = [level.solved for level in self.levels], self.attempts_per_level
        powers = [2**i for i in range(attempts.bit_length()) if 2**i < attempts]
        return {k: best_of(solved, attempts, k) for k in (*powers, attempts)}

    def over_levels(self, base_levels: Sequence[str]) -> dict[str, Any] | None:
        """`intervals.interval_over_levels`; base_levels: of each level."""
        return interval_over_levels([level.solved for level in self.levels], self.attempts_per_level, base_levels)

    def to_dict(self, *, per_level: bool = True) -> dict[str, Any]:
        """Values for JSON: {"rate", "attempts", "low", "high", ..., "levels": [{"name", "rate", ...}, ...]}."""
        content: dict[str, Any] = dataclasses.asdict(self.total)
        del content["name"]
        content["worst_tenth"] = self.worst_tenth
        content["best_of"] = {str(k): share for k, share in self.best_of.items()}
        if per_level:
            content["levels"] = [dataclasses.asdict(level) for level in self.levels]
        return content


def evaluate(
    env: Environment,
    player: Player,
    levels: Level,
    *,
    attempts: int,
    key: Array,
    names: Sequence[str] | None = None,
    max_worlds: int = MAX_WORLDS,
) -> SolveRates:
    """Tries every level of a batch ([L, ...]) `attempts` times, once where all attempts would be the same.

    player: see `policies.py`. names: of the levels, for the table.
    The key is consumed. Compiles once for each (env, policy, number of worlds at once).
    """
    num_levels = int(np.shape(levels.angle)[0])
    if attempts < 1:
        raise ValueError(f"attempts is {attempts}; at least 1 is needed")
    if num_levels == 0:
        raise ValueError("there are no levels to evaluate on")
    if max_worlds < 1:
        raise ValueError(f"max_worlds is {max_worlds}; at least 1 is needed")
    names = [f"level_{i}" for i in range(num_levels)] if names is None else list(names)
    if len(names) != num_levels:
        raise ValueError(f"{len(names)} names were given for {num_levels} levels")
    attempts = distinct_attempts(player.policy, attempts)
    episodes = attempts_of_levels(
        lambda index: play_attempts(env, *player, levels, key, index, index // attempts),
        num_levels,
        attempts,
        max_worlds=max_worlds,
    )
    return solve_rates(names, episodes)


def attempts_of_levels(
    play: Callable[[Array], Episodes], num_levels: int, attempts: int, *, max_worlds: int = MAX_WORLDS
) -> Episodes:
    """Episodes (numpy) of every attempt at every level, [num_levels, attempts].

    play: of attempts `index` [W]; number i is of level i // attempts.
    """
    total = num_levels * attempts
    chunks = [jax.device_get(play(index)) for index in _chunks(total, max_worlds)]
    return jax.tree.map(lambda *parts: np.concatenate(parts)[:total].reshape(num_levels, attempts), *chunks)


def solve_rates(names: Sequence[str], episodes: Episodes) -> SolveRates:
    """Solve rates of episodes [levels, attempts], which have these names."""
    return SolveRates(
        total=solve_rate("all", episodes),
        levels=tuple(solve_rate(name, index_worlds(episodes, i)) for i, name in enumerate(names)),
    )


def compile_evaluation(env: Environment, player: Player, levels: Level, *, attempts: int, key: Array) -> None:
    """Compiles what `evaluate` runs with the same arguments."""
    attempts = distinct_attempts(player.policy, attempts)
    index = _chunks(int(np.shape(levels.angle)[0]) * attempts, MAX_WORLDS)[0]
    play_attempts.lower(env, *player, levels, key, index, index // attempts).compile()


def _chunks(total: int, max_worlds: int) -> list[Array]:
    """Indices of attempts that are played at once, of equal lengths: the last ones repeat the last attempt."""
    size = min(max_worlds, total)
    return [jnp.minimum(jnp.arange(start, start + size), total - 1) for start in range(0, total, size)]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Playing:
    """First episodes after some steps. [W, ...] but for the number of steps."""

    num_steps: Array  # [] int32, environment steps played
    env_state: EnvState
    obs: Any
    memory: Array | None
    episodes: Episodes


def first_episodes(env: Environment, policy: Policy, params: Any, prepared: PreparedLevels, keys: Array) -> Episodes:
    """Plays until every world has finished one episode. keys [W]. Pure; `env` and `policy` are static under jit."""
    # A time limit finishes whatever is left.
    return play_on(
        env, policy, params, prepared, keys, begin_play(env, policy, prepared), env.config.max_steps
    ).episodes


def begin_play(env: Environment, policy: Policy, prepared: PreparedLevels) -> Playing:
    """Before the first step."""
    env_state, obs = env.reset(prepared)
    memory = first_memory(policy, env_state.distance.shape[0])
    episodes = no_episodes(env_state.distance)
    return Playing(num_steps=jnp.int32(0), env_state=env_state, obs=obs, memory=memory, episodes=episodes)


def no_episodes(like: Array) -> Episodes:
    """Before anything was played, of as many worlds as `like` [W] float32 has."""
    zeros = jnp.zeros_like(like)
    no = zeros.astype(bool)
    return Episodes(
        finished=no,
        solved=no,
        failed=no,
        timed_out=no,
        unstable=no,
        episode_return=zeros,
        episode_length=zeros.astype(jnp.int32),
    )


def play_on(
    env: Environment,
    policy: Policy,
    params: Any,
    prepared: PreparedLevels,
    keys: Array,
    playing: Playing,
    num_steps: int,
) -> Playing:
    """`num_steps` steps more, fewer where every world has finished an episode. Pure, as `first_episodes`."""
    end = playing.num_steps + num_steps

    def some_play_on(now: Playing) -> Array:
        return ~now.episodes.finished.all() & (now.num_steps < end)

    def play(now: Playing) -> Playing:
        step_keys = jax.vmap(prng.fold_in, in_axes=(0, None))(keys, now.num_steps)
        actions, memory = act(policy, params, env.observe(prepared, now.obs), step_keys, now.memory)
        env_state, obs, _, done, info = env.step(prepared, now.env_state, actions)
        return Playing(
            num_steps=now.num_steps + 1,
            env_state=env_state,
            obs=obs,
            memory=memory,
            episodes=record_first(now.episodes, done, info),
        )

    return jax.lax.while_loop(some_play_on, play, playing)


def attempt_keys(key: Array, index: Array) -> Array:
    """[W] keys of attempts `index` [W], counted over all levels. The key is consumed."""
    return jax.vmap(prng.fold_in, in_axes=(None, 0))(key, index)


@functools.partial(jax.jit, static_argnums=(0, 1))
def play_attempts(
    env: Environment, policy: Policy, params: Any, levels: Level, key: Array, index: Array, level_index: Array
) -> Episodes:
    """Attempts `index` [W], of which the random numbers follow, each on level `level_index` [W]."""
    chosen = jax.tree.map(lambda x: jnp.asarray(x)[level_index], levels)
    return first_episodes(env, policy, params, env.prepare(chosen), attempt_keys(key, index))


def record_first(episodes: Episodes, done: Array, info: StepInfo) -> Episodes:
    """Adds the episodes that end now, but for worlds that have finished one before."""
    is_first = done & ~episodes.finished
    return Episodes(
        finished=episodes.finished | done,
        solved=episodes.solved | (info.solved & is_first),
        failed=episodes.failed | (info.failed & is_first),
        timed_out=episodes.timed_out | (info.timed_out & is_first),
        unstable=episodes.unstable | (info.unstable & is_first),
        episode_return=jnp.where(is_first, info.episode_return, episodes.episode_return),
        episode_length=jnp.where(is_first, info.episode_length, episodes.episode_length),
    )


def solve_rate(name: str, episodes: Episodes) -> SolveRate:
    """Solve rate of all episodes (numpy) together."""
    solved, attempts = int(episodes.solved.sum()), int(episodes.solved.size)
    low, high = wilson_interval(solved, attempts)
    return SolveRate(
        name=name,
        rate=solved / attempts,
        attempts=attempts,
        low=low,
        high=high,
        solved=solved,
        failed=int(episodes.failed.sum()),
        timed_out=int(episodes.timed_out.sum()),
        unstable=int(episodes.unstable.sum()),
        mean_return=float(episodes.episode_return.mean()),
        mean_length=float(episodes.episode_length.mean()),
    )
