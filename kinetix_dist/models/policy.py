"""Which network a policy is, and how large: `PolicyConfig`, `make_policy`, `init_params`.

policy = make_policy(PolicyConfig(dtype="bfloat16"))
params = init_params(policy, obs, key)
logits, value = policy.apply(params, obs)          # a tuple of [B, choices] a head, and [B]; both float32
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
from flax import linen as nn

from jax2d.scene import Array
from kinetix_dist.models.entity_transformer import NUM_MASKS, EntityTransformer
from kinetix_dist.models.flat_mlp import FlatMlp

if TYPE_CHECKING:
    from kinetix_dist.env.observations.entities import EntityObs

NETWORKS = ("transformer", "flat")
DTYPES = {"float32": jnp.float32, "bfloat16": jnp.bfloat16}


@dataclasses.dataclass(frozen=True, kw_only=True)
class PolicyConfig:
    """The defaults are the paper's transformer: its 786,417 parameters with six action heads, and 384 for sliders."""

    network: str = "transformer"  # or "flat"
    encoder_size: int = 128  # width of tokens
    attention_features: int = 16  # of all heads together
    num_heads: int = 8  # a quarter of them for each attention mask
    num_layers: int = 2
    hidden_size: int = 128  # of actor and critic
    hidden_layers: int = 5  # before the output layer
    flat_size: int = 512  # encoder of the flat network
    dtype: str = "float32"  # of activations: "float32" or "bfloat16"; parameters and outputs are float32

    def __post_init__(self) -> None:
        if self.network not in NETWORKS:
            raise ValueError(f"PolicyConfig.network is {self.network!r}; choose one of {', '.join(NETWORKS)}")
        if self.dtype not in DTYPES:
            raise ValueError(f"PolicyConfig.dtype is {self.dtype!r}; choose one of {', '.join(DTYPES)}")
        at_least_one = ("encoder_size", "attention_features", "num_heads", "num_layers", "hidden_size", "flat_size")
        for name, least in (*((name, 1) for name in at_least_one), ("hidden_layers", 0)):
            if getattr(self, name) < least:
                raise ValueError(f"PolicyConfig.{name} is {getattr(self, name)}; it must be {least} or more")
        if self.num_heads % NUM_MASKS:
            raise ValueError(f"PolicyConfig.num_heads is {self.num_heads}; it must be a multiple of {NUM_MASKS} masks")
        if self.attention_features % self.num_heads:
            raise ValueError(
                f"PolicyConfig.attention_features is {self.attention_features}; "
                f"it must be a multiple of num_heads, {self.num_heads}"
            )


def make_policy(config: PolicyConfig, head_sizes: tuple[int, ...] = (3, 3, 3, 3, 2, 2)) -> nn.Module:
    """A flax module. head_sizes: choices of each action head, `Environment.action_head_sizes`."""
    common: dict[str, Any] = {
        "hidden_size": config.hidden_size,
        "hidden_layers": config.hidden_layers,
        "head_sizes": tuple(head_sizes),
        "dtype": DTYPES[config.dtype],
    }
    if config.network == "flat":
        return FlatMlp(flat_size=config.flat_size, **common)
    return EntityTransformer(
        encoder_size=config.encoder_size,
        attention_features=config.attention_features,
        num_heads=config.num_heads,
        num_layers=config.num_layers,
        **common,
    )


def init_params(policy: nn.Module, obs: EntityObs, key: Array) -> Any:
    """Parameters, float32, drawn for one world of `obs` (the batch size does not matter)."""
    one_world = jax.tree.map(lambda x: x[:1], obs)
    return jax.jit(policy.init)(key, one_world)


def num_parameters(params: Any) -> int:
    return sum(x.size for x in jax.tree.leaves(params))
