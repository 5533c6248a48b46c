"""The paper's network: a gated transformer over shapes, with messages along joints and from thrusters.

    encoders    polygons, circles, joints, thrusters: Dense + tanh each to [B, count, encoder_size]; one constant token
                more ("dummy") that sees every shape. With `shape_ids`, as in the public package, polygons and circles
                are encoded one narrower, and the last number of a token is that of its kind
    layer       x = gate1(x, relu(attention(norm(x))))         a quarter of the heads for each of the four masks
                x = gate2(x, relu(Dense(norm(x))))
                x[from] += Dense([x_from, x_to, joint])        for each joint and direction
                x[owner] += Dense([x_owner, thruster])         for each thruster, from the same x
    pooling     mean over the tokens that exist, the dummy included

Where it is not `gated` its gates are plain residuals around norms (pre-norm, Xiong et al. 2020): one product takes the
place of six of a layer's nine, and tokens are normalised once more before pooling.

    layer       x = x + attention(norm(x))
                x = x + Dense(relu(Dense(norm(x))))
                messages as above
    towers      actor and critic, see towers.py; a memory before them, see gru.py. Where heads read by colour, they
                are given the tokens at joints and thrusters besides, see colour_readout.py

What bounds it on a GPU is memory traffic between small operations, not arithmetic. So products of one input are
one product (queries, keys and values; the gates, see gate.py), the scale and offset of a norm are folded into the
product behind it, a joint's own share of its messages is computed once for all layers, and attention and messages
are elementwise loops (attention.py, rows.py). Activations are [B, tokens, F] in `dtype`; parameters are float32.
Observations enter in float32: bfloat16 would round positions in a 5 m box to centimetres.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn

from jax2d.scene import Array
from kinetix_dist.env.observations.entities import JOINT_COLOUR, THRUSTER_COLOUR
from kinetix_dist.models.attention import pack_mask
from kinetix_dist.models.colour_readout import sum_by_colour
from kinetix_dist.models.gru import apply_towers
from kinetix_dist.models.hidden_units import note_units
from kinetix_dist.models.kernels.support import LayerShape, uses_fused
from kinetix_dist.models.layer import (
    XLA,
    LayerParts,
    attention_update,
    encode_with_ids,
    feed_forward_update,
    joint_ends,
)
from kinetix_dist.models.linear import DenseParameters, linear
from kinetix_dist.models.norms import masked_mean, normalise
from kinetix_dist.models.rows import take_rows
from kinetix_dist.models.towers import TANH_GAIN, Towers

if TYPE_CHECKING:
    from kinetix_dist.env.observations.entities import EntityObs

NUM_MASKS = 4
lecun_normal = nn.initializers.lecun_normal
zeros = nn.initializers.zeros
ones = nn.initializers.ones


class EntityTransformer(nn.Module):
    """EntityObs of a batch of worlds -> (logits of each head [B, choices] float32, value [B] float32)."""

    encoder_size: int
    attention_features: int
    num_heads: int
    num_layers: int
    hidden_size: int
    hidden_layers: int
    head_sizes: tuple[int, ...]
    dtype: Any
    shape_ids: tuple[float, float] | None = None  # of polygons and of circles
    memory_size: int = 0  # see gru.py; 0: none
    gated: bool = True
    by_colour: bool = False  # heads read what obeys them, see colour_readout.py
    kernels: str = "xla"  # of the layers, see kernels/support.py
    max_qk_norm: float = 0.0  # of a head's weights, see `limit_queries_and_keys`; 0: none

    @nn.compact
    def __call__(self, obs: EntityObs, memory: Array | None = None, *, is_first: Array | None = None) -> Any:
        parts = self._parts(obs)
        # Encode: shapes become tokens, the dummy token is the last.
        shapes = {"polygon_encoder": obs.polygons, "circle_encoder": obs.circles}
        x = self._encode(parts, shapes, num_others=1, kind_ids=self.shape_ids)
        # A colour that only its head reads: then no colour is another one.
        joint_rows = obs.joints.at[..., JOINT_COLOUR].set(0.0) if self.by_colour else obs.joints
        thruster_rows = obs.thrusters.at[..., THRUSTER_COLOUR].set(0.0) if self.by_colour else obs.thrusters
        joints = self._encode(parts, {"joint_encoder": joint_rows})
        thrusters = self._encode(parts, {"thruster_encoder": thruster_rows})
        token_mask, mask_words = _token_masks(obs.shape_mask, obs.attention_masks)
        ends = parts.ends(obs)
        # The share of a message that does not depend on the layer's tokens.
        joint_kernels, joint_terms = self._message_terms("joint_messages", joints, parts, num_ends=2)
        thruster_kernels, thruster_terms = self._message_terms("thruster_messages", thrusters, parts, num_ends=1)
        for layer in range(self.num_layers):
            x = self._attention(layer, x, mask_words, token_mask, parts)
            x = self._feed_forward(layer, x, token_mask, parts)
            terms, kernels = (
                (joint_terms[layer], thruster_terms[layer]),
                (joint_kernels[layer], thruster_kernels[layer]),
            )
            x = parts.add_messages(x, ends, *terms, *kernels)
        embedding = masked_mean(x if self.gated else normalise(x), token_mask)
        if not self.gated:  # scale and offset of the norm: a mean of tokens takes them as each token would
            scale, offset = self._norm("pooling")
            embedding = scale * embedding + offset
        towers: Callable[..., Any] = Towers(self.hidden_size, self.hidden_layers, self.head_sizes, name="towers")
        if self.by_colour:
            normal = normalise(x)
            motors = obs.joints[..., JOINT_COLOUR] * obs.joint_mask[..., None]
            thrusts = obs.thrusters[..., THRUSTER_COLOUR] * obs.thruster_mask[..., None]
            of_joints = self._for_colours("joint", normal, joint_ends(obs), joints, motors)
            of_thrusters = self._for_colours("thruster", normal, obs.thruster_owner, thrusters, thrusts)
            towers = functools.partial(towers, by_colour=(of_joints, of_thrusters))
        return apply_towers(towers, embedding.astype(self.dtype), memory, is_first, self.memory_size)

    def _encode(
        self,
        parts: LayerParts,
        features: Mapping[str, Array],
        *,
        num_others: int = 0,
        kind_ids: tuple[float, float] | None = None,
    ) -> Array:
        """Tokens of groups, by the names of their encoders, then `num_others` that are ones."""
        width = self.encoder_size if kind_ids is None else self.encoder_size - 1
        init = nn.initializers.orthogonal(TANH_GAIN)
        parameters = [DenseParameters(width, init, name=name)(each.shape[-1]) for name, each in features.items()]
        kernels, biases = zip(*parameters, strict=True)
        encode = parts.encode if kind_ids is None else functools.partial(encode_with_ids, kind_ids)
        return encode(list(features.values()), list(kernels), list(biases), num_others, self.dtype)

    def _parts(self, obs: EntityObs) -> LayerParts:
        """Implementations of the parts of a layer."""
        layer = LayerShape(
            width=self.encoder_size,
            dtype=jnp.dtype(self.dtype).name,
            is_gated=self.gated,
            num_heads=self.num_heads,
            attention_features=self.attention_features,
            num_tokens=obs.shape_mask.shape[1] + 1,
            num_joints=obs.joint_mask.shape[1],
            num_thrusters=obs.thruster_mask.shape[1],
            num_features=max(each.shape[-1] for each in (obs.polygons, obs.circles, obs.joints, obs.thrusters)),
        )
        if not uses_fused(self.kernels, layer):
            return XLA
        from kinetix_dist.models.kernels.layer import FUSED  # of a jax that has these kernels

        return FUSED

    def _attention(self, layer: int, x: Array, mask_words: Array, token_mask: Array, parts: LayerParts) -> Array:
        size, features, name = self.encoder_size, self.attention_features, f"attention_{layer}"
        kernel = self.param(f"{name}_qkv_kernel", lecun_normal(), (size, 3 * features), jnp.float32)
        bias = self.param(f"{name}_qkv_bias", zeros, (3 * features,), jnp.float32)
        kernel, bias = self._fold_norm(name, kernel, bias)
        bias = without_key_bias(bias)
        if self.max_qk_norm:
            kernel, bias = limit_queries_and_keys(kernel, bias, self.num_heads, self.max_qk_norm)
        out_kernel = self.param(f"{name}_out_kernel", lecun_normal(), (features, size), jnp.float32)
        out_bias = self.param(f"{name}_out_bias", zeros, (size,), jnp.float32)
        heads = (NUM_MASKS, self.num_heads // NUM_MASKS)
        arguments = (mask_words, kernel, bias, out_kernel, out_bias, heads)
        if self.gated:
            x, update = parts.attention_branch(x, *arguments)
            note_units(self, name, update, token_mask)
            return self._gate(name, x, update, parts)
        x, update = attention_update(x, *arguments)
        return x + update

    def _feed_forward(self, layer: int, x: Array, token_mask: Array, parts: LayerParts) -> Array:
        size, name = self.encoder_size, f"feed_forward_{layer}"
        kernel = self.param(f"{name}_kernel", lecun_normal(), (size, size), jnp.float32)
        bias = self.param(f"{name}_bias", zeros, (size,), jnp.float32)
        kernel, bias = self._fold_norm(name, kernel, bias)
        branch = parts.feed_forward_branch if self.gated else feed_forward_update
        x, update = branch(x, kernel, bias)
        note_units(self, name, update, token_mask)
        if self.gated:
            return self._gate(name, x, update, parts)
        out_kernel = self.param(f"{name}_out_kernel", lecun_normal(), (size, size), jnp.float32)
        out_bias = self.param(f"{name}_out_bias", zeros, (size,), jnp.float32)
        return x + linear(update, out_kernel) + out_bias.astype(self.dtype)

    def _norm(self, name: str) -> tuple[Array, Array]:
        """Scale and offset."""
        return (
            self.param(f"{name}_norm_scale", ones, (self.encoder_size,), jnp.float32),
            self.param(f"{name}_norm_offset", zeros, (self.encoder_size,), jnp.float32),
        )

    def _fold_norm(self, name: str, kernel: Array, bias: Array) -> tuple[Array, Array]:
        """Kernel and bias that act on `normalise(x)` as the given ones do on scale * normalise(x) + offset."""
        scale, offset = self._norm(name)
        return scale[:, None] * kernel, bias + jnp.sum(offset[:, None] * kernel, axis=0)

    def _gate(self, name: str, x: Array, update: Array, parts: LayerParts) -> Array:
        size = self.encoder_size
        return parts.gate(
            x,
            update,
            self.param(f"{name}_gate_update_kernel", lecun_normal(), (size, 3 * size), jnp.float32),
            self.param(f"{name}_gate_stream_kernel", lecun_normal(), (size, 2 * size), jnp.float32),
            self.param(f"{name}_gate_reset_kernel", lecun_normal(), (size, size), jnp.float32),
            self.param(f"{name}_gate_bias", zeros, (size,), jnp.float32),
        )

    def _message_terms(
        self, name: str, entities: Array, parts: LayerParts, *, num_ends: int
    ) -> tuple[list[Array], list[Array]]:
        """Message terms of each layer: the kernel for tokens at the ends [ends E, E], the entities' terms [B, K, E]."""
        size, layers = self.encoder_size, range(self.num_layers)
        kernels = [
            self.param(f"{name}_{layer}_kernel", lecun_normal(), ((num_ends + 1) * size, size), jnp.float32)
            for layer in layers
        ]
        biases = [self.param(f"{name}_{layer}_bias", zeros, (size,), jnp.float32) for layer in layers]
        of_entity = [kernel[num_ends * size :] for kernel in kernels]
        if parts.joins_terms:
            joined = linear(entities, jnp.concatenate(of_entity, axis=1)) + jnp.concatenate(biases).astype(self.dtype)
            terms = jnp.split(joined, self.num_layers, axis=-1)
        else:
            terms = [
                linear(entities, kernel) + bias.astype(self.dtype)
                for kernel, bias in zip(of_entity, biases, strict=True)
            ]
        return [kernel[: num_ends * size] for kernel in kernels], terms

    def _for_colours(self, kind: str, x: Array, ends: Array, entities: Array, colours: Array) -> Array:
        """[B, colours, hidden_size]: joints or thrusters of each colour, summed for its heads (colour_readout.py)."""
        rows = jnp.concatenate([take_rows(x, ends).reshape(*entities.shape[:2], -1), entities], axis=-1)
        kernel = self.param(f"{kind}_told_kernel", lecun_normal(), (rows.shape[-1], self.hidden_size), jnp.float32)
        bias = self.param(f"{kind}_told_bias", zeros, (self.hidden_size,), jnp.float32)
        return sum_by_colour(jnp.tanh(linear(rows, kernel) + bias.astype(self.dtype)), colours)


def without_key_bias(bias: Array) -> Array:
    """[3 F], of queries, keys and values, with zeros for keys.

    What is the same for all keys moves all scores of a query alike, and softmax ignores it: the attention is the same.
    As a parameter nothing holds it but the rounding of its gradient, which Adam makes steps of. In a long run in
    bfloat16 it grew until scores were rounded away (docs/lab_log.md, "Network and kernels").
    """
    return bias * np.repeat(np.array([1.0, 0.0, 1.0], np.float32), bias.shape[0] // 3)


def limit_queries_and_keys(kernel: Array, bias: Array, num_heads: int, max_norm: float) -> tuple[Array, Array]:
    """Kernel [E, 3 F] and bias [3 F] with the Frobenius norm of what gives a head's queries, and of what gives its
    keys, scaled to `max_norm` where it is more: a max-norm constraint (Srivastava et al. 2014) as a parametrisation.

    A head whose scores grow until it looks at one token has no gradient left but rounding, and Adam makes steps of it:
    "attention entropy collapse" (Zhai et al. 2023). Here tokens are normalised, so that a query is about as long as
    the norm of its weights, and scores stay where bfloat16 tells them apart. Beyond the limit a gradient turns the
    weights and no longer stretches them.
    """
    weights = jnp.concatenate([kernel, bias[None]])
    by_head = weights.reshape(weights.shape[0], 3, num_heads, -1)
    squared = jnp.sum(by_head * by_head, axis=(0, 3), keepdims=True)
    factor = max_norm * jax.lax.rsqrt(jnp.maximum(squared, max_norm * max_norm))
    is_value = np.array([False, False, True])[:, None, None]
    weights = (by_head * jnp.where(is_value, 1.0, factor)).reshape(weights.shape)
    return weights[:-1], weights[-1]


def _token_masks(shape_mask: Array, attention_masks: Array) -> tuple[Array, Array]:
    """Masks: tokens that exist [B, n + 1], tokens that each may look at [4, B, n + 1] uint32; the dummy is last."""
    token_mask = jnp.pad(shape_mask, ((0, 0), (0, 1)), constant_values=True)
    dummy_bit = jnp.uint32(1) << jnp.uint32(shape_mask.shape[1])
    words = pack_mask(attention_masks) | jnp.where(shape_mask, dummy_bit, 0).astype(jnp.uint32)[:, None]
    words = jnp.where(shape_mask[:, None], words, 0)
    of_dummy = jnp.broadcast_to(pack_mask(token_mask)[:, None, None], (*words.shape[:2], 1))
    words = jnp.moveaxis(jnp.concatenate([words, of_dummy], axis=-1), 1, 0)
    # Stored once: fused into the loops of attention, words would be packed again for every pair of tokens.
    return token_mask, jax.lax.optimization_barrier(words)
