"""Arguments that a caller is likely to get wrong: one line that says what to give instead."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from jax2d import Capacity, Engine, SceneBuilder, SceneError, Settings, Trajectory, preset, stack_worlds
from tests.engine.worlds import CAPACITY, builder, engine


def refused(call: Callable[[], Any], message: str, kind: type[Exception] = SceneError) -> None:
    """Literally `message`, within one line."""
    with pytest.raises(kind, match=re.escape(message)) as error:
        call()
    assert "\n" not in str(error.value)


def jointed(**options: Any) -> int:
    b = builder()
    a, c = b.add_box(width=1, height=1), b.add_circle(radius=1)
    return b.add_revolute_joint(a, c, at=(0, 0), **options)


# Builders


@pytest.mark.parametrize("name", ["fixed", "kinematic"])
@pytest.mark.parametrize("value", ["no", np.nan, -1, 1, None])
def test_only_true_and_false_fix_a_shape(name: str, value: Any):
    refused(lambda: builder().add_circle(radius=1, **{name: value}), f"{name} is {value!r}; it must be True or False")


def test_bools_of_numpy_fix_a_shape():
    b = builder()
    shapes = [b.add_circle(radius=1, fixed=np.True_), b.add_circle(radius=1, fixed=np.False_)]
    assert (b.build().scene.shapes.inverse_mass[shapes] == 0).tolist() == [True, False]


@pytest.mark.parametrize("options", [{"motor_power": 3}, {"max_torque": 1}, {"motor_power": 3, "drive": "brake"}])
def test_the_strength_of_no_motor_is_refused(options: dict):
    refused(lambda: jointed(**options), f"{next(iter(options))} without a motor; give its speed=")


def test_a_drive_of_another_type_is_refused():
    refused(lambda: jointed(drive=["servo"], speed=1), "drive is ['servo']; use 'velocity', 'brake', 'servo'")


@pytest.mark.parametrize("base", [0.0, 1e-30])
@pytest.mark.parametrize(
    ("unit", "name", "add"),
    [
        ("base_friction", "friction_coefficient", lambda b: b.add_circle(radius=1, friction_coefficient=0.3)),
        ("base_motor_speed", "speed", lambda b: b.add_revolute_joint(0, 7, at=(0, 0), speed=0.3)),
        ("base_motor_power", "max_torque", lambda b: b.add_revolute_joint(0, 7, at=(0, 0), speed=1, max_torque=0.3)),
        ("base_slider_speed", "speed", lambda b: b.add_prismatic_joint(0, 7, at=(0, 0), axis_angle=0, speed=0.3)),
        ("base_thruster_power", "force", lambda b: b.add_thruster(0, at=(0, 0), angle=0, force=0.3)),
    ],
)
def test_units_without_size_are_named(unit: str, base: float, name: str, add: Callable):
    b = SceneBuilder(CAPACITY, settings=preset("standard").replace(**{unit: base}))
    b.add_box(width=1, height=1)
    b.add_circle(radius=1)
    refused(lambda: add(b), f"{name} is 0.3, but scenes hold it in units of Settings.{unit}, {base:g}; raise that")


def test_numbers_beyond_all_floats_are_refused():
    huge = 10**400
    refused(lambda: builder().add_circle(radius=huge), "radius is inf; give a finite number")
    refused(lambda: builder().add_circle(radius=-huge), "radius is -inf; give a finite number")
    refused(lambda: builder().add_circle(radius=1, position=(0, huge)), "give 2 finite numbers")
    refused(lambda: builder().add_polygon([(0, 0), (huge, 0), (0, 1)]), "vertices are no list of (x, y) points")
    refused(lambda: builder().add_terrain([(0, 0), (huge, 0)]), "give a list of two or more (x, y) points")
    refused(lambda: Settings(dt=huge), "it must be finite and not negative", ValueError)


# Engines


@pytest.mark.parametrize("kind", [Engine, SceneBuilder])
def test_a_capacity_is_needed(kind: Any):
    refused(lambda: kind(None), "capacity is of type NoneType, not Capacity; give one", TypeError)


@pytest.mark.parametrize("kind", [Engine, SceneBuilder])
def test_the_name_of_a_preset_is_no_settings(kind: Any):
    refused(
        lambda: kind(CAPACITY, settings="fine"),
        "settings is 'fine', not Settings; give settings=preset('fine')",
        TypeError,
    )
    refused(lambda: kind(CAPACITY, settings={}), "settings is {}, not Settings; give settings=preset(", TypeError)


@pytest.mark.parametrize("backend", [None, "cpu", ["warp"], 3])
def test_backends_that_are_none_are_refused(backend: Any):
    refused(
        lambda: Engine(CAPACITY, backend=backend),
        f"unknown engine backend {backend!r}; known backends: warp, xla",
        ValueError,
    )


def test_names_of_effects_and_presets_that_are_none_are_refused():
    wanted: Any = "all"
    refused(
        lambda: Engine(CAPACITY, effects=wanted),
        "effects is of type str, not Effects; give effects_of(scenes), or leave it out",
        TypeError,
    )
    name: Any = []
    refused(lambda: preset(name), "unknown preset []; known presets: draft, fine", ValueError)


def test_no_worlds_make_no_batch():
    refused(lambda: stack_worlds([]), "stack_worlds has no worlds to stack", ValueError)


def test_a_start_has_real_positions():
    scene = builder().build().scene
    nowhere: Any = None
    refused(lambda: engine().initial_state(scene, nowhere), "position is None; give one point for each", ValueError)
    positions = np.zeros((CAPACITY.shapes, 2))
    for given in (positions + 1j, jnp.asarray(positions + 1j), (positions + 1j).tolist()):
        refused(lambda x=given: engine().initial_state(scene, x), "position has complex numbers", ValueError)
    refused(
        lambda: engine().initial_state(scene, positions, velocity=positions + 1j),
        "velocity has complex numbers",
        ValueError,
    )


@pytest.mark.parametrize("two", [jnp.int32(2), np.int64(2), np.array(2)])
def test_numbers_of_steps_are_whole_numbers_of_any_kind(two: Any):
    b = builder()
    b.add_circle(radius=1, velocity=(1, 0))
    world = b.build()
    start = engine().initial_state(*world)
    ended, _ = engine().step(world.scene, start, num_steps=two)
    expected, _ = engine().step(world.scene, start, num_steps=2)
    np.testing.assert_array_equal(ended.position, expected.position)


# Trajectories


def still() -> Trajectory:
    """A ball that lies still, two samples."""
    b = SceneBuilder(Capacity(polygons=0, circles=1, joints=0, thrusters=0))
    b.add_circle(radius=1)
    scene, position, *_ = b.build()
    positions, rest = np.tile(position, (2, 1, 1)).astype(float), np.zeros((2, 1))
    return Trajectory(
        scene=scene, interval=0.1, position=positions, angle=rest, velocity=0 * positions, angular_velocity=rest
    )


@pytest.mark.parametrize(
    "view", [(0, 0, 0, 0), (1, 1, 0, 0), (0, 1, 1, 0), (np.nan, 0, 1, 1), (0, 0, np.inf, 1), (0, 1), 3, "all"]
)
def test_views_of_nothing_are_refused(view: Any, tmp_path):
    refused(
        lambda: still().draw(tmp_path / "run.png", view=view),
        f"view is {view}; give lowest x, lowest y, highest x, highest y in m",
        ValueError,
    )


def test_files_with_little_in_them_are_refused(tmp_path):
    path = tmp_path / "run.npz"
    still().save(path)
    with np.load(path) as file:
        arrays = dict(file)
    without_gravity = {name: x for name, x in arrays.items() if name != "scene.gravity"}
    for stored in ({"format": arrays["format"]}, without_gravity, arrays | {"colour": np.zeros(2)}):
        np.savez(path, **stored)
        refused(lambda: Trajectory.load(path), "run.npz is no file that Trajectory.save wrote", ValueError)


@pytest.mark.parametrize("seconds", [-1, np.nan])
def test_times_before_the_start_are_refused(seconds: float):
    refused(lambda: still().until(seconds), f"seconds is {seconds}; give 0 or more", ValueError)


def test_times_after_the_end_are_the_end():
    assert still().until(np.inf).num_intervals == still().until(9).num_intervals == 1
    assert still().until(0).num_intervals == 0


def test_one_world_has_no_worlds():
    refused(lambda: still().world(0), "the trajectory is of one world, not of a batch; use it as it is", ValueError)
