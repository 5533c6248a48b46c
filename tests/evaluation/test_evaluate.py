"""Solve rates on levels whose outcome is known, and what a rate must not depend on."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kinetix_dist.env.environment import EnvConfig, Environment
from kinetix_dist.env.observations.entities import EntityObs
from kinetix_dist.evaluation.evaluate import SolveRates, evaluate
from kinetix_dist.evaluation.intervals import wilson_interval
from kinetix_dist.evaluation.policies import NetworkPolicy, NoopPolicy, Player, RandomPolicy
from tests.env.test_environment import MAX_STEPS, MEETS, MEETS_RED, PUSHED, RESTS
from tests.env.worlds import BOX, DISC_1, THRUSTER, batch, small_level

NAMES = ["meets", "meets_red", "rests"]
# A thruster that reaches blue in about ten steps when it fires in most of them.
NEAR = small_level(
    box=(1.0, 1.0),
    disc_1=(1.62, 1.0),
    fixed=(DISC_1,),
    thruster={**THRUSTER, "thrusters.position": (0.0, 0.0), "thrusters.angle": 0.0},
)


@pytest.fixture(scope="module")
def env() -> Environment:
    return Environment(EnvConfig(size="s", max_steps=MAX_STEPS))


@dataclasses.dataclass(frozen=True)
class AlwaysThrust:
    """A network without weights whose logits always prefer firing every thruster."""

    def apply(self, params: Any, obs: EntityObs) -> tuple[tuple[jax.Array, ...], jax.Array]:
        num_worlds = obs.shape_mask.shape[0]
        motor = jnp.tile(jnp.array([20.0, 0.0, 0.0]), (num_worlds, 1))
        thruster = jnp.tile(jnp.array([0.0, 20.0]), (num_worlds, 1))
        return (motor,) * 4 + (thruster,) * 2, jnp.zeros(num_worlds)


def noop_rates(env: Environment, **keywords: Any) -> SolveRates:
    levels = batch(MEETS, MEETS_RED, RESTS)
    policy = NoopPolicy(env.action_space)
    return evaluate(env, Player(policy), levels, attempts=20, key=jax.random.key(0), names=NAMES, **keywords)


def test_known_levels_have_known_rates(env: Environment) -> None:
    rates = noop_rates(env)
    assert [(level.name, level.rate) for level in rates.levels] == [("meets", 1.0), ("meets_red", 0.0), ("rests", 0.0)]
    assert [level.mean_length for level in rates.levels] == [6.0, 6.0, MAX_STEPS]
    # 20 attempts without actions are the same: three levels are three attempts, and not sixty.
    assert (rates.total.solved, rates.total.failed, rates.total.timed_out, rates.total.unstable) == (1, 1, 1, 0)
    assert (rates.rate, rates.attempts, rates.attempts_per_level) == (pytest.approx(1 / 3), 3, 1)
    assert (rates.low, rates.high) == wilson_interval(1, 3)


def test_only_the_first_episode_of_an_attempt_counts(env: Environment) -> None:
    # "meets" is solved every 6 steps, twice while "rests" takes its 12.
    rates = noop_rates(env)
    for rate in (*rates.levels, rates.total):
        assert rate.solved + rate.failed + rate.timed_out + rate.unstable == rate.attempts
    assert rates.levels[0].mean_return == pytest.approx(1.0 + 0.1 * 0.55, abs=0.02)


def test_rates_do_not_depend_on_the_chunk_size(env: Environment) -> None:
    levels = batch(NEAR, RESTS, PUSHED)
    policy = RandomPolicy(env.action_space)
    results = [
        evaluate(env, Player(policy), levels, attempts=4, key=jax.random.key(3), max_worlds=size) for size in (12, 5)
    ]
    assert results[0] == results[1]


def test_attempts_differ_and_keys_repeat(env: Environment) -> None:
    policy = RandomPolicy(env.action_space)

    def mean_length(seed: int) -> float:
        # How long the way to blue takes depends on when the thruster happened to fire; the return hardly does.
        rates = evaluate(env, Player(policy), batch(NEAR), attempts=20, key=jax.random.key(seed))
        return rates.total.mean_length

    assert mean_length(0) == mean_length(0) != mean_length(1)


@pytest.mark.parametrize("greedy", [False, True])
def test_a_network_acts_by_its_logits(env: Environment, greedy: bool) -> None:
    policy = NetworkPolicy(AlwaysThrust(), env.action_distribution, greedy=greedy)
    trained = evaluate(env, Player(policy), batch(NEAR), attempts=3, key=jax.random.key(0))
    idle = evaluate(env, Player(NoopPolicy(env.action_space)), batch(NEAR), attempts=1, key=jax.random.key(0))
    assert (trained.rate, idle.rate) == (1.0, 0.0)
    assert trained.attempts == (1 if greedy else 3)  # greedy ones are all the same


def test_json_holds_the_interval_and_every_level(env: Environment) -> None:
    content = noop_rates(env).to_dict()
    assert {"rate", "attempts", "low", "high"} <= set(content)
    assert [level["name"] for level in content["levels"]] == NAMES
    assert "levels" not in noop_rates(env).to_dict(per_level=False)


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"attempts": 0}, "attempts is 0"),
        ({"max_worlds": 0}, "max_worlds is 0"),
        ({"names": ["one"]}, "1 names were given for 2 levels"),
    ],
)
def test_bad_requests_are_refused(env: Environment, keywords: dict[str, Any], message: str) -> None:
    given: dict[str, Any] = {"attempts": 1, "key": jax.random.key(0), **keywords}
    with pytest.raises(ValueError, match=message):
        evaluate(env, Player(NoopPolicy(env.action_space)), batch(RESTS, RESTS), **given)


def test_no_levels_are_refused(env: Environment) -> None:
    none = jax.tree.map(lambda x: x[:0], batch(RESTS))
    with pytest.raises(ValueError, match="no levels"):
        evaluate(env, Player(NoopPolicy(env.action_space)), none, attempts=1, key=jax.random.key(0))


def test_thruster_level_is_as_described() -> None:
    assert NEAR.shape_role[BOX] == 1 and np.asarray(NEAR.scene.thrusters.active).all()
