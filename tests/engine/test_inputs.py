"""Wrong input to an engine: one line that names the field, or a count where nothing can be raised."""

from __future__ import annotations

import dataclasses
import unittest.mock
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jax2d import Capacity, Controls, Engine, Scene, SceneBuilder, Settings, State, preset, stack_worlds
from jax2d.builder_checks import SceneError
from jax2d.fields import as_dict, with_fields
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
    return with_fields(tree, fields)


def holding(array: Any, value: float, *index: int) -> np.ndarray:
    array = np.array(array)
    array[index] = value
    return array


def controls(motor: float = 0.0, thruster: float = 0.0) -> Controls:
    return Controls(
        motor=np.full(CAPACITY.joints, motor, np.float32), thruster=np.full(CAPACITY.thrusters, thruster, np.float32)
    )


@pytest.mark.parametrize(
    "field",
    ["shapes.inverse_mass", "shapes.friction", "shapes.vertices", "joints.anchor_a", "gravity", "shapes.radius"],
)
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_scene_with_a_value_that_is_not_finite_is_refused(field: str, value: float):
    scene, state = start()
    bad = np.array(as_dict(scene)[field])
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


def test_nan_in_a_contact_slot_is_refused_where_the_slot_is_in_use():
    scene, state = start()
    state = changed(state, contact_impulse=holding(state.contact_impulse, np.nan, 1, 0))
    engine().step(scene, state)
    with pytest.raises(ValueError, match=r"state\.contact_impulse\[1, 0\] is nan; it must be finite"):
        engine().step(scene, changed(state, contact_key=holding(state.contact_key, 4096, 1)))


UNIT_BOX = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]], np.float32)
DART = UNIT_BOX * [[1, 1], [1, 1], [-0.4, -0.4], [1, 1]]


@pytest.mark.parametrize(
    ("field", "index", "value", "said"),
    [
        ("joints.a", 0, 10, r"joints\.a\[0\] is 10; it must be the index of a shape"),
        ("joints.b", 0, -1, r"joints\.b\[0\] is -1; it must be the index"),
        ("joints.b", 0, 0, r"joints\.b\[0\] is 0; it must be another shape than joints\.a"),
        ("thrusters.body", 0, 10**9, r"thrusters\.body\[0\] is 1000000000; it must be the index"),
        ("shapes.num_vertices", 1, 2, r"shapes\.num_vertices\[1\] is 2; it must be from 3 to Capacity\.vertices"),
        ("shapes.num_vertices", 1, 5, r"shapes\.num_vertices\[1\] is 5"),
        ("shapes.vertices", 1, UNIT_BOX[::-1], r"shapes\.vertices\[1\] is .*; it must be convex, counter-clockwise"),
        ("shapes.vertices", 1, DART, r"shapes\.vertices\[1\] is .*; it must be convex"),
        ("shapes.vertices", 1, UNIT_BOX[[0, 1, 1, 2]], r"shapes\.vertices\[1\] is .*; it must be convex"),
        (
            "shapes.vertices",
            1,
            UNIT_BOX + 0.01,
            r"shapes\.vertices\[1\] is .*; it must have its centre of mass at \(0, 0\)",
        ),
        ("shapes.radius", 0, 0.0, r"shapes\.radius\[0\] is 0\.0; it must be positive"),
        ("shapes.restitution", 1, 1.5, r"shapes\.restitution\[1\] is 1\.5; it must be from 0 to 1"),
        ("shapes.friction", 1, -1.0, r"shapes\.friction\[1\] is -1\.0; it must be 0 or more"),
        (
            "shapes.inverse_mass",
            1,
            -1.0,
            r"shapes\.inverse_mass\[1\] is -1\.0; it must be 0 or more \(0: nothing pushes it\)",
        ),
        ("shapes.inverse_inertia", 1, -1.0, r"shapes\.inverse_inertia\[1\] is -1\.0; it must be 0"),
        ("joints.motor_power", 0, -1.0, r"joints\.motor_power\[0\] is -1\.0; it must be 0 or more"),
        ("joints.lower_limit", 0, 2.0, r"joints\.lower_limit\[0\] is 2\.0; it must be at most upper_limit"),
        (
            "shapes.can_touch",
            (2, 3),
            False,
            r"shapes\.can_touch\[2, 3\] is False; it must be the same for \[i, j\] and \[j, i\]",
        ),
    ],
)
def test_scene_with_values_that_make_no_world_is_refused(field: str, index: Any, value: Any, said: str):
    scene, state = start()
    scene = changed(
        scene,
        **{"joints.has_limits": np.ones(CAPACITY.joints, bool)},
        **{"shapes.active": holding(scene.shapes.active, True, CAPACITY.polygons)},
    )
    bad = np.array(as_dict(scene)[field])
    bad[index] = value
    with pytest.raises(ValueError, match=rf"^scene\.{said}"):
        engine().step(changed(scene, **{field: bad}), state)


def test_slots_that_are_not_active_may_hold_anything():
    scene, state = start()
    unused = changed(
        scene,
        **{"joints.a": holding(scene.joints.a, 99, 1)},
        **{"thrusters.body": holding(scene.thrusters.body, -5, 1)},
        **{"shapes.num_vertices": holding(scene.shapes.num_vertices, 0, 6)},
        **{"shapes.radius": holding(scene.shapes.radius, -1.0, 0)},
    )
    jax.tree.map(np.testing.assert_array_equal, engine().step(unused, state), engine().step(scene, state))


@pytest.mark.also_gpu
def test_indices_of_no_shape_are_off_and_counted_inside_jit():
    scene, state = start()
    step = jax.jit(lambda scene: engine().step(scene, state, controls(motor=1.0, thruster=1.0), num_steps=5))
    bad = changed(
        scene,
        **{"joints.a": holding(scene.joints.a, 2**30, 0)},
        **{"thrusters.body": holding(scene.thrusters.body, -7, 0)},
        **{"shapes.num_vertices": holding(scene.shapes.num_vertices, 5, 0)},
    )
    off = changed(
        scene, **{"joints.active": scene.joints.active & False}, **{"thrusters.active": scene.thrusters.active & False}
    )
    ended, touching = step(bad)
    jax.tree.map(np.testing.assert_array_equal, ended, step(off)[0])
    assert int(touching.invalid_scene) == 3
    assert int(step(scene)[1].invalid_scene) == 0
    assert int(step(changed(scene, **{"joints.b": scene.joints.a}))[1].invalid_scene) == 1


@pytest.mark.also_gpu
@pytest.mark.parametrize("kind", [-1, 3, 4, 7, 2**30])
def test_joints_of_no_kind_are_off_and_counted_inside_jit(kind: int):
    scene, state = start()
    step = jax.jit(lambda scene: engine().step(scene, state, controls(motor=1.0, thruster=1.0), num_steps=5))
    bad = changed(scene, **{"joints.kind": holding(scene.joints.kind, kind, 0)})
    off = changed(scene, **{"joints.active": scene.joints.active & False})
    ended, touching = step(bad)
    jax.tree.map(np.testing.assert_array_equal, ended, step(off)[0])
    assert int(touching.invalid_scene) == 1
    with pytest.raises(ValueError, match=rf"scene\.joints\.kind\[0\] is {kind}; it must be from 0 to 2"):
        engine().step(bad, state)


def test_a_scene_of_jax_arrays_is_checked_once_and_one_that_can_change_every_time():
    scene, state = start()
    fixed = jax.tree.map(jnp.asarray, scene)
    with unittest.mock.patch("jax2d.engine.check_scene") as check:
        for _ in range(3):
            engine().step(fixed, state)
        assert check.call_count == 1
        engine().step(scene, state)
        engine().step(scene, state)
        assert check.call_count == 3
    scene.joints.a[0] = 99
    with pytest.raises(ValueError, match=r"joints\.a"):
        engine().step(scene, state)


def test_error_names_the_world_of_a_batch():
    scene, state = jax.tree.map(lambda x: np.stack([np.asarray(x)] * 3), start())
    bad = changed(scene, **{"shapes.friction": holding(scene.shapes.friction, np.nan, 2, 1)})
    with pytest.raises(ValueError, match=r"scene\.shapes\.friction\[2, 1\] is nan"):
        engine().step(bad, state)


def test_wrong_types_are_refused():
    scene, state = start()
    with pytest.raises(
        ValueError, match=r"scene\.shapes\.friction is float64, but this engine computes in float32; cast it"
    ):
        engine().step(changed(scene, **{"shapes.friction": np.asarray(scene.shapes.friction, np.float64)}), state)
    with pytest.raises(ValueError, match=r"scene\.shapes\.active is float32; it must be bool"):
        engine().step(changed(scene, **{"shapes.active": np.ones(CAPACITY.shapes, np.float32)}), state)
    with pytest.raises(ValueError, match=r"scene\.joints\.a is float32; it must be integer"):
        engine().step(changed(scene, **{"joints.a": np.zeros(CAPACITY.joints, np.float32)}), state)
    with pytest.raises(ValueError, match=r"state\.position is int32; it must be floating-point"):
        engine().step(scene, changed(state, position=np.zeros((CAPACITY.shapes, 2), np.int32)))
    with pytest.raises(ValueError, match=r"controls\.motor is int32; it must be floating-point"):
        engine().step(scene, state, changed(controls(), motor=np.zeros(CAPACITY.joints, np.int32)))


def test_wrong_shapes_are_refused_inside_jit_too():
    scene, state = start()
    wrong = changed(controls(), motor=np.zeros(CAPACITY.joints + 1, np.float32))
    for step in (engine().step, jax.jit(engine().step)):
        with pytest.raises(ValueError, match=r"controls\.motor has shape \(4,\); this engine .* needs \(3,\)"):
            step(scene, state, wrong)
    with pytest.raises(ValueError, match=r"scene\.shapes\.radius has shape \(1,\)"):
        engine().step(changed(scene, **{"shapes.radius": np.ones(1, np.float32)}), state)


@pytest.mark.parametrize(
    ("bad", "said"),
    [
        (controls(motor=1.5), r"controls\.motor\[0\] is 1\.5; it must be from -1 to 1"),
        (controls(motor=np.nan), r"controls\.motor\[0\] is nan"),
        (controls(thruster=-0.5), r"controls\.thruster\[0\] is -0\.5; it must be from 0 to 1"),
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


@pytest.mark.parametrize(
    ("value", "said"),
    [
        (0, "0; a call takes 1 to"),
        (2**31, "2147483648; a call takes 1 to 2147483647 steps"),
        (1.5, "1.5; it must be a whole number"),
        (True, "True; it must be"),
    ],
)
def test_numbers_of_steps_that_are_none_are_refused(value: Any, said: str):
    with pytest.raises(ValueError, match=f"num_steps is {said}"):
        engine().step(*start(), num_steps=value)


def test_number_of_steps_must_be_known_when_a_step_is_compiled():
    with pytest.raises(ValueError, match="num_steps is known inside jit only"):
        jax.jit(lambda number: engine().step(*start(), num_steps=number))(3)


def test_things_of_another_type_are_refused_by_name():
    scene, state = start()
    world = builder().build()
    with pytest.raises(TypeError, match=r"scene is of type BuiltWorld, not Scene; give its \.scene"):
        engine().step(world, state)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="state is of type NoneType, not State"):
        engine().step(scene, None)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="controls is of type ndarray, not Controls"):
        engine().step(scene, state, np.zeros(3))  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"scene\.gravity is of type list; it must be a numpy or JAX array"):
        engine().step(changed(scene, gravity=[0.0, -9.81]), state)
    with pytest.raises(TypeError, match=r"scene is of type Scene, not PackedScene"):
        engine().step_packed(stack_worlds([scene]), state, engine().no_controls(1))  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"state is of type State, not what pack_state of this engine gives"):
        engine().step_packed(engine().pack_scene(stack_worlds([scene])), state, engine().no_controls(1))


def test_batches_that_do_not_fit_each_other_are_refused():
    scene, state = start()
    scenes, states = stack_worlds([scene] * 3), stack_worlds([state] * 2)
    with pytest.raises(ValueError, match=r"^scene has 3 worlds, state 2"):
        engine().step(scenes, states)
    with pytest.raises(ValueError, match=r"scene is a single world, state a batch of 2; .* jax\.vmap with \(None, 0\)"):
        engine().step(scene, states)
    with pytest.raises(ValueError, match=r"state is a single world, scene a batch of 3; .* jax\.vmap with \(0, None\)"):
        engine().step(scenes, state)
    packed, packed_states = engine().pack_scene(scenes), engine().pack_state(states)
    for step in (engine().step_packed, jax.jit(engine().step_packed)):
        with pytest.raises(ValueError, match=r"^scene has 3 worlds, state 2"):
            step(packed, packed_states, engine().no_controls(3))


def test_tables_of_another_engine_are_refused():
    scene, state = jax.tree.map(lambda x: np.asarray(x)[None], start())
    wider = Engine(dataclasses.replace(CAPACITY, joints=CAPACITY.joints + 1))
    packed, packed_state = engine().pack_scene(scene), engine().pack_state(state)
    with pytest.raises(
        ValueError, match=r"^scene was packed by an engine of another capacity or precision: a table is"
    ):
        wider.step_packed(packed, packed_state, wider.no_controls(1))
    reference = Engine(CAPACITY, backend="xla")
    with pytest.raises(TypeError, match=r"^scene is of type SceneTables, not what pack_scene of this engine gives"):
        reference.step_packed(packed, packed_state, reference.no_controls(1))


def test_a_start_that_does_not_fit_its_scene_is_refused():
    scene, _ = start()
    n = CAPACITY.shapes
    with pytest.raises(ValueError, match=rf"position has shape \(3, 2\); a state of this scene needs \({n}, 2\)"):
        engine().initial_state(scene, np.zeros((3, 2)))
    with pytest.raises(ValueError, match=rf"velocity has shape \(2, {n}\); a state of this scene needs \({n}, 2\)"):
        engine().initial_state(scene, np.zeros((n, 2)), velocity=np.zeros((2, n)))
    with pytest.raises(ValueError, match=rf"position has shape \(4, {n}, 2\)"):
        engine().initial_state(scene, np.zeros((4, n, 2)))
    with pytest.raises(ValueError, match=r"^position has text; give numbers$"):
        engine().initial_state(scene, "abc")
    with pytest.raises(ValueError, match=r"^position has parts of 2 different shapes; give them one shape$"):
        engine().initial_state(scene, [[0.0, 0.0], [0.0]])
    other = SceneBuilder(Capacity(polygons=1, circles=0, joints=0, thrusters=0)).build()
    with pytest.raises(ValueError, match=r"scene\.shapes\.active has shape \(1,\); this engine .* needs"):
        engine().initial_state(other.scene, np.zeros((n, 2)))


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"max_speed": -1}, "max_speed is -1; it must be finite and not negative"),
        ({"push_out_speed": np.float32(np.inf)}, "push_out_speed is inf; it must be finite"),
        ({"dt": "0.1"}, "dt is '0.1'; it must be a number"),
        ({"dt": None}, "dt is None; it must be a number"),
        ({"dt": 0}, "dt is 0; a step must take a positive time"),
        ({"max_speed": 0.0}, "max_speed is 0.0; nothing would move"),
        ({"contact_hertz": 0}, "contact_hertz is 0; contacts would hold nothing apart"),
        ({"substeps": 2.5}, "substeps is 2.5; it must be a whole number"),
        ({"substeps": 0}, "substeps is 0; it must be from 1 to 1000"),
        ({"solver": "sequential_impulses", "solver_batch_size": 16.0}, "solver_batch_size is 16.0; it must be a whole"),
        (
            {"substeps": 1},
            "max_angular_speed is 50: a body could turn by 0.83 rad a sub-step .*; lower it to 30, lower dt",
        ),
        (
            {"dt": 1 / 20, "substeps": 16},
            "max_angular_speed is 50: .* and 2.5 rad a step, .*; lower it to 40, lower dt",
        ),
        ({"warm_start": 1}, "warm_start is 1; it must be True or False"),
    ],
)
def test_settings_of_another_kind_are_refused(settings: dict[str, Any], said: str):
    with pytest.raises(ValueError, match=rf"^Settings\.{said}"):
        Settings(**settings)


def test_an_option_that_shapes_do_not_have_is_named():
    builder = SceneBuilder(Capacity(polygons=1, circles=1, joints=0, thrusters=0))
    with pytest.raises(SceneError, match=r"^a shape has no option resttitution; did you mean restitution\?$"):
        builder.add_circle(radius=0.1, resttitution=0.5)  # type: ignore[call-arg]
    with pytest.raises(SceneError, match=r"^a shape has no option colour; options are position, angle"):
        builder.add_box(width=1, height=1, colour="red")  # type: ignore[call-arg]


def test_settings_take_numbers_of_numpy():
    assert Settings(dt=np.float64(1 / 60), substeps=np.int64(4)) == preset("standard")  # type: ignore[arg-type]


ONE_OF_EACH: dict[str, Any] = {"polygons": 1, "circles": 1, "joints": 1, "thrusters": 1}


@pytest.mark.parametrize(
    ("sizes", "said"),
    [
        ({"polygons": 1.5}, "polygons is 1.5; it must be a whole number"),
        ({"joints": "1"}, "joints is '1'; it must be a whole number"),
        ({"thrusters": -1}, "thrusters is -1; it must be 0 or more"),
        ({"vertices": 4.0}, "vertices is 4.0; it must be a whole number"),
        ({"vertices": 9}, "vertices is 9; polygons have 3 to 8 vertices"),
    ],
)
def test_capacities_of_no_whole_numbers_are_refused(sizes: dict[str, Any], said: str):
    with pytest.raises(ValueError, match=rf"^Capacity\.{said}"):
        Capacity(**{**ONE_OF_EACH, **sizes})


def test_worlds_of_different_kinds_are_not_stacked():
    scene, state = start()
    other = SceneBuilder(Capacity(polygons=1, circles=0, joints=0, thrusters=0)).build()
    with pytest.raises(ValueError, match=r"^worlds 0 and 1 are of different capacities; build them with one$"):
        stack_worlds([scene, other.scene])
    with pytest.raises(TypeError, match=r"^world 1 is of type State, world 0 Scene; give one type$"):
        stack_worlds([scene, state])


@pytest.mark.parametrize(
    ("backend", "velocity", "spin"),
    [
        ("warp", (1.0, 0.0), 0.0),
        ("warp", (0.0, -5.0), 0.0),
        ("warp", (0.0, 0.0), 3.0),
        ("xla", (1.0, -5.0), 3.0),
    ],
)
def test_velocity_of_a_fixed_shape_is_refused_outside_jit_and_none_inside(backend: str, velocity: Any, spin: float):
    """The shape stood still and gave its speed to what lay on it, or let it through."""
    capacity = CAPACITY if backend == "warp" else Capacity(polygons=2, circles=0, joints=0, thrusters=0)
    b = SceneBuilder(capacity)
    floor = b.add_box(width=10, height=1, position=(0, -0.5), fixed=True)
    box = b.add_box(width=0.5, height=0.5, position=(0, 0.25))
    # Both presets of the reference load states by the same code, and `paper` compiles in a fifth of the time.
    settings = preset("standard" if backend == "warp" else "paper")
    world, here = b.build(), Engine(capacity, settings=settings, backend=backend)
    state = here.initial_state(*world)
    moved = changed(
        state,
        velocity=jnp.asarray(state.velocity).at[floor].set(np.array(velocity)),
        angular_velocity=jnp.asarray(state.angular_velocity).at[floor].set(spin),
    )
    with pytest.raises(ValueError, match=rf"^state\.(angular_)?velocity\[{floor}\] is .* of a fixed shape; give 0, or"):
        here.step(world.scene, moved)
    jitted = jax.jit(lambda state: here.step(world.scene, state, num_steps=4)[0])
    np.testing.assert_array_equal(jitted(moved).position[box], jitted(state).position[box])
    np.testing.assert_array_equal(jitted(moved).velocity[box], jitted(state).velocity[box])
