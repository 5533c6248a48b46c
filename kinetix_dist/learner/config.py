"""Section `ppo` of a run's configuration."""

from __future__ import annotations

import dataclasses
from typing import Any

import optax

from jax2d.scene import Array
from kinetix_dist.learner.state import LearnerState, adam, init_learner_state


@dataclasses.dataclass(frozen=True, kw_only=True)
class AnnealConfig:
    """From which step on settings of PPO change, linearly, and by which factor at the end. Factors of 1: not at all.

    Steps are those of the run, progress/env_steps, learned from or not."""

    start: int = 0  # environment steps of the run
    end: int = 0  # environment steps of the run, from which on the factors hold; 0: nothing changes
    learning_rate: float = 1.0
    clip: float = 1.0
    entropy_coefficient: float = 1.0

    def __post_init__(self) -> None:
        if self.start < 0:
            raise ValueError(f"AnnealConfig.start is {self.start}; it must be 0 or more")
        if self.end and self.end <= self.start:
            raise ValueError(f"AnnealConfig.end is {self.end}; it must be after start, {self.start}, or 0 for none")
        for name in ("learning_rate", "clip"):
            if not getattr(self, name) > 0:
                raise ValueError(f"AnnealConfig.{name} is {getattr(self, name)}; the factor must be positive")
        if self.entropy_coefficient < 0:
            raise ValueError(f"AnnealConfig.entropy_coefficient is {self.entropy_coefficient}; it must be 0 or more")


@dataclasses.dataclass(frozen=True, kw_only=True)
class PpoConfig:
    """The defaults are the paper's (256 steps of 2,048 worlds make minibatches of 16,384)."""

    discount: float = 0.995
    trace: float = 0.9  # lambda of GAE
    epochs: int = 8
    minibatches: int = 32  # an epoch, over all devices together
    clip: float = 0.02
    value_clip: bool = True  # by the same amount
    learning_rate: float = 5e-5
    adam_eps: float = 1e-5
    max_grad_norm: float = 0.5
    value_coefficient: float = 0.5
    entropy_coefficient: float = 0.01
    normalise_advantages: bool = True  # over each minibatch, all devices together
    virtual_shards: int = 64  # of worlds, for shuffling; no more devices can learn
    mask_unbound_heads: bool = False  # leave colours that a level does not use out of ratio, clip and entropy
    bootstrap_timeouts: bool = False  # an episode that ends at the time limit is worth as much as the state before
    average_updates: int = 0  # over how many of them parameters are averaged, for evaluation and scoring; 0: none
    max_kl: float = 0.0  # mean KL of an update above which the learning rate is lowered for good; 0: it never is
    anneal: AnnealConfig = dataclasses.field(default_factory=AnnealConfig)

    def __post_init__(self) -> None:
        for name in ("epochs", "minibatches", "virtual_shards"):
            if getattr(self, name) < 1:
                raise ValueError(f"PpoConfig.{name} is {getattr(self, name)}; it must be 1 or more")
        for name in ("clip", "learning_rate", "adam_eps", "max_grad_norm"):
            if not getattr(self, name) > 0:
                raise ValueError(f"PpoConfig.{name} is {getattr(self, name)}; it must be positive")
        for name in ("average_updates", "max_kl"):
            if getattr(self, name) < 0:
                raise ValueError(f"PpoConfig.{name} is {getattr(self, name)}; it must be 0 or more")
        for name in ("discount", "trace"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"PpoConfig.{name} is {getattr(self, name)}; it must be from 0 to 1")

    def check_batch(self, *, num_steps: int, num_worlds: int, whole_worlds: bool = False) -> None:
        """Raises ValueError, with the numbers, if T steps of W worlds (all devices) cannot be divided as asked.

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
        samples = num_steps * num_worlds // shards
        if samples % self.minibatches:
            raise ValueError(
                f"{num_steps} steps of {num_worlds} worlds give {samples} samples to each of {shards} virtual shards, "
                f"which cannot be divided into {self.minibatches} minibatches; change one of these numbers"
            )

    def optimizer(self) -> optax.GradientTransformation:
        return adam(self.learning_rate, epsilon=self.adam_eps)

    def initial_state(self, params: Any, key: Array) -> LearnerState:
        """Of a learner that starts with these parameters; key: typed, see `init_learner_state`."""
        return init_learner_state(params, self.optimizer(), key, has_average=self.average_updates > 0)
