"""Multi-discrete heads: hand-worked probabilities, and samples that follow them."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from kinetix_dist.env.action_spaces.categorical import Categorical

HEADS = Categorical(head_sizes=(3, 2))
LOG2 = float(np.log(2.0))


def test_log_prob_and_entropy_of_two_uniform_heads():
    logits = (jnp.zeros((1, 3)), jnp.zeros((1, 2)))
    actions = jnp.asarray([[2, 1]])
    log_prob, entropy = HEADS.log_prob_and_entropy(logits, actions)
    np.testing.assert_allclose(log_prob, [-np.log(6.0)], rtol=1e-6)
    np.testing.assert_allclose(entropy, [np.log(6.0)], rtol=1e-6)


def test_log_prob_of_a_skewed_head():
    logits = (jnp.log(jnp.asarray([[0.5, 0.25, 0.25]])), jnp.asarray([[30.0, 30.0]]))
    log_prob, entropy = HEADS.log_prob_and_entropy(logits, jnp.asarray([[1, 0]]))
    np.testing.assert_allclose(log_prob, [-3 * LOG2], rtol=1e-6)
    np.testing.assert_allclose(entropy, [1.5 * LOG2 + LOG2], rtol=1e-6)


def test_gradients_stay_finite_with_extreme_logits():
    logits = (jnp.asarray([[1e4, -1e4, 0.0]]), jnp.asarray([[-1e4, 1e4]]))
    grads = jax.grad(lambda x: jnp.sum(sum(HEADS.log_prob_and_entropy(x, jnp.asarray([[1, 0]])))))(logits)
    assert all(bool(jnp.all(jnp.isfinite(g))) for g in grads)


def test_a_uniform_number_picks_the_choice_whose_share_it_falls_in():
    logits = (jnp.log(jnp.asarray([[0.5, 0.25, 0.25]])), jnp.zeros((1, 2)))
    for uniform, choice in [(0.0, 0), (0.49, 0), (0.51, 1), (0.74, 1), (0.76, 2), (0.9999999, 2)]:
        actions, log_prob = HEADS.sample(logits, jnp.asarray([[uniform, uniform]]))
        assert actions.tolist() == [[choice, int(uniform >= 0.5)]]
        np.testing.assert_allclose(log_prob, HEADS.log_prob_and_entropy(logits, actions)[0], rtol=1e-6)


def test_samples_follow_the_probabilities_and_never_leave_the_head():
    probabilities = np.array([0.6, 0.3, 0.1])
    count = 20_000
    logits = (jnp.broadcast_to(jnp.log(probabilities), (count, 3)), jnp.full((count, 2), 7.0))
    actions, _ = HEADS.sample(logits, jax.random.uniform(jax.random.key(0), (count, 2)))
    found = np.bincount(np.asarray(actions[:, 0]), minlength=3) / count
    np.testing.assert_allclose(found, probabilities, atol=0.015)  # four standard errors of 20,000 draws
    assert set(np.unique(actions[:, 1])) == {0, 1}


def test_mode_is_the_most_likely_choice():
    logits = (jnp.asarray([[0.0, 2.0, 1.0]]), jnp.asarray([[3.0, 1.0]]))
    assert HEADS.mode(logits).tolist() == [[1, 0]]
