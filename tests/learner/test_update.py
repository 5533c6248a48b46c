"""The learner update on one device: what it computes, what it refuses, and what a broken sample does to it."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from kinetix_dist.benchmarks.synthetic_batch import ACTIONS
from kinetix_dist.env.observations import OBSERVATIONS
from kinetix_dist.env.observations.entities import observe
from kinetix_dist.learner.config import PpoConfig
from kinetix_dist.learner.division import Division
from kinetix_dist.learner.gae import gae
from kinetix_dist.learner.ppo_loss import Samples, ppo_terms, total_loss
from kinetix_dist.learner.sharding import data_mesh
from kinetix_dist.learner.update import METRICS, _Program, _shuffled
from kinetix_dist.models.policy import make_policy
from tests.learner.update_program import POLICY, PPO, STEPS, WORLDS, make_problem, place, poisoned


def _flat(state) -> np.ndarray:
    return np.asarray(ravel_pytree(state.params)[0])


@pytest.fixture(scope="module")
def problem():
    mesh = data_mesh(jax.devices()[:1])
    update, state, arguments = make_problem(mesh)
    return update, state, arguments, mesh


def test_one_full_batch_step_is_adam_on_the_gradient_of_the_formula():
    mesh = data_mesh(jax.devices()[:1])
    config = dataclasses.replace(PPO, epochs=1, minibatches=1, max_grad_norm=0.05)
    update, state, arguments = make_problem(mesh, config)
    after, metrics = update(state, *place(arguments, mesh))

    static, trajectory, last_value = jax.tree.map(jnp.asarray, arguments)
    advantages = jax.jit(functools.partial(gae, discount=config.discount, trace=config.trace))(
        trajectory.rewards, trajectory.values, trajectory.done_after, last_value
    )
    normalised = (advantages - advantages.mean()) / advantages.std()
    samples = Samples(
        actions=trajectory.actions.reshape(STEPS * WORLDS, -1),
        old_log_probs=trajectory.log_probs.reshape(-1),
        old_values=trajectory.values.reshape(-1),
        advantages=normalised.reshape(-1),
        targets=(advantages + trajectory.values).reshape(-1),
    )
    obs = jax.jit(observe)(static.obs, trajectory.dynamic_obs)
    obs = jax.tree.map(lambda x: x.reshape(STEPS * WORLDS, *x.shape[2:]), obs)

    def loss(params):
        logits, values = make_policy(POLICY, ACTIONS.head_sizes).apply(params, obs)
        log_probs, entropies = ACTIONS.log_prob_and_entropy(logits, samples.actions)
        terms = ppo_terms(log_probs, entropies, values, samples, clip=config.clip, value_clip=config.clip)
        return total_loss(terms / (STEPS * WORLDS), value_coefficient=0.5, entropy_coefficient=0.01)

    gradient = ravel_pytree(jax.jit(jax.grad(loss))(state.params))[0]
    norm = jnp.linalg.norm(gradient)
    assert float(metrics["grad_norm"]) == pytest.approx(float(norm), rel=1e-4)
    assert float(norm) > config.max_grad_norm  # so that clipping matters
    gradient = gradient * config.max_grad_norm / norm
    # The first step of Adam: bias correction makes it learning_rate x g / (|g| + eps).
    expected = _flat(state) - config.learning_rate * gradient / (jnp.abs(gradient) + config.adam_eps)
    # Elements with |g| near eps magnify float32 differences of the gradient.
    np.testing.assert_allclose(_flat(after), expected, atol=2e-4)


def test_counters_and_metrics(problem):
    update, state, arguments, mesh = problem
    after, metrics = update(state, *place(arguments, mesh))
    assert set(metrics) == set(METRICS)
    assert all(bool(jnp.isfinite(value)) for value in metrics.values())
    assert (int(after.num_updates), int(after.num_gradient_steps)) == (1, 6)
    assert after.env_steps.tolist() == state.env_steps.tolist()  # the clock is the run's: it sets it before each update
    assert float(metrics["skipped_steps"]) == 0


def test_the_same_update_twice_is_bitwise_the_same_and_the_next_one_shuffles_anew(problem):
    update, state, arguments, mesh = problem
    first, again = (update(state, *place(arguments, mesh))[0] for _ in range(2))
    np.testing.assert_array_equal(_flat(first), _flat(again))
    later = dataclasses.replace(state, num_updates=state.num_updates + 1)
    assert not np.array_equal(_flat(update(later, *place(arguments, mesh))[0]), _flat(first))


def test_a_sample_that_is_not_a_number_skips_only_its_minibatches(problem):
    update, state, arguments, mesh = problem
    after, metrics = update(state, *place(poisoned(arguments), mesh))
    assert float(metrics["skipped_steps"]) == PPO.epochs  # it is in one minibatch of each epoch
    assert int(after.num_gradient_steps) == PPO.epochs * (PPO.minibatches - 1)
    assert np.all(np.isfinite(_flat(after)))
    assert np.isfinite(float(metrics["policy_loss"]))
    assert not np.array_equal(_flat(after), _flat(state))


def test_when_every_sample_is_broken_nothing_changes(problem):
    update, state, (static, trajectory, last_value), mesh = problem
    trajectory = dataclasses.replace(trajectory, log_probs=np.full_like(trajectory.log_probs, np.nan))
    after, metrics = update(state, *place((static, trajectory, last_value), mesh))
    np.testing.assert_array_equal(_flat(after), _flat(state))
    assert float(metrics["skipped_steps"]) == PPO.epochs * PPO.minibatches
    assert np.isnan(float(metrics["policy_loss"]))


def test_an_epoch_visits_every_sample_once():
    mesh = data_mesh(jax.devices()[:1])

    def shuffled(key):
        policy = make_policy(POLICY, ACTIONS.head_sizes)
        program = _Program(policy, OBSERVATIONS["entity"], ACTIONS, PPO, Division(PPO.virtual_shards, 1))
        return _shuffled(key, STEPS, WORLDS, program)

    on_device = jax.shard_map(shuffled, mesh=mesh, in_specs=jax.P(), out_specs=jax.P(), check_vma=False)
    index = np.asarray(jax.jit(on_device)(jax.random.key(0)))
    assert index.shape == (PPO.minibatches, STEPS * WORLDS // PPO.minibatches)
    assert sorted(index.ravel().tolist()) == list(range(STEPS * WORLDS))
    assert index.ravel().tolist() != list(range(STEPS * WORLDS))


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ({"num_steps": 6, "num_worlds": 12}, "12 worlds cannot be divided into 8"),
        ({"num_steps": 4, "num_worlds": 8}, "4 samples to each of 8 .* 3 minibatches"),
    ],
)
def test_batches_that_cannot_be_divided_are_refused(numbers, message):
    with pytest.raises(ValueError, match=message):
        PPO.check_batch(**numbers)


@pytest.mark.parametrize(
    ("field", "value"), [("epochs", 0), ("clip", 0.0), ("learning_rate", float("nan")), ("discount", 1.5)]
)
def test_a_bad_configuration_names_field_and_value(field, value):
    with pytest.raises(ValueError, match=f"PpoConfig.{field} is {value}"):
        PpoConfig(**{field: value})
