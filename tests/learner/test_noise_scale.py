"""The noise scale of the gradient: of a problem in which it is known, and against gradients of single samples."""

import dataclasses
import json
import subprocess
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from kinetix_dist.benchmarks.synthetic_batch import ACTIONS
from kinetix_dist.env.observations import OBSERVATIONS
from kinetix_dist.learner.noise_scale import METRICS, noise_metrics, part_square
from kinetix_dist.learner.sharding import data_mesh
from kinetix_dist.learner.update import METRICS as UPDATE_METRICS
from kinetix_dist.models.policy import make_policy
from tests.helpers import REPOSITORY, environment_of_cpus
from tests.learner.update_program import (
    POLICY,
    PPO,
    RECURRENT_POLICY,
    RECURRENT_PPO,
    STEPS,
    WORLDS,
    make_problem,
    place,
)

pytestmark = pytest.mark.long


def test_of_a_problem_in_which_it_is_known_on_one_device_and_on_three():
    """Four virtual shards on three devices: their parts have other sizes. 256 minibatches of 128 samples."""
    command = [sys.executable, str(REPOSITORY / "tests/learner/noise_scale_program.py")]
    done = subprocess.run(command, env=environment_of_cpus(3), capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert set(found) == {"1", "3"}
    for metrics in found.values():
        # Gradients 0.5 (b - r), r of N(1, 3^2). Standard errors: 9 % with two parts, 3 % and 10 %.
        assert metrics["gradient_variance"] == pytest.approx(2.25, rel=0.2)
        assert metrics["gradient_square"] == pytest.approx(0.25, rel=0.15)
        assert metrics["gradient_noise_scale"] == pytest.approx(9.0, rel=0.3)
        assert metrics["gradient_noise_scale"] == pytest.approx(
            metrics["gradient_variance"] / metrics["gradient_square"], rel=1e-5
        )


def test_the_formulas_have_no_bias_whatever_the_sizes_of_the_parts():
    """20,000 minibatches of 10 samples in three parts, of 5, 3 and 2, of gradients of three numbers."""
    rng = np.random.default_rng(0)
    true, deviation = np.array([1.0, -0.5, 0.2]), np.array([1.0, 2.0, 0.5])
    samples = true + deviation * rng.normal(size=(20_000, 10, 3))
    shares = [samples[:, a:b].sum(1) / 10 for a, b in ((0, 5), (5, 8), (8, 10))]
    squares = jax.vmap(part_square, (0, None, None))
    small = sum(squares(jnp.asarray(share), size, 10).mean() for share, size in zip(shares, (5, 3, 2), strict=True))
    whole = np.square(sum(shares)).sum(1).mean()
    found = noise_metrics(small, jnp.asarray(whole), 3, 10)
    # Four standard errors: 0.04 of the variance, 0.02 of the square.
    assert float(found["gradient_variance"]) == pytest.approx(1.0 + 4.0 + 0.25, abs=0.15)
    assert float(found["gradient_square"]) == pytest.approx(1.0 + 0.25 + 0.04, abs=0.08)


@pytest.mark.parametrize("recurrent", [False, True])
def test_halves_are_of_other_worlds(recurrent):
    """The first step of an update, of one minibatch, against the gradients of the first and the last shards' worlds."""
    config, policy_config = (RECURRENT_PPO, RECURRENT_POLICY) if recurrent else (PPO, POLICY)
    changed = {"epochs": 1, "minibatches": 1, "normalise_advantages": False, "noise_scale": True}
    config, mesh = dataclasses.replace(config, **changed), data_mesh(jax.devices()[:1])
    update, state, arguments = make_problem(mesh, config, policy_config)
    _, metrics = update(state, *place(arguments, mesh, config))
    assert set(metrics) == {*UPDATE_METRICS, *METRICS}
    halves = []
    for worlds in (slice(0, WORLDS // 2), slice(WORLDS // 2, WORLDS)):
        static, trajectory, last_value = arguments
        part = jax.tree.map(lambda x, w=worlds: x[w], static), jax.tree.map(lambda x, w=worlds: x[:, w], trajectory)
        halves.append(_gradient(config, policy_config, state.params, *part, last_value[worlds]))
    first, second = halves
    num_samples = STEPS * WORLDS
    assert float(metrics["gradient_square"]) == pytest.approx(float(first @ second), rel=1e-3)
    variance = num_samples * float(jnp.sum((first - second) ** 2)) / 4
    assert float(metrics["gradient_variance"]) == pytest.approx(variance, rel=1e-3)


def _gradient(config, policy_config, params, static, trajectory, last_value):
    """Gradient of the mean PPO loss over these worlds, at the policy's own parameters, step by step in numpy terms."""
    policy, observation = make_policy(policy_config, ACTIONS.head_sizes), OBSERVATIONS["entity"]
    num_steps, num_worlds = trajectory.rewards.shape
    advantages, following, value_after = np.zeros_like(trajectory.rewards), 0.0, last_value
    for step in reversed(range(num_steps)):
        goes_on = config.discount * (1.0 - trajectory.done_after[step])
        delta = trajectory.rewards[step] + goes_on * value_after - trajectory.values[step]
        advantages[step] = following = delta + config.trace * goes_on * following
        value_after = trajectory.values[step]

    def loss(params):
        rows = jax.tree.map(lambda x: x.reshape(num_steps * num_worlds, *x.shape[2:]), trajectory.dynamic_obs)
        fixed = jax.tree.map(lambda x: jnp.tile(x, (num_steps, *[1] * (x.ndim - 1))), static.obs)
        memory: dict[str, Any] = {}
        if policy_config.recurrent != "none":
            is_first = np.roll(trajectory.done_after, 1, axis=0)
            is_first[0] = True
            memory = {"is_first": jnp.asarray(is_first)}
        outputs, values = policy.apply(params, observation.join(fixed, rows), **memory)
        actions = jnp.asarray(trajectory.actions.reshape(num_steps * num_worlds, -1))
        log_probs, entropies = ACTIONS.log_prob_and_entropy(outputs, actions)
        ratio = jnp.exp(log_probs - trajectory.log_probs.reshape(-1))
        gain = advantages.reshape(-1)
        surrogate = jnp.minimum(ratio * gain, jnp.clip(ratio, 1 - config.clip, 1 + config.clip) * gain)
        old = trajectory.values.reshape(-1)
        target = gain + old
        near = old + jnp.clip(values - old, -config.clip, config.clip)
        error = jnp.maximum((values - target) ** 2, (near - target) ** 2)
        return jnp.mean(-surrogate + config.value_coefficient * 0.5 * error - config.entropy_coefficient * entropies)

    return ravel_pytree(jax.grad(loss)(params))[0]


def test_it_leaves_the_update_what_it_was_up_to_rounding():
    mesh = data_mesh(jax.devices()[:1])
    results = []
    for noise_scale in (False, True):
        config = dataclasses.replace(PPO, noise_scale=noise_scale)
        update, state, arguments = make_problem(mesh, config)
        after, metrics = update(state, *place(arguments, mesh, config))
        results.append((ravel_pytree(after.params)[0], metrics))
    (plain, without), (measured, with_it) = results
    assert set(without) == set(UPDATE_METRICS)
    np.testing.assert_allclose(measured, plain, atol=2e-4)  # Adam magnifies differences of gradients near zero
    assert float(with_it["grad_norm"]) == pytest.approx(float(without["grad_norm"]), rel=1e-3)


def test_a_minibatch_of_one_part_is_refused():
    config = dataclasses.replace(PPO, noise_scale=True, minibatches=8, virtual_shards=1)
    with pytest.raises(ValueError, match=r"ppo.noise_scale compares parts of a minibatch, but 6 steps of 8 worlds"):
        config.check_batch(num_steps=6, num_worlds=8, whole_worlds=True)
