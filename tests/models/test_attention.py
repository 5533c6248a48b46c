"""Attention, gate, norm and messages against the plain formulas, values and gradients."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kinetix_dist.models.attention import attend, pack_mask
from kinetix_dist.models.gate import gate
from kinetix_dist.models.linear import contract
from kinetix_dist.models.norms import NORM_EPSILON, normalise
from kinetix_dist.models.rows import add_rows, take_rows

ATOL = 1e-5  # float32, sums of at most a few hundred terms of order one


def _random(seed: int, *shape: int) -> jax.Array:
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), jnp.float32)


def _assert_same_with_gradients(function, reference, *inputs) -> None:
    expected = reference(*inputs)
    np.testing.assert_allclose(function(*inputs), expected, atol=ATOL)
    probe = _random(99, *expected.shape)
    which = tuple(range(len(inputs)))
    found = jax.grad(lambda *xs: jnp.sum(probe * function(*xs)), which)(*inputs)
    wanted = jax.grad(lambda *xs: jnp.sum(probe * reference(*xs)), which)(*inputs)
    for ours, theirs in zip(found, wanted):
        np.testing.assert_allclose(ours, theirs, atol=ATOL * max(1.0, float(jnp.max(jnp.abs(theirs)))))


def test_attention_is_the_masked_softmax_formula():
    num_worlds, num_tokens = 3, 5
    mask = np.random.default_rng(0).random((4, num_worlds, num_tokens, num_tokens)) < 0.5
    mask |= np.eye(num_tokens, dtype=bool)
    words = pack_mask(jnp.asarray(mask))

    def reference(qkv):
        query, key, value = qkv
        scores = jnp.einsum("dmgbi,dmgbj->mgbij", query, key) / jnp.sqrt(3.0)
        weights = jax.nn.softmax(jnp.where(mask[:, None], scores, -jnp.inf), axis=-1)
        return jnp.einsum("mgbij,dmgbj->dmgbi", weights, value)

    _assert_same_with_gradients(
        lambda qkv: attend(qkv, words), reference, _random(1, 3, 3, 4, 2, num_worlds, num_tokens)
    )


def test_a_token_that_may_look_at_nobody_gets_zero_and_gives_no_gradient():
    words = jnp.zeros((4, 1, 3), jnp.uint32).at[:, :, 0].set(0b011)
    qkv = _random(2, 3, 2, 4, 1, 1, 3)
    out = attend(qkv, words)
    assert jnp.all(out[..., 1:] == 0)
    grad = jax.grad(lambda x: jnp.sum(attend(x, words) ** 2))(qkv)
    assert jnp.all(jnp.isfinite(grad))
    assert jnp.all(grad[..., 2] == 0)  # no token sees token 2, and it sees none


def test_attention_does_not_overflow_with_huge_scores():
    qkv = 1e4 * _random(3, 3, 2, 4, 1, 2, 4)
    words = jnp.full((4, 2, 4), 0b1111, jnp.uint32)
    assert jnp.all(jnp.isfinite(jax.grad(lambda x: jnp.sum(attend(x, words)))(qkv)))


def test_more_tokens_than_mask_bits_are_refused():
    with pytest.raises(ValueError, match="33 tokens"):
        pack_mask(jnp.ones((1, 33), bool))


def test_gate_is_the_gtrxl_formula():
    def reference(x, y, kernel_y, kernel_x, kernel_h, bias):
        w_r, w_z, w_h = jnp.split(kernel_y, 3, axis=1)
        u_r, u_z = jnp.split(kernel_x, 2, axis=1)
        r = jax.nn.sigmoid(y @ w_r + x @ u_r)
        z = jax.nn.sigmoid(y @ w_z + x @ u_z - bias)
        h = jnp.tanh(y @ w_h + (r * x) @ kernel_h)
        return (1 - z) * x + z * h

    inputs = (
        _random(0, 3, 4, 8),
        _random(1, 3, 4, 8),
        _random(2, 8, 24),
        _random(3, 8, 16),
        _random(4, 8, 8),
        _random(5, 8),
    )
    _assert_same_with_gradients(gate, reference, *inputs)


def test_a_high_gate_bias_keeps_the_stream():
    x, y = _random(0, 1, 2, 4), _random(1, 1, 2, 4)
    kernels = _random(2, 4, 12), _random(3, 4, 8), _random(4, 4, 4)
    np.testing.assert_allclose(gate(x, y, *kernels, jnp.full(4, 50.0)), x, atol=1e-6)


def test_norm_has_zero_mean_and_unit_variance_and_the_gradient_of_the_formula():
    def reference(x):
        mean = jnp.mean(x, axis=-1, keepdims=True)
        return (x - mean) / jnp.sqrt(jnp.var(x, axis=-1, keepdims=True) + NORM_EPSILON)

    _assert_same_with_gradients(normalise, reference, 3.0 + _random(0, 2, 3, 16))


def test_rows_are_taken_and_added_by_index_and_a_row_can_get_several():
    x = jnp.arange(6.0).reshape(1, 3, 2)
    index = jnp.asarray([[2, 0, 2]])
    np.testing.assert_array_equal(take_rows(x, index), [[[4, 5], [0, 1], [4, 5]]])
    messages = jnp.asarray([[[10.0, 10.0], [1.0, 1.0], [20.0, 20.0]]])
    np.testing.assert_array_equal(add_rows(x, index, messages), [[[1, 2], [2, 3], [34, 35]]])
    _assert_same_with_gradients(lambda x: take_rows(x, index), lambda x: x[:, index[0]], _random(1, 1, 3, 2))
    _assert_same_with_gradients(
        lambda x, m: add_rows(x, index, m), lambda x, m: x.at[:, index[0]].add(m), _random(1, 1, 3, 2), messages
    )


def test_kernel_gradients_of_bfloat16_activations_are_not_rounded_to_bfloat16():
    x = jnp.ones((257, 1), jnp.bfloat16)
    grad = jax.grad(lambda kernel: jnp.sum(contract("bi,io->bo", x, kernel).astype(jnp.float32)))(jnp.ones((1, 1)))
    assert grad.dtype == jnp.float32
    assert float(grad[0, 0]) == 257.0  # bfloat16 has 8 bits: 257 would become 256
