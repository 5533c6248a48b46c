"""What an evaluator holds: solve rates and recordings of given parameters, on one device, beside training."""

from __future__ import annotations

import time
from typing import Any

from kinetix_dist.config import TrainConfig
from kinetix_dist.models.policy import make_policy
from kinetix_dist.runtime.cores.evaluator import Evaluator
from kinetix_dist.runtime.cores.levels import make_environment


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
