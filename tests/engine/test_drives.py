"""Motors by what drives them, velocity, brake and servo, and in the units of an engineer: motions with a formula,
what is refused. test_follows_float64.py has the reference and momentum."""

from __future__ import annotations

import functools
import math

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
    preset,
)
from jax2d.fidelity import Trajectory, record

CAPACITY = Capacity(polygons=3, circles=1, joints=2, thrusters=1)
G = 9.81
STANDARD = preset("standard")
WEIGHT = 5 * 0.1 * G  # N, of the arm
NEEDED = WEIGHT * 0.5  # N m, that holds it level
INERTIA = 0.5 * (1 + 0.01) / 12 + 0.5 * 0.25  # kg m^2 about its end, of 0.5 kg


@functools.cache
def engine(dt: float = STANDARD.dt) -> Engine:
    return Engine(CAPACITY, settings=STANDARD.replace(dt=dt))


def motion(world: BuiltWorld, control: float, seconds: float, dt: float = STANDARD.dt) -> Trajectory:
    one = engine(dt)
    controls = Controls(motor=np.full(2, control, np.float32), thruster=np.full(1, abs(control), np.float32))
    steps = round(seconds / dt)
    return record(one, world.scene, one.initial_state(*world), controls, num_samples=steps)[0]


def arm(gravity: float = G, angle: float = 0.0, **motor: object) -> tuple[BuiltWorld, int]:
    """A bar of 0.5 kg and 1 m that turns about its end on a fixed base; level at angle 0."""
    b = SceneBuilder(CAPACITY, gravity=(0, -gravity))
    base = b.add_box(width=0.2, height=0.2, fixed=True)
    middle = (0.5 * math.cos(angle), 0.5 * math.sin(angle))
    bar = b.add_box(width=1, height=0.1, position=middle, angle=angle, density=5)
    b.add_revolute_joint(base, bar, at=(0, 0), **motor)  # type: ignore[arg-type]
    return b.build(), bar


def lift(gravity: float = G, **motor: object) -> tuple[BuiltWorld, int]:
    """A box of 2 kg that slides straight up beside a fixed base."""
    b = SceneBuilder(CAPACITY, gravity=(0, -gravity))
    base = b.add_box(width=0.2, height=0.2, fixed=True)
    box = b.add_box(width=0.5, height=0.4, position=(0.5, 1), density=10)
    b.add_prismatic_joint(base, box, at=(0.5, 1), axis_angle=math.pi / 2, **motor)  # type: ignore[arg-type]
    return b.build(), box


# Units


def test_motor_accelerates_a_wheel_by_torque_over_inertia_up_to_its_speed():
    b = SceneBuilder(CAPACITY, gravity=(0, 0))
    base = b.add_box(width=0.2, height=0.2, fixed=True)
    wheel = b.add_circle(radius=0.4, density=3)
    b.add_revolute_joint(base, wheel, at=(0, 0), speed=5.0, max_torque=0.6)
    inertia = 3 * math.pi * 0.4**4 / 2
    spin = motion(b.build(), 1.0, 2.0).angular_velocity[:, wheel]
    assert spin[30] == pytest.approx(0.6 / inertia * 0.5, rel=1e-4)
    assert spin[-1] == pytest.approx(5.0, rel=1e-5)


def test_torque_of_a_free_pair_is_that_on_each_of_the_two():
    b = SceneBuilder(CAPACITY, gravity=(0, 0))
    one, other = b.add_box(width=1, height=0.5, density=2), b.add_circle(radius=0.3, density=4)
    b.add_revolute_joint(one, other, at=(0, 0), speed=100.0, max_torque=0.5)
    spin = motion(b.build(), 1.0, 0.2).angular_velocity[-1]
    assert spin[one] == pytest.approx(-0.5 * 0.2 / (1.0 * (1 + 0.25) / 12), rel=1e-4)
    assert spin[other] == pytest.approx(0.5 * 0.2 / (4 * math.pi * 0.3**4 / 2), rel=1e-4)


@pytest.mark.parametrize("share", [0.3, 0.8])
def test_motor_stalls_where_the_weight_needs_its_torque(share: float):
    """tau = m g l sin theta, theta from hanging down; it swings about that by 0.013 rad, at 1.6 s a time."""
    world, bar = arm(angle=-math.pi / 2, speed=0.05, max_torque=share * NEEDED)
    end = motion(world, 1.0, 35.0).angle[-600:, bar].mean() + math.pi / 2
    assert math.sin(end) == pytest.approx(share, abs=0.003)


@pytest.mark.parametrize("force", [25.0, 15.0])
def test_slider_rises_or_sinks_by_what_its_force_has_over_the_weight(force: float):
    world, box = lift(speed=100.0, max_force=force)
    rise = motion(world, 1.0, 0.5).velocity[-1, box, 1]
    assert rise == pytest.approx((force / 2.0 - G) * 0.5, rel=1e-4)


def test_force_of_a_slider_beside_the_centre_counts_what_turns_too():
    """Free, pushed apart along a line 0.3 m beside the centre of one of the two, which can turn."""
    b = SceneBuilder(CAPACITY, gravity=(0, 0))
    one = b.add_box(width=1, height=1, density=2)
    other = b.add_box(width=0.2, height=0.2, position=(2, 0.3), density=50)
    b.add_prismatic_joint(one, other, at=(2, 0.3), axis_angle=0.0, speed=100.0, max_force=4.0)
    momentum = motion(b.build(), 1.0, 1 / 60).velocity[-1, :, 0] * np.array([2.0, 2.0, 0, 0])
    assert momentum[[one, other]] == pytest.approx(np.array([-4, 4]) / 60, rel=1e-3)


def test_thruster_pushes_with_its_force():
    b = SceneBuilder(CAPACITY, gravity=(0, 0))
    box = b.add_box(width=1, height=0.5, density=4)
    b.add_thruster(box, at=(0, 0), angle=0.5, force=3.0)
    velocity = motion(b.build(), 1.0, 1.0).velocity[-1, box]
    assert velocity == pytest.approx([1.5 * math.cos(0.5), 1.5 * math.sin(0.5)], rel=1e-4)


def test_other_units_of_an_engine_keep_torques_and_speeds():
    settings = STANDARD.replace(base_motor_power=10.0, base_motor_speed=0.5, base_thruster_power=7.0)
    scenes = []
    for of in (STANDARD, settings):
        b = SceneBuilder(CAPACITY, settings=of)
        base, wheel = b.add_box(width=0.2, height=0.2, fixed=True), b.add_circle(radius=0.4)
        b.add_revolute_joint(base, wheel, at=(0, 0), speed=5.0, max_torque=0.6)
        b.add_thruster(wheel, at=(0, 0), angle=0, force=2)
        scenes.append(b.build().scene)
    one, other = scenes
    assert other.joints.motor_speed[0] == pytest.approx(one.joints.motor_speed[0] * 12)
    assert other.joints.motor_power[0] == pytest.approx(one.joints.motor_power[0] * 90)
    assert other.thrusters.power[0] == pytest.approx(2 / 7)


# Brakes


@pytest.mark.parametrize("load", [0.5, 0.98])
def test_brake_holds_its_load_for_a_minute_without_creep(load: float):
    for (world, body), axis in ((arm(speed=1.0, max_torque=NEEDED / load, drive="brake"), "angle"),):
        m = motion(world, 0.0, 60.0)
        angle = getattr(m, axis)[:, body]
        assert abs(angle[60]) < 3e-4  # settled: the hinge has given way by 0.1 mm
        assert np.abs(angle[60:] - angle[60]).max() < 1e-7
    world, box = lift(speed=1.0, max_force=2 * G / load, drive="brake")
    height = motion(world, 0.0, 60.0).position[:, box, 1]
    assert np.abs(height - height[0]).max() < 1e-6


def test_brake_that_is_too_weak_slips_by_what_is_left():
    world, bar = arm(speed=1.0, max_torque=0.5 * NEEDED, drive="brake")
    assert motion(world, 0.0, 0.1).angular_velocity[-1, bar] == pytest.approx(-0.5 * NEEDED / INERTIA * 0.1, rel=0.01)


def test_velocity_drive_exerts_nothing_at_control_0_and_a_brake_drives_as_it_does_at_others():
    world, bar = arm(speed=1.0, max_torque=50.0)
    assert motion(world, 0.0, 0.05).angular_velocity[-1, bar] == pytest.approx(-NEEDED / INERTIA * 0.05, rel=0.01)
    world, bar = arm(speed=1.0, max_torque=50.0, drive="brake")
    assert motion(world, 0.4, 0.5).angular_velocity[-1, bar] == pytest.approx(0.4, rel=1e-3)


# Servos

LIMITS = (-1.0, 1.4)  # rad or m: control -1 and 1


@pytest.mark.parametrize("dt", [1 / 30, 1 / 60, 1 / 240])
@pytest.mark.parametrize("control", [1.0, 0.5, -0.7])
@pytest.mark.parametrize("gravity", [0.0, G])
def test_servo_arrives_when_its_speed_says_and_does_not_overshoot(dt: float, control: float, gravity: float):
    world, bar = arm(gravity, speed=0.8, max_torque=20.0, drive="servo", limits=LIMITS)
    m = motion(world, control, 3.0, dt)
    wanted = 0.2 + 1.2 * control
    angle, way = m.angle[:, bar] * np.sign(wanted), abs(wanted)
    assert angle.max() < way + 1e-5
    assert angle[-1] == pytest.approx(way, abs=1e-5)
    arrival = m.time[np.argmax(angle > way - 1e-3)]
    # Slowing down by half of torque / inertia takes speed^2 / (2 of that) more, and finding it out a step.
    assert arrival == pytest.approx(way / 0.8, abs=0.8 / (0.5 * 20 / INERTIA) + 1.5 * dt)
    assert np.abs(m.angular_velocity[:, bar]).max() < 0.8 * 1.05  # the hinge gives way at the start


@pytest.mark.parametrize("dt", [1 / 30, 1 / 120])
def test_servo_of_a_slider_goes_to_its_place_under_load(dt: float):
    world, box = lift(speed=0.5, max_force=40.0, drive="servo", limits=LIMITS)
    m = motion(world, 0.9, 4.0, dt)
    rise, wanted = m.position[:, box, 1] - 1.0, 0.2 + 1.2 * 0.9
    assert rise.max() < wanted + 1e-5 and rise[-1] == pytest.approx(wanted, abs=1e-5)
    assert m.time[np.argmax(rise > wanted - 1e-3)] == pytest.approx(wanted / 0.5, abs=0.05 + 1.5 * dt)


def test_servo_holds_its_angle_against_the_weight_and_sags_where_it_is_too_weak():
    world, bar = arm(speed=1.0, max_torque=1.05 * NEEDED, drive="servo", limits=LIMITS)
    assert motion(world, -1 / 6, 5.0).angle[-1, bar] == pytest.approx(0.0, abs=1e-5)
    world, bar = arm(angle=-1.0, speed=0.05, max_torque=0.8 * NEEDED, drive="servo", limits=(0.0, 2.0))
    assert math.cos(motion(world, 0.0, 35.0).angle[-600:, bar].mean()) == pytest.approx(0.8, abs=0.005)


def test_negative_speed_turns_a_servo_round():
    (one, bar), (other, _) = (arm(0.0, speed=v, max_torque=20, drive="servo", limits=LIMITS) for v in (0.8, -0.8))
    assert motion(one, 0.5, 2.0).angle[-1, bar] == pytest.approx(0.8, abs=1e-5)
    assert motion(other, 0.5, 2.0).angle[-1, bar] == pytest.approx(-0.4, abs=1e-5)


# Effects


def test_velocity_motors_call_for_less_and_an_engine_for_the_effect_gives_the_same_bits():
    servo, _ = arm(speed=0.8, max_torque=20.0, drive="servo", limits=LIMITS)
    plain, _ = arm(speed=0.8, max_torque=20.0, limits=LIMITS)
    assert effects_of(servo.scene).brakes_and_servos and not effects_of(plain.scene).brakes_and_servos
    special = Engine(CAPACITY, effects=effects_of(servo.scene))
    controls = Controls(motor=np.ones(2, np.float32), thruster=np.zeros(1, np.float32))
    one, other = (e.step(servo.scene, e.initial_state(*servo), controls, 60)[0] for e in (special, engine()))
    for x, y in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(x, y)
    for lacking in (
        Engine(CAPACITY, settings=preset("paper")),
        Engine(CAPACITY, effects=Effects.full(CAPACITY).without("brakes_and_servos")),
    ):
        with pytest.raises(MissingEffectError, match="brakes_and_servos"):
            lacking.step(servo.scene, lacking.initial_state(*servo))


# What is refused


@pytest.mark.parametrize(
    ("motor", "message"),
    [
        ({"speed": 1.0, "drive": "servo"}, "a servo without limits has no positions"),
        ({"speed": 1.0, "motor_speed": 1.0}, "motor_speed and speed are both given"),
        ({"speed": 1.0, "max_torque": 1.0, "motor_power": 1.0}, "motor_power and max_torque are both given"),
        ({"max_torque": 1.0}, "max_torque without a motor; give its speed="),
        ({"drive": "brake"}, "drive 'brake' without a motor"),
        ({"speed": 1.0, "drive": "step"}, "drive is 'step'; use 'velocity', 'brake', 'servo'"),
        ({"speed": 1.0, "max_torque": -1.0}, "max_torque is -1; it must be positive"),
        ({"speed": math.nan}, "speed is nan; give a finite number"),
    ],
)
def test_motor_that_contradicts_itself_is_refused(motor: dict[str, object], message: str):
    with pytest.raises(SceneError, match=message):
        arm(**motor)  # type: ignore[arg-type]


def test_thruster_of_two_strengths_is_refused():
    b = SceneBuilder(CAPACITY)
    box = b.add_box(width=1, height=1)
    with pytest.raises(SceneError, match="power and force are both given"):
        b.add_thruster(box, at=(0, 0), angle=0, power=1, force=1)


def test_scene_of_a_servo_without_limits_or_of_an_unknown_drive_is_refused():
    world, _ = arm(speed=1.0, max_torque=1.0, drive="servo", limits=LIMITS)
    state = engine().initial_state(*world)
    none = np.zeros(2, bool)
    with pytest.raises(ValueError, match=r"joints.has_limits\[0\] is False; it must be True: a servo without limits"):
        engine().step(world.scene.replace(joints={"has_limits": none}), state)
    with pytest.raises(ValueError, match=r"scene.joints.drive\[0\] is 3; it must be from 0 to 2"):
        engine().step(world.scene.replace(joints={"drive": np.array([3, 0], np.int32)}), state)
