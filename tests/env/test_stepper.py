"""Worlds grouped by what they call for: the engines chosen, and results that do not depend on it by a bit."""

from __future__ import annotations

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jax2d.effects import Effects, effects_of, names_of_bits
from jax2d.engine import Engine, MissingEffectError
from jax2d.scene import stack_worlds
from kinetix_dist.env.environment import EnvConfig, Environment
from kinetix_dist.env.records import EnvState
from kinetix_dist.env.stepper import GroupedScene
from kinetix_dist.level.level import SIZES, Level
from tests.env.worlds import BOX, MOTOR_JOINT, THRUSTER, batch, small_level
from tests.helpers import REPOSITORY, environment_of_cpus

MAX_STEPS = 12
FULL = Effects.full(SIZES["s"])
WITHOUT_JOINTS = FULL.without("revolute_joints", "fixed_joints", "joint_limits", "motors")
VARIANTS = (WITHOUT_JOINTS, FULL)

PUSHED = small_level(disc_2=(4.0, 4.0), thruster=THRUSTER)
DRIVEN = small_level(disc_2=(4.0, 4.0), joint=MOTOR_JOINT)
FALLING = small_level(disc_2=(1.1, 2.0), gravity=-9.81)
MEETS = small_level(disc_1=(1.7, 1.0), velocity={BOX: (3.0, 0.0)})  # green slides into blue: solved after a few steps


def environment(groups: int) -> Environment:
    return Environment(
        EnvConfig(size="s", max_steps=MAX_STEPS, effect_groups=groups), variants=VARIANTS if groups else ()
    )


def course(env: Environment, levels: Level, num_steps: int) -> tuple:
    """Everything that is seen under random actions, [T, W, ...] on every field."""
    num_worlds = len(levels.position)

    def play(levels: Level, keys: jax.Array) -> tuple:
        prepared = env.prepare(levels)

        def advance(env_state: EnvState, key: jax.Array) -> tuple[EnvState, tuple]:
            env_state, *seen = env.step(prepared, env_state, env.action_space.sample(key, num_worlds))
            return env_state, tuple(seen)

        env_state, obs = env.reset(prepared)
        return obs, jax.lax.scan(advance, env_state, keys)[1]

    return jax.jit(play)(levels, jax.random.split(jax.random.key(1), num_steps))


def test_groups_change_no_bit_of_what_is_seen() -> None:
    # Groups of 2, 2 and 3 worlds; episodes end and start again at different times.
    levels = batch(DRIVEN, PUSHED, MEETS, FALLING, DRIVEN, MEETS, PUSHED)
    whole, grouped = course(environment(0), levels, 16), course(environment(3), levels, 16)
    done = np.asarray(whole[1][2])
    assert 0 < done.sum(axis=0).min() < done.sum(axis=0).max()
    for ours, theirs in zip(jax.tree.leaves(grouped), jax.tree.leaves(whole), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_a_group_is_stepped_by_the_cheapest_engine_that_covers_all_of_it() -> None:
    # Joints are called for by worlds 0 and 3; sorted, the other three come first.
    levels = batch(DRIVEN, PUSHED, PUSHED, DRIVEN, PUSHED)
    chosen = {}
    for groups in (1, 2, 9):
        scene = environment(groups).prepare(levels).packed_scene
        assert isinstance(scene, GroupedScene)
        np.testing.assert_array_equal(scene.grouping.world, [1, 2, 4, 0, 3])
        chosen[groups] = scene.grouping.engine.tolist()
    assert chosen == {1: [1], 2: [0, 1], 9: [0, 0, 0, 1, 1]}  # no more groups than worlds


def test_the_engine_that_is_chosen_is_the_one_that_steps() -> None:
    """A first engine that does not do what it says it covers, so that its worlds show who stepped them."""
    levels = batch(DRIVEN, PUSHED)
    env = environment(2)
    no_thrusters = Engine(SIZES["s"], effects=WITHOUT_JOINTS.without("thrusters"))
    env.stepper._engines[0].step_packed = no_thrusters.step_packed  # type: ignore[union-attr, method-assign]
    actions = jnp.ones((2, 6), jnp.int32)
    moved = []
    for one in (env, environment(2)):
        prepared = one.prepare(levels)
        _, obs, *_ = one.step(prepared, one.reset(prepared)[0], actions)
        moved.append(np.asarray(obs.bodies))
    np.testing.assert_array_equal(moved[0][0], moved[1][0])
    assert not np.array_equal(moved[0][1], moved[1][1])


def test_groups_and_variants_come_together() -> None:
    with pytest.raises(ValueError, match="effect_groups is 2 with 0 variants"):
        Environment(EnvConfig(size="s", effect_groups=2))
    with pytest.raises(ValueError, match="effect_groups is 0 with 2 variants"):
        Environment(EnvConfig(size="s"), variants=VARIANTS)
    with pytest.raises(ValueError, match="last variant"):
        Environment(EnvConfig(size="s", effect_groups=2), variants=VARIANTS[::-1])
    with pytest.raises(ValueError, match="effect_groups is -1"):
        EnvConfig(effect_groups=-1)


def test_an_environment_for_fewer_effects_names_what_a_level_lacks() -> None:
    scenes = stack_worlds([PUSHED]).scene
    env = Environment(EnvConfig(size="s"), engine=Engine(SIZES["s"], effects=effects_of(scenes)))
    with pytest.raises(MissingEffectError, match=r"scene 1 calls for revolute_joints, motors, joint_slots"):
        env.prepare(batch(PUSHED, DRIVEN))

    def step_once(levels: object) -> jax.Array:  # inside jit nothing can be refused
        prepared = env.prepare(levels)
        return env.step(prepared, env.reset(prepared)[0], jnp.zeros((2, 6), jnp.int32))[-1].missing_effects

    missing = jax.jit(step_once)(batch(PUSHED, DRIVEN))
    assert [list(names_of_bits(int(bits))) for bits in missing] == [[], ["revolute_joints", "motors", "joint_slots"]]


SHARDED = """
import jax, numpy as np
from jax.sharding import Mesh, PartitionSpec
from kinetix_dist.learner.sharding import on_devices
from tests.env.test_stepper import DRIVEN, FALLING, MEETS, PUSHED, environment
from tests.env.worlds import batch

levels = batch(DRIVEN, PUSHED, MEETS, DRIVEN, PUSHED, PUSHED, MEETS, FALLING)
actions = environment(0).action_space.sample(jax.random.key(0), 8 * 10).reshape(10, 8, 6)

def play(env):
    def unroll(levels, actions):
        prepared = env.prepare(levels)
        def advance(env_state, action):
            env_state, *seen = env.step(prepared, env_state, action)
            return env_state, tuple(seen)
        return jax.lax.scan(advance, env.reset(prepared)[0], actions)[1]
    return unroll

worlds, steps = PartitionSpec("data"), PartitionSpec(None, "data")
mesh = Mesh(np.array(jax.devices()), ("data",))
sharded = on_devices(play(environment(2)), mesh, in_specs=(worlds, steps), out_specs=steps)
two, one = (jax.tree.leaves(jax.jit(f)(levels, actions)) for f in (sharded, play(environment(0))))
for a, b in zip(two, one, strict=True):
    np.testing.assert_array_equal(a, b)
assert len(jax.devices()) == 2
print("same")
"""


def test_groups_on_each_of_two_devices_give_the_same_bits() -> None:
    result = subprocess.run(
        [sys.executable, "-c", SHARDED],
        cwd=REPOSITORY,
        env=environment_of_cpus(2),
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert result.returncode == 0 and "same" in result.stdout, result.stderr[-2000:]
