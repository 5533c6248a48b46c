"""Section `ppo` of a run's configuration."""

from __future__ import annotations

import dataclasses
from typing import Any

import optax

from jax2d.scene import Array
from kinetix_dist.learner.state import LearnerState, adam, init_learner_state
from kinetix_dist.setting import ConfigError, check_settings, setting


@dataclasses.dataclass(frozen=True, kw_only=True)
class AnnealConfig:
    """Factors by which settings of PPO change linearly between two steps. Factors of 1: not at all.

    Steps are those of the run, progress/env_steps, learned from or not."""

    start: int = setting(0, minimum=0)  # environment steps of the run
    end: int = setting(0, minimum=0)  # environment steps of the run, from which on the factors hold; 0: nothing changes
    learning_rate: float = setting(1.0, above=0)
    clip: float = setting(1.0, above=0)
    entropy_coefficient: float = setting(1.0, minimum=0)

    def __post_init__(self) -> None:
        check_settings(self)
        if self.end and self.end <= self.start:
            raise ConfigError(f"AnnealConfig.end is {self.end}; it must be after start, {self.start}, or 0 for none")


@dataclasses.dataclass(frozen=True, kw_only=True)
class PpoConfig:
    """Settings of PPO; defaults are the paper's (256 steps of 2,048 worlds make minibatches of 16,384)."""

    discount: float = setting(0.995, minimum=0, maximum=1)
    trace: float = setting(0.9, minimum=0, maximum=1)  # lambda of GAE
    epochs: int = setting(8, minimum=1)
    minibatches: int = setting(32, minimum=1)  # an epoch, over all devices together
    clip: float = setting(0.02, above=0)
    value_clip: bool = True  # by the same amount
    learning_rate: float = setting(5e-5, above=0)
    adam_eps: float = setting(1e-5, above=0)
    max_grad_norm: float = setting(0.5, above=0)
    value_coefficient: float = 0.5
    entropy_coefficient: float = 0.01
    normalise_advantages: bool = True  # over each minibatch, all devices together
    virtual_shards: int = setting(64, minimum=1)  # of worlds, for shuffling; no more devices can learn
    mask_unbound_heads: bool = False  # leave colours that a level does not use out of ratio, clip and entropy
    bootstrap_timeouts: bool = False  # an episode that ends at the time limit is worth as much as the state before
    average_updates: int = setting(0, minimum=0)  # over which parameters are averaged for evaluation; 0: none
    noise_scale: bool = False  # report learner/gradient_noise_scale; one device computes each gradient in two halves
    max_kl: float = setting(0.0, minimum=0)  # mean KL of an update above which the rate falls for good; 0: never
    anneal: AnnealConfig = dataclasses.field(default_factory=AnnealConfig)

    def __post_init__(self) -> None:
        check_settings(self)

    def check_batch(self, *, num_steps: int, num_worlds: int, whole_worlds: bool = False) -> None:
        """Raises ValueError, with the numbers, if T steps of W worlds (all devices) cannot be divided.

        whole_worlds: minibatches are of all steps of some worlds, as for recurrent policies.
        """
        shards = self.virtual_shards
        if num_worlds % shards:
            raise ValueError(
                f"{num_worlds} worlds cannot be divided into {shards} virtual shards; "
                "change the number of worlds or PpoConfig.virtual_shards"
            )
        if whole_worlds and num_worlds // shards % self.minibatches:
            raise ValueError(
                f"a recurrent policy learns from whole worlds: {num_worlds} worlds give {num_worlds // shards} to each "
                f"of {shards} virtual shards, which cannot be divided into {self.minibatches} minibatches; raise "
                "rollout.num_envs, or lower ppo.virtual_shards or ppo.minibatches"
            )
        if self.noise_scale and (num_worlds if whole_worlds else num_steps * num_worlds) < 2 * self.minibatches:
            raise ValueError(
                f"ppo.noise_scale compares parts of a minibatch, but {num_steps} steps of {num_worlds} worlds in "
                f"{self.minibatches} minibatches leave one part each; lower ppo.minibatches or leave it out"
            )
        samples = num_steps * num_worlds // shards
        if samples % self.minibatches:
            raise ValueError(
                f"{num_steps} steps of {num_worlds} worlds give {samples} samples to each of {shards} virtual shards, "
                f"which cannot be divided into {self.minibatches} minibatches; change one of these numbers"
            )

    def optimizer(self) -> optax.GradientTransformation:
        return adam(self.learning_rate, epsilon=self.adam_eps)

    def initial_state(self, params: Any, key: Array) -> LearnerState:
        """State of a learner that starts with these parameters; key: typed, see `init_learner_state`."""
        return init_learner_state(params, self.optimizer(), key, has_average=self.average_updates > 0)
