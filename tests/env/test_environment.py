"""Stepping: outcomes, rewards, auto-reset and time limit on levels whose course is known beforehand."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jax2d import Engine, MissingEffectError
from jax2d.effects import effects_of, names_of_bits
from jax2d.scene import stack_worlds
from kinetix_dist.env.environment import EnvConfig, Environment
from kinetix_dist.env.noop import noop_solved
from kinetix_dist.level.generator import generate_levels
from kinetix_dist.level.generator_config import GeneratorConfig
from kinetix_dist.level.level import SIZES, Level, Role
from kinetix_dist.level.simulation import NOOP_STEPS
from kinetix_dist.level.simulation import noop_solved as noop_solved_of_levels
from tests.env.worlds import BOX, DISC_1, DISC_2, HALF_BOX_M, MOTOR_JOINT, RADIUS_M, THRUSTER, batch, small_level
from tests.helpers import REPOSITORY, environment_of_cpus

MAX_STEPS = 12
STEP_S = 2 / 60  # frame skip 2, dt 1/60


@pytest.fixture(scope="module")
def env() -> Environment:
    return Environment(EnvConfig(size="s", max_steps=MAX_STEPS))


# Green slides towards blue at 3 m/s without gravity; their surfaces are 0.55 m apart: 5.5 environment steps.
GAP_M = 0.55
MEETS = small_level(
    box=(1.0, 1.0),
    disc_1=(1.0 + HALF_BOX_M + RADIUS_M + GAP_M, 1.0),
    fixed=(DISC_1,),
    velocity={BOX: (3.0, 0.0)},
)
# The same, but the disc in the way is red and blue is far away.
MEETS_RED = dataclasses.replace(
    small_level(
        box=(1.0, 1.0),
        disc_1=(1.0 + HALF_BOX_M + RADIUS_M + GAP_M, 1.0),
        disc_2=(4.0, 4.0),
        roles={BOX: Role.GREEN, DISC_1: Role.RED, DISC_2: Role.BLUE},
        fixed=(DISC_1, DISC_2),
        velocity={BOX: (3.0, 0.0)},
    )
)
RESTS = small_level(box=(1.0, 1.0), disc_1=(4.0, 4.0))
PUSHED = small_level(
    box=(1.0, 1.0),
    disc_1=(4.0, 1.0),
    thruster={**THRUSTER, "thrusters.position": (0.0, 0.0), "thrusters.angle": 0.0, "thrusters.power": 0.5},
)


def play(env: Environment, levels: Level, actions: np.ndarray) -> dict[str, np.ndarray]:
    """Steps through actions [T, W, 6] in one scan; fields are [T, W, ...]."""

    def advance(carry: tuple, action: jax.Array) -> tuple[tuple, dict]:
        prepared, env_state = carry
        env_state, obs, reward, done, info = env.step(prepared, env_state, action)
        record = {"reward": reward, "done": done, "bodies": obs.bodies, "touching": obs.touching}
        record |= {field.name: getattr(info, field.name) for field in dataclasses.fields(info)}
        return (prepared, env_state), record

    prepared = env.prepare(levels)
    env_state, _ = env.reset(prepared)
    _, records = jax.jit(lambda carry, a: jax.lax.scan(advance, carry, a))((prepared, env_state), jnp.asarray(actions))
    return jax.tree.map(np.asarray, records)


def noops(num_steps: int, num_worlds: int) -> np.ndarray:
    return np.zeros((num_steps, num_worlds, 6), np.int32)


def test_green_meeting_blue_ends_the_episode_with_plus_one(env: Environment) -> None:
    course = play(env, batch(MEETS), noops(6, 1))
    np.testing.assert_array_equal(course["done"][:, 0], [False] * 5 + [True])
    np.testing.assert_array_equal(course["solved"][:, 0], course["done"][:, 0])
    # 3 m/s towards the goal: kappa * 0.1 m a step until they meet.
    np.testing.assert_allclose(course["reward"][:5, 0], 0.1 * 3.0 * STEP_S, rtol=1e-4)
    assert 1.0 <= course["reward"][5, 0] <= 1.0 + 0.1 * 3.0 * STEP_S
    assert course["episode_length"][5, 0] == 6
    assert course["episode_return"][5, 0] == pytest.approx(course["reward"][:, 0].sum(), rel=1e-5)


def test_green_meeting_red_ends_the_episode_with_minus_one(env: Environment) -> None:
    course = play(env, batch(MEETS_RED), noops(6, 1))
    np.testing.assert_array_equal(course["failed"][:, 0], [False] * 5 + [True])
    assert not course["solved"].any()
    assert -1.01 <= course["reward"][5, 0] <= -0.98


def test_an_episode_times_out_after_max_steps(env: Environment) -> None:
    course = play(env, batch(RESTS), noops(2 * MAX_STEPS, 1))
    expected = np.zeros(2 * MAX_STEPS, bool)
    expected[[MAX_STEPS - 1, 2 * MAX_STEPS - 1]] = True
    np.testing.assert_array_equal(course["timed_out"][:, 0], expected)
    np.testing.assert_array_equal(course["done"][:, 0], expected)
    np.testing.assert_array_equal(course["episode_length"][:, 0], list(range(1, MAX_STEPS + 1)) * 2)
    np.testing.assert_allclose(course["reward"], 0.0, atol=1e-6)


def test_a_finished_episode_restarts_on_the_same_level_and_runs_the_same_course(env: Environment) -> None:
    levels = batch(MEETS)
    course = play(env, levels, noops(12, 1))
    np.testing.assert_array_equal(course["bodies"][5, 0], env.prepare(levels).initial_obs.bodies[0])
    assert not course["touching"][5].any()
    for name in ("reward", "done", "bodies", "touching", "episode_return", "episode_length"):
        np.testing.assert_array_equal(course[name][6:], course[name][:6], err_msg=name)


def test_only_worlds_that_finished_are_reset(env: Environment) -> None:
    together = play(env, batch(MEETS, RESTS, MEETS_RED), noops(8, 3))
    for world, level in enumerate((MEETS, RESTS, MEETS_RED)):
        alone = play(env, batch(level), noops(8, 1))
        for name, values in alone.items():
            np.testing.assert_array_equal(together[name][:, world], values[:, 0], err_msg=name)


def test_thruster_of_the_right_colour_pushes_green_towards_blue(env: Environment) -> None:
    actions = noops(10, 3)
    actions[:, 1, 4] = 1  # the other colour
    actions[:, 2, 5] = 1  # the thruster's
    course = play(env, batch(PUSHED, PUSHED, PUSHED), actions)
    travelled = course["bodies"][-1, :, BOX, 0] - 1.0
    assert travelled[0] == travelled[1] == pytest.approx(0.0, abs=1e-6)
    assert travelled[2] > 0.05
    # Blue is straight ahead: kappa times the way travelled.
    assert course["reward"][:, 2].sum() == pytest.approx(0.1 * travelled[2], rel=1e-4)


def test_touching_is_observed_while_a_body_rests_on_the_floor(env: Environment) -> None:
    level = small_level(box=(1.0, HALF_BOX_M), disc_1=(4.0, 4.0), gravity=-9.81, fixed=(DISC_1,))
    prepared = env.prepare(batch(level))
    env_state, obs = env.reset(prepared)
    for _ in range(3):
        env_state, obs, *_ = env.step(prepared, env_state, noops(1, 1)[0])
    masks = np.asarray(env.observe(prepared, obs).attention_masks[0, 3])
    assert masks[0, BOX] and masks[BOX, 0] and not masks[DISC_1, 0]
    np.testing.assert_array_equal(masks, masks.T)


def test_numbers_that_are_not_finite_are_counted_and_do_not_outlive_their_episode(env: Environment) -> None:
    prepared = env.prepare(batch(RESTS, RESTS))
    env_state, first_obs = env.reset(prepared)

    def poison(x: jax.Array) -> jax.Array:
        return x.at[..., 0].set(jnp.nan) if jnp.issubdtype(x.dtype, jnp.floating) else x

    poisoned = dataclasses.replace(env_state, packed_state=jax.tree.map(poison, env_state.packed_state))
    env_state, obs, reward, done, info = env.step(prepared, poisoned, noops(1, 2)[0])
    np.testing.assert_array_equal(info.unstable, [True, False])
    np.testing.assert_array_equal(done, [True, False])
    np.testing.assert_allclose(reward, [0.0, 0.0], atol=1e-6)
    np.testing.assert_array_equal(obs.bodies[0], first_obs.bodies[0])
    _, obs, _, done, _ = env.step(prepared, env_state, noops(1, 2)[0])
    assert not done.any() and jnp.isfinite(obs.bodies).all()


def test_bad_actions_are_refused_outside_of_jit_and_counted_inside(env: Environment) -> None:
    prepared = env.prepare(batch(RESTS))
    env_state, _ = env.reset(prepared)
    bad = jnp.array([[0, 3, 0, 0, 0, -2]], jnp.int32)
    with pytest.raises(ValueError, match=r"action 3 at \[0, 1\] is out of range"):
        env.step(prepared, env_state, bad)
    with pytest.raises(ValueError, match=r"shape \(2, 6\); multi_discrete actions of 1 worlds"):
        env.step(prepared, env_state, jnp.zeros((2, 6), jnp.int32))
    with pytest.raises(ValueError, match="type float32"):
        env.step(prepared, env_state, jnp.zeros((1, 6)))
    *_, info = jax.jit(env.step)(prepared, env_state, bad)
    assert int(info.invalid_actions[0]) == 2


def test_levels_of_another_size_and_single_levels_are_refused(env: Environment) -> None:
    with pytest.raises(ValueError, match=r"levels have slots for 5 polygons, size 'm' for 6"):
        Environment(EnvConfig(size="m"), engine=None).prepare(batch(RESTS))
    with pytest.raises(ValueError, match="takes a batch"):
        env.prepare(RESTS)


def test_levels_with_what_the_engine_was_made_without_are_refused(env: Environment) -> None:
    is_disc = np.arange(MEETS.scene.shapes.kinematic.shape[-1]) == DISC_1
    carried = dataclasses.replace(MEETS, scene=MEETS.scene.replace(shapes={"kinematic": is_disc}))
    with pytest.raises(MissingEffectError, match="scene 1 calls for kinematic_bodies"):
        env.prepare(batch(RESTS, carried))


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("size", "xl", "EnvConfig.size is 'xl'; choose one of s, m, l"),
        ("action_space", "buttons", "EnvConfig.action_space is 'buttons'"),
        ("frame_skip", 0, "EnvConfig.frame_skip is 0"),
        ("frame_skip", 1.5, "EnvConfig.frame_skip is 1.5; it must be a whole number"),
        ("max_steps", float("nan"), "EnvConfig.max_steps is nan; it must be a whole number"),
        ("max_steps", True, "EnvConfig.max_steps is True; it must be a whole number"),
        ("max_steps", -1, "EnvConfig.max_steps is -1"),
        ("dense_reward_scale", float("nan"), "EnvConfig.dense_reward_scale is nan"),
        ("dense_reward_scale", 0.0, "EnvConfig.dense_reward_scale is 0; choose reward 'sparse'"),
        ("reward", "densse", "EnvConfig.reward is 'densse'; choose one of dense, sparse, shaped"),
        ("shaping_discount", 1.1, "EnvConfig.shaping_discount is 1.1"),
        ("failure_penalty", -0.5, "EnvConfig.failure_penalty is -0.5; it must be from 0 to 3.4"),
        ("failure_penalty", 1e39, "EnvConfig.failure_penalty is 1e\\+39; it must be from 0 to 3.4"),
    ],
)
def test_bad_config_values_are_refused(field: str, value: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        EnvConfig(**{field: value})


def test_noop_filter_finds_levels_that_solve_themselves() -> None:
    env = Environment(EnvConfig(size="s"))
    solved = noop_solved(env, batch(MEETS, RESTS, MEETS_RED))
    np.testing.assert_array_equal(solved, [True, False, False])
    np.testing.assert_array_equal(noop_solved(env, batch(MEETS), num_steps=5), [False])


def test_noop_filter_of_the_levels_judges_as_the_environment_does() -> None:
    levels = generate_levels(jax.random.key(5), 48, SIZES["s"], GeneratorConfig())
    env = Environment(EnvConfig(size="s"))
    prepared = env.prepare(levels)
    actions = env.action_space.noop_actions(48)

    def advance(carry: tuple, _: None) -> tuple[tuple, None]:
        env_state, solved, over = carry
        env_state, _, _, done, info = env.step(prepared, env_state, actions)
        return (env_state, solved | (info.solved & ~over), over | done), None

    none_yet = jnp.zeros(48, bool)
    (_, played, _), _ = jax.lax.scan(advance, (env.reset(prepared)[0], none_yet, none_yet), None, length=NOOP_STEPS)
    np.testing.assert_array_equal(played, noop_solved(env, levels))
    np.testing.assert_array_equal(played, noop_solved_of_levels(levels))
    assert 0 < played.sum() < 48


SHARDED = """
import jax, numpy as np, jax.numpy as jnp
from jax.sharding import Mesh, PartitionSpec
from kinetix_dist.env.environment import EnvConfig, Environment
from kinetix_dist.learner.sharding import on_devices
from tests.env.test_environment import MEETS, MEETS_RED, PUSHED, RESTS, MAX_STEPS
from tests.env.worlds import batch

env = Environment(EnvConfig(size="s", max_steps=MAX_STEPS))
levels = batch(MEETS, MEETS_RED, PUSHED, RESTS)
actions = env.action_space.sample(jax.random.key(0), 4 * 14).reshape(14, 4, 6)

def unroll(levels, actions):
    prepared = env.prepare(levels)
    def advance(env_state, action):
        env_state, obs, reward, done, info = env.step(prepared, env_state, action)
        return env_state, (obs, reward, done, info)
    return jax.lax.scan(advance, env.reset(prepared)[0], actions)[1]

mesh = Mesh(np.array(jax.devices()), ("data",))
sharded = jax.jit(on_devices(
    unroll, mesh, in_specs=(PartitionSpec("data"), PartitionSpec(None, "data")), out_specs=PartitionSpec(None, "data")))
two, one = (jax.tree.leaves(f(levels, actions)) for f in (sharded, jax.jit(unroll)))
for a, b in zip(two, one, strict=True):
    np.testing.assert_array_equal(a, b)
assert len(jax.devices()) == 2
print("same")
"""


def test_two_devices_give_the_same_bits_as_one() -> None:
    result = subprocess.run(
        [sys.executable, "-c", SHARDED],
        cwd=REPOSITORY,
        env=environment_of_cpus(2),
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert result.returncode == 0 and "same" in result.stdout, result.stderr[-2000:]


LIGHT = small_level(disc_2=(4.0, 4.0), thruster=THRUSTER)
DRIVEN = small_level(disc_2=(4.0, 4.0), joint=MOTOR_JOINT)


def test_an_environment_for_fewer_effects_names_what_a_level_lacks() -> None:
    scenes = stack_worlds([LIGHT]).scene
    env = Environment(EnvConfig(size="s"), engine=Engine(SIZES["s"], effects=effects_of(scenes)))
    with pytest.raises(MissingEffectError, match=r"scene 1 calls for revolute_joints, motors, joint_slots"):
        env.prepare(batch(LIGHT, DRIVEN))

    def step_once(levels: Level) -> jax.Array:  # inside jit nothing can be refused
        prepared = env.prepare(levels)
        return env.step(prepared, env.reset(prepared)[0], jnp.zeros((2, 6), jnp.int32))[-1].missing_effects

    missing = jax.jit(step_once)(batch(LIGHT, DRIVEN))
    assert [list(names_of_bits(int(bits))) for bits in missing] == [[], ["revolute_joints", "motors", "joint_slots"]]
