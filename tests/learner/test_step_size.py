"""Annealing, the guard on KL, the average of parameters, bootstrapping at time limits and unbound heads, in updates."""

from __future__ import annotations

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from kinetix_dist.benchmarks.synthetic_batch import ACTIONS
from kinetix_dist.learner.config import AnnealConfig
from kinetix_dist.learner.sharding import data_mesh, replicate
from kinetix_dist.learner.state import at_env_steps, clock, init_learner_state
from kinetix_dist.learner.step_size import GUARD_FACTOR, guarded, sizes
from kinetix_dist.learner.update import advantages_of
from tests.learner.update_program import PPO, STEPS, WORLDS, make_problem, place

BATCH = STEPS * WORLDS
ANNEAL = AnnealConfig(start=BATCH, end=3 * BATCH, learning_rate=0.1, clip=0.5, entropy_coefficient=0.0)
ALL = dataclasses.replace(PPO, average_updates=2, max_kl=1e-9, anneal=ANNEAL)


def _flat(params):
    return np.asarray(ravel_pytree(params)[0])


def _after(steps, **state):
    """A state of a run that has played so many environment steps."""
    zero = init_learner_state({"x": jnp.zeros(1)}, PPO.optimizer(), jax.random.key(0))
    return dataclasses.replace(at_env_steps(zero, jnp.asarray(clock(steps))), **state)


@pytest.fixture(scope="module")
def updated():
    """The states after 0, 1, ... updates on one batch, and the metrics of each."""
    mesh = data_mesh(jax.devices()[:1])
    update, state, (static, trajectory, last_value) = make_problem(mesh, ALL)
    bound = np.zeros((WORLDS, len(ACTIONS.head_sizes)), bool)
    bound[:, 0] = True
    log_probs = trajectory.log_probs / len(ACTIONS.head_sizes)
    arguments = (
        dataclasses.replace(static, bound_heads=bound),
        dataclasses.replace(trajectory, log_probs=log_probs),
        last_value,
    )
    states, rows = [state], []
    for number in range(4):
        now = at_env_steps(states[-1], replicate(clock(number * BATCH), mesh))
        state, metrics = update(now, *place(arguments, mesh, ALL))
        states.append(state)
        rows.append(metrics)
    return states, rows


@pytest.mark.parametrize(("steps", "share"), [(0, 0.0), (BATCH, 0.0), (2 * BATCH, 0.5), (3 * BATCH, 1.0), (2**31, 1.0)])
def test_settings_are_annealed_from_start_to_end(steps, share):
    now = sizes(dataclasses.replace(ALL, max_kl=0.0), _after(steps))
    np.testing.assert_allclose(now.rate, 1.0 - 0.9 * share, rtol=1e-6)
    np.testing.assert_allclose(now.clip, PPO.clip * (1.0 - 0.5 * share), rtol=1e-6)
    np.testing.assert_allclose(now.entropy_coefficient, PPO.entropy_coefficient * (1.0 - share), atol=1e-9)


def test_where_nothing_changes_settings_are_constants():
    assert sizes(PPO, _after(10**9)) == (1.0, PPO.clip, PPO.entropy_coefficient)


def test_steps_beyond_32_bits_are_annealed():
    config = dataclasses.replace(PPO, anneal=AnnealConfig(start=0, end=20_000_000_000, learning_rate=0.5))
    np.testing.assert_allclose(sizes(config, _after(2**33)).rate, 1 - 0.5 * 2**33 / 2e10, rtol=1e-6)


def test_all_agents_of_a_run_go_by_its_clock_however_much_each_has_learned_from():
    """The antagonist of PAIRED learns from half of what is played, its teacher from constructions."""
    state = {"teacher": _after(7), "antagonist": _after(99), "seen": {"regret": jnp.zeros(())}}
    now = at_env_steps(state, jnp.asarray(clock(2**32 + 5)))
    assert [now[agent].env_steps.tolist() for agent in ("teacher", "antagonist")] == [[5, 1], [5, 1]]
    assert now["seen"] is not state["seen"] and float(now["seen"]["regret"]) == 0


@pytest.mark.parametrize("steps", [-1, 2**64])
def test_a_clock_holds_two_words(steps):
    with pytest.raises(ValueError, match=f"{steps} environment steps"):
        clock(steps)


def test_the_guard_lowers_the_rate_and_never_raises_it():
    config = dataclasses.replace(PPO, max_kl=0.02)
    state = _after(0)
    found = []
    for kl in (0.01, 0.03, 0.001, jnp.nan, 0.021):
        state = dataclasses.replace(state, rate_factor=guarded(config, state, jnp.float32(kl)))
        found.append(float(state.rate_factor))
    g = GUARD_FACTOR
    np.testing.assert_allclose(found, [1.0, g, g, g, g * g], rtol=1e-6)


def test_updates_use_the_rate_of_schedule_and_guard(updated):
    states, rows = updated
    kl = [float(row["approx_kl"]) for row in rows]
    assert all(value > ALL.max_kl for value in kl)  # so that the guard acts in each
    schedule = np.array([1.0, 1.0, 0.55, 0.1])
    expected = ALL.learning_rate * schedule * GUARD_FACTOR ** np.arange(4)
    np.testing.assert_allclose([float(row["learning_rate"]) for row in rows], expected, rtol=1e-5)
    moved = [np.abs(_flat(b.params) - _flat(a.params)).max() for a, b in itertools.pairwise(states)]
    assert moved[3] < 0.2 * moved[1]


def test_the_average_is_a_plain_mean_first_and_then_an_exponential_one(updated):
    states, _ = updated
    params = [_flat(state.params) for state in states]
    expected = params[1]
    np.testing.assert_allclose(_flat(states[1].average), expected, rtol=1e-5, atol=1e-7)
    for number in (2, 3, 4):
        expected = expected + (params[number] - expected) / 2
        np.testing.assert_allclose(_flat(states[number].average), expected, rtol=1e-5, atol=1e-7)
    assert states[4].released is states[4].average


def test_heads_that_are_not_bound_do_not_learn(updated):
    """The last layer of the actor has columns of its own for each head; Adam moves what has a gradient."""
    states, _ = updated
    before, after = (states[i].params["params"]["towers"]["actor_output"] for i in (0, 1))
    for name in ("kernel", "bias"):
        moved = (
            np.abs(np.asarray(after[name]) - np.asarray(before[name])).reshape(-1, sum(ACTIONS.head_sizes)).max(axis=0)
        )
        assert (moved[: ACTIONS.head_sizes[0]] > 0).all()
        np.testing.assert_array_equal(moved[ACTIONS.head_sizes[0] :], 0.0)


def test_at_the_time_limit_the_value_of_the_state_before_stands_for_what_follows():
    _, _, (_, trajectory, last_value) = make_problem(data_mesh(jax.devices()[:1]))
    timed_out = trajectory.done_after & (np.arange(STEPS)[:, None] % 2 == 0)
    timed_out[3], trajectory.done_after[3] = True, True
    found = advantages_of(dataclasses.replace(trajectory, timed_out=timed_out), last_value, PPO)
    without = advantages_of(trajectory, last_value, PPO)
    # An advantage ends with its episode: where one timed out, the last step has discount * value more.
    np.testing.assert_allclose((found - without)[timed_out], PPO.discount * trajectory.values[timed_out], atol=1e-5)
    no_timeout = trajectory.done_after & ~timed_out
    np.testing.assert_array_equal(np.asarray(found)[no_timeout], np.asarray(without)[no_timeout])


@pytest.mark.parametrize("bad", [{"start": -1}, {"start": 5, "end": 5}, {"learning_rate": 0.0}, {"clip": -1.0}])
def test_annealing_that_makes_no_sense_is_refused(bad):
    with pytest.raises(ValueError, match=f"AnnealConfig.{'end' if 'end' in bad else next(iter(bad))}"):
        AnnealConfig(**{"end": 10, **bad})
