"""Worlds that begin an update after random actions: which, for how long, and what they may not depend on."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jax2d.scene import stack_worlds
from kinetix_dist.actors.random_starts import MAX_HOLD, after_random_actions
from kinetix_dist.config import ConfigError, RolloutConfig
from kinetix_dist.env.environment import EnvConfig, Environment
from kinetix_dist.level.schema import load_level
from kinetix_dist.recipes import recipe
from tests.helpers import REPOSITORY

NUM_WORLDS, MAX_STEPS, EPISODE = 64, 12, 100


@dataclasses.dataclass(frozen=True)
class Problem:
    env: Environment
    prepared: object
    started: object  # (share, numbers) -> (env state, obs)


@pytest.fixture(scope="module")
def problem():
    files = sorted((REPOSITORY / "levels" / "s").glob("*.json"))[:2]
    levels = stack_worlds([load_level(path)[0] for path in files] * (NUM_WORLDS // 2))
    env = Environment(EnvConfig(size="s", max_steps=EPISODE))
    prepared = env.prepare(levels)

    @jax.jit
    def started(share, numbers):
        start = env.reset(prepared)
        return after_random_actions(env, prepared, *start, jax.random.key(3), numbers, share=share, max_steps=MAX_STEPS)

    return Problem(env, prepared, started)


def _positions(problem, env_state) -> np.ndarray:
    return np.asarray(problem.env.engine.bodies(env_state.packed_state)[0])


def test_the_other_worlds_stand_at_their_start(problem):
    first, first_obs = problem.env.reset(problem.prepared)
    state, obs = problem.started(0.5, jnp.arange(NUM_WORLDS))
    acted = np.asarray(state.num_steps) > 0
    assert 16 < acted.sum() < 48
    for now, before in zip(jax.tree.leaves((obs, state.distance)), jax.tree.leaves((first_obs, first.distance))):
        np.testing.assert_array_equal(np.asarray(now)[~acted], np.asarray(before)[~acted])
    moved = np.abs(_positions(problem, state) - _positions(problem, first)).max((1, 2))
    assert (moved[~acted] == 0).all() and (moved[acted] > 0).all()
    everywhere, _ = problem.started(1.0, jnp.arange(NUM_WORLDS))
    lengths = np.asarray(everywhere.num_steps)
    assert lengths.min() == 1 and lengths.max() == MAX_STEPS and len(set(lengths.tolist())) > 6
    nowhere, _ = problem.started(0.0, jnp.arange(NUM_WORLDS))
    assert not np.asarray(nowhere.num_steps).any()


def test_a_world_is_where_its_actions_step_by_step_lead(problem):
    """Held random actions, drawn here once more by the same streams, and the environment stepped as a policy would."""
    state, obs = problem.started(1.0, jnp.arange(NUM_WORLDS))
    env, prepared = problem.env, problem.prepared
    step = jax.jit(env.step)
    now, seen = env.reset(prepared)
    lengths = np.asarray(state.num_steps)
    for number in range(MAX_STEPS):
        actions = []
        for world in range(NUM_WORLDS):
            draw_key, action_key = jax.random.split(jax.random.fold_in(jax.random.key(3), world))
            held_for = 1 + int(np.floor(float(jax.random.uniform(draw_key, (3,))[2]) * MAX_HOLD))
            actions.append(env.action_space.sample(jax.random.fold_in(action_key, number // held_for), 1)[0])
        now, seen, _, done, _ = step(prepared, now, jnp.stack(actions))
        here = lengths == number + 1
        assert not np.asarray(done)[lengths > number].any(), "an episode ended: choose other levels for this test"
        np.testing.assert_allclose(_positions(problem, now)[here], _positions(problem, state)[here], atol=1e-5)
        for ours, wanted in zip(jax.tree.leaves(obs), jax.tree.leaves(seen)):
            np.testing.assert_allclose(np.asarray(ours)[here], np.asarray(wanted)[here], atol=1e-4)


def test_what_happens_to_a_world_depends_on_its_number_alone(problem):
    state, _ = problem.started(0.5, jnp.arange(NUM_WORLDS))
    order = np.random.default_rng(0).permutation(NUM_WORLDS // 2) * 2  # of one level
    numbers = np.arange(NUM_WORLDS)
    numbers[::2] = order
    other, _ = problem.started(0.5, jnp.asarray(numbers))
    np.testing.assert_array_equal(np.asarray(other.num_steps), np.asarray(state.num_steps)[numbers])
    np.testing.assert_allclose(_positions(problem, other), _positions(problem, state)[numbers], atol=1e-6)


def test_refusals_and_the_hash():
    config = recipe("tiny")
    starts = dataclasses.replace(config.rollout, random_start_share=0.25, random_start_steps=8)
    with_starts = dataclasses.replace(config, rollout=starts)
    assert with_starts.hash != config.hash
    for share in (-0.1, 1.5, float("nan")):
        with pytest.raises(
            ConfigError, match=f"random_start_share is {share}; it must be (from 0 to 1|a finite number)"
        ):
            RolloutConfig(random_start_share=share)
    with pytest.raises(ConfigError, match="random_start_steps is 0; it must be 1 or more"):
        RolloutConfig(random_start_steps=0)
    with pytest.raises(ConfigError, match="random_start_steps is 16 and an episode has 16 steps"):
        long = dataclasses.replace(with_starts.rollout, random_start_steps=16)
        dataclasses.replace(with_starts, rollout=long)
    whole = dataclasses.replace(with_starts.rollout, num_steps=16)
    with pytest.raises(ConfigError, match="'plr' scores levels by the episodes of training"):
        plr = dataclasses.replace(config.curriculum, name="plr")
        dataclasses.replace(with_starts, rollout=whole, curriculum=plr)
