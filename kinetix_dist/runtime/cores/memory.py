"""Whether the worlds and minibatches of a run fit on its devices, where that is known in advance."""

from __future__ import annotations

import math

from kinetix_dist.config import TrainConfig
from kinetix_dist.env.device_memory import check_fits
from kinetix_dist.env.observations import OBSERVATIONS
from kinetix_dist.models.policy import NETWORKS


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
