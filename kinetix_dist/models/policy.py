"""Networks of policies: `PolicyConfig`, `make_policy`, `init_params`.

policy = make_policy(PolicyConfig(dtype="bfloat16"), env.action_space.distribution.head_sizes)
params = init_params(policy, obs, key)
logits, value = policy.apply(params, obs)          # a tuple of [B, choices] a head, and [B]; both float32
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn

from jax2d.scene import Array
from kinetix_dist import prng
from kinetix_dist.env.observations import ENTITIES, IMAGE, VECTOR
from kinetix_dist.models.colour_readout import check_heads
from kinetix_dist.models.entity_transformer import NUM_MASKS, EntityTransformer
from kinetix_dist.models.flat_mlp import FlatMlp
from kinetix_dist.models.kernels.support import KERNELS
from kinetix_dist.models.pixel_cnn import SAMPLE_BYTES, PixelCnn
from kinetix_dist.registry import Registry
from kinetix_dist.setting import MAX_LAYERS, MAX_WIDTH, ConfigError, check_settings, setting

RECURRENT = ("none", "gru")
READ_OUTS = ("pooled", "colour")
DTYPES = {"float32": jnp.float32, "bfloat16": jnp.bfloat16}


@dataclasses.dataclass(frozen=True)
class Network:
    """Kind of network: its input and how it is built."""

    takes: str  # the kind of policy input, see `Observation.gives`
    build: Callable[[PolicyConfig, tuple[int, ...]], nn.Module]  # (config, sizes of the heads) -> a flax module
    reads_by_colour: bool = False  # whether it has `PolicyConfig.read_out` "colour"
    has_attention: bool = False  # whether it has `PolicyConfig.max_qk_norm`
    has_kernels: bool = False  # whether it has `PolicyConfig.kernels` "fused"
    plays_all_sizes: bool = False  # whether its parameters fit levels of any size, whichever it was trained on
    sample_bytes: int = 0  # of device memory for a sample of a minibatch, gradients included; 0: too few to count


NETWORKS: Registry[Network] = Registry("network")


@dataclasses.dataclass(frozen=True, kw_only=True)
class PolicyConfig:
    """The defaults are the paper's transformer: its 786,417 parameters with six action heads, and 384 for sliders."""

    network: str = setting("transformer", choices=NETWORKS)  # of entities; "flat" of a vector; "cnn" of a picture
    encoder_size: int = setting(128, minimum=1, maximum=MAX_WIDTH)  # width of tokens
    attention_features: int = setting(16, minimum=1, maximum=MAX_WIDTH)  # of all heads together
    num_heads: int = setting(8, minimum=1, maximum=MAX_WIDTH)  # a quarter of them for each attention mask
    num_layers: int = setting(2, minimum=1, maximum=MAX_LAYERS)
    hidden_size: int = setting(128, minimum=1, maximum=MAX_WIDTH)  # of actor and critic
    hidden_layers: int = setting(5, minimum=0, maximum=MAX_LAYERS)  # before the output layer
    flat_size: int = setting(512, minimum=1, maximum=MAX_WIDTH)  # encoder of the flat network
    read_out: str = setting("pooled", choices=READ_OUTS)  # or "colour": heads read tokens of their colour; transformers
    recurrent: str = setting("none", choices=RECURRENT)  # or "gru": a memory between the embedding and actor and critic
    memory_size: int = setting(256, minimum=1, maximum=MAX_WIDTH)  # of it
    dtype: str = setting("float32", choices=DTYPES)  # of activations, or "bfloat16"; parameters are float32
    kernels: str = setting("xla", choices=KERNELS)  # of layers: or "fused" (Hopper GPUs), or "auto": where these run
    max_qk_norm: float = setting(0.0, minimum=0)  # of weights of a head's queries and keys; 0: no limit; transformers

    def __post_init__(self) -> None:
        check_settings(self)
        network = NETWORKS[self.network]
        if self.kernels == "fused" and not network.has_kernels:
            raise ConfigError(
                f"PolicyConfig.kernels is 'fused', but network {self.network!r} has no kernels; "
                "set it to 'auto' or 'xla'"
            )
        if self.read_out == "colour" and not network.reads_by_colour:
            able = [name for name in NETWORKS if NETWORKS[name].reads_by_colour]
            raise ConfigError(
                f"PolicyConfig.read_out is 'colour', but network {self.network!r} has no tokens to read; "
                f"set it to 'pooled' or use network {' or '.join(map(repr, able))}"
            )
        if self.max_qk_norm and not network.has_attention:
            raise ConfigError(
                f"PolicyConfig.max_qk_norm is {self.max_qk_norm}, but network {self.network!r} has no attention; "
                "set it to 0"
            )
        if self.num_heads % NUM_MASKS:
            raise ConfigError(f"PolicyConfig.num_heads is {self.num_heads}; it must be a multiple of {NUM_MASKS} masks")
        if self.attention_features % self.num_heads:
            raise ConfigError(
                f"PolicyConfig.attention_features is {self.attention_features}; "
                f"it must be a multiple of num_heads, {self.num_heads}"
            )


def make_policy(config: PolicyConfig, head_sizes: tuple[int, ...]) -> nn.Module:
    """A flax module. head_sizes: of the outputs that act, `ActionSpace.distribution.head_sizes`."""
    return NETWORKS[config.network].build(config, tuple(head_sizes))


def make_encoder(config: PolicyConfig) -> nn.Module:
    """The same network without actor and critic: its output is the embedding of the observations, [B, features].

    Raises ConfigError for settings of what it does not have.
    """
    if config.read_out != "pooled" or config.recurrent != "none":
        raise ConfigError(
            f"an encoder alone has PolicyConfig.read_out 'pooled' and recurrent 'none', not {config.read_out!r} and "
            f"{config.recurrent!r}"
        )
    return make_policy(config, ())


def _common(config: PolicyConfig, head_sizes: tuple[int, ...]) -> dict[str, Any]:
    return {
        "hidden_size": config.hidden_size,
        "hidden_layers": config.hidden_layers,
        "head_sizes": head_sizes,
        "memory_size": config.memory_size if config.recurrent == "gru" else 0,
        "dtype": DTYPES[config.dtype],
    }


def _transformer(
    config: PolicyConfig,
    head_sizes: tuple[int, ...],
    *,
    shape_ids: tuple[float, float] | None = None,
    gated: bool = True,
) -> nn.Module:
    by_colour = config.read_out == "colour"
    if by_colour:
        check_heads(head_sizes)
    return EntityTransformer(
        encoder_size=config.encoder_size,
        attention_features=config.attention_features,
        num_heads=config.num_heads,
        num_layers=config.num_layers,
        shape_ids=shape_ids,
        gated=gated,
        by_colour=by_colour,
        kernels=config.kernels,
        max_qk_norm=config.max_qk_norm,
        **_common(config, head_sizes),
    )


def _flat(config: PolicyConfig, head_sizes: tuple[int, ...]) -> nn.Module:
    return FlatMlp(flat_size=config.flat_size, **_common(config, head_sizes))


def _cnn(config: PolicyConfig, head_sizes: tuple[int, ...]) -> nn.Module:
    return PixelCnn(**_common(config, head_sizes))


_ATTENTION = functools.partial(Network, takes=ENTITIES, has_attention=True, plays_all_sizes=True)
NETWORKS.register("transformer", _ATTENTION(build=_transformer, reads_by_colour=True, has_kernels=True))
# Plain residuals for gates: fewer and smaller products, see entity_transformer.py.
NETWORKS.register(
    "transformer_lean",
    _ATTENTION(build=functools.partial(_transformer, gated=False), reads_by_colour=True),
)
NETWORKS.register("flat", Network(takes=VECTOR, build=_flat))
NETWORKS.register("cnn", Network(takes=IMAGE, build=_cnn, plays_all_sizes=True, sample_bytes=SAMPLE_BYTES))
# Those of the public package's policies, and of the paper's, in which an error gave all shapes the same number.
NETWORKS.register(
    "transformer_kinetix",
    _ATTENTION(build=functools.partial(_transformer, shape_ids=(1.0, 0.0)), has_kernels=True),
)
NETWORKS.register(
    "transformer_kinetix_paper",
    _ATTENTION(build=functools.partial(_transformer, shape_ids=(0.0, 0.0)), has_kernels=True),
)


def init_params(policy: nn.Module, obs: Any, key: Array) -> Any:
    """Parameters, float32, drawn for one world of `obs` (the batch size does not matter)."""
    one_world = jax.tree.map(lambda x: x[:1], obs)
    with prng.pinned():  # Flax's initializers draw
        return jax.jit(policy.init)(key, one_world)


def num_parameters(params: Any) -> int:
    return sum(x.size for x in jax.tree.leaves(params))
