"""Bidirectional decoding by hand, and what each method does with the old plan."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen as nn

from kinetix_dist import prng
from kinetix_dist.delay.chunk_policy import ChunkPolicy
from kinetix_dist.delay.guidance import soft_weights
from kinetix_dist.delay.methods import (
    Bidirectional,
    Method,
    Params,
    Plain,
    Plan,
    Rtc,
    Seen,
    TrainingTimeRtc,
    backward_loss,
    forward_loss,
)
from kinetix_dist.env.action_spaces import ACTION_SPACES

HORIZON, WORLDS = 6, 3


class ToPoint(nn.Module):
    """A flow whose every action ends at `params`, or where the first one is, if that is told to be without noise."""

    horizon: int = HORIZON

    def encode(self, obs: Any) -> Any:
        return obs

    def velocity(self, embedding: Any, chunk: Any, time: Any) -> Any:
        point = self.variables["params"]["point"]
        goal = jnp.where((time[:, :1] == 1.0)[..., None], chunk[:, :1], point)
        return (goal - chunk) / jnp.maximum(1.0 - time[..., None], 1e-3)


def policy_with(network: ToPoint, num_steps: int = 5) -> ChunkPolicy:
    # pyrefly: ignore[bad-argument-type]  # it has the methods of a FlowNetwork
    return ChunkPolicy(network, ACTION_SPACES["continuous"], num_steps)


POLICY = policy_with(ToPoint())
BOUND = jnp.array([True, True, False, False, True, False])


def params(point: float) -> dict:
    return {"params": {"point": jnp.float32(point)}}


def seen() -> Seen:
    bound = jnp.broadcast_to(BOUND, (WORLDS, 6))
    return Seen(jnp.zeros((WORLDS, 1)), bound, prng.split(prng.key(0), WORLDS))


def old_plan(value: float, *, delay: int, known: int) -> Plan:
    chunk = jnp.full((WORLDS, HORIZON, 6), value) * BOUND
    return Plan(chunk.at[:, known:].set(0.0), delay, known)


@pytest.mark.parametrize("method", [Plain(), Rtc(), TrainingTimeRtc(), Bidirectional(num_samples=2)])
def test_what_nothing_obeys_stays_in_the_middle(method: Method) -> None:
    chunk = method.plan(POLICY, Params(params(0.5)), seen(), old_plan(0.25, delay=2, known=4))
    assert chunk.shape == (WORLDS, HORIZON, 6)
    np.testing.assert_array_equal(chunk[..., ~np.asarray(BOUND)], 0.0)
    assert (chunk[..., BOUND] != 0.0).all()


def test_plain_chunks_forget_the_old_plan_and_training_time_rtc_goes_on_with_it() -> None:
    old = old_plan(-0.75, delay=2, known=4)
    plain = Plain().plan(POLICY, Params(params(0.5)), seen(), old)
    np.testing.assert_allclose(plain[..., BOUND], 0.5, atol=1e-5)
    given = TrainingTimeRtc().plan(POLICY, Params(params(0.5)), seen(), old)
    np.testing.assert_allclose(given[..., BOUND], -0.75, atol=1e-5)  # the flow follows what is given
    without_delay = TrainingTimeRtc().plan(POLICY, Params(params(0.5)), seen(), old._replace(delay=0))
    np.testing.assert_allclose(without_delay, plain, atol=1e-6)


class Still(ToPoint):
    """A flow that leaves noise as it is."""

    def velocity(self, embedding: Any, chunk: Any, time: Any) -> Any:
        return jnp.zeros_like(chunk)


def test_rtc_keeps_what_will_be_executed_and_less_of_what_follows() -> None:
    policy = policy_with(Still())
    old = old_plan(0.5, delay=2, known=4)
    chunk = Rtc().plan(policy, Params({}), seen(), old)
    noise = jnp.clip(Rtc(max_guidance=0.0).plan(policy, Params({}), seen(), old), -1.0, 1.0)
    np.testing.assert_allclose(chunk[:, :2], old.chunk[:, :2], atol=1e-5)
    np.testing.assert_allclose(chunk[:, 4:], noise[:, 4:], atol=1e-6)
    far, before = (np.abs(each - old.chunk)[:, 2:4][..., BOUND] for each in (chunk, noise))
    assert (far <= before).all() and far.mean() < 0.6 * before.mean()
    assert far[:, 0].mean() < far[:, 1].mean()


def test_backward_loss_by_hand() -> None:
    samples = jnp.zeros((2, 1, 3, 2)).at[0, 0, 0].set(jnp.array([3.0, 4.0])).at[1, 0, 1].set(jnp.array([0.0, 2.0]))
    assert backward_loss(samples, jnp.zeros((1, 3, 2)), jnp.array([1.0, 0.25, 0.0])).tolist() == [[5.0], [0.5]]


def test_forward_loss_by_hand() -> None:
    """One world, chunks of one action: sample 1.0, good ones 0.5 and 2.0, bad ones -1.0 and 3.0."""

    def one(*values):
        return jnp.array(values)[:, None, None, None]

    assert float(forward_loss(one(1.0), one(0.5, 2.0), one(-1.0, 3.0))[0, 0]) == pytest.approx((0.5 + 1) - (2 + 2))


class Shift(ToPoint):
    """A flow that moves noise by `params`."""

    def velocity(self, embedding: Any, chunk: Any, time: Any) -> Any:
        return jnp.full_like(chunk, self.variables["params"]["point"])


@pytest.mark.parametrize("shift_of_weak", [None, 0.9])
def test_bidirectional_decoding_takes_the_best_sample(shift_of_weak: float | None) -> None:
    """Against all samples one by one, in numpy; the weaker policy has the same noise."""
    policy = policy_with(Shift(), num_steps=1)
    method, weak = Bidirectional(num_samples=6, num_kept=2), shift_of_weak
    old = old_plan(0.5, delay=1, known=3)
    chosen = method.plan(policy, Params(params(0.1), None if weak is None else params(weak)), seen(), old)
    keys = [[prng.fold_in(key, i) for key in seen().keys] for i in range(6)]
    noise = np.array([[prng.normal(key, (HORIZON, 6)) for key in of_sample] for of_sample in keys]) * BOUND
    strong, other = (np.clip(noise + shift * np.asarray(BOUND), -1, 1) for shift in (0.1, weak or 0.0))
    weights = np.asarray(soft_weights(1, 3, HORIZON))

    def backward(samples: np.ndarray, world: int) -> np.ndarray:
        distance = np.linalg.norm(samples[:, world] - np.asarray(old.chunk[world]), axis=-1)
        return (weights * distance).sum(axis=-1)

    for world in range(WORLDS):
        losses = backward(strong, world)
        if weak is not None:
            good = strong[np.argsort(losses)[:2], world]
            bad = other[np.argsort(backward(other, world))[:2], world]
            for number, sample in enumerate(strong[:, world]):
                for others, sign in ((good, 1), (bad, -1)):
                    losses[number] += sign * np.linalg.norm(sample - others, axis=-1).sum() / 6
        np.testing.assert_allclose(chosen[world], strong[np.argmin(losses), world], atol=1e-6)
