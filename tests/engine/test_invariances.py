"""Invariances of a simulation: the batch, the slot, the position, padding, a pause, the process."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from jax2d import (
    BuiltWorld,
    Capacity,
    Controls,
    Scene,
    SceneBuilder,
    Settings,
    State,
    Touching,
    index_worlds,
    preset,
    stack_worlds,
)
from jax2d.fields import SLOTS, fields_of
from tests.engine.worlds import CAPACITY, builder, engine, run
from tests.slots import is_active

PRESETS = [preset("standard"), preset("paper")]


def tumble(b: SceneBuilder, x: float = 0.0, y: float = 0.0, turn: float = 0.3) -> list[int]:
    """A floor and four bodies that fall, hit, roll and hang together."""
    b.add_box(width=20, height=1, position=(x, y - 0.5), fixed=True, restitution=0.3)
    box = b.add_box(width=0.6, height=0.4, position=(x, y + 1), angle=turn, restitution=0.5)
    arm = b.add_box(width=0.8, height=0.2, position=(x + 0.6, y + 1), density=2)
    ball = b.add_circle(radius=0.25, position=(x + 0.1, y + 1.8), velocity=(0.5, -1))
    b.add_revolute_joint(box, arm, at=(x + 0.25, y + 1), motor_speed=1.0, limits=(-1, 2))
    b.add_thruster(arm, at=(x + 0.9, y + 1), angle=1.0, power=0.5)
    return [box, arm, ball]


def batch_of(worlds: list[BuiltWorld]):
    one = engine()
    return stack_worlds([w.scene for w in worlds]), stack_worlds([one.initial_state(*w) for w in worlds])


def controls(batch: int) -> Controls:
    return Controls(
        motor=np.ones((batch, CAPACITY.joints), np.float32), thruster=np.ones((batch, CAPACITY.thrusters), np.float32)
    )


def assert_same_bits(a, b):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(np.asarray(x), np.asarray(y))


@pytest.mark.also_gpu
def test_world_in_a_batch_is_bitwise_the_world_alone():
    worlds = []
    for turn in (0.0, 0.3, 0.6, 0.9):
        b = builder()
        tumble(b, turn=turn)
        worlds.append(b.build())
    scene, state = batch_of(worlds)
    together, _ = engine().step(scene, state, controls(4), num_steps=90)
    for i in range(4):
        one_scene, one_state = index_worlds((scene, state), slice(i, i + 1))
        alone, _ = engine().step(one_scene, one_state, controls(1), num_steps=90)
        assert_same_bits(index_worlds(together, slice(i, i + 1)), alone)


@pytest.mark.also_gpu
def test_two_calls_are_bitwise_one_call_and_a_saved_state_goes_on_the_same():
    b = builder()
    tumble(b)
    scene, state = batch_of([b.build()])
    once, _ = engine().step(scene, state, controls(1), num_steps=60)
    half, _ = engine().step(scene, state, controls(1), num_steps=25)
    saved = jax.tree.map(np.asarray, half)
    twice, _ = engine().step(scene, jax.tree.map(np.array, saved), controls(1), num_steps=35)
    assert_same_bits(once, twice)


@pytest.mark.also_gpu
def test_same_start_gives_bitwise_the_same_end():
    b = builder()
    tumble(b)
    scene, state = batch_of([b.build()])
    assert_same_bits(
        engine().step(scene, state, controls(1), num_steps=90), engine().step(scene, state, controls(1), num_steps=90)
    )


@pytest.mark.also_gpu
def test_rows_that_a_step_does_not_write_would_be_seen():
    """Every output is written: a call after one with other contents gives the same bits."""
    b = builder()
    tumble(b)
    scene, state = batch_of([b.build()])
    reference = engine().step(scene, state, controls(1), num_steps=40)
    dirty = jax.tree.map(lambda x: np.asarray(x).copy(), state)
    dirty.contact_impulse[:] = np.nan  # slots without a key are never read
    again = engine().step(scene, dirty, controls(1), num_steps=40)
    np.testing.assert_array_equal(reference[0].position, again[0].position)
    np.testing.assert_array_equal(reference[1].at_end, again[1].at_end)


@pytest.mark.also_gpu
@pytest.mark.parametrize("noise", [3.0, np.nan])
def test_values_in_inactive_slots_change_nothing(noise: float):
    """Whatever stands in slots of shapes, joints and thrusters that are not active, NaN too."""
    b = builder()
    tumble(b)
    scene, state = jax.tree.map(lambda x: np.array(x), batch_of([b.build()]))
    off, no_joint, no_thruster = ~scene.shapes.active, ~scene.joints.active, ~scene.thrusters.active
    assert off[:, : CAPACITY.polygons].any() and off[:, CAPACITY.polygons :].any()
    assert no_joint.any() and no_thruster.any()
    noisy_scene, noisy_state = jax.tree.map(np.copy, (scene, state))
    for record in (noisy_scene, noisy_state):
        for field in fields_of(type(record)):
            if field.dims[0] not in SLOTS or field.path[-1] in ("active", "can_touch"):
                continue
            values, where = field.get(record), ~is_active(field, scene)
            if field.kind is bool:
                values[where] = True
            elif field.kind is float:
                values[where] = noise
            else:
                values[where] = 0 if field.name == "joints.a" else 2
    noisy_scene.shapes.can_touch[:] |= off[:, :, None] | off[:, None, :]

    @jax.jit  # outside of jit NaN is refused
    def simulate(scene: Scene, state: State) -> tuple[State, Touching]:
        return engine().step(scene, state, controls(1), num_steps=60)

    (expected, touching), (result, noisy_touching) = simulate(scene, state), simulate(noisy_scene, noisy_state)
    active = scene.shapes.active[0]
    for name in ("position", "angle", "velocity", "angular_velocity"):
        np.testing.assert_array_equal(
            np.asarray(getattr(result, name))[0, active], np.asarray(getattr(expected, name))[0, active], err_msg=name
        )
    np.testing.assert_array_equal(result.joint_impulse[~no_joint], expected.joint_impulse[~no_joint])
    assert_same_bits(touching, noisy_touching)


@pytest.mark.also_gpu
@pytest.mark.parametrize("settings", PRESETS, ids=["standard", "paper"])
def test_mirrored_world_moves_as_the_mirror_image(settings: Settings):
    def world(side: int) -> BuiltWorld:
        b = builder()
        b.add_box(width=20, height=1, position=(0, -0.5), fixed=True)
        b.add_box(width=0.6, height=0.4, position=(side * 0.2, 1), angle=side * 0.3)
        b.add_circle(radius=0.25, position=(side * 0.9, 1.5), velocity=(-side * 1.0, 0))
        return b.build()

    left, right = (run(world(side), 0.5, settings=settings) for side in (-1, 1))
    # Vertex order differs between the two, so rounding does too.
    np.testing.assert_allclose(left.position[:, 0], -right.position[:, 0], atol=2e-4)
    np.testing.assert_allclose(left.position[:, 1], right.position[:, 1], atol=2e-4)
    np.testing.assert_allclose(left.angle, -right.angle, atol=1e-3)


def test_world_moved_by_ten_metres_moves_the_same():
    ends = []
    for x, y in ((0.0, 0.0), (10.0, 20.0)):
        b = builder()
        bodies = tumble(b, x, y)
        end = run(b.build(), 0.7)
        ends.append(end.position[bodies] - [x, y])
    np.testing.assert_allclose(ends[0], ends[1], atol=2e-3)  # float32 has 2e-6 m there; contacts amplify it


def test_engine_refuses_arrays_of_another_capacity():
    b = SceneBuilder(CAPACITY)
    tumble(b)
    world = b.build()
    state = engine().initial_state(*world)
    with pytest.raises(ValueError, match=r"controls\.motor has shape"):
        engine().step(world.scene, state, Controls(motor=np.zeros(1), thruster=np.zeros(2)))


def test_worlds_with_more_shapes_than_contact_keys_can_name_are_refused():
    with pytest.raises(ValueError, match="at most 512 shapes"):
        Capacity(polygons=500, circles=13, joints=0, thrusters=0)


@pytest.mark.also_gpu
def test_no_state_moves_faster_than_the_limits_and_each_time_they_act_is_counted():
    """A hammer of 20 kg at 40 m/s on the tip of a light rod: the impact alone would spin it far beyond 50 rad/s."""
    b = builder(gravity=(0, 0))
    rod = b.add_box(width=1.0, height=0.05, position=(0, 0))
    b.add_circle(radius=0.25, position=(0.45, 0.6), velocity=(0, -40), density=100, restitution=0.9)
    world = b.build()
    state, counted, fastest = engine().initial_state(*world), 0, 0.0
    for _ in range(4):
        state, touching = engine().step(world.scene, state)
        counted += int(touching.limited)
        fastest = max(fastest, abs(float(state.angular_velocity[rod])))
    assert counted > 0
    assert 45 < fastest <= 50.0 * (1 + 1e-6)
    assert np.linalg.norm(state.velocity, axis=-1).max() <= 100.0 * (1 + 1e-6)
