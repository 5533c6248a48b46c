"""Masked attention for heads of a few features, over a few tokens, for very many worlds.

Heads here are 2 wide and a world has at most 32 tokens. Batched matrix products do that shape badly, so scores and
sums are written out as multiply-adds over tokens: everything between the projections fuses into one elementwise loop
over [heads, worlds, tokens], no [tokens, tokens] matrix is ever stored, and the backward pass recomputes the weights
from the saved log-sum-exp. Worlds and tokens are the fastest axes, so that loads are contiguous; features are the
slowest, so that a result is one concatenation along them: a thread of a GPU writes all features of a token and head,
and computes their weights once.

    score_ij = q_i . k_j / sqrt(D)     weight_ij = mask_ij exp(score_ij - lse_i)     out_i = sum_j weight_ij v_j
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Sequence

import jax
import jax.numpy as jnp

from jax2d.scene import Array
from kinetix_dist.models.linear import stored

MAX_TOKENS = 32  # one mask row is one 32-bit word
_MASKED_SCORE = -1e30


def pack_mask(mask: Array) -> Array:
    """[..., n] bool to [...] uint32: bit j of the word is mask[..., j]."""
    num_tokens = mask.shape[-1]
    if num_tokens > MAX_TOKENS:
        raise ValueError(f"attention over {num_tokens} tokens; a mask word holds {MAX_TOKENS}: use a smaller size")
    word = jnp.zeros(mask.shape[:-1], jnp.uint32)
    for j in range(num_tokens):
        word = word | (mask[..., j].astype(jnp.uint32) << j)
    return word


@jax.custom_vjp
def attend(qkv: Array, mask_words: Array) -> Array:
    """Multi-head attention in float32, each group of heads with its own mask.

    qkv: [3, D, M, G, B, n] queries, keys, values; D features a head, M masks, G heads a mask, B worlds, n tokens.
    mask_words: [M, B, n] uint32, bit j of word i: token i may look at token j. A token that may look at none gets 0.
    Returns [D, M, G, B, n] in the type of `qkv`.
    """
    return _attend(qkv, mask_words)


def _attend(qkv: Array, mask_words: Array) -> Array:
    _, _, value = _features(qkv)
    words = mask_words[:, None]
    scores, highest = _scores(qkv, words)
    total = jnp.zeros_like(highest)
    weighted = [total] * len(value)
    for j, score in enumerate(scores):
        weight = _masked_exp(_bit(words, j), score - highest)
        total = total + weight
        weighted = [sums + weight * feature[..., j : j + 1] for sums, feature in zip(weighted, value, strict=True)]
    total = jnp.where(words == 0, 1.0, total)
    return jnp.stack([sums / total for sums in weighted]).astype(qkv.dtype)


def _log_sum_exp(qkv: Array, mask_words: Array) -> Array:
    """Log-sum-exp of a token's scores, [M, G, B, n] float32; 0 for a token that looks at none."""
    words = mask_words[:, None]
    scores, highest = _scores(qkv, words)
    total = sum(_masked_exp(_bit(words, j), score - highest) for j, score in enumerate(scores))
    is_empty = words == 0
    return jnp.where(is_empty, 0.0, highest + jnp.log(jnp.where(is_empty, 1.0, total)))


def _attend_forward(qkv: Array, mask_words: Array) -> tuple[Array, tuple[Array, ...]]:
    # A loop for each result: one for both is slower on a GPU than the two.
    out = _attend(qkv, mask_words)
    return out, (qkv, mask_words, out, _log_sum_exp(*stored((qkv, mask_words))))


def _attend_backward(residuals: tuple[Array, ...], grad_out: Array) -> tuple[Array, None]:
    qkv, mask_words, out, log_sum_exp = residuals
    query, key, value = _features(qkv)
    grad = _wide(grad_out)
    scale = len(query) ** -0.5
    num_tokens = qkv.shape[-1]
    words = mask_words[:, None]
    delta = _dot(grad, _wide(out))
    tokens = jnp.arange(num_tokens, dtype=jnp.uint32)
    nothing = jnp.zeros_like(log_sum_exp)
    grad_query, grad_key, grad_value = ([nothing] * len(query) for _ in range(3))
    for t in range(num_tokens):
        at = slice(t, t + 1)
        query_t, key_t, value_t, grad_t = ([x[..., at] for x in xs] for xs in (query, key, value, grad))
        # Rows i of the weights, at column t.
        weight = _masked_exp(_bit(words, t), scale * _dot(query, key_t) - log_sum_exp)
        grad_score = weight * (_dot(grad, value_t) - delta) * scale
        grad_query = [sums + grad_score * feature for sums, feature in zip(grad_query, key_t, strict=True)]
        # Columns j of the weights, at row t.
        weight = _masked_exp(_bit(words[..., at], tokens), scale * _dot(query_t, key) - log_sum_exp[..., at])
        grad_score = weight * (_dot(grad_t, value) - delta[..., at]) * scale
        grad_key = [sums + grad_score * feature for sums, feature in zip(grad_key, query_t, strict=True)]
        grad_value = [sums + weight * feature for sums, feature in zip(grad_value, grad_t, strict=True)]
    return jnp.stack([*grad_query, *grad_key, *grad_value]).reshape(qkv.shape).astype(qkv.dtype), None


attend.defvjp(_attend_forward, _attend_backward)


def _wide(x: Array) -> list[Array]:
    """Features of [D, ...] in float32."""
    return [feature.astype(jnp.float32) for feature in x]


def _features(qkv: Array) -> tuple[list[Array], ...]:
    """Features of queries, of keys and of values: lists of D arrays [M, G, B, n] float32."""
    return tuple(map(_wide, qkv))


def _scores(qkv: Array, words: Array) -> tuple[list[Array], Array]:
    """[M, G, B, n] of all tokens with each one, and the highest of a token."""
    query, key, _ = _features(qkv)
    scale = len(query) ** -0.5
    dots = (scale * _dot(query, [feature[..., j : j + 1] for feature in key]) for j in range(qkv.shape[-1]))
    scores = [jnp.where(_bit(words, j), score, _MASKED_SCORE) for j, score in enumerate(dots)]
    return scores, functools.reduce(jnp.maximum, scores)


def _bit(words: Array, index: int | Array) -> Array:
    return ((words >> jnp.asarray(index, jnp.uint32)) & 1) != 0


def _masked_exp(is_seen: Array, exponent: Array) -> Array:
    """exp where a token is seen, else 0. Selects the argument: a select of the result compiles to a branch on CPUs."""
    return jnp.exp(jnp.where(is_seen, exponent, _MASKED_SCORE))


def _dot(a: Sequence[Array], b: Sequence[Array]) -> Array:
    """Sum over features."""
    return functools.reduce(operator.add, map(operator.mul, a, b))
