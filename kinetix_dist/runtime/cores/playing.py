"""What a process plays with in a phase of a run: curriculum and rollout, made anew where a phase changes them.

What is made anew is compiled when it is first used.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from jax.sharding import Mesh

from kinetix_dist.config import TrainConfig
from kinetix_dist.curator.curriculum import Curriculum
from kinetix_dist.env.environment import Environment
from kinetix_dist.learner.division import Division
from kinetix_dist.models.policy import make_policy
from kinetix_dist.runtime.cores.curriculum_state import make_curriculum
from kinetix_dist.runtime.cores.levels import make_environment
from kinetix_dist.runtime.cores.rollout_core import RolloutCore, rollout_core

T = TypeVar("T")


class Playing:
    """Of one process. groups, division: see `RolloutCore`. Methods take the configuration of a phase, and give the same
    object until one differs in what that depends on."""

    def __init__(
        self, config: TrainConfig, mesh: Mesh, *, groups: range | None = None, division: Division | None = None
    ) -> None:
        """groups: None: all."""
        self._mesh = mesh
        self._groups = groups if groups is not None else range(config.rollout.num_groups)
        self._division = division
        self._made: dict[str, tuple[Any, Any]] = {}  # by name: (what it was made for, the object)
        self.policy = make_policy(config.policy, self.environment(config).action_distribution.head_sizes)

    def environment(self, config: TrainConfig) -> Environment:
        return self._kept("environment", (config.env, config.curriculum), lambda: make_environment(config))

    def curriculum(self, config: TrainConfig) -> Curriculum:
        # What learns in `observe` does so by the settings of the policy.
        learns_by = config.ppo if config.curriculum_class.observes else None
        return self._kept(
            "curriculum",
            (config.env, config.curriculum, config.rollout, learns_by),
            lambda: make_curriculum(config, self.environment(config), self.policy, self._mesh),
        )

    def rollout(self, config: TrainConfig) -> RolloutCore:
        return self._kept(
            "rollout",
            (config.env, config.curriculum, config.rollout),
            lambda: rollout_core(
                config,
                self.environment(config),
                self.policy,
                self.curriculum(config),
                self._mesh,
                groups=self._groups,
                division=self._division,
            ),
        )

    def _kept(self, name: str, made_for: Any, make: Callable[[], T]) -> T:
        found = self._made.get(name)
        if found is None or found[0] != made_for:
            found = self._made[name] = made_for, make()
        return found[1]  # not what another thread may have put there since, for another phase
