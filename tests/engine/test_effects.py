"""Effects: what scenes call for is found, engines made for it give the same bits, what is missing is named."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jax2d import (
    EFFECTS,
    Capacity,
    Controls,
    Effects,
    Engine,
    MissingEffectError,
    Scene,
    SceneBuilder,
    called_for,
    effects_of,
    index_worlds,
    preset,
    stack_worlds,
)
from jax2d.effects import SLOTS, names_of_bits
from kinetix_dist.level.level import SIZES
from tests.engine.worlds import CAPACITY, builder, engine
from tests.level.random_levels import random_levels


def floor_and(*, gravity: tuple[float, float] = (0.0, -9.81), floor_friction: float = 0.0) -> SceneBuilder:
    b = builder(gravity)
    b.add_box(width=20, height=1, position=(0, -0.5), fixed=True, friction=floor_friction)
    return b


def ball_on_floor() -> Scene:
    b = floor_and(floor_friction=1.0)
    b.add_circle(radius=0.3, position=(0, 1), velocity=(1, 0), friction=1.0)
    return b.build().scene


def test_nothing_is_called_for_by_an_empty_scene():
    empty = effects_of(builder().build().scene)
    assert empty == Effects()


def test_full_effects_cover_every_scene_of_the_capacity():
    assert Effects.full(CAPACITY).covers(effects_of(ball_on_floor()))
    assert not Effects().covers(effects_of(ball_on_floor()))
    assert [Effects.full(dataclasses.replace(CAPACITY, springs=n)).springs for n in (0, 1)] == [False, True]


def test_ball_on_a_floor_calls_for_what_it_shows():
    effects = effects_of(ball_on_floor())
    assert [name for name in EFFECTS if getattr(effects, name)] == [
        "polygon_circle_pairs",
        "friction",
        "continuous_collision",
        "gravity",
    ]
    assert [getattr(effects, name) for name in SLOTS] == [1, 1, 0, 0, 1]


def joined(
    *, fixed: bool = False, motor_speed: float | None = None, limits: tuple[float, float] | None = None
) -> Scene:
    b = builder(gravity=(0, 0))
    one, two = b.add_box(width=1, height=0.2), b.add_box(width=1, height=0.2, position=(1, 0))
    if fixed:
        b.add_fixed_joint(one, two, at=(0.5, 0))
    else:
        b.add_revolute_joint(one, two, at=(0.5, 0), motor_speed=motor_speed, limits=limits)
    return b.build().scene


@pytest.mark.parametrize(
    ("scene", "called"),
    [
        (joined(fixed=True), {"fixed_joints"}),
        (joined(), {"revolute_joints"}),
        (joined(motor_speed=1.0), {"revolute_joints", "motors"}),
        (joined(limits=(-1, 1)), {"revolute_joints", "joint_limits"}),
    ],
    ids=["fixed", "revolute", "motor", "limits"],
)
def test_joints_call_for_what_they_do(scene: Scene, called: set[str]):
    effects = effects_of(scene)
    assert {name for name in EFFECTS if getattr(effects, name)} == called
    assert effects.joint_slots == 1
    assert effects.contact_slots == 0  # jointed bodies do not touch


def without_the_second_body() -> tuple[Scene, tuple]:
    """A driven, limited joint and a thruster, both on a disc that is not active, and a box that is."""
    b = builder()
    box, disc = b.add_box(width=1, height=0.2), b.add_circle(radius=0.2, position=(1, 0))
    b.add_revolute_joint(box, disc, at=(0.5, 0), motor_speed=1.0, limits=(-1, 1))
    b.add_thruster(disc, at=(1, 0), angle=0.0)
    scene, *start = b.build()
    active = scene.shapes.active.copy()
    active[disc] = False
    return scene.replace(shapes={"active": active}), tuple(start)


def test_joints_and_thrusters_of_inactive_shapes_call_for_nothing():
    effects = effects_of(without_the_second_body()[0])
    assert {name for name in EFFECTS if getattr(effects, name)} == {"gravity"}
    assert [getattr(effects, name) for name in SLOTS] == [1, 0, 0, 0, 0]


def test_restitution_is_called_for_where_both_bounce():
    for other, called in ((0.0, False), (0.5, True)):
        b = builder()
        b.add_box(width=20, height=1, position=(0, -0.5), fixed=True, restitution=other)
        b.add_circle(radius=0.3, position=(0, 1), restitution=0.5)
        assert effects_of(b.build().scene).restitution == called


def test_shapes_that_cannot_move_call_for_nothing():
    b = builder()
    b.add_box(width=2, height=2, fixed=True, friction=1.0, restitution=1.0)
    b.add_box(width=2, height=2, position=(1, 0), fixed=True, friction=1.0, restitution=1.0)
    effects = effects_of(b.build().scene)
    assert not any(getattr(effects, name) for name in EFFECTS)
    assert effects.polygon_slots == 2


def test_union_covers_both_and_the_table_says_who_needs_what():
    scenes = stack_worlds([ball_on_floor(), joined(motor_speed=1.0)])
    table = called_for(scenes)
    ball, joint = (effects_of(index_worlds(scenes, i)) for i in range(2))
    assert table.union() == ball | joint == effects_of(scenes)
    np.testing.assert_array_equal(ball.covers_worlds(table), [True, False])
    np.testing.assert_array_equal((ball | joint).covers_worlds(table), [True, True])
    names = set(names_of_bits(int(ball.missing_worlds(table)[1])))
    assert names == set(ball.missing(joint)) == {"revolute_joints", "motors", "polygon_slots", "joint_slots"}


# Same bits


def some_levels(size: str, number: int) -> tuple[Scene, tuple]:
    """Random levels: scenes, and what initial_state takes."""
    levels = random_levels(size, number, seed=3)
    return levels.scene, (levels.position, levels.angle, levels.velocity, levels.angular_velocity)


def some_controls(size: str, steps: int, worlds: int) -> Controls:
    """[steps, worlds, ...], held for two steps each."""
    rng = np.random.default_rng(0)
    return Controls(
        motor=rng.integers(-1, 2, (steps, worlds, SIZES[size].joints)).astype(np.float32),
        thruster=rng.integers(0, 2, (steps, worlds, SIZES[size].thrusters)).astype(np.float32),
    )


def rollout(one: Engine, scenes: Scene, start: tuple, controls: Controls):
    """(packed states with worlds last, Touching with worlds first) of every call, [steps, ...] numpy."""

    @jax.jit
    def simulate(scenes, start, controls):
        packed_scene, packed = one.pack_scene(scenes), one.pack_state(one.initial_state(scenes, *start))

        def body(packed, controls):
            packed, touching = one.step_packed(packed_scene, packed, controls, num_steps=2)
            return packed, (packed, touching)

        return jax.lax.scan(body, packed, controls)[1]

    return jax.tree.map(np.asarray, simulate(scenes, start, controls))


def assert_same_bits(a, b):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)


@pytest.mark.also_gpu
@pytest.mark.parametrize(
    ("preset_name", "lacking"),
    [("standard", "revolute_joints"), ("standard", "thrusters"), ("paper", "circle_pairs")],
)
def test_engine_for_the_effects_of_levels_gives_the_bits_of_the_full_engine(preset_name: str, lacking: str):
    """Steps levels, of 96 random ones, that do not call for an effect on an engine without it."""
    scenes, start = some_levels("m", 96)
    controls = some_controls("m", 60, 96)
    worlds = np.flatnonzero(~np.asarray(called_for(scenes).flags)[:, EFFECTS.index(lacking)])
    assert len(worlds) >= 5
    packed, touching = rollout(Engine(SIZES["m"], settings=preset(preset_name)), scenes, start, controls)
    scenes, start = index_worlds((scenes, start), worlds)
    effects = effects_of(scenes)
    assert not getattr(effects, lacking)
    special = Engine(SIZES["m"], settings=preset(preset_name), effects=effects)
    controls = jax.tree.map(lambda x: x[:, worlds], controls)
    special_packed, special_touching = rollout(special, scenes, start, controls)
    assert_same_bits(special_packed, jax.tree.map(lambda x: x[..., worlds], packed))
    assert_same_bits(special_touching, jax.tree.map(lambda x: x[:, worlds], touching))


@pytest.mark.also_gpu
def test_scene_without_pairs_joints_or_thrusters_gives_the_same_bits():
    b = builder()
    b.add_circle(radius=0.3, position=(0, 1), velocity=(1, 2))
    world = b.build()
    special = Engine(CAPACITY, effects=effects_of(world.scene))
    assert special.effects.polygon_slots == special.effects.contact_slots == 0
    assert_same_bits(
        special.step(world.scene, special.initial_state(*world), num_steps=30),
        engine().step(world.scene, engine().initial_state(*world), num_steps=30),
    )


@pytest.mark.also_gpu
def test_joints_and_thrusters_of_inactive_shapes_do_nothing():
    """The kernel once read what was left in memory of the shape that is not there."""
    scene, start = without_the_second_body()
    acts = Controls(motor=np.ones(CAPACITY.joints, np.float32), thruster=np.ones(CAPACITY.thrusters, np.float32))
    none = {
        "joints": {"active": np.zeros(CAPACITY.joints, bool)},
        "thrusters": {"active": np.zeros(CAPACITY.thrusters, bool)},
    }
    state = engine().initial_state(scene, *start)
    ended = engine().step(scene, state, acts, num_steps=30)
    assert_same_bits(ended, engine().step(scene.replace(**none), state, acts, num_steps=30))
    assert_same_bits(ended, Engine(CAPACITY, effects=effects_of(scene)).step(scene, state, acts, num_steps=30))
    assert float(ended[0].velocity[0, 1]) == pytest.approx(-9.81 / 2, rel=1e-5)


@pytest.mark.also_gpu
def test_states_pass_between_engines_of_one_capacity():
    b = floor_and(floor_friction=1.0)
    b.add_circle(radius=0.3, position=(0, 0.5), velocity=(1, 0), friction=1.0)
    world = b.build()
    special = Engine(CAPACITY, effects=effects_of(world.scene))
    state = engine().initial_state(*world)
    there, _ = engine().step(world.scene, state, num_steps=60)
    back, _ = special.step(world.scene, there, num_steps=30)
    straight, _ = engine().step(world.scene, state, num_steps=90)
    assert_same_bits(back, straight)


# What is missing is named


def test_scene_that_calls_for_more_is_refused_with_the_name_of_the_effect():
    special = Engine(CAPACITY, effects=effects_of(ball_on_floor()))
    scenes = stack_worlds([ball_on_floor(), joined(motor_speed=1.0)])
    with pytest.raises(MissingEffectError, match=r"scene 1 calls for revolute_joints, motors, .*effects_of"):
        special.pack_scene(scenes)


@pytest.mark.also_gpu
def test_inside_jit_what_is_missing_is_counted_world_by_world():
    special = Engine(CAPACITY, effects=effects_of(ball_on_floor()))
    worlds = stack_worlds([ball_on_floor(), joined(motor_speed=1.0)])

    @jax.jit
    def step(scenes):
        position = jnp.zeros((2, CAPACITY.shapes, 2)) + jnp.arange(CAPACITY.shapes)[:, None]
        return special.step(scenes, special.initial_state(scenes, position), num_steps=2)

    state, touching = step(worlds)
    assert np.isfinite(state.position).all()
    assert int(touching.missing[0]) == 0
    assert "revolute_joints" in names_of_bits(int(touching.missing[1]))


def test_full_engine_misses_nothing():
    _, touching = engine().step(ball_on_floor(), engine().initial_state(ball_on_floor(), np.zeros((10, 2))))
    assert int(touching.missing) == 0


def test_effects_of_another_capacity_are_refused():
    wide = Effects.full(Capacity(polygons=9, circles=1, joints=0, thrusters=0))
    with pytest.raises(ValueError, match=r"Effects\.polygon_slots is 9, but Capacity"):
        Engine(CAPACITY, effects=wide)


def test_unknown_effect_is_refused():
    with pytest.raises(ValueError, match="unknown effect 'magnetism'; effects are polygon_pairs"):
        Effects.full(CAPACITY).without("magnetism")


def test_an_effect_left_out_on_purpose_is_not_simulated():
    """`without` is for studies: tables packed by the full engine, stepped by one that lacks an effect."""
    scene = ball_on_floor()
    state = engine().initial_state(scene, np.array([[0, -0.5]] + [[5, 5]] * 6 + [[0, 1]] + [[5, 5]] * 2))
    lean = Engine(CAPACITY, effects=dataclasses.replace(Effects.full(CAPACITY), gravity=False))
    batch = jax.tree.map(lambda x: np.asarray(x)[None], (scene, state))
    packed = lean.step_packed(
        engine().pack_scene(batch[0]), engine().pack_state(batch[1]), engine().no_controls(1), num_steps=30
    )[0]
    height = np.asarray(lean.bodies(packed)[0])[0, CAPACITY.polygons, 1]
    assert height == 1.0
