"""Measures of plasticity: how much of a network is in use, of a part of the batch that it just learned from.

    dormant_share   share of hidden units with  E|h_i| <= tau mean_k E|h_k|,  k over the units of a layer
                    (tau-dormant neurons, Sokar et al. 2023, definition 3.1)
    feature_rank    least k with  s_1 + ... + s_k >= (1 - delta) (s_1 + ... + s_n),  s: singular values of the features
                    before the output of actor or critic, falling (srank, Kumar et al. 2021, section 3)
    weight_norm     L2 norm of all parameters

Every part of the batch gives as many samples, at the same places, so that the samples do not depend on how parts are
divided over devices.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, TypedDict

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jax.sharding import Mesh, PartitionSpec

from jax2d.scene import Array
from kinetix_dist.env.observations import Observation
from kinetix_dist.learner.division import Division
from kinetix_dist.learner.sharding import DATA_AXIS, on_devices
from kinetix_dist.messages import StaticInput, Trajectory
from kinetix_dist.models.gru import has_memory
from kinetix_dist.models.hidden_units import COLLECTIONS, FEATURES, UNITS
from kinetix_dist.setting import check_settings, setting

TAU = 0.025
DELTA = 0.01
NUM_SAMPLES = 2048  # of all devices, about: many times the units of a layer, and little next to a batch


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlasticityConfig:
    """Measures of plasticity (dormant units, rank of features, norm of weights). They change no number of training."""

    every: int = setting(0, minimum=0)  # updates between measures of plasticity; 0: none

    def __post_init__(self) -> None:
        check_settings(self)

    def is_due(self, num_updates: int) -> bool:
        """Measured in the update that leads to `num_updates`."""
        return self.every > 0 and num_updates % self.every == 0


class _Memory(TypedDict, total=False):
    """Arguments of a network with a memory besides observations."""

    is_first: Array  # [steps, worlds]
    memory: Array  # [worlds, size], before the first step


Measure = Callable[[Any, StaticInput, Trajectory], dict[str, Array]]


@functools.lru_cache(maxsize=8)
def make_measure(policy: nn.Module, observation: Observation, mesh: Mesh, *, division: Division) -> Measure:
    """A compiled measure(params, static, trajectory) -> replicated float32 scalars by name.

    Arguments are those of `make_update`; static and trajectory lie as it takes them. Raises ValueError, when it is
    called, for a network that notes no units.
    """

    def on_device(params: Any, static: StaticInput, trajectory: Trajectory) -> dict[str, Array]:
        num_steps, num_worlds = trajectory.rewards.shape
        steps, worlds = _places(num_steps, num_worlds, division, whole_worlds=has_memory(policy))
        dynamic = jax.tree.map(lambda x: x[steps, worlds], trajectory.dynamic_obs)
        obs = observation.join(jax.tree.map(lambda x: x[worlds], static.obs), dynamic)
        memory: _Memory = {}
        if has_memory(policy):
            is_first = jnp.roll(trajectory.done_after, 1, axis=0).at[0].set(static.memory is None)
            memory["is_first"] = is_first[steps, worlds].reshape(num_steps, -1)
            if static.memory is not None:
                memory["memory"] = static.memory[worlds[: worlds.size // num_steps]]
        _, noted = policy.apply(params, obs, mutable=list(COLLECTIONS), **memory)
        layers = [layer.astype(jnp.float32) for layer in jax.tree.leaves(noted.get(UNITS, {}))]
        if not layers or FEATURES not in noted:
            raise ValueError(
                f"network {type(policy).__name__} notes no hidden units, of which plasticity is measured; set "
                "plasticity.every to 0, or let it note them (kinetix_dist/models/hidden_units.py)"
            )
        device = jax.lax.axis_index(DATA_AXIS)
        is_counted = jnp.repeat(jnp.asarray(division.is_counted)[device], len(steps) // division.slots)
        if has_memory(policy):  # samples are step by step
            is_counted = is_counted.reshape(-1, num_steps).T.reshape(-1)
        return {
            "dormant_share": _dormant_share([_sums(layer, is_counted) for layer in layers]),
            **{
                f"{name}_feature_rank": effective_rank(_of_all_devices(features, is_counted))
                for name, (features,) in _tower_features(noted[FEATURES]).items()
            },
            "weight_norm": jnp.sqrt(sum(jnp.sum(jnp.square(leaf)) for leaf in jax.tree.leaves(params))),
        }

    whole, worlds, steps = PartitionSpec(), PartitionSpec(DATA_AXIS), PartitionSpec(None, DATA_AXIS)
    return jax.jit(on_devices(on_device, mesh, in_specs=(whole, worlds, steps), out_specs=whole))


def _places(
    num_steps: int, num_worlds: int, division: Division, *, whole_worlds: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Steps and worlds of the samples of a device, part by part; of whole worlds step by step."""
    worlds_per_slot = num_worlds // division.slots
    first_worlds = np.arange(division.slots) * worlds_per_slot
    num_per_part = max(NUM_SAMPLES // division.num_parts, 1)
    if whole_worlds:
        count = min(max(num_per_part // num_steps, 1), worlds_per_slot)
        worlds = (first_worlds[:, None] + np.arange(count)).reshape(-1)
        return np.repeat(np.arange(num_steps), worlds.size), np.tile(worlds, num_steps)
    count = min(num_per_part, num_steps * worlds_per_slot)
    place = np.arange(count) * num_steps * worlds_per_slot // count  # evenly over the part
    worlds = first_worlds[:, None] + place % worlds_per_slot
    return np.tile(place // worlds_per_slot, division.slots), worlds.reshape(-1)


def _sums(layer: Array, is_counted: Array) -> Array:
    """[units] sums of |h| over the samples of all devices. layer: [samples, ..., units]"""
    rows = jnp.abs(layer).reshape(layer.shape[0], -1, layer.shape[-1]).sum(axis=1)
    return jax.lax.psum(jnp.sum(jnp.where(is_counted[:, None], rows, 0.0), axis=0), DATA_AXIS)


def _dormant_share(sums: list[Array]) -> Array:
    num_dormant = sum(jnp.sum(layer <= TAU * jnp.mean(layer)) for layer in sums)
    return num_dormant / jnp.float32(sum(layer.size for layer in sums))


def _tower_features(noted: Any) -> dict[str, tuple[Array]]:
    """By name, wherever in the network they were noted."""
    found = {}
    for name, value in noted.items():
        found |= {name: value} if isinstance(value, tuple) else _tower_features(value)
    return found


def _of_all_devices(features: Array, is_counted: Array) -> Array:
    """Rows of all devices; those that are there once more are zero, which changes no singular value."""
    rows = jnp.where(is_counted[:, None], features.astype(jnp.float32), 0.0)
    return jax.lax.all_gather(rows, DATA_AXIS, tiled=True)


def effective_rank(features: Array) -> Array:
    """srank of [samples, units], float32; 0 where all are zero."""
    values = jnp.linalg.svd(features, compute_uv=False)
    total = jnp.cumsum(values)
    rank = 1 + jnp.sum(total < (1 - DELTA) * total[-1])
    return jnp.where(total[-1] > 0, rank, 0).astype(jnp.float32)
