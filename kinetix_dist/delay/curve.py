"""Solve rates over delays: policies x methods x delays, on levels, as records.

    contender_at(path)      a chunk policy, a policy of single actions or one a level, by checkpoint or directory
    played(...)             episodes of one of them by one method at one delay; record_of: their rates

Rates are those of levels, and their mean: each level counts alike. Two intervals go with a mean, at 95 %: that of the
rate on these levels, where attempts are the sample, and that on levels like these, where levels are (intervals.py). A
method is compared with the naive one at the same delay by differences level by level.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from kinetix_dist import prng
from kinetix_dist.checkpoint import CheckpointError
from kinetix_dist.delay.chunk_policy import (
    ChunkPolicy,
    TrainedChunks,
    chunk_policy_of,
    is_chunk_policy,
    load_chunk_policy,
    stored_checkpoint,
)
from kinetix_dist.delay.execution import Attempts, Schedule, play_chunks, play_single
from kinetix_dist.delay.methods import Bidirectional, Method, Params, Plain, Rtc, TrainingTimeRtc
from kinetix_dist.env.env_config import EnvConfig
from kinetix_dist.env.environment import Environment
from kinetix_dist.evaluation.evaluate import Episodes, attempts_of_levels, solve_rates
from kinetix_dist.evaluation.intervals import interval_of_mean
from kinetix_dist.evaluation.paired_levels import difference_over_levels
from kinetix_dist.evaluation.policies import Player
from kinetix_dist.level.fit import capacity_of
from kinetix_dist.level.level import SIZES, Level
from kinetix_dist.registry import Registry
from kinetix_dist.stored_specialists import are_specialists, specialists_of
from kinetix_dist.trained_policy import trained_at

SYNCHRONOUS, NAIVE, TRAINING_TIME = "synchronous", "naive", "training_time_rtc"
METHODS: Registry[Method] = Registry("method")
METHODS.register(SYNCHRONOUS, Plain())
METHODS.register(NAIVE, Plain())
METHODS.register("bidirectional", Bidirectional())
METHODS.register("rtc", Rtc())
METHODS.register(TRAINING_TIME, TrainingTimeRtc())
SINGLE_ACTION_METHODS = (SYNCHRONOUS, NAIVE)  # of policies without chunks

Record = dict[str, Any]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Contender:
    """A policy with the environment for its levels."""

    name: str
    env: Environment
    chunks: ChunkPolicy | None  # None: `singles` play
    params: Params
    singles: tuple[tuple[Player, ...], ...] = ()  # [L] of each level, which share its attempts; [1]: of all levels
    seeds: Mapping[str, Sequence[int]] = dataclasses.field(default_factory=dict)  # of specialists, by level
    left_out: tuple[str, ...] = ()  # a line for each specialist that does not play
    max_delay: int = 0  # longest one that training simulated, of training-time RTC

    @property
    def single(self) -> Player | None:
        """Player of all levels; None: chunks are played, or each level has its own."""
        players = [player for own in self.singles for player in own]
        return players[0] if len(players) == 1 else None

    @property
    def horizon(self) -> int:
        return 1 if self.chunks is None else self.chunks.horizon

    def cannot(self, method: str, delay: int) -> str | None:
        """Reason why it does not play by a method, in words; None where it does."""
        if self.chunks is None:
            if method not in SINGLE_ACTION_METHODS:
                return f"{self.name} gives single actions; {method} is of chunk policies"
        elif method == TRAINING_TIME and delay > self.max_delay:
            return (
                f"{self.name} was trained with prefixes of up to {self.max_delay} actions; {method} at delay "
                f"{delay} takes a policy of `clone-flow --max-delay {delay}` or more"
            )
        return None


def contender_at(
    path: Path, levels: Level, names: Sequence[str], *, weak: Path | None = None, min_rate: float | None = None
) -> Contender:
    """The policy of a checkpoint, a run, a bundled name or specialists of these levels [L, ...], of any size.

    weak: checkpoint that bidirectional decoding takes for the weaker policy. min_rate: of specialists, as
    `specialists_of` takes it. Raises CheckpointError, ValueError or UserError, one line.
    """
    size = next(name for name, known in SIZES.items() if known == capacity_of(levels))
    if are_specialists(path):
        chosen = specialists_of(path, levels, names, min_rate=min_rate)
        env = _environment(chosen.first.env_config(size))
        singles = tuple(map(tuple, chosen.players(env, levels)))
        return Contender(
            name=str(path),
            env=env,
            chunks=None,
            params=Params(None),
            singles=singles,
            seeds={own[0].level: [one.seed for one in own] for own in chosen.by_level},
            left_out=chosen.left_out,
        )
    checkpoint = stored_checkpoint(path)
    if checkpoint is not None and is_chunk_policy(checkpoint.description):
        trained = chunk_policy_of(checkpoint)
        env = _environment(dataclasses.replace(trained.env, size=size))
        policy, params = trained.player(env)
        return Contender(
            name=str(path),
            env=env,
            chunks=policy,
            params=Params(params, _weak(weak, trained, env)),
            max_delay=trained.config.max_delay,
        )
    newest = trained_at(path)
    env = _environment(newest.env_config(size))
    singles = ((newest.player(env, levels),),)
    return Contender(name=str(path), env=env, chunks=None, params=Params(None), singles=singles)


@functools.lru_cache(maxsize=8)
def _environment(config: EnvConfig) -> Environment:
    """Policies of one kind of environment share it, and with it the programs that play them."""
    return Environment(config)


def _weak(path: Path | None, strong: TrainedChunks, env: Environment) -> Any:
    if path is None:
        return None
    weak = load_chunk_policy(path)
    if weak.config != strong.config:
        raise CheckpointError(f"{path} has another network than {strong.path}; give an earlier checkpoint of it")
    return weak.player(env)[1]


def played(
    contender: Contender, method: str, levels: Level, schedule: Schedule, *, attempts: int, max_delay: int, seed: int
) -> Episodes:
    """Episodes (numpy) [levels, attempts]. max_delay: of all schedules that are played, for one program.

    Raises ValueError, one line, for a schedule that cannot be executed.
    """
    levels, key = jax.tree.map(jnp.asarray, levels), prng.key(seed)
    num_levels = int(np.shape(levels.angle)[0])
    schedule.check_space(contender.env.action_space)
    if method == SYNCHRONOUS:
        schedule = dataclasses.replace(schedule, delay=0)
    if contender.chunks is not None:
        schedule.check()

    def play(index: jax.Array, single: Player | None = None) -> Episodes:
        these = Attempts(levels, key, index, index // attempts)
        if contender.chunks is None:
            assert single is not None
            return play_single(contender.env, *single, these, max_delay, schedule)
        chosen = METHODS[method]
        return play_chunks(contender.env, contender.chunks, chosen, contender.params, these, schedule)

    if contender.singles and contender.single is None:
        return _by_turns(play, contender.singles, attempts)
    return attempts_of_levels(functools.partial(play, single=contender.single), num_levels, attempts)


def _by_turns(
    play: Callable[[jax.Array, Player], Episodes], singles: Sequence[Sequence[Player]], attempts: int
) -> Episodes:
    """Episodes [levels, attempts] of players of each level: attempt a is of player a mod n of the n that it has.

    All are played by one program, a share of the attempts at a time, whose last ones repeat the last one.
    """
    size = math.ceil(attempts / max(map(len, singles)))
    found: list[Episodes] = []
    for level, players in enumerate(singles):
        parts = []
        for number, player in enumerate(players):
            own = np.arange(number, attempts, len(players))
            for first in range(0, len(own), size):
                index = own[np.minimum(np.arange(first, first + size), len(own) - 1)]
                episodes = jax.device_get(play(jnp.asarray(level * attempts + index), player))
                count = min(size, len(own) - first)
                parts.append((own[first : first + count], jax.tree.map(lambda x, n=count: x[:n], episodes)))
        order = np.argsort(np.concatenate([index for index, _ in parts]))
        found.append(jax.tree.map(lambda *xs, by=order: np.concatenate(xs)[by], *(part for _, part in parts)))
    return jax.tree.map(lambda *xs: np.stack(xs), *found)


def record_of(
    contender: Contender,
    method: str,
    schedule: Schedule,
    episodes: Episodes,
    names: Sequence[str],
    bases: Sequence[str],
) -> Record:
    """Values for JSON of one point of a curve. Lengths are in environment steps; `mean_waiting` is what a synchronous
    world waits besides, `schedule.delay` steps for each chunk or action."""
    rates = solve_rates(names, episodes)
    mean, low, high = interval_of_mean([(level.rate, level.low, level.high) for level in rates.levels])
    waits = np.ceil(episodes.episode_length / schedule.execute) * schedule.delay if method == SYNCHRONOUS else 0.0
    return {
        "policy": contender.name,
        "method": method,
        "delay": schedule.delay,
        "execute": schedule.execute,
        "horizon": schedule.horizon,
        "action_noise": schedule.action_noise,
        "rate": mean,
        "low": low,
        "high": high,
        "over_levels": rates.over_levels(bases),
        "attempts_per_level": rates.attempts_per_level,
        "mean_length": rates.total.mean_length,
        "mean_waiting": float(np.mean(waits)),
        "levels": [dataclasses.asdict(level) for level in rates.levels],
    } | ({"seeds": dict(contender.seeds)} if contender.seeds else {})


def with_differences(records: Sequence[Record], bases: Sequence[str]) -> list[Record]:
    """The records, each with `above_naive`: its rate less that of the naive method of the same policy and delay, with
    the interval over levels, whose ends are None where all levels differ alike; None where that was not played or there
    is one level."""
    naive = {_point(record): record for record in records if record["method"] == NAIVE}
    return [record | {"above_naive": _difference(record, naive.get(_point(record)), bases)} for record in records]


def _point(record: Record) -> tuple[Any, ...]:
    return tuple(record[name] for name in ("policy", "delay", "execute", "horizon"))


def _difference(record: Record, naive: Record | None, bases: Sequence[str]) -> dict[str, float | None] | None:
    if naive is None or naive is record or len(set(bases)) < 2:
        return None
    rates, others = ([level["rate"] for level in each["levels"]] for each in (record, naive))
    found = difference_over_levels(rates, others, bases)
    difference, low, high = found or (float(np.mean(rates) - np.mean(others)), None, None)
    return {"difference": difference, "low": low, "high": high}
