"""What an engine does with wrong input: one line that names the field, or a count where nothing can be raised."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jax2d import Controls, Scene, State
from tests.engine.worlds import CAPACITY, builder, engine


def start() -> tuple[Scene, State]:
    """A motorised pair and a thruster."""
    b = builder(gravity=(0, 0))
    one, two = b.add_box(width=1, height=0.2), b.add_box(width=1, height=0.2, position=(1, 0))
    b.add_revolute_joint(one, two, at=(0.5, 0), motor_speed=1.0)
    b.add_thruster(one, at=(0, 0), angle=0.0)
    world = b.build()
    return world.scene, engine().initial_state(*world)


def changed(tree: Any, **fields: Any) -> Any:
    return dataclasses.replace(tree, **fields)


def holding(array: Any, value: float, *index: int) -> np.ndarray:
    array = np.array(array)
    array[index] = value
    return array


def controls(motor: float = 0.0, thruster: float = 0.0) -> Controls:
    return Controls(
        motor=np.full(CAPACITY.joints, motor, np.float32), thruster=np.full(CAPACITY.thrusters, thruster, np.float32)
    )


@pytest.mark.parametrize("field", ["inverse_mass", "friction", "vertices", "joint_anchor_a", "gravity", "radius"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_scene_with_a_value_that_is_not_finite_is_refused(field: str, value: float):
    scene, state = start()
    bad = np.array(getattr(scene, field))
    bad.flat[0] = value
    with pytest.raises(ValueError, match=rf"scene\.{field}\[0.*\] is {value}; it must be finite"):
        engine().step(changed(scene, **{field: bad}), state)


@pytest.mark.parametrize("field", ["position", "angle", "velocity", "angular_velocity", "joint_impulse"])
def test_state_with_nan_is_refused(field: str):
    scene, state = start()
    bad = np.array(getattr(state, field))
    bad.flat[0] = np.nan
    with pytest.raises(ValueError, match=rf"state\.{field}\[0.*\] is nan"):
        engine().step(scene, changed(state, **{field: bad}))


def test_error_names_the_world_of_a_batch():
    scene, state = jax.tree.map(lambda x: np.stack([np.asarray(x)] * 3), start())
    bad = changed(scene, friction=holding(scene.friction, np.nan, 2, 1))
    with pytest.raises(ValueError, match=r"scene\.friction\[2, 1\] is nan"):
        engine().step(bad, state)


def test_wrong_types_are_refused():
    scene, state = start()
    with pytest.raises(ValueError, match=r"scene\.friction is float64, but this engine computes in float32; cast it"):
        engine().step(changed(scene, friction=np.asarray(scene.friction, np.float64)), state)
    with pytest.raises(ValueError, match=r"scene\.shape_active is float32; it must be bool"):
        engine().step(changed(scene, shape_active=np.ones(CAPACITY.shapes, np.float32)), state)
    with pytest.raises(ValueError, match=r"scene\.joint_a is float32; it must be integer"):
        engine().step(changed(scene, joint_a=np.zeros(CAPACITY.joints, np.float32)), state)
    with pytest.raises(ValueError, match=r"state\.position is int32; it must be floating-point"):
        engine().step(scene, changed(state, position=np.zeros((CAPACITY.shapes, 2), np.int32)))
    with pytest.raises(ValueError, match=r"controls\.motor is int32; it must be floating-point"):
        engine().step(scene, state, changed(controls(), motor=np.zeros(CAPACITY.joints, np.int32)))


def test_wrong_shapes_are_refused_inside_jit_too():
    scene, state = start()
    wrong = changed(controls(), motor=np.zeros(CAPACITY.joints + 1, np.float32))
    for step in (engine().step, jax.jit(engine().step)):
        with pytest.raises(ValueError, match=r"controls\.motor has shape \(1, 4\); this engine .* needs \(1, 3\)"):
            step(scene, state, wrong)
    with pytest.raises(ValueError, match=r"scene\.radius has shape \(1, 1\)"):
        engine().step(changed(scene, radius=np.ones(1, np.float32)), state)


@pytest.mark.parametrize(
    ("bad", "said"),
    [
        (controls(motor=1.5), r"controls\.motor\[0, 0\] is 1\.5; it must be from -1 to 1"),
        (controls(motor=np.nan), r"controls\.motor\[0, 0\] is nan"),
        (controls(thruster=-0.5), r"controls\.thruster\[0, 0\] is -0\.5; it must be from 0 to 1"),
    ],
)
def test_controls_out_of_range_are_refused_outside_jit(bad: Controls, said: str):
    with pytest.raises(ValueError, match=said):
        engine().step(*start(), bad)


@pytest.mark.also_gpu
def test_controls_out_of_range_are_clamped_and_counted_inside_jit():
    scene, state = start()
    step = jax.jit(lambda controls: engine().step(scene, state, controls, num_steps=5))
    most, touching = step(controls(motor=1.0, thruster=1.0))
    assert int(touching.invalid_controls) == 0
    beyond, touching = step(controls(motor=7.0, thruster=1.5))
    assert int(touching.invalid_controls) == CAPACITY.joints + CAPACITY.thrusters
    np.testing.assert_array_equal(beyond.velocity, most.velocity)
    still, touching = step(controls(motor=np.nan, thruster=np.nan))
    assert int(touching.invalid_controls) == CAPACITY.joints + CAPACITY.thrusters
    np.testing.assert_array_equal(still.velocity, jnp.zeros((CAPACITY.shapes, 2)))


def test_no_steps_at_all_are_refused():
    with pytest.raises(ValueError, match="num_steps is 0; a call takes at least one step"):
        engine().step(*start(), num_steps=0)
