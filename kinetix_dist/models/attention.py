"""Masked attention for heads of a few features, over a few tokens, for very many worlds.

Heads here are 2 wide and a world has at most 32 tokens. Batched matrix products do that shape badly, so scores and
sums are written out as multiply-adds over tokens: everything between the projections fuses into one elementwise loop
over [heads, features, worlds, tokens], no [tokens, tokens] matrix is ever stored, and the backward pass recomputes
the weights from the saved log-sum-exp. Worlds and tokens are the fastest axes, so that loads are contiguous.

    score_ij = q_i . k_j / sqrt(D)     weight_ij = mask_ij exp(score_ij - lse_i)     out_i = sum_j weight_ij v_j
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jax2d.scene import Array
from kinetix_dist.models.stored import stored

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

    qkv: [3, M, G, D, B, n] queries, keys, values; M masks, G heads a mask, D features a head, B worlds, n tokens.
    mask_words: [M, B, n] uint32, bit j of word i: token i may look at token j. A token that may look at none gets 0.
    Returns [M, G, D, B, n] in the type of `qkv`.
    """
    return _attend(qkv, mask_words)[0]


def _attend(qkv: Array, mask_words: Array) -> tuple[Array, Array]:
    """Output, and the logarithm of the sum of a token's exponentials [M, G, 1, B, n], 0 for one that looks at none."""
    query, key, value = (qkv[i].astype(jnp.float32) for i in range(3))
    num_tokens = qkv.shape[-1]
    words = mask_words[:, None, None]
    scores = [_dot(query, key[..., j : j + 1]) for j in range(num_tokens)]
    scores = [jnp.where(_bit(words, j), score, _MASKED_SCORE) for j, score in enumerate(scores)]
    highest = scores[0]
    for score in scores[1:]:
        highest = jnp.maximum(highest, score)
    total = jnp.zeros_like(query)
    weighted = jnp.zeros_like(query)
    for j, score in enumerate(scores):
        weight = _masked_exp(_bit(words, j), score - highest)
        total = total + weight
        weighted = weighted + weight * value[..., j : j + 1]
    is_empty = words == 0
    total = jnp.where(is_empty, 1.0, total)
    log_sum_exp = jnp.where(is_empty, 0.0, highest + jnp.log(total))
    return (weighted / total).astype(qkv.dtype), log_sum_exp[:, :, :1]


def _attend_in_two(qkv: Array, mask_words: Array) -> tuple[Array, Array]:
    """The same, with a loop for each result: one for both is slower on a GPU than the two."""
    return _attend(qkv, mask_words)[0], _attend(*stored((qkv, mask_words)))[1]


def _attend_forward(qkv: Array, mask_words: Array) -> tuple[Array, tuple[Array, ...]]:
    out, log_sum_exp = jax.lax.platform_dependent(qkv, mask_words, cpu=_attend, default=_attend_in_two)
    return out, (qkv, mask_words, out, log_sum_exp)


def _attend_backward(residuals: tuple[Array, ...], grad_out: Array) -> tuple[Array, None]:
    qkv, mask_words, out, log_sum_exp = residuals
    query, key, value = (qkv[i].astype(jnp.float32) for i in range(3))
    grad = grad_out.astype(jnp.float32)
    scale = qkv.shape[3] ** -0.5
    num_tokens = qkv.shape[-1]
    words = mask_words[:, None, None]
    delta = _sum_over_features(grad * out.astype(jnp.float32))
    tokens = jnp.arange(num_tokens, dtype=jnp.uint32)
    grad_query = jnp.zeros_like(query)
    grad_key = jnp.zeros_like(query)
    grad_value = jnp.zeros_like(query)
    for t in range(num_tokens):
        at = slice(t, t + 1)
        # Rows i of the weights, at column t.
        weight = _masked_exp(_bit(words, t), _dot(query, key[..., at]) - log_sum_exp)
        grad_score = weight * (_sum_over_features(grad * value[..., at]) - delta) * scale
        grad_query = grad_query + grad_score * key[..., at]
        # Columns j of the weights, at row t.
        weight = _masked_exp(_bit(words[..., at], tokens), _dot(query[..., at], key) - log_sum_exp[..., at])
        grad_score = weight * (_sum_over_features(grad[..., at] * value) - delta[..., at]) * scale
        grad_key = grad_key + grad_score * query[..., at]
        grad_value = grad_value + weight * grad[..., at]
    return jnp.stack([grad_query, grad_key, grad_value]).astype(qkv.dtype), None


attend.defvjp(_attend_forward, _attend_backward)


def _bit(words: Array, index: int | Array) -> Array:
    return ((words >> jnp.asarray(index, jnp.uint32)) & 1) != 0


def _masked_exp(is_seen: Array, exponent: Array) -> Array:
    """exp where a token is seen, else 0. Selects the argument: a select of the result compiles to a branch on CPUs."""
    return jnp.exp(jnp.where(is_seen, exponent, _MASKED_SCORE))


def _dot(query: Array, key: Array) -> Array:
    return _sum_over_features(query * key) * query.shape[2] ** -0.5


def _sum_over_features(x: Array) -> Array:
    """Sum over D of [M, G, D, B, n], repeated along D so that consumers fuse without a reduction."""
    total = x[:, :, 0:1]
    for d in range(1, x.shape[2]):
        total = total + x[:, :, d : d + 1]
    return jnp.broadcast_to(total, x.shape)
