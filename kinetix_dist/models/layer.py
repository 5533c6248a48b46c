"""The parts of the transformer: encoders, and those of a layer between a stream of tokens and what is let into it.

`LayerParts` are functions of the same formulas and arguments: `XLA` of this file, and kernels for Hopper GPUs
(kernels/layer.py). Parameters are float32; activations are [B, n, F] in their type.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp

from jax2d.scene import Array
from kinetix_dist.models.attention import attend
from kinetix_dist.models.gate import gate
from kinetix_dist.models.linear import contract, linear
from kinetix_dist.models.norms import norm_branch
from kinetix_dist.models.rows import add_rows, take_rows

if TYPE_CHECKING:
    from kinetix_dist.env.observations.entities import EntityObs


@dataclasses.dataclass(frozen=True)
class LayerParts:
    """Parts of a layer. A `..._branch` gives the stream, too: gradients of stream and branch are added there."""

    # (features of groups, their kernels, their biases, number of others, type) -> tokens of all groups, then ones
    encode: Callable[..., Array]
    # (x, mask words, kernel, bias, kernel of the output, bias of it, heads) -> x, relu(attention(normalise(x)))
    attention_branch: Callable[..., tuple[Array, Array]]
    # (x, kernel, bias) -> x, relu(normalise(x) kernel + bias)
    feed_forward_branch: Callable[..., tuple[Array, Array]]
    # (x, y, parameters of the gate) -> x with y let in, see gate.py
    gate: Callable[..., Array]
    # (observation) -> ends of joints and thrusters, for the next
    ends: Callable[[EntityObs], Any]
    # (x, ends, terms of joints, of thrusters, kernel of joints, of thrusters) -> x with messages added
    add_messages: Callable[..., Array]
    joins_terms: bool  # whether terms of all layers are one product: their slices cost nothing then


def _encode(
    features: Sequence[Array], kernels: Sequence[Array], biases: Sequence[Array], num_others: int, dtype: Any
) -> Array:
    groups = zip(features, kernels, biases, strict=True)
    tokens = [jnp.tanh(each @ kernel + bias).astype(dtype) for each, kernel, bias in groups]
    return _with_ones(tokens, num_others)


def encode_with_ids(
    kind_ids: Sequence[float],
    features: Sequence[Array],
    kernels: Sequence[Array],
    biases: Sequence[Array],
    num_others: int,
    dtype: Any,
) -> Array:
    """Encoding by `LayerParts.encode`, with the number of a group as the last one of its tokens."""
    groups = zip(kind_ids, features, kernels, biases, strict=True)
    tokens = [
        jnp.concatenate(
            [jnp.tanh(each @ kernel + bias).astype(dtype), jnp.full((*each.shape[:-1], 1), kind_id, dtype)], axis=-1
        )
        for kind_id, each, kernel, bias in groups
    ]
    return _with_ones(tokens, num_others)


def _with_ones(tokens: list[Array], num_others: int) -> Array:
    """[B, n, F] of groups of tokens in their order, then `num_others` of ones. A sum, which a GPU writes in half of a
    concatenation's time."""
    if num_others:
        tokens = [*tokens, jnp.ones((tokens[0].shape[0], num_others, tokens[0].shape[2]), tokens[0].dtype)]
    counts = [part.shape[1] for part in tokens]
    befores = [sum(counts[:i]) for i in range(len(tokens))]
    padded = [
        jnp.pad(part, ((0, 0), (before, sum(counts) - before - part.shape[1]), (0, 0)))
        for part, before in zip(tokens, befores, strict=True)
    ]
    return sum(padded[1:], padded[0])


def attention_update(
    x: Array, mask_words: Array, kernel: Array, bias: Array, out_kernel: Array, out_bias: Array, heads: tuple[int, int]
) -> tuple[Array, Array]:
    """`x`, and attention over normalise(x), projected. kernel: [E, 3 F], bias: [3 F]; out_kernel: [F, E], out_bias:
    [E]; mask_words: [M, B, n], see attention.py. heads: (M masks, heads a mask); their features are F / heads."""
    size, features = kernel.shape[0], out_kernel.shape[0]
    shape = (*heads, features // (heads[0] * heads[1]))
    x, normal = norm_branch(x)
    # Features first, [3 features, B, n]: attention runs over worlds and tokens, the features of a head slowest.
    kernel = _feature_slowest(kernel.reshape(size, 3, *shape), 4).reshape(size, -1)
    bias = _feature_slowest(bias.reshape(3, *shape), 3).reshape(-1)
    qkv = contract("bni,if->fbn", normal, kernel) + bias[:, None, None].astype(x.dtype)
    out = attend(qkv.reshape(3, shape[-1], *heads, *qkv.shape[1:]), mask_words).reshape(features, *qkv.shape[1:])
    out_kernel = _feature_slowest(out_kernel.reshape(*shape, size), 2).reshape(features, size)
    return x, contract("fbn,fo->bno", out, out_kernel) + out_bias.astype(x.dtype)


def feed_forward_update(x: Array, kernel: Array, bias: Array) -> tuple[Array, Array]:
    """`x`, and relu(normalise(x) kernel + bias)."""
    x, normal = norm_branch(x)
    return x, jax.nn.relu(linear(normal, kernel) + bias.astype(x.dtype))


def _attention_branch(x: Array, *arguments: Any) -> tuple[Array, Array]:
    x, update = attention_update(x, *arguments)
    return x, jax.nn.relu(update)


def _feature_slowest(x: Array, axis: int) -> Array:
    """[..., M, G, D, ...] as [..., D, M, G, ...]; axis: that of D."""
    return jnp.moveaxis(x, axis, axis - 2)


@dataclasses.dataclass(frozen=True)
class _Ends:
    of_joints: Array  # [B, 2 J] tokens: from, to, from, to, ...
    obs: EntityObs


def joint_ends(obs: EntityObs) -> Array:
    """[B, 2 J] tokens: from, to, from, to, ..."""
    return jnp.stack([obs.joint_from, obs.joint_to], axis=-1).reshape(obs.joint_from.shape[0], -1)


def _ends(obs: EntityObs) -> _Ends:
    return _Ends(joint_ends(obs), obs)


def _add_messages(
    x: Array,
    ends: _Ends,
    joint_terms: Array,
    thruster_terms: Array,
    joint_kernel: Array,
    thruster_kernel: Array,
) -> Array:
    """Messages along joints and from thrusters, both from the tokens before either is added."""
    obs = ends.obs
    from_joints = _messages(x, ends.of_joints, joint_kernel, joint_terms, obs.joint_mask)
    from_thrusters = _messages(x, obs.thruster_owner, thruster_kernel, thruster_terms, obs.thruster_mask)
    x = add_rows(x, obs.joint_from, from_joints)
    return add_rows(x, obs.thruster_owner, from_thrusters)


def _messages(x: Array, ends: Array, kernel: Array, terms: Array, mask: Array) -> Array:
    """[B, K, E]: what each of K joints or thrusters tells, zero for those that do not exist. ends: [B, K x ends]."""
    rows = take_rows(x, ends).reshape(*mask.shape, -1)
    return (linear(rows, kernel) + terms) * mask[..., None].astype(x.dtype)


XLA = LayerParts(
    encode=_encode,
    attention_branch=_attention_branch,
    feed_forward_branch=feed_forward_update,
    gate=gate,
    ends=_ends,
    add_messages=_add_messages,
    joins_terms=True,
)
