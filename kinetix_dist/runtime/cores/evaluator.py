"""Solve rates and recordings of a policy on the evaluation sets of a config: all sets in one batch."""

from __future__ import annotations

import threading
import time
from typing import Any

import jax
import numpy as np

from kinetix_dist import prng
from kinetix_dist.config import TrainConfig
from kinetix_dist.env.environment import Environment
from kinetix_dist.evaluation.evaluate import compile_evaluation, evaluate
from kinetix_dist.evaluation.intervals import interval_over_levels, wilson_interval
from kinetix_dist.evaluation.policies import NetworkPolicy, Player, RandomPolicy
from kinetix_dist.evaluation.recordings import record_rollouts
from kinetix_dist.level.level import Level
from kinetix_dist.level.level_data import base_levels
from kinetix_dist.level.sets import load_level_set
from kinetix_dist.models.policy import make_policy
from kinetix_dist.runtime.cores.playing import make_environment

EVALUATION_STREAM = 0x4556414C  # "EVAL": keys of evaluations; training folds its own constants into its own seed


class Evaluator:
    """Loads the sets at the first use, and compiles then."""

    def __init__(self, config: TrainConfig, env: Environment, module: Any) -> None:
        self._config = config.evaluation
        self._size = config.env.size
        self._seed = config.run.seed
        self._env = env
        self._network = NetworkPolicy(module, env.action_distribution)
        self._sets: dict[str, tuple[Level, list[str]]] | None = None
        self._loading = threading.Lock()

    def evaluate(self, params: Any | None) -> dict[str, dict[str, Any]]:
        """{set: {"rate", "attempts", "low", "high", "interval_over_levels", "levels"}} of a network's parameters; None:
        of random actions.

        "levels" is a set's part of a line of evaluations.jsonl: {"names", "solved", "attempts"}, by level.

        The levels, attempts and keys are the same every time, so that before and after are paired.
        """
        random = Player(RandomPolicy(self._env.action_space))
        player = random if params is None else self._player(params)
        rates = evaluate(self._env, player, self._batch(), attempts=1, key=self._key())
        result, start = {}, 0
        for name, (_, level_names) in self._load().items():
            attempts_per_level = self._config.attempts_of(len(level_names))
            attempts = len(level_names) * attempts_per_level
            tried = [attempt.solved for attempt in rates.levels[start : start + attempts]]
            by_level = [
                sum(tried[first : first + attempts_per_level]) for first in range(0, attempts, attempts_per_level)
            ]
            solved = sum(tried)
            low, high = wilson_interval(solved, attempts)
            result[name] = {
                "rate": solved / attempts,
                "attempts": attempts,
                "low": low,
                "high": high,
                "interval_over_levels": interval_over_levels(
                    by_level, attempts_per_level, base_levels(name, level_names)
                ),
                "levels": {"names": level_names, "solved": by_level, "attempts": attempts_per_level},
            }
            start += attempts
        return result

    def compile_ahead(self, params: Any) -> None:
        """The program that plays with a network."""
        compile_evaluation(self._env, self._player(params), self._batch(), attempts=1, key=self._key())

    def record(self, params: Any, num_rollouts: int, num_updates: int) -> list[Any]:
        """Rollouts on the levels of all sets, as many solved as unsolved ones where there are both."""
        if num_rollouts == 0:
            return []
        sets = list(self._load().values())[::-1]  # designed levels first: they are nicer to look at
        batch = jax.tree.map(lambda *xs: np.concatenate(xs), *[levels for levels, _ in sets])
        names = [name for _, level_names in sets for name in level_names]
        played = record_rollouts(
            self._env,
            self._player(params),
            batch,
            self._key(),
            names=names,
            policy_version=num_updates,
            seed=self._seed,
        )
        solved = [rollout for rollout in played if rollout.solved]
        unsolved = sorted((rollout for rollout in played if not rollout.solved), key=lambda r: not r.failed)
        num_solved = min(len(solved), max(num_rollouts // 2, num_rollouts - len(unsolved)))
        return solved[:num_solved] + unsolved[: num_rollouts - num_solved]

    def _player(self, params: Any) -> Player:
        return Player(self._network, jax.device_put(params))

    def _batch(self) -> Level:
        """Levels of all sets, each as often as it is tried."""
        repeated = [_repeat(levels, self._config.attempts_of(len(names))) for levels, names in self._load().values()]
        return jax.tree.map(lambda *xs: np.concatenate(xs), *repeated)

    def _load(self) -> dict[str, tuple[Level, list[str]]]:
        with self._loading:  # programs are compiled by another thread
            if self._sets is None:
                self._sets = {name: load_level_set(name, self._size) for name in self._config.sets}
            return self._sets

    def _key(self) -> Any:
        return prng.key(EVALUATION_STREAM)


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
