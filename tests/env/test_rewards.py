"""Rewards: single steps worked by hand, episodes of shaped ones, and what is refused or counted."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jax2d.scene import Controls
from kinetix_dist.config import ConfigError, TrainConfig, from_dict, from_dict_for_playing, numbers_of, to_dict
from kinetix_dist.config.phases import PhaseConfig, read_phases
from kinetix_dist.config.train_config import differences
from kinetix_dist.env.environment import EnvConfig, Environment
from kinetix_dist.env.outcome import Outcome, RoleMasks
from kinetix_dist.env.rewards import REWARDS, Bodies, Reward, Step
from kinetix_dist.level.level import Role
from kinetix_dist.level.sets import load_level_set
from kinetix_dist.recipes import recipe
from kinetix_dist.registry import Registry
from kinetix_dist.renamed_settings import PHASE_NAMES
from tests.env.worlds import BOX, DISC_1, DISC_2, HALF_BOX_M, RADIUS_M, batch, small_level

# Worlds of the steps by hand: it goes on, solved, failed, timed out.
GOES_ON, SOLVED, FAILED, TIMED_OUT = range(4)
BEFORE_M, AFTER_M = 2.0, 1.5
KAPPA, GAMMA = 0.1, 0.9


def step(penalty: float = 1.0) -> Step:
    def is_world(number: int) -> jax.Array:
        return jnp.arange(4) == number

    nothing = jnp.zeros((4, 1))
    bodies = Bodies(position=nothing, angle=nothing, velocity=nothing, angular_velocity=nothing)
    return Step(
        level=None,
        roles=RoleMasks(is_green=nothing, is_blue=nothing, blue_bits=nothing, red_bits=nothing),
        before=bodies,
        after=bodies,
        distance_before=jnp.full(4, BEFORE_M),
        distance_after=jnp.full(4, AFTER_M),
        actions=nothing,
        controls=Controls(motor=nothing, thruster=nothing),
        outcome=Outcome(
            solved=is_world(SOLVED), failed=is_world(FAILED), timed_out=is_world(TIMED_OUT), unstable=is_world(-1)
        ),
        num_steps=jnp.ones(4, jnp.int32),
        failure_penalty=penalty,
        dense_scale=KAPPA,
        discount=GAMMA,
    )


@pytest.mark.parametrize("penalty", [1.0, 0.25, 0.0])
def test_a_step_of_each_reward(penalty: float) -> None:
    sparse = np.array([0.0, 1.0, -penalty, 0.0])
    np.testing.assert_allclose(REWARDS["sparse"].reward(step(penalty)), sparse)
    np.testing.assert_allclose(REWARDS["dense"].reward(step(penalty)), sparse + 0.05, rtol=1e-6)  # kappa (d - d')
    # kappa (d - gamma d') while it goes on; the state that ends an episode has no potential.
    shaped = np.array([0.1 * (2.0 - 0.9 * 1.5), 0.2, 0.2, 0.2])
    np.testing.assert_allclose(REWARDS["shaped"].reward(step(penalty)), sparse + shaped, rtol=1e-6)


def test_what_a_reward_uses_is_what_changes_it() -> None:
    for name in ("dense", "sparse", "shaped"):  # other tests of the process register their own
        reward = REWARDS[name]
        by_hand = reward.reward(step())
        for changed, uses in (
            (dataclasses.replace(step(), dense_scale=0.5), reward.uses_dense_scale),
            (dataclasses.replace(step(), discount=0.5), reward.uses_discount),
        ):
            assert bool((reward.reward(changed) != by_hand).any()) == uses, (name, changed)


# Episodes

MAX_STEPS = 12
SPEED = {BOX: (3.0, 0.0)}
BESIDE = (1.0 + HALF_BOX_M + RADIUS_M + 0.55, 1.0)
SOLVES = small_level(box=(1.0, 1.0), disc_1=BESIDE, fixed=(DISC_1,), velocity=SPEED)
FAILS = small_level(
    box=(1.0, 1.0),
    disc_1=BESIDE,
    disc_2=(4.0, 4.0),
    roles={BOX: Role.GREEN, DISC_1: Role.RED, DISC_2: Role.BLUE},
    fixed=(DISC_1, DISC_2),
    velocity=SPEED,
)
RESTS = small_level(box=(1.0, 1.0), disc_1=(4.0, 4.0))


def test_shaping_adds_the_same_to_all_episodes_of_a_level_however_they_go_and_end() -> None:
    """Ng et al., 1999: the discounted F of an episode add up to -Phi(s_0) = kappa d_0."""
    settings = {"size": "s", "max_steps": MAX_STEPS, "dense_reward_scale": 0.3, "shaping_discount": 0.9}
    given = {}
    for name in ("sparse", "shaped"):
        env = Environment(EnvConfig(reward=name, **settings))
        prepared = env.prepare(batch(SOLVES, FAILS, RESTS, RESTS))
        state, _ = env.reset(prepared)
        rows, ends = [], []
        for number in range(MAX_STEPS):
            actions = jnp.zeros((4, 6), jnp.int32).at[3].set(number % 2)
            state, _, reward, done, info = env.step(prepared, state, actions)
            rows.append(reward)
            ends.append(done)
        before_end = np.cumsum(ends, axis=0) - np.asarray(ends) == 0  # of the first episode
        assert np.asarray(ends).any(axis=0).all() and not info.invalid_rewards.any()
        given[name] = np.asarray(rows) * before_end
    added = given["shaped"] - given["sparse"]
    discounts = 0.9 ** np.arange(MAX_STEPS)
    np.testing.assert_allclose(discounts @ added, 0.3 * prepared.initial_distance, rtol=1e-5)  # float32, 12 steps
    assert given["sparse"].sum(axis=0).tolist() == [1.0, -1.0, 0.0, 0.0]


class _Given(Reward):
    """What a function makes of a step."""

    def __init__(self, function) -> None:
        self._function = function

    def reward(self, step: Step) -> jax.Array:
        return self._function(step)


@pytest.fixture
def register(monkeypatch):
    """Registers a reward "mine" for the test alone."""

    def add(function) -> None:
        monkeypatch.setattr(REWARDS, "_parts", {**REWARDS._parts, "mine": _Given(function)})

    return add


def play(config: EnvConfig):
    env = Environment(config)
    prepared = env.prepare(batch(SOLVES, RESTS))
    return env.step(prepared, env.reset(prepared)[0], jnp.zeros((2, 6), jnp.int32))


def test_a_reward_that_is_not_finite_counts_as_zero_and_is_counted(register) -> None:
    register(lambda step: jnp.array([jnp.nan, 0.5], jnp.float32))
    _, _, reward, _, info = play(EnvConfig(reward="mine"))
    assert reward.tolist() == [0.0, 0.5] and info.invalid_rewards.tolist() == [True, False]
    assert info.episode_return.tolist() == [0.0, 0.5]


@pytest.mark.parametrize(
    ("function", "says"),
    [
        (lambda step: step.after.velocity[..., 0], "reward 'mine' gives float32[2, 7]; it has to be float32[2]"),
        (lambda step: step.num_steps, "reward 'mine' gives int32[2]; it has to be float32[2], a number for each world"),
        (lambda step: 0.5, "reward 'mine' gives float32[]; it has to be float32[2]"),
    ],
)
def test_an_array_that_is_no_reward_is_refused(register, function, says: str) -> None:
    register(function)
    with pytest.raises(ValueError) as error:
        play(EnvConfig(reward="mine"))
    assert says in str(error.value)


def test_a_reward_sees_where_bodies_were_and_are(register) -> None:
    """It flies 3 m/s * 1/30 s = 0.1 m in a step."""
    register(
        lambda step: jnp.where(step.roles.is_green, (step.after.position - step.before.position)[..., 0], 0).sum(1)
    )
    _, _, reward, _, _ = play(EnvConfig(reward="mine"))
    assert float(reward[0]) == pytest.approx(0.1, abs=1e-4)


def test_names_are_taken_once() -> None:
    registry: Registry[Reward] = Registry("reward")
    registry.register("sparse", REWARDS["sparse"])
    with pytest.raises(ValueError, match=r"there is a reward 'sparse' already; register yours under another name"):
        registry.register("sparse", REWARDS["dense"])
    with pytest.raises(ValueError, match=r"unknown reward 'shapd'; did you mean 'shaped'?"):
        REWARDS["shapd"]


# Configurations


def config(phases: tuple[PhaseConfig, ...] = (), **env) -> TrainConfig:
    tiny = recipe("tiny")
    ppo = dataclasses.replace(tiny.ppo, bootstrap_timeouts=False)
    return dataclasses.replace(tiny, env=dataclasses.replace(tiny.env, **env), ppo=ppo, phases=phases)


def phase(start: int, **options: object) -> PhaseConfig:
    return PhaseConfig(start=start, options=options)


def before_rewards(config: TrainConfig, scale: float, *phase_scales: float) -> dict:
    """The configuration as a version before rewards had names stored it."""
    data = to_dict(config)
    for name in ("reward", "shaping_discount"):
        del data["env"][name]
    del data["env"]["physics"]["line_search"]  # which came later
    data["env"]["dense_reward_scale"] = scale
    old_names = [name for name in PHASE_NAMES if name != "reward"]
    for phase, phase_scale in zip(data["phases"], phase_scales, strict=True):
        del phase["options"]
        phase |= {**dict.fromkeys(old_names), "dense_reward_scale": phase_scale}
    return data


def test_runs_from_before_rewards_had_names_go_on() -> None:
    phases = (phase(256, **{"env.dense_reward_scale": 0.5}), phase(512, **{"env.reward": "sparse"}))
    for ours, theirs in (
        (config(), before_rewards(config(), 0.1)),
        (config(reward="sparse"), before_rewards(config(), 0.0)),
        (config(phases), before_rewards(config(phases), 0.1, 0.5, 0.0)),
    ):
        assert from_dict(theirs) == ours == from_dict(to_dict(ours))
        assert from_dict_for_playing(theirs).env == ours.env
        # The hash is over the same words as then.
        numbers = numbers_of(ours)
        assert numbers["env"] == theirs["env"]
        assert numbers["phases"] == theirs["phases"]
    (stored,) = from_dict(
        to_dict(config()) | {"phases": [{"start": 256, "options": {"env.dense_reward_scale": 0.0}}]}
    ).phases
    assert stored == phase(256, **{"env.reward": "sparse"})


def test_hashes_of_rewards_differ_and_differences_name_them() -> None:
    named = {name: config(reward=name) for name in ("dense", "sparse", "shaped")}
    assert len({each.hash for each in named.values()}) == 3
    assert differences(named["sparse"], named["dense"]) == ["env.reward 'sparse' instead of 'dense'"]
    assert differences(named["shaped"], named["sparse"]) == ["env.reward 'shaped' instead of 'sparse'"]
    # A scale that only a later phase uses is part of it.
    phases = (phase(256, **{"env.reward": "dense"}),)
    scales = {config(phases, reward="sparse", dense_reward_scale=scale).hash for scale in (0.1, 0.2, 0.3)}
    assert len(scales) == 3


def test_a_shaped_reward_has_the_discount_of_the_learner_and_its_ends() -> None:
    with pytest.raises(ConfigError, match=r"shaping_discount 0.9, and ppo.discount is 0.995; set both to one value"):
        config(reward="shaped", shaping_discount=0.9)
    assert config(reward="dense", shaping_discount=0.9).hash == config().hash  # which does not use it
    with pytest.raises(ConfigError, match=r"ppo.bootstrap_timeouts does not; set that to False"):
        dataclasses.replace(recipe("tiny"), env=config(reward="shaped").env)
    with pytest.raises(ValueError, match=r"phase 1: env.reward 'shaped' discounts by env.shaping_discount 0.9"):
        config((phase(256, **{"env.reward": "shaped"}),), shaping_discount=0.9)


def test_a_phase_changes_the_reward_and_sets_nothing_that_it_does_not_use(tmp_path) -> None:
    sparse, scaled = phase(256, **{"env.reward": "sparse"}), {"env.dense_reward_scale": 0.5}
    phases = sparse, phase(512, **{"env.reward": "shaped"}, **scaled)
    schedule = config(phases).schedule
    assert [schedule.at(update).config.env.reward for update in (0, 2, 4)] == ["dense", "sparse", "shaped"]
    unused = r"phase 2: env.dense_reward_scale is not used by env.reward 'sparse'; leave it out, or set env.reward, too"
    with pytest.raises(ValueError, match=unused):
        config((sparse, phase(512, **scaled)))
    stored = [{"start": 256, "reward": "sparse"}, {"start": 512, "dense_reward_scale": 0.5}]  # names until 0.2
    with pytest.raises(ValueError, match=unused):
        from_dict(to_dict(config()) | {"phases": stored})
    with pytest.raises(ValueError, match=r"phase 1: EnvConfig.reward is 'dence'; choose one of dense, sparse, shaped"):
        config((phase(256, **{"env.reward": "dence"}),))
    file = tmp_path / "phases.toml"
    file.write_text("[[phases]]\nstart = 256\noptions = {'env.dense_reward_scale' = 0.0}\n")
    with pytest.raises(ValueError, match=r"env.dense_reward_scale 0.0 is now called env.reward 'sparse'; use that"):
        read_phases(file)


def test_public_environments_take_the_reward_of_their_config() -> None:
    import kinetix_dist as kd

    levels = load_level_set("s/hop_home", "s")[0]
    env = kd.make(EnvConfig(size="s", reward="sparse", max_steps=4), num_envs=2, levels=levels)
    _, state = env.reset(jax.random.key(0))
    _, _, reward, _, info = env.step(jax.random.key(1), state, env.action_space.noop_actions(2))
    assert reward.tolist() == [0.0, 0.0] and not info.invalid_rewards.any()
