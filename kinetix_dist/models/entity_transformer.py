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
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
from flax import linen as nn

from jax2d.scene import Array
from kinetix_dist.env.observations.entities import JOINT_COLOUR, THRUSTER_COLOUR
from kinetix_dist.models.attention import attend, pack_mask
from kinetix_dist.models.colour_readout import sum_by_colour
from kinetix_dist.models.contraction import contract, linear
from kinetix_dist.models.gate import gate
from kinetix_dist.models.gru import apply_towers
from kinetix_dist.models.kernels.support import uses_mosaic
from kinetix_dist.models.rows import add_rows, take_rows
from kinetix_dist.models.stored import stored
from kinetix_dist.models.towers import TANH_GAIN, Towers

if TYPE_CHECKING:
    from kinetix_dist.env.observations.entities import EntityObs

NUM_MASKS = 4
NORM_EPSILON = 1e-6
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
    kernels: str = "xla"  # of the gates, see kernels/support.py

    @nn.compact
    def __call__(self, obs: EntityObs, memory: Array | None = None, *, is_first: Array | None = None) -> Any:
        # Encode: shapes become tokens, the dummy token is the last.
        polygon_id, circle_id = self.shape_ids or (None, None)
        polygons = self._encode("polygon_encoder", obs.polygons, polygon_id)
        circles = self._encode("circle_encoder", obs.circles, circle_id)
        # A colour that only its head reads: then no colour is another one.
        joint_rows = obs.joints.at[..., JOINT_COLOUR].set(0.0) if self.by_colour else obs.joints
        thruster_rows = obs.thrusters.at[..., THRUSTER_COLOUR].set(0.0) if self.by_colour else obs.thrusters
        joints = self._encode("joint_encoder", joint_rows)
        thrusters = self._encode("thruster_encoder", thruster_rows)
        dummy = jnp.ones((polygons.shape[0], 1, self.encoder_size), self.dtype)
        x = _join_tokens(polygons, circles, dummy)
        token_mask, mask_words = _token_masks(obs.shape_mask, obs.attention_masks)
        # The share of a message that does not depend on the layer's tokens, for all layers at once.
        joint_kernel, joint_terms = self._message_terms("joint_messages", joints, num_ends=2)
        thruster_kernel, thruster_terms = self._message_terms("thruster_messages", thrusters, num_ends=1)
        ends = jnp.stack([obs.joint_from, obs.joint_to], axis=-1).reshape(x.shape[0], -1)
        for layer in range(self.num_layers):
            x = self._attention(layer, x, mask_words)
            x = self._feed_forward(layer, x)
            # Messages along joints and from thrusters, both from the tokens before either is added.
            from_joints = _messages(x, ends, joint_kernel[layer], joint_terms[layer], obs.joint_mask)
            from_thrusters = _messages(
                x, obs.thruster_owner, thruster_kernel[layer], thruster_terms[layer], obs.thruster_mask
            )
            x = add_rows(x, obs.joint_from, from_joints)
            x = add_rows(x, obs.thruster_owner, from_thrusters)
        embedding = masked_mean(x if self.gated else normalise(x), token_mask)
        if not self.gated:  # scale and offset of the norm: a mean of tokens takes them as each token would
            scale, offset = self._norm("pooling")
            embedding = scale * embedding + offset
        towers: Callable[..., Any] = Towers(self.hidden_size, self.hidden_layers, self.head_sizes, name="towers")
        if self.by_colour:
            normal = normalise(x)
            motors = obs.joints[..., JOINT_COLOUR] * obs.joint_mask[..., None]
            thrusts = obs.thrusters[..., THRUSTER_COLOUR] * obs.thruster_mask[..., None]
            of_joints = self._told("joint", normal, ends, joints, motors)
            of_thrusters = self._told("thruster", normal, obs.thruster_owner, thrusters, thrusts)
            towers = functools.partial(towers, by_colour=(of_joints, of_thrusters))
        return apply_towers(towers, embedding.astype(self.dtype), memory, is_first, self.memory_size)

    def _encode(self, name: str, features: Array, kind_id: float | None = None) -> Array:
        width = self.encoder_size if kind_id is None else self.encoder_size - 1
        dense = nn.Dense(width, kernel_init=nn.initializers.orthogonal(TANH_GAIN), name=name)
        tokens = jnp.tanh(dense(features)).astype(self.dtype)
        if kind_id is None:
            return tokens
        return jnp.concatenate([tokens, jnp.full_like(tokens[..., :1], kind_id)], axis=-1)

    def _attention(self, layer: int, x: Array, mask_words: Array) -> Array:
        size, features = self.encoder_size, self.attention_features
        kernel = self.param(f"attention_{layer}_qkv_kernel", lecun_normal(), (size, 3 * features))
        bias = self.param(f"attention_{layer}_qkv_bias", zeros, (3 * features,))
        kernel, bias = self._fold_norm(f"attention_{layer}", kernel, bias)
        x, normal = beside_norm(x)
        # Features first: [3 features, B, n], so that attention runs over worlds and tokens.
        qkv = contract("bni,if->fbn", normal, kernel) + bias[:, None, None].astype(self.dtype)
        heads_a_mask = self.num_heads // NUM_MASKS
        out = attend(
            qkv.reshape(3, NUM_MASKS, heads_a_mask, features // self.num_heads, *qkv.shape[1:]), mask_words
        ).reshape(features, *qkv.shape[1:])
        out_kernel = self.param(f"attention_{layer}_out_kernel", lecun_normal(), (features, size))
        out_bias = self.param(f"attention_{layer}_out_bias", zeros, (size,))
        update = contract("fbn,fo->bno", out, out_kernel) + out_bias.astype(self.dtype)
        return self._gate(f"attention_{layer}", x, jax.nn.relu(update)) if self.gated else x + update

    def _feed_forward(self, layer: int, x: Array) -> Array:
        size = self.encoder_size
        kernel = self.param(f"feed_forward_{layer}_kernel", lecun_normal(), (size, size))
        bias = self.param(f"feed_forward_{layer}_bias", zeros, (size,))
        kernel, bias = self._fold_norm(f"feed_forward_{layer}", kernel, bias)
        x, normal = beside_norm(x)
        update = linear(normal, kernel) + bias.astype(self.dtype)
        if self.gated:
            return self._gate(f"feed_forward_{layer}", x, jax.nn.relu(update))
        out_kernel = self.param(f"feed_forward_{layer}_out_kernel", lecun_normal(), (size, size))
        out_bias = self.param(f"feed_forward_{layer}_out_bias", zeros, (size,))
        return x + linear(jax.nn.relu(update), out_kernel) + out_bias.astype(self.dtype)

    def _norm(self, name: str) -> tuple[Array, Array]:
        """Scale and offset."""
        return (
            self.param(f"{name}_norm_scale", ones, (self.encoder_size,)),
            self.param(f"{name}_norm_offset", zeros, (self.encoder_size,)),
        )

    def _fold_norm(self, name: str, kernel: Array, bias: Array) -> tuple[Array, Array]:
        """Kernel and bias that act on `normalise(x)` as the given ones do on scale * normalise(x) + offset."""
        scale, offset = self._norm(name)
        return scale[:, None] * kernel, bias + jnp.sum(offset[:, None] * kernel, axis=0)

    def _gate(self, name: str, x: Array, update: Array) -> Array:
        size = self.encoder_size
        return self._gate_function()(
            x,
            update,
            self.param(f"{name}_gate_update_kernel", lecun_normal(), (size, 3 * size)),
            self.param(f"{name}_gate_stream_kernel", lecun_normal(), (size, 2 * size)),
            self.param(f"{name}_gate_reset_kernel", lecun_normal(), (size, size)),
            self.param(f"{name}_gate_bias", zeros, (size,)),
        )

    def _gate_function(self) -> Callable[..., Array]:
        if not uses_mosaic(self.kernels, self.encoder_size, jnp.dtype(self.dtype).name):
            return gate
        from kinetix_dist.models.kernels.gate import gate as mosaic_gate  # of a jax that has these kernels

        return mosaic_gate

    def _message_terms(self, name: str, entities: Array, *, num_ends: int) -> tuple[Array, Array]:
        """Kernels for the tokens at the ends [layers, ends E, E], and the entities' terms, [B, K, E] a layer."""
        size, layers = self.encoder_size, self.num_layers
        kernels = [
            self.param(f"{name}_{layer}_kernel", lecun_normal(), ((num_ends + 1) * size, size))
            for layer in range(layers)
        ]
        biases = [self.param(f"{name}_{layer}_bias", zeros, (size,)) for layer in range(layers)]
        of_entity = jnp.concatenate([kernel[num_ends * size :] for kernel in kernels], axis=1)
        terms = linear(entities, of_entity) + jnp.concatenate(biases).astype(self.dtype)
        of_ends = jnp.stack([kernel[: num_ends * size] for kernel in kernels])
        return of_ends, jnp.split(terms, layers, axis=-1)

    def _told(self, kind: str, x: Array, ends: Array, entities: Array, colours: Array) -> Array:
        """[B, colours, hidden_size]: what joints or thrusters tell the heads of their colours (colour_readout.py)."""
        rows = jnp.concatenate([take_rows(x, ends).reshape(*entities.shape[:2], -1), entities], axis=-1)
        kernel = self.param(f"{kind}_told_kernel", lecun_normal(), (rows.shape[-1], self.hidden_size))
        bias = self.param(f"{kind}_told_bias", zeros, (self.hidden_size,))
        return sum_by_colour(jnp.tanh(linear(rows, kernel) + bias.astype(self.dtype)), colours)


def _messages(x: Array, ends: Array, kernel: Array, terms: Array, mask: Array) -> Array:
    """[B, K, E]: what each of K joints or thrusters tells, zero for those that do not exist. ends: [B, K x ends]."""
    rows = take_rows(x, ends).reshape(*mask.shape, -1)
    return (linear(rows, kernel) + terms) * mask[..., None].astype(x.dtype)


def _token_masks(shape_mask: Array, attention_masks: Array) -> tuple[Array, Array]:
    """Which tokens exist [B, n + 1], and whom each may look at, [4, B, n + 1] uint32 words; the dummy is the last."""
    token_mask = jnp.pad(shape_mask, ((0, 0), (0, 1)), constant_values=True)
    dummy_bit = jnp.uint32(1) << jnp.uint32(shape_mask.shape[1])
    words = pack_mask(attention_masks) | jnp.where(shape_mask, dummy_bit, 0).astype(jnp.uint32)[:, None]
    words = jnp.where(shape_mask[:, None], words, 0)
    of_dummy = jnp.broadcast_to(pack_mask(token_mask)[:, None, None], (*words.shape[:2], 1))
    words = jnp.moveaxis(jnp.concatenate([words, of_dummy], axis=-1), 1, 0)
    # Stored once: fused into the loops of attention, words would be packed again for every pair of tokens.
    return token_mask, jax.lax.optimization_barrier(words)


def _join_tokens(*parts: Array) -> Array:
    """[B, n, F] of parts [B, k, F], in their order. A sum, which a GPU writes in half of a concatenation's time."""
    counts = [part.shape[1] for part in parts]
    befores = [sum(counts[:i]) for i in range(len(parts))]
    padded = [
        jnp.pad(part, ((0, 0), (before, sum(counts) - before - part.shape[1]), (0, 0)))
        for part, before in zip(parts, befores, strict=True)
    ]
    return sum(padded[1:], padded[0])


@jax.custom_vjp
def masked_mean(x: Array, mask: Array) -> Array:
    """Mean in float32 over the tokens that exist, [B, F] of [B, n, F]; at least one does (the dummy token)."""
    return _masked_mean_forward(x, mask)[0]


def _masked_mean_forward(x: Array, mask: Array) -> tuple[Array, tuple[Array, Array]]:
    # Else XLA takes the division by a sum and what follows for a softmax.
    x, weight = stored((x, mask.astype(jnp.float32) / jnp.sum(mask, axis=1, keepdims=True)))
    total = jnp.zeros((x.shape[0], x.shape[2]), jnp.float32)
    for token in range(x.shape[1]):
        total = total + weight[:, token, None] * x[:, token].astype(jnp.float32)
    return total, (weight, jnp.zeros(0, x.dtype))


def _masked_mean_backward(residuals: tuple[Array, Array], grad: Array) -> tuple[Array, None]:
    weight, like = residuals
    return (weight[:, :, None] * grad[:, None]).astype(like.dtype), None


masked_mean.defvjp(_masked_mean_forward, _masked_mean_backward)


@jax.custom_vjp
def normalise(x: Array) -> Array:
    """Layer norm without scale and offset: zero mean and unit variance over the last axis, computed in float32."""
    return _normalise_forward(x)[0]


@jax.custom_vjp
def beside_norm(x: Array) -> tuple[Array, Array]:
    """`x` and `normalise(x)`, for a stream that goes on beside its norm: one loop adds up the gradients of both."""
    return x, normalise(x)


def _normalise_forward(x: Array) -> tuple[Array, tuple[Array, Array]]:
    wide = _stored_rows(x)
    centred = wide - jnp.mean(wide, axis=-1, keepdims=True)
    inverse_std = jax.lax.rsqrt(jnp.mean(centred * centred, axis=-1, keepdims=True) + NORM_EPSILON)
    normal = (centred * inverse_std).astype(x.dtype).reshape(x.shape)
    return normal, (normal, inverse_std)


def _normalise_backward(residuals: tuple[Array, Array], grad: Array) -> tuple[Array]:
    return (_as(grad, _grad_of_rows(residuals, grad)),)


def _beside_norm_forward(x: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    normal, residuals = _normalise_forward(x)
    return (x, normal), residuals


def _beside_norm_backward(residuals: tuple[Array, Array], grads: tuple[Array, Array]) -> tuple[Array]:
    of_stream, of_norm = grads
    return (_as(of_stream, _stored_rows(of_stream) + _grad_of_rows(residuals, of_norm)),)


def _grad_of_rows(residuals: tuple[Array, Array], grad: Array) -> Array:
    """[rows, F] float32: of what was normalised."""
    normal, inverse_std = _stored_rows(residuals[0]), residuals[1]
    wide = _stored_rows(grad)
    along = jnp.mean(wide * normal, axis=-1, keepdims=True)
    return (wide - jnp.mean(wide, axis=-1, keepdims=True) - normal * along) * inverse_std


def _stored_rows(x: Array) -> Array:
    """[..., F] as [rows, F] in float32, read from memory."""
    return stored(x.reshape(-1, x.shape[-1])).astype(jnp.float32)


def _as(like: Array, rows: Array) -> Array:
    """[rows, F] in type and shape of `like`, stored."""
    return stored(rows.astype(like.dtype)).reshape(like.shape)


normalise.defvjp(_normalise_forward, _normalise_backward)
beside_norm.defvjp(_beside_norm_forward, _beside_norm_backward)
