"""A network of your own: shapes, joints and thrusters are embedded one by one and averaged (Deep Sets, Zaheer 2017).

    python examples/own_network.py                          trains for seconds on the CPU
    PYTHONPATH=examples kinetix-dist train --recipe quickstart --run.plugins own_network --policy.network deep_set

A network is a flax module. It takes an observation of B worlds and gives logits of each action head and a value.
"""

from __future__ import annotations

import sys
from typing import Any

import jax.numpy as jnp
from flax import linen as nn

from kinetix_dist.cli.main import main
from kinetix_dist.env.observations import ENTITIES
from kinetix_dist.env.observations.entities import EntityObs
from kinetix_dist.models.policy import NETWORKS, Network, PolicyConfig
from kinetix_dist.models.towers import Towers

Array = Any


class DeepSet(nn.Module):
    """Entities of B worlds -> (logits of each head [B, choices], value [B])."""

    size: int
    hidden_size: int
    hidden_layers: int
    head_sizes: tuple[int, ...]

    @nn.compact
    def __call__(self, obs: EntityObs, memory: Array | None = None, *, is_first: Array | None = None) -> Any:
        del memory, is_first  # of recurrent networks
        shapes = jnp.concatenate(
            [nn.Dense(self.size, name="polygons")(obs.polygons), nn.Dense(self.size, name="circles")(obs.circles)],
            axis=1,
        )
        joints = nn.Dense(self.size, name="joints")(obs.joints)
        thrusters = nn.Dense(self.size, name="thrusters")(obs.thrusters)
        world = jnp.concatenate(
            [
                masked_mean(jnp.tanh(shapes), obs.shape_mask),
                masked_mean(jnp.tanh(joints), obs.joint_mask),
                masked_mean(jnp.tanh(thrusters), obs.thruster_mask),
            ],
            axis=-1,
        )
        # Actor and critic, as those of the built-in networks.
        return Towers(self.hidden_size, self.hidden_layers, self.head_sizes, name="towers")(world)


def masked_mean(rows: Array, mask: Array) -> Array:
    """[B, features] of rows [B, n, features] where mask [B, n]; zeros where there is none."""
    weight = mask[..., None].astype(rows.dtype)
    return (rows * weight).sum(axis=1) / jnp.maximum(weight.sum(axis=1), 1.0)


def build(config: PolicyConfig, head_sizes: tuple[int, ...]) -> nn.Module:
    """The module that a run's `policy` settings describe."""
    return DeepSet(config.encoder_size, config.hidden_size, config.hidden_layers, head_sizes)


if __name__ == "__main__":
    options = ["--recipe", "tiny", "--run.plugins", "own_network", "--policy.network", "deep_set"]
    raise SystemExit(main(["train", *options, *sys.argv[1:]]))

# A run imports this file as a plugin, in each of its processes: the name is known from then on.
NETWORKS.register("deep_set", Network(takes=ENTITIES, build=build))
