"""Clipped PPO, sample by sample, by hand."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kinetix_dist.learner.ppo_loss import LOSS_METRICS, Samples, ppo_terms, total_loss


def _terms(*, ratio=1.0, advantage=0.0, value=0.0, old_value=0.0, target=0.0, value_clip=0.2, entropy=0.0) -> dict:
    samples = Samples(
        actions=jnp.zeros((1, 1), jnp.int8),
        old_log_probs=jnp.asarray([-1.0]),
        old_values=jnp.asarray([old_value]),
        advantages=jnp.asarray([advantage]),
        targets=jnp.asarray([target]),
    )
    log_prob = jnp.asarray([-1.0 + np.log(ratio)], jnp.float32)
    terms = ppo_terms(log_prob, jnp.asarray([entropy]), jnp.asarray([value]), samples, clip=0.2, value_clip=value_clip)
    return dict(zip(LOSS_METRICS, terms.tolist()))


@pytest.mark.parametrize(
    ("ratio", "advantage", "loss"),
    [
        (1.1, 2.0, -2.2),  # inside the clip range
        (1.5, 2.0, -2.4),  # more of a good action counts up to 1.2
        (0.5, 2.0, -1.0),  # less of a good action counts in full
        (0.5, -2.0, 1.6),  # less of a bad action counts down to 0.8
        (1.5, -2.0, 3.0),  # more of a bad action counts in full
    ],
)
def test_policy_loss(ratio, advantage, loss):
    assert _terms(ratio=ratio, advantage=advantage)["policy_loss"] == pytest.approx(loss, rel=1e-5)


def test_value_loss_takes_the_worse_of_clipped_and_unclipped():
    # 1.0 is 0.5 above old: clipped to 0.7, whose error to 2.0 is larger.
    terms = _terms(value=1.0, old_value=0.5, target=2.0)
    assert terms["value_loss"] == pytest.approx(0.5 * 1.3**2, rel=1e-5)
    assert _terms(value=1.0, old_value=0.5, target=0.0)["value_loss"] == pytest.approx(0.5)
    assert _terms(value=1.0, old_value=0.5, target=2.0, value_clip=None)["value_loss"] == pytest.approx(0.5)


def test_kl_and_clip_fraction():
    assert _terms(ratio=1.0)["approx_kl"] == 0.0
    assert _terms(ratio=2.0)["approx_kl"] == pytest.approx(1 - np.log(2), rel=1e-5)
    assert [_terms(ratio=r)["clip_fraction"] for r in (1.1, 1.3, 0.7)] == [0.0, 1.0, 1.0]


def test_total_loss_rewards_entropy():
    terms = jnp.asarray([1.0, 2.0, 3.0, 9.0, 9.0])
    assert float(total_loss(terms, value_coefficient=0.5, entropy_coefficient=0.1)) == pytest.approx(1 + 1 - 0.3)


def test_no_gradient_reaches_the_policy_outside_of_the_clip_range():
    def loss(log_prob):
        samples = Samples(
            actions=jnp.zeros((2, 1)),
            old_log_probs=jnp.zeros(2),
            old_values=jnp.zeros(2),
            advantages=jnp.asarray([1.0, -1.0]),
            targets=jnp.zeros(2),
        )
        return ppo_terms(log_prob, jnp.zeros(2), jnp.zeros(2), samples, clip=0.2, value_clip=None)[0]

    assert jax.grad(loss)(jnp.asarray([0.5, -0.5])).tolist() == [0.0, 0.0]
