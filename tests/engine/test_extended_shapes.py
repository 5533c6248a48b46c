"""Surface speed, damping, rolling resistance and outside forces: formulas, momentum, the reference, the effects."""

from __future__ import annotations

import functools
import math
from typing import Any

import jax
import numpy as np
import pytest

from jax2d import (
    BuiltWorld,
    Capacity,
    Controls,
    Effects,
    Engine,
    MissingEffectError,
    SceneBuilder,
    SceneError,
    effects_of,
    measure,
    preset,
)
from jax2d.builder_options import BodyKeywords, MaterialKeywords
from jax2d.effects import EXTENDED
from jax2d.fidelity import Trajectory, record
from jax2d.warp.memory import table_bytes

pytestmark = pytest.mark.also_gpu

PLAIN = Capacity(polygons=3, circles=1, joints=1, thrusters=0)
CAPACITY = Capacity(polygons=3, circles=1, joints=1, thrusters=0, extended_shapes=True)
G = 9.81
STANDARD = preset("standard")
H = STANDARD.substep_seconds
MU = STANDARD.base_friction  # of two shapes of friction 1


@functools.cache
def engine() -> Engine:
    return Engine(CAPACITY)


def builder(gravity: tuple[float, float] = (0.0, -G)) -> SceneBuilder:
    return SceneBuilder(CAPACITY, gravity=gravity)


def floor(b: SceneBuilder, **options: Any) -> int:
    """Its top is y = 0."""
    return b.add_box(width=60, height=1, position=(0, -0.5), fixed=True, **options)


def controls_of(shape: int, force: tuple[float, float], torque: float) -> Controls:
    controls = jax.tree.map(np.array, engine().no_controls())
    controls.force[shape], controls.torque[shape] = force, torque
    return controls


def follow(world: BuiltWorld, seconds: float, controls: Controls | None = None) -> Trajectory:
    state = engine().initial_state(*world)
    return record(engine(), world.scene, state, controls, num_samples=round(60 * seconds))[0]


# Surface speed


@pytest.mark.parametrize("speed", [2.0, -1.0])
def test_box_on_a_belt_reaches_its_speed(speed: float):
    b = builder()
    floor(b, surface_speed=speed)
    box = b.add_box(width=0.5, height=0.5, position=(0, 0.25))
    path = follow(b.build(), 1.0)
    v = path.velocity[:, box, 0] / speed
    assert v[-1] == pytest.approx(1.0, abs=1e-5)
    assert np.argmax(v > 0.9999) == pytest.approx(60 * abs(speed) / (MU * G), abs=1.5)
    # Semi-implicit Euler slides v h / 2 less.
    slipped = abs(speed) - abs(path.position[-1, box, 0])
    assert slipped == pytest.approx(speed**2 / (2 * MU * G) - abs(speed) * H / 2, rel=2e-3)


def test_disc_that_bounces_on_a_belt_gets_what_friction_gives():
    """mu (1 + e) u along the belt and twice that over r of spin: the belt's work, which no limit of energy takes."""
    b = builder()
    floor(b, surface_speed=50.0, restitution=1.0)
    disc = b.add_circle(radius=0.2, position=(0, 1.2), restitution=0.8)
    path = follow(b.build(), 0.6)
    u = math.sqrt(2 * G * 1.0)
    pushed = MU * 1.8 * u
    assert path.velocity[-1, disc, 0] == pytest.approx(pushed, rel=0.01)
    assert path.angular_velocity[-1, disc] == pytest.approx(2 * pushed / 0.2, rel=0.01)
    assert path.position[-1, disc, 1] - 0.2 == pytest.approx(
        0.8 * u * (0.6 - u / G) - G / 2 * (0.6 - u / G) ** 2, abs=0.02
    )


def test_belt_around_a_body_drives_it_and_pushes_the_ground_back():
    """A tracked vehicle: its underside runs towards +x, against the floor, so that it goes towards -x."""
    b = builder()
    floor(b)
    car = b.add_box(width=1, height=0.4, position=(0, 0.2), surface_speed=-1.5)
    assert follow(b.build(), 1.0).velocity[-1, car] == pytest.approx([-1.5, 0], abs=1e-3)


# Damping


def test_damping_is_implicit_euler():
    b = builder((0.0, 0.0))
    box = b.add_box(width=0.5, height=0.5, velocity=(3, 1), angular_velocity=4, linear_damping=0.8, angular_damping=2.0)
    path = follow(b.build(), 1.0)
    linear, angular = (1 + 0.8 * H) ** -240, (1 + 2.0 * H) ** -240
    assert path.velocity[-1, box] == pytest.approx([3 * linear, linear], rel=1e-4)
    assert path.angular_velocity[-1, box] == pytest.approx(4 * angular, rel=1e-4)
    assert (linear, angular) == pytest.approx((math.exp(-0.8), math.exp(-2.0)), rel=0.01)


@pytest.mark.parametrize("damping", [4.0, 1e9])
def test_fall_ends_at_g_over_damping_however_stiff(damping: float):
    b = builder()
    box = b.add_box(width=0.5, height=0.5, velocity=(9, 0), linear_damping=damping)
    assert follow(b.build(), 5.0).velocity[-1, box] == pytest.approx([0, -G / damping], rel=1e-3, abs=1e-6)


# Rolling resistance


@pytest.mark.parametrize("of_the_disc", [True, False])
def test_rolling_disc_stops_after_three_quarters_of_v_squared_over_c_g(of_the_disc: bool):
    """m v' = -F, I w' = F r - c N r: both together (m + m / 2) v' = -c m g."""
    share, speed, radius = 0.1, 2.0, 0.3
    shares: tuple[MaterialKeywords, ...] = (
        {"rolling_resistance": share},
        {"rolling_resistance": share / 3},
    )  # the larger one counts
    b = builder()
    floor(b, **shares[of_the_disc])
    options: BodyKeywords = {"velocity": (speed, 0), "angular_velocity": -speed / radius, **shares[not of_the_disc]}
    disc = b.add_circle(radius=radius, position=(0, radius), **options)
    path = follow(b.build(), 3.5)
    assert path.position[-1, disc, 0] == pytest.approx(3 * speed**2 / (4 * share * G), rel=0.01)
    assert np.argmax(path.velocity[:, disc, 0] < 1e-3) / 60 == pytest.approx(3 * speed / (2 * share * G), rel=0.01)
    assert path.velocity[-1, disc] == pytest.approx([0, 0], abs=1e-5)


def test_disc_stays_on_a_slope_below_its_resistance_and_rolls_on_a_steeper_one():
    share = 0.1
    for slope in (0.09, 0.15):
        b = builder((G * math.sin(slope), -G * math.cos(slope)))
        floor(b)
        disc = b.add_circle(radius=0.3, position=(0, 0.3), rolling_resistance=share)
        a = max(0.0, 2 / 3 * G * (math.sin(slope) - share * math.cos(slope)))
        assert follow(b.build(), 3.0).position[-1, disc, 0] == pytest.approx(a * 9 / 2, rel=0.02, abs=2e-4)


def test_belts_and_rolling_keep_the_momentum_of_two_free_bodies():
    b = builder((0.0, 0.0))
    b.add_box(width=1, height=0.4, position=(0, 0), surface_speed=1.0, velocity=(0.1, 1), angular_velocity=0.5)
    b.add_circle(radius=0.3, position=(0.1, 0.6), rolling_resistance=0.3, angular_velocity=6.0, velocity=(0, -3))
    world = b.build()
    path = follow(world, 1.0)
    assert np.ptp(path.angular_velocity[:, CAPACITY.polygons]) > 1  # they have met
    for total in (path.momentum(), path.angular_momentum()):
        np.testing.assert_allclose(total, np.broadcast_to(total[:1], total.shape), atol=2e-5)


# Forces


def test_force_and_torque_accelerate_by_mass_and_inertia():
    b = builder((0.0, 0.0))
    box = b.add_box(width=1, height=2, density=1.5)
    path = follow(b.build(), 1.0, controls_of(box, (6.0, -3.0), 5.0))
    assert path.velocity[-1, box] == pytest.approx([2.0, -1.0], rel=1e-4)
    assert path.angular_velocity[-1, box] == pytest.approx(5 / (3 * (1 + 4) / 12), rel=1e-4)


def test_wind_blows_a_bouncing_disc_aside_without_losing_what_it_adds():
    b = builder()
    floor(b, restitution=1.0, friction=0.0)
    disc = b.add_circle(radius=0.2, position=(0, 0.7), restitution=1.0)
    world = b.build()
    path = follow(world, 1.0, controls_of(disc, (3.0, 0.0), 0.0))
    mass = math.pi * 0.04
    assert path.velocity[-1, disc, 0] == pytest.approx(3.0 / mass, rel=1e-3)
    assert path.position[:, disc, 1].max() == pytest.approx(0.7, abs=2e-3)


def test_forces_that_are_none_of_the_kind_are_refused_or_counted():
    b = builder()
    box = b.add_box(width=1, height=1)
    world = b.build()
    state = engine().initial_state(*world)
    bad = controls_of(box, (math.nan, 1e12), -math.inf)
    with pytest.raises(ValueError, match=r"controls\.force\[0, 0\] is nan; it must be from -1e\+09 to 1e\+09"):
        engine().step(world.scene, state, bad)
    step = jax.jit(lambda controls: engine().step(world.scene, state, controls))
    end, touching = step(bad)
    assert int(touching.invalid_controls) == 3
    assert np.isfinite(end.velocity).all()
    assert int(step(controls_of(box, (1.0, 1.0), 1.0))[1].invalid_controls) == 0
    with pytest.raises(ValueError, match=r"controls\.torque has shape \(2,\); this engine .* needs \(4,\)"):
        engine().step(
            world.scene, state, Controls(motor=bad.motor, thruster=bad.thruster, torque=np.zeros(2, np.float32))
        )


# The effects and the memory


def everything(capacity: Capacity, **left_out: Any) -> BuiltWorld:
    """A disc that rolls on a kinematic belt, a damped box that slides and bounces on it, a rod that hangs from it."""

    def options(**values: Any) -> dict[str, Any]:
        return {name: values[name] for name in values if name not in left_out}

    b = SceneBuilder(capacity)
    belt = options(kinematic=True, velocity=(0.3, 1.0), angular_velocity=0.2, restitution=0.7, surface_speed=1.5)
    carrier = b.add_box(width=6, height=0.2, position=(0, -0.1), **belt)
    damped = options(linear_damping=0.5, angular_damping=1.0, restitution=0.7)
    b.add_box(width=0.4, height=0.4, position=(1.0, 0.4), velocity=(0.5, -2), **damped)
    rod = b.add_box(width=1, height=0.1, position=(-3.2, 0.3))
    b.add_circle(radius=0.2, position=(-1.0, 0.25), velocity=(0, 1.0), **options(rolling_resistance=0.2))
    b.add_revolute_joint(carrier, rod, at=(-2.7, 0.3))
    return b.build()


def steps(one: Engine, world: BuiltWorld) -> Any:
    return one.step(world.scene, one.initial_state(*world), num_steps=30)


def same_bits(a: Any, b: Any, *names: str) -> None:
    for name in names:
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


@pytest.mark.long
def test_engine_for_the_effects_of_a_scene_gives_the_bits_of_the_full_one():
    moving = ("position", "angle", "velocity", "angular_velocity", "contact_key", "contact_impulse")
    for left_out in ({"surface_speed"}, {"rolling_resistance", "linear_damping", "angular_damping"}):
        world = everything(CAPACITY, **dict.fromkeys(left_out))
        effects = effects_of(world.scene)
        gone = [name for name in EXTENDED if not getattr(effects, name)]
        assert gone == [name for name in EXTENDED if name in left_out or (name == "damping" and len(left_out) > 1)]
        same_bits(
            steps(Engine(CAPACITY, effects=effects), world)[0], steps(engine(), world)[0], *moving, "rolling_impulse"
        )
    none = dict.fromkeys(("surface_speed", "rolling_resistance", "linear_damping", "angular_damping"))
    plain = steps(Engine(PLAIN), everything(PLAIN, **none))[0]
    same_bits(plain, steps(engine(), everything(CAPACITY, **none))[0], *moving)


def test_capacity_without_extended_shapes_has_no_room_for_them():
    b = SceneBuilder(PLAIN)
    with pytest.raises(SceneError, match=r"surface_speed is 2, but .* build with Capacity\(extended_shapes=True\)"):
        b.add_box(width=1, height=1, surface_speed=2.0)
    assert not any(getattr(Effects.full(PLAIN), name) for name in EXTENDED)
    more = {
        name: table_bytes(CAPACITY)[name] - table_bytes(PLAIN)[name] for name in ("scene", "controls", "state", "out")
    }
    n = CAPACITY.shapes
    assert more == {"scene": 16 * n, "controls": 12 * n, "state": 4 * CAPACITY.contact_slots, "out": 0}
    controls = Controls(motor=np.zeros(1, np.float32), thruster=np.zeros(0, np.float32), torque=np.zeros(n, np.float32))
    world = b.build()
    one = Engine(PLAIN)
    with pytest.raises(ValueError, match=r"controls\.torque has shape \(4,\); .* needs \(0,\)"):
        one.step(world.scene, one.initial_state(*world), controls)


def test_what_is_missing_or_makes_no_sense_is_refused():
    world = everything(CAPACITY)
    lacking = Engine(CAPACITY, effects=Effects.full(CAPACITY).without("damping"))
    with pytest.raises(MissingEffectError, match="calls for damping"):
        lacking.step(world.scene, lacking.initial_state(*world))
    with pytest.raises(ValueError, match=r"extended_shapes is True, but solver .* \(preset paper\)"):
        Engine(CAPACITY, settings=preset("paper"))
    with pytest.raises(ValueError, match="extended_shapes is 1; it must be True or False"):
        Capacity(polygons=1, circles=0, joints=0, thrusters=0, extended_shapes=1)  # type: ignore[arg-type]
    b = builder()
    refused: tuple[tuple[BodyKeywords, str], ...] = (
        ({"linear_damping": -1.0}, "linear_damping is -1; it must be 0 or more"),
        ({"rolling_resistance": math.nan}, "rolling_resistance is nan; give a finite number"),
        ({"angular_damping": 1.0, "fixed": True}, "angular_damping of a shape that is fixed or kinematic"),
    )
    for options, said in refused:
        with pytest.raises(SceneError, match=said):
            b.add_circle(radius=1, **options)
    damping = world.scene.shapes.linear_damping.copy()
    damping[1] = -1
    bad = world.scene.replace(shapes={"linear_damping": damping})
    with pytest.raises(ValueError, match=r"scene\.shapes\.linear_damping\[1\] is -1\.0; it must be 0 or more"):
        engine().step(bad, engine().initial_state(*world))
    assert float(measure.kinetic_energy(world.scene, engine().initial_state(*world))) > 0
