"""Objects that a process plays with in a phase of a run: environment, curriculum and rollout.

An object is made again where a phase changes what it depends on, and compiled when it is first used.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any, TypeVar

from jax.sharding import Mesh

from kinetix_dist.config import StoredConfig, TrainConfig
from kinetix_dist.curator.curriculum import Curriculum
from kinetix_dist.env.device_memory import check_fits
from kinetix_dist.env.env_config import EnvConfig
from kinetix_dist.env.environment import Environment
from kinetix_dist.env.observations import OBSERVATIONS
from kinetix_dist.learner.config import PpoConfig
from kinetix_dist.learner.division import Division
from kinetix_dist.models.policy import NETWORKS, make_policy
from kinetix_dist.runtime.cores.curriculum_state import make_curriculum
from kinetix_dist.runtime.cores.rollout_core import Players, RolloutCore, rollout_core


def make_environment(config: TrainConfig | StoredConfig) -> Environment:
    """Return the environment of a run, or of a policy that was trained."""
    return _environment(config.env)


@functools.cache
def _environment(config: EnvConfig) -> Environment:
    """One for all parts of a process: each uses what another has compiled."""
    return Environment(config)


def check_memory(config: TrainConfig, num_devices: int) -> None:
    """Raises DeviceMemoryError for a batch or a minibatch of which a device's share is too large for it."""
    observed, learned = OBSERVATIONS[config.env.observation].working_bytes, NETWORKS[config.policy.network].sample_bytes
    if not observed:
        return
    what = f"observations {config.env.observation!r} of"
    check_fits(
        math.ceil(config.rollout.num_envs / num_devices),
        observed,
        what=f"{what} worlds of a device:",
        advice="lower rollout.num_envs or use more devices",
    )
    samples = config.num_trained_envs * config.rollout.num_steps / config.ppo.minibatches
    check_fits(
        math.ceil(samples / num_devices),
        observed + learned,
        what=f"{what} samples of a minibatch on a device:",
        advice="raise ppo.minibatches, lower rollout.num_steps or use more devices",
    )


T = TypeVar("T")


class Playing:
    """Environment, curriculum and rollout of one process. groups, division: see `RolloutCore`.

    Methods take the configuration of a phase. Objects of the last two are kept: in the split placement a learner is in
    one while the next one begins.
    """

    def __init__(
        self, config: TrainConfig, mesh: Mesh, *, groups: range | None = None, division: Division | None = None
    ) -> None:
        """config: of the run, with its phases. groups: None: all."""
        self._mesh = mesh
        self._times = config.refresh_times
        self._groups = groups if groups is not None else range(config.rollout.num_groups)
        self._division = division
        self._made: dict[str, list[tuple[Any, Any]]] = {}  # by name: (what it was made for, the object), newest first
        self.policy = make_policy(config.policy, self.environment(config).action_distribution.head_sizes)

    def environment(self, config: TrainConfig) -> Environment:
        return self._cached("environment", (config.env, config.curriculum), lambda: make_environment(config))

    def curriculum(self, config: TrainConfig) -> Curriculum:
        # What learns in `observe` does so by the settings of the policy.
        learns_by = config.ppo if config.curriculum_class.observes else None
        return self._cached(
            "curriculum",
            (config.env, config.curriculum, config.rollout, learns_by),
            lambda: make_curriculum(config, self.environment(config), self.policy, self._mesh, times=self._times),
        )

    def rollout(self, config: TrainConfig) -> RolloutCore:
        return self._cached(
            "rollout",
            (config.env, config.curriculum, config.rollout, _of_play(config.ppo)),
            lambda: rollout_core(
                config,
                Players(self.environment(config), self.policy, self.curriculum(config)),
                self._mesh,
                groups=self._groups,
                division=self._division,
            ),
        )

    def _cached(self, name: str, made_for: Any, make: Callable[[], T]) -> T:
        known = self._made.get(name, [])
        found = next((entry for entry in known if entry[0] == made_for), None) or (made_for, make())
        others = [entry for entry in known if entry[0] != made_for]
        self._made[name] = [found, *others[:1]]  # another list: another thread may look at the one before
        return found[1]


def _of_play(ppo: PpoConfig) -> tuple[Any, ...]:
    """Settings of learning that a rollout depends on: parts of its batch, and advantages that a curriculum sees."""
    return ppo.mask_unbound_heads, ppo.bootstrap_timeouts, ppo.discount, ppo.trace
