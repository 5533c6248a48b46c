"""Worlds under delay against loops that say step by step which action is due."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kinetix_dist import prng
from kinetix_dist.delay.chunk_policy import FlowConfig, init_params, make_chunk_policy
from kinetix_dist.delay.execution import Attempts, Schedule, play_chunks, play_single, rest_of
from kinetix_dist.delay.methods import Bidirectional, Method, Params, Plain, Plan, Rtc, Seen, TrainingTimeRtc
from kinetix_dist.env.env_config import EnvConfig
from kinetix_dist.env.environment import Environment
from kinetix_dist.evaluation.evaluate import Episodes, play_attempts
from kinetix_dist.evaluation.policies import RandomPolicy
from kinetix_dist.level.sets import load_level_set
from kinetix_dist.models.flow_network import Remembered
from kinetix_dist.models.policy import PolicyConfig
from tests.helpers import num_compiled

HORIZON = 8
ENCODER = PolicyConfig(encoder_size=8, attention_features=8, num_layers=1, hidden_size=8, hidden_layers=1)
FLOW = FlowConfig(horizon=HORIZON, integration_steps=2, width=8, token_width=4, num_layers=1, encoder=ENCODER)


@pytest.fixture(scope="module")
def env() -> Environment:
    return Environment(EnvConfig(size="s", max_steps=13, action_space="continuous"))


@pytest.fixture(scope="module")
def attempts() -> Attempts:
    levels, names = load_level_set("designed_s")
    index = jnp.arange(2 * len(names))
    return Attempts(jax.tree.map(jnp.asarray, levels), prng.key(3), index, index // 2)


@pytest.fixture(scope="module")
def params(env: Environment, attempts: Attempts) -> Params:
    obs = env.observe(prepared := env.prepare(attempts.levels), prepared.initial_obs)
    return Params(init_params(make_chunk_policy(FLOW, env), obs, prng.key(0)))


@dataclasses.dataclass(frozen=True)
class Sees:
    """Chunks, or single actions, that follow from what is seen alone."""

    horizon: int

    def plan(self, policy: Any, params: Any, seen: Seen, old: Plan | None) -> jax.Array:
        del policy, params, old
        phase = seen.obs.polygons[..., :2].sum(axis=(1, 2)) * 40.0
        return jnp.sin(phase[:, None, None] + jnp.arange(self.horizon)[:, None] + jnp.arange(6.0))

    def __call__(self, params: Any, obs: Any, keys: jax.Array) -> jax.Array:
        chunk = self.plan(None, None, Seen(obs, keys, keys), None)[:, 0]
        return 0.5 * (chunk + jnp.array([0.0] * 4 + [1.0] * 2)) * jnp.array([2.0] * 4 + [1.0] * 2)


class Loop:
    """One environment step after another, in Python; remembers all it saw."""

    def __init__(self, env: Environment, attempts: Attempts) -> None:
        levels = jax.tree.map(lambda x: x[attempts.level_index], attempts.levels)
        self.env, self.prepared = env, env.prepare(levels)
        self.state, obs = env.reset(self.prepared)
        self.seen = [env.observe(self.prepared, obs)]
        self.returns, self.lengths = np.zeros(len(attempts.index)), np.zeros(len(attempts.index), int)

    def step(self, actions: jax.Array) -> None:
        self.state, obs, _, done, info = self.env.step(self.prepared, self.state, actions)
        self.seen.append(self.env.observe(self.prepared, obs))
        first = np.asarray(done) & (self.lengths == 0)
        self.returns[first], self.lengths[first] = info.episode_return[first], info.episode_length[first]

    def assert_equals(self, episodes: Episodes) -> None:
        assert (self.lengths > 0).all()
        np.testing.assert_array_equal(episodes.episode_length, self.lengths)
        # Rounding of thirteen steps; a step of another observation is far off (`assert_differs`).
        np.testing.assert_allclose(episodes.episode_return, self.returns, atol=1e-5)

    def assert_differs(self, episodes: Episodes) -> None:
        assert np.abs(np.asarray(episodes.episode_return) - self.returns).max() > 1e-3


@pytest.mark.parametrize("delay", [0, 1, 4])
def test_a_single_action_is_of_what_was_seen_a_delay_before(env: Environment, attempts: Attempts, delay: int) -> None:
    found = play_single(env, Sees(1), None, attempts, 4, Schedule(delay=delay))
    loop = Loop(env, attempts)
    for t in range(env.config.max_steps):
        loop.step(Sees(1)(None, loop.seen[max(t - delay, 0)], attempts.index))
    loop.assert_equals(found)
    loop.assert_differs(play_single(env, Sees(1), None, attempts, 4, Schedule(delay=(delay + 1) % 5)))


@pytest.mark.parametrize(("delay", "execute"), [(0, 3), (2, 3), (3, 3), (2, 6)])
def test_a_new_chunk_takes_over_after_the_delay(
    env: Environment, attempts: Attempts, params: Params, delay: int, execute: int
) -> None:
    policy = make_chunk_policy(FLOW, env)
    schedule = Schedule(delay=delay, execute=execute, horizon=HORIZON)
    found = play_chunks(env, policy, _Given(HORIZON), params, attempts, schedule)
    loop = Loop(env, attempts)

    def chunk_seen_at(t: int) -> jax.Array:
        return Sees(HORIZON).plan(None, None, Seen(loop.seen[t], None, None), None)

    for t in range(env.config.max_steps + execute):
        segment, i = divmod(t, execute)
        # The chunk that began with this segment, or, until it is there, the one before, further on.
        begun, ahead = (segment, i) if i >= delay else (segment - 1, i + execute)
        if begun < 0:  # the first chunk is there when the episode begins
            begun, ahead = 0, i
            chunk = _first(policy, env, params, attempts, loop)
        else:
            chunk = chunk_seen_at(begun * execute)
        loop.step(policy.actions(chunk[:, ahead]))
    loop.assert_equals(found)
    other = dataclasses.replace(schedule, delay=(delay + 1) % (execute + 1))
    loop.assert_differs(play_chunks(env, policy, _Given(HORIZON), params, attempts, other))


@dataclasses.dataclass(frozen=True)
class _Given(Sees):
    """`Sees` as a method."""


@dataclasses.dataclass(frozen=True)
class _Remembers(Sees):
    """Chunks that follow from the present and the two steps before it."""

    def plan(self, policy: Any, params: Any, seen: Seen, old: Plan | None) -> jax.Array:
        del policy, params, old
        now, past, actions = seen.obs
        phase = now.polygons[..., :2].sum(axis=(-2, -1)) * 40.0
        phase += jnp.tensordot(jnp.array([20.0, 10.0]), past.polygons[..., :2].sum(axis=(-2, -1)).T, 1)
        phase += jnp.tensordot(jnp.array([3.0, 2.0]), actions.sum(axis=-1).T, 1)
        return jnp.sin(phase[:, None, None] + jnp.arange(self.horizon)[:, None] + jnp.arange(6.0))


def test_a_policy_with_history_sees_the_steps_before(env: Environment, attempts: Attempts) -> None:
    policy = make_chunk_policy(dataclasses.replace(FLOW, history=2), env)
    loop = Loop(env, attempts)
    nothing = jnp.zeros((len(attempts.index), 6))

    def seen_at(t: int) -> Remembered:
        past = jax.tree.map(lambda *xs: jnp.stack(xs, 1), *(loop.seen[max(t - back, 0)] for back in (1, 2)))
        actions = jnp.stack([chosen[t - back] if t >= back else nothing for back in (1, 2)], 1)
        return Remembered(loop.seen[t], past, actions)

    chosen: list[jax.Array] = []
    params = Params(init_params(policy, seen_at(0), prng.key(0)))
    schedule = Schedule(delay=1, execute=2, horizon=HORIZON)
    found = play_chunks(env, policy, _Remembers(HORIZON), params, attempts, schedule)
    keys = jax.vmap(prng.fold_in, (0, None))(jax.vmap(prng.fold_in, (None, 0))(attempts.key, attempts.index), 0)
    first = Seen(seen_at(0), loop.prepared.bound_heads, keys)
    old = jax.jit(lambda: Plain().plan(policy, params, first, None))()
    for t in range(0, env.config.max_steps + 2, 2):
        new = _Remembers(HORIZON).plan(None, None, Seen(seen_at(t), None, None), None)
        for action in (old[:, 0], new[:, 1]):
            loop.step(policy.actions(action))
            chosen.append(action)
        old = new[:, 2:]
    loop.assert_equals(found)
    without = make_chunk_policy(FLOW, env)
    obs = env.observe(prepared := env.prepare(attempts.levels), prepared.initial_obs)
    plain = Params(init_params(without, obs, prng.key(0)))
    loop.assert_differs(play_chunks(env, without, _Given(HORIZON), plain, attempts, schedule))


def _first(policy: Any, env: Environment, params: Params, attempts: Attempts, loop: Loop) -> jax.Array:
    keys = jax.vmap(prng.fold_in, (None, 0))(attempts.key, attempts.index)
    keys = jax.vmap(prng.fold_in, (0, None))(keys, 0)
    seen = Seen(loop.seen[0], loop.prepared.bound_heads, keys)
    return jax.jit(lambda: Plain().plan(policy, params, seen, None))()


@pytest.mark.parametrize("method", [Plain(), Rtc(), TrainingTimeRtc(), Bidirectional(num_samples=4, num_kept=2)])
def test_every_method_plays_every_delay(env: Environment, attempts: Attempts, params: Params, method: Method) -> None:
    """With one program; a delay changes what is played, and the same numbers give the same bits."""
    policy = make_chunk_policy(FLOW, env)
    before = num_compiled(play_chunks)
    played = [
        play_chunks(
            env, policy, method, params, attempts, Schedule(delay=d, execute=4, horizon=HORIZON, action_noise=n)
        )
        for d, n in [(0, 0.0), (3, 0.0), (3, 0.0), (3, 0.2)]
    ]
    assert num_compiled(play_chunks) - before <= 1
    assert all(np.asarray(each.finished).all() for each in played)
    returns = [np.asarray(each.episode_return) for each in played]
    assert (returns[1] != returns[0]).any() and (returns[3] != returns[1]).any()
    np.testing.assert_array_equal(returns[1], returns[2])


def test_without_delay_single_actions_are_those_of_evaluation(env: Environment, attempts: Attempts) -> None:
    policy = RandomPolicy(env.action_space)
    expected = play_attempts(env, policy, None, *attempts)
    found = play_single(env, policy, None, attempts, 0, Schedule(delay=0))
    jax.tree.map(np.testing.assert_array_equal, found, expected)


def test_a_world_plays_the_same_beside_any_others(env: Environment, attempts: Attempts, params: Params) -> None:
    policy, schedule = make_chunk_policy(FLOW, env), Schedule(delay=2, execute=3, horizon=HORIZON, action_noise=0.1)
    whole = play_chunks(env, policy, Rtc(), params, attempts, schedule)
    some = attempts._replace(index=attempts.index[3:6], level_index=attempts.level_index[3:6])
    part = play_chunks(env, policy, Rtc(), params, some, schedule)
    np.testing.assert_array_equal(part.episode_length, whole.episode_length[3:6])
    np.testing.assert_allclose(part.episode_return, whole.episode_return[3:6], atol=1e-4)  # batches round otherwise


def test_what_is_left_of_a_chunk() -> None:
    chunk = jnp.arange(1.0, 7.0)[None, :, None]
    left = rest_of(chunk, Schedule(delay=1, execute=2, horizon=5))
    assert left[0, :, 0].tolist() == [3, 4, 5, 0, 0, 0]


@pytest.mark.parametrize(
    ("schedule", "words"),
    [
        (Schedule(delay=5, execute=4, horizon=8), "a delay of 5 steps is beyond the horizon: chunks of 8 actions"),
        (Schedule(delay=3, execute=2, horizon=8), "execute 3 or more"),
        (Schedule(delay=-1, execute=2, horizon=8), "not possible"),
        (Schedule(delay=0, execute=0, horizon=8), "not possible"),
    ],
)
def test_what_cannot_be_executed_is_one_line(schedule: Schedule, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        schedule.check()
    Schedule(delay=4, execute=4, horizon=8).check()


def test_noise_on_whole_numbers_is_refused(env: Environment) -> None:
    discrete = Environment(EnvConfig(size="s")).action_space
    with pytest.raises(ValueError, match="action noise is of numbers"):
        Schedule(delay=0, action_noise=0.1).check_space(discrete)
    Schedule(delay=0, action_noise=0.1).check_space(env.action_space)
