"""Velocity of action chunks: what a flow-matching policy learns (kinetix_dist/delay/flow_matching.py).

    encode      observation -> embedding [B, width], once for all integration steps
    velocity    embedding, noisy chunk [B, H, A], flow time [B, H] -> its velocity [B, H, A]

`encode` is the encoder of any network of `policy.py` and a norm; of several steps it takes each, beside their
actions. `velocity` takes each action of a chunk as a token: `num_layers` blocks mix tokens, then channels (MLP-Mixer,
Tolstikhin et al. 2021), with scale, shift and gate of each norm by the flow time (adaLN-zero, Peebles and Xie 2023).
Blocks, widths and the periods of the time's sines are those of the public benchmark (Black, Galliker and Levine 2025).
A token has a flow time of its own, so that actions that are known already can be given without noise (training-time
RTC, Black et al. 2025).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import linen as nn

from jax2d.scene import Array

MIN_PERIOD, MAX_PERIOD = 4e-3, 4.0  # of the sines of the flow time, which is from 0 to 1
zeros = nn.initializers.zeros


class Remembered(NamedTuple):
    """Observation of B worlds with n steps before it, the newest first."""

    now: Any  # [B, ...]
    past: Any  # [B, n, ...]
    actions: Array  # [B, n, A] in -1..1, of these steps


class FlowNetwork(nn.Module):
    """See above. The encoder's parameters lie below "encoder"."""

    encoder: nn.Module  # `policy.make_encoder`
    horizon: int  # actions of a chunk, H
    num_dimensions: int  # of an action, A
    width: int  # channels of a token
    token_width: int  # hidden units of the mixing of tokens
    num_layers: int

    def setup(self) -> None:
        self.embed = nn.Dense(self.width)
        self.action_in = nn.Dense(self.width)
        self.time_in, self.time_out = nn.Dense(self.width), nn.Dense(self.width)
        self.blocks = [MixerBlock(self.width, self.token_width) for _ in range(self.num_layers)]
        self.final = Modulation(2)
        self.norm = _plain_norm()
        self.action_out = nn.Dense(self.num_dimensions)

    def __call__(self, obs: Any, chunk: Array, time: Array) -> Array:
        return self.velocity(self.encode(obs), chunk, time)

    def encode(self, obs: Any) -> Array:
        """[B, width] float32. obs: [B, ...], or `Remembered`, whose observations share the encoder. Raises ValueError
        for a network that has no embedding to give."""
        if not isinstance(obs, Remembered):
            return self.embed(self._encoded(obs))
        num_worlds = len(obs.actions)
        steps = jax.tree.map(lambda now, past: jnp.concatenate([now[:, None], past], axis=1), obs.now, obs.past)
        embeddings = self._encoded(jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), steps))
        beside = embeddings.reshape(num_worlds, -1), obs.actions.reshape(num_worlds, -1)
        return self.embed(jnp.concatenate(beside, axis=1))

    def _encoded(self, obs: Any) -> Array:
        embedding = self.encoder(obs)
        if isinstance(embedding, tuple):
            raise ValueError(f"network {type(self.encoder).__name__} gives no embedding; see models/gru.py")
        return self.norm(embedding.astype(jnp.float32))

    def velocity(self, embedding: Array, chunk: Array, time: Array) -> Array:
        """[B, H, A] float32. chunk [B, H, A] in units of -1..1; time [B, H] of each action, 0: noise, 1: data."""
        given = nn.silu(self.time_out(nn.silu(self.time_in(sines(time, self.width)))))
        x = self.action_in(chunk) + embedding[:, None]
        for block in self.blocks:
            x = block(x, given)
        scale, shift = self.final(given)
        return self.action_out(self.norm(x) * (1 + scale) + shift)


class MixerBlock(nn.Module):
    """Tokens [B, H, width], with what is known of their time [B, H, width] -> the same shape."""

    width: int
    token_width: int

    @nn.compact
    def __call__(self, x: Array, given: Array) -> Array:
        scale, shift, gate = Modulation(3, name="token_modulation")(given)
        y = jnp.swapaxes(_plain_norm()(x) * (1 + scale) + shift, 1, 2)
        y = nn.gelu(nn.Dense(self.token_width, use_bias=False, name="token_in")(y))
        y = nn.Dense(x.shape[1], use_bias=False, name="token_out")(y)
        x = x + gate * jnp.swapaxes(y, 1, 2)
        scale, shift, gate = Modulation(3, name="channel_modulation")(given)
        y = _plain_norm()(x) * (1 + scale) + shift
        y = nn.gelu(nn.Dense(2 * self.width, use_bias=False, name="channel_in")(y))
        return x + gate * nn.Dense(self.width, use_bias=False, name="channel_out")(y)


class Modulation(nn.Module):
    """`count` arrays like `given`, all zero at first: a block begins as the identity."""

    count: int

    @nn.compact
    def __call__(self, given: Array) -> tuple[Array, ...]:
        both = nn.Dense(self.count * given.shape[-1], kernel_init=zeros)(given)
        return tuple(jnp.split(both, self.count, axis=-1))


def sines(time: Array, width: int) -> Array:
    """[..., width]: sines and cosines of `time` with periods from MIN_PERIOD to MAX_PERIOD, evenly in their log."""
    share = jnp.linspace(0.0, 1.0, width // 2)
    angle = time[..., None] * (2 * math.pi / (MIN_PERIOD * (MAX_PERIOD / MIN_PERIOD) ** share))
    return jnp.concatenate([jnp.sin(angle), jnp.cos(angle)], axis=-1)


def _plain_norm() -> nn.LayerNorm:
    return nn.LayerNorm(use_scale=False, use_bias=False)
