"""Angles of what turns for long: within half a turn, exact for hours, and joints that do not notice."""

from __future__ import annotations

import functools
import math

import jax
import numpy as np
import pytest

from jax2d import BuiltWorld, Capacity, Controls, Engine, SceneBuilder, State, preset
from jax2d.fidelity import record

CAPACITY = Capacity(polygons=2, circles=1, joints=1, thrusters=0)
STANDARD = preset("standard")


@functools.cache
def engine(name: str = "standard") -> Engine:
    return Engine(CAPACITY, settings=preset(name))


def wheel(angular_velocity: float, angle: float = 0.0, capacity: Capacity = CAPACITY) -> BuiltWorld:
    b = SceneBuilder(capacity, gravity=(0, 0))
    b.add_circle(radius=0.3, angle=angle, angular_velocity=angular_velocity)
    return b.build()


def after(world: BuiltWorld, steps: int, motor: float = 0.0, name: str = "standard") -> State:
    controls = Controls(motor=np.full(1, motor, np.float32), thruster=np.zeros(0, np.float32))
    one = engine(name)
    return jax.device_get(one.step(world.scene, one.initial_state(*world), controls, steps)[0])


WHEEL = CAPACITY.polygons


@pytest.mark.parametrize("speed", [50.0, -37.3])
def test_wheel_that_turns_for_an_hour_is_where_float64_says(speed: float):
    end = after(wheel(speed), 60 * 3600)
    assert end.angular_velocity[WHEEL] == np.float32(speed)
    one_step = float(after(wheel(speed), 1).angle[WHEEL])  # speed x dt as float32 rounds it
    exact = 60 * 3600 * one_step
    assert abs(exact) > 1.3e5  # where float32 is 0.016 rad coarse: each sum would be rounded by up to 0.008
    assert abs(end.angle[WHEEL]) <= np.float32(math.pi)
    # 216,000 sums are each rounded by 1e-7 at most, mostly to the same side, since the same is added in each.
    assert math.remainder(float(end.angle[WHEEL]) - exact, math.tau) == pytest.approx(0, abs=0.01)


def test_paper_counts_turns_as_its_appendix_does():
    assert after(wheel(10.0), 120, name="paper").angle[WHEEL] == pytest.approx(20.0, abs=1e-4)


def test_recorded_angles_count_turns_also_between_sparse_samples():
    world, one = wheel(40.0), engine()
    trajectory, _ = record(one, world.scene, one.initial_state(*world), num_samples=20, every=30)
    np.testing.assert_allclose(trajectory.angle[:, WHEEL], 40.0 * trajectory.time, atol=1e-3)


# Joints


def spinning_pair(kind: str) -> BuiltWorld:
    """Pair of bars that turn together about their common centre of mass, from angles of two turns and a half."""
    b = SceneBuilder(CAPACITY, gravity=(0, 0))
    start = 5 * math.pi
    bars = [
        b.add_box(width=0.6, height=0.2, position=(x, 0), angle=start, velocity=(0, 20 * x), angular_velocity=20.0)
        for x in (-0.3, 0.3)
    ]
    if kind == "weld":
        b.add_fixed_joint(*bars, at=(0, 0))
    elif kind == "slider":
        b.add_prismatic_joint(*bars, at=(0, 0), axis_angle=0.0, limits=(-0.1, 0.1))
    else:
        b.add_revolute_joint(*bars, at=(0, 0), limits=(-0.2, 1.0))
    return b.build()


@pytest.mark.parametrize("kind", ["weld", "slider", "limits"])
def test_joints_do_not_notice_that_their_bodies_are_wrapped(kind: str):
    world, one = spinning_pair(kind), engine()
    trajectory, _ = record(one, world.scene, one.initial_state(*world), num_samples=600)
    between = trajectory.angle[:, 1] - trajectory.angle[:, 0]
    assert trajectory.angle[-1, 0] - trajectory.angle[0, 0] > 8 * math.tau
    assert between.min() > -0.205 and between.max() < (1.01 if kind == "limits" else 0.005)
    assert np.ptp(trajectory.angular_velocity[:, 0]) < 5.0
    assert np.abs(trajectory.joint_gaps()).max() < 0.02


def arm(limits: tuple[float, float], drive: str = "velocity") -> BuiltWorld:
    b = SceneBuilder(CAPACITY, gravity=(0, 0))
    base = b.add_box(width=0.2, height=0.2, fixed=True)
    bar = b.add_box(width=1, height=0.1, position=(0.5, 0))
    b.add_revolute_joint(base, bar, at=(0, 0), speed=5.0, max_torque=20.0, limits=limits, drive=drive)
    return b.build()


@pytest.mark.parametrize("limit", [3.0, 3.5, 6.5, 20.0])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_limits_count_turns_where_they_span_so_many(limit: float, sign: float):
    """Limits count turns under a motor that leans into them, too."""
    end = after(arm((-limit, limit)), 400, motor=sign)
    assert sign * end.angle[1] == pytest.approx(limit, abs=math.radians(0.5))
    assert abs(end.angular_velocity[1]) < 1e-3


def test_limits_at_the_seam_stop_an_arm_that_stands_there():
    """Limits of a quarter turn about an arm that points to -x, where angles jump from pi to -pi."""
    for sign in (1.0, -1.0):
        b = SceneBuilder(CAPACITY, gravity=(0, 0))
        base = b.add_box(width=0.2, height=0.2, fixed=True)
        bar = b.add_box(width=1, height=0.1, position=(-0.5, 0), angle=math.pi)
        b.add_revolute_joint(base, bar, at=(0, 0), speed=5.0, max_torque=20.0, limits=(-0.8, 0.8))
        end = after(b.build(), 120, motor=sign)
        assert math.remainder(end.angle[bar] - math.pi, math.tau) == pytest.approx(sign * 0.8, abs=math.radians(0.5))


def test_servo_goes_to_a_position_three_turns_away():
    end = after(arm((-20.0, 20.0), drive="servo"), 400, motor=0.95)
    assert end.angle[1] == pytest.approx(19.0, abs=1e-5)
