"""Step sizes of PPO: settings that change over training, a guard on KL, an average of the parameters.

    factor(t) = 1 + (end - 1) clip((t - anneal.start) / (anneal.end - anneal.start), 0, 1)
    rate      = factor of the learning rate * what the guard has left of it
    average'  = average + (parameters - average) / min(k, average_updates)                    after update k = 1, 2, ...

t are the environment steps of the run before the update, as in progress/env_steps: what a curriculum plays and the
policy does not learn from counts, and other agents of the run (the antagonist and the teacher of PAIRED) go by the
same clock. The guard and the average count the updates of each agent.

The average begins as the plain mean of all updates and becomes an exponential one (PPO-EWMA, Hilton et al. 2022, uses
the latter). The guard only ever lowers the rate: by `GUARD_FACTOR` after each update whose mean KL was above `max_kl`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jax2d.scene import Array
from kinetix_dist.learner.config import PpoConfig
from kinetix_dist.learner.state import LearnerState

GUARD_FACTOR = 0.8


class Sizes(NamedTuple):
    """Step sizes of one update. Plain numbers where nothing changes, so that programs are those of a constant."""

    rate: Any  # that the step of the optimizer is multiplied with
    clip: Any
    entropy_coefficient: Any


def sizes(config: PpoConfig, state: LearnerState) -> Sizes:
    """Sizes of the update that begins with `state`, whose clock is that of the run (`state.at_env_steps`)."""
    rate = state.rate_factor if config.max_kl else 1.0
    anneal = config.anneal
    if not anneal.end:
        return Sizes(rate, config.clip, config.entropy_coefficient)
    steps = state.env_steps[0].astype(jnp.float32) + 2.0**32 * state.env_steps[1].astype(jnp.float32)
    share = jnp.clip((steps - float(anneal.start)) / float(anneal.end - anneal.start), 0.0, 1.0)

    def factor(at_end: float) -> Array:
        return 1.0 + (at_end - 1.0) * share

    return Sizes(
        rate * factor(anneal.learning_rate),
        config.clip * factor(anneal.clip),
        config.entropy_coefficient * factor(anneal.entropy_coefficient),
    )


def guarded(config: PpoConfig, state: LearnerState, kl: Array) -> Array:
    """`LearnerState.rate_factor` after an update of this mean KL. NaN (all steps were skipped): no change."""
    if not config.max_kl:
        return state.rate_factor
    return jnp.where(kl > config.max_kl, GUARD_FACTOR, 1.0) * state.rate_factor


def average(config: PpoConfig, state: LearnerState, params: Any) -> Any:
    """`LearnerState.average` after the update from `state` to `params`."""
    if not config.average_updates:
        return None
    count = jnp.minimum(state.num_updates + 1, config.average_updates).astype(jnp.float32)
    return jax.tree.map(lambda mean, x: mean + (x - mean) / count, state.average, params)
