"""Solve rates and recordings of a policy on the evaluation sets of a config: all sets of a size in one batch.

Sets that fit the size of the run are one batch; sets of a larger size are another, in arrays of that size.
"""

from __future__ import annotations

import dataclasses
import threading
import time
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np

from kinetix_dist import prng
from kinetix_dist.config import TrainConfig
from kinetix_dist.env.environment import Environment
from kinetix_dist.evaluation.evaluate import compile_evaluation, evaluate
from kinetix_dist.evaluation.evaluation_sets import EvaluationSet, load_evaluation_set
from kinetix_dist.evaluation.intervals import interval_over_levels, wilson_interval
from kinetix_dist.evaluation.policies import NetworkPolicy, Player, RandomPolicy
from kinetix_dist.evaluation.recordings import record_rollouts
from kinetix_dist.level.level import Level
from kinetix_dist.level.level_data import base_levels
from kinetix_dist.models.policy import make_policy
from kinetix_dist.runtime.cores.playing import make_environment

EVALUATION_STREAM = 0x4556414C  # "EVAL": keys of evaluations; training folds its own constants into its own seed


class Evaluator:
    """Loads the sets at the first use, and compiles then."""

    def __init__(self, config: TrainConfig, env: Environment, module: Any) -> None:
        self._config = config.evaluation
        self._run_config = config
        self._seed = config.run.seed
        self._env = env
        self._network = NetworkPolicy(module, env.action_distribution)
        self._sets: tuple[EvaluationSet, ...] | None = None
        self._loading = threading.Lock()

    def evaluate(self, params: Any | None) -> dict[str, dict[str, Any]]:
        """{set: {"rate", "attempts", "low", "high", "interval_over_levels", "levels"}} of a network's parameters; None:
        of random actions.

        "levels" is a set's part of a line of evaluations.jsonl: {"names", "solved", "attempts"}, by level.

        The levels, attempts and keys are the same every time, so that before and after are paired.
        """
        random = Player(RandomPolicy(self._env.action_space))
        player = random if params is None else self._player(params)
        result = {}
        for env, sets in self._by_size():
            rates = evaluate(env, player, self._batch(sets), attempts=1, key=self._key())
            start = 0
            for one in sets:
                attempts_per_level = self._config.attempts_of(len(one.level_names))
                attempts = len(one.level_names) * attempts_per_level
                tried = [attempt.solved for attempt in rates.levels[start : start + attempts]]
                result[one.name] = _rates_of_set(one, tried, attempts_per_level)
                start += attempts
        return {name: result[name] for name in self._config.sets}

    def compile_ahead(self, params: Any) -> None:
        """The programs that play with a network."""
        for env, sets in self._by_size():
            compile_evaluation(env, self._player(params), self._batch(sets), attempts=1, key=self._key())

    def record(self, params: Any, num_rollouts: int, num_updates: int) -> list[Any]:
        """Rollouts on the levels of all sets, as many solved as unsolved ones where there are both."""
        if num_rollouts == 0:
            return []
        played = []
        for env, sets in self._by_size():
            played += self._recorded(env, sets, params, num_updates)
        solved = [rollout for rollout in played if rollout.solved]
        unsolved = sorted((rollout for rollout in played if not rollout.solved), key=lambda r: not r.failed)
        num_solved = min(len(solved), max(num_rollouts // 2, num_rollouts - len(unsolved)))
        return solved[:num_solved] + unsolved[: num_rollouts - num_solved]

    def _recorded(self, env: Environment, sets: tuple[EvaluationSet, ...], params: Any, num_updates: int) -> list[Any]:
        """One rollout of each level of sets of a size."""
        last_first = sets[::-1]  # designed levels first: they are nicer to look at
        return record_rollouts(
            env,
            self._player(params),
            jax.tree.map(lambda *xs: np.concatenate(xs), *[one.levels for one in last_first]),
            self._key(),
            names=[name for one in last_first for name in one.level_names],
            policy_version=num_updates,
            seed=self._seed,
        )

    def _player(self, params: Any) -> Player:
        return Player(self._network, jax.device_put(params))

    def _batch(self, sets: tuple[EvaluationSet, ...]) -> Level:
        """Levels of sets of a size, each as often as it is tried."""
        repeated = [_repeat(one.levels, self._config.attempts_of(len(one.level_names))) for one in sets]
        return jax.tree.map(lambda *xs: np.concatenate(xs), *repeated)

    def _by_size(self) -> Iterator[tuple[Environment, tuple[EvaluationSet, ...]]]:
        """Sets that are played in arrays of one size, in their order, with the environment of these."""
        config, sets = self._run_config, self._load()
        for size in dict.fromkeys(one.size for one in sets):
            larger = dataclasses.replace(config, env=dataclasses.replace(config.env, size=size))
            env = self._env if size == config.env.size else make_environment(larger)
            yield env, tuple(one for one in sets if one.size == size)

    def _load(self) -> tuple[EvaluationSet, ...]:
        with self._loading:  # programs are compiled by another thread
            if self._sets is None:
                size = self._run_config.env.size
                self._sets = tuple(load_evaluation_set(name, size) for name in dict.fromkeys(self._config.sets))
            return self._sets

    def _key(self) -> Any:
        return prng.key(EVALUATION_STREAM)


def _rates_of_set(one: EvaluationSet, tried: list[int], attempts_per_level: int) -> dict[str, Any]:
    """Result of a set, as `Evaluator.evaluate` gives it. tried: 0 or 1 of each attempt, level by level."""
    names, attempts = list(one.level_names), len(tried)
    by_level = [sum(tried[first : first + attempts_per_level]) for first in range(0, attempts, attempts_per_level)]
    solved = sum(tried)
    low, high = wilson_interval(solved, attempts)
    return {
        "rate": solved / attempts,
        "attempts": attempts,
        "low": low,
        "high": high,
        "interval_over_levels": interval_over_levels(by_level, attempts_per_level, base_levels(one.name, names)),
        "levels": {"names": names, "solved": by_level, "attempts": attempts_per_level},
    }


def _repeat(levels: Level, count: int) -> Level:
    return jax.tree.map(lambda x: np.repeat(np.asarray(x), count, axis=0), levels)


class EvaluatorCore:
    """No state between calls: the same parameters give the same answers, bit for bit."""

    def __init__(self, config: TrainConfig) -> None:
        env = make_environment(config)
        self._num_rollouts = config.recording.num_rollouts
        self._evaluator = Evaluator(config, env, make_policy(config.policy, env.action_distribution.head_sizes))

    def evaluate(self, params: Any, num_updates: int) -> tuple[dict[str, float], dict[str, dict[str, Any]]]:
        """({"seconds": how long it took}, as `Evaluator.evaluate` gives it)."""
        del num_updates
        began = time.monotonic()
        rates = self._evaluator.evaluate(params)
        return {"seconds": time.monotonic() - began}, rates

    def record(self, params: Any, num_updates: int) -> tuple[dict[str, float], list[Any]]:
        """({"seconds": how long it took}, rollouts)."""
        began = time.monotonic()
        rollouts = self._evaluator.record(params, self._num_rollouts, num_updates)
        return {"seconds": time.monotonic() - began}, rollouts
