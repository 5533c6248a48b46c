"""Measures of a state against values worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from jax2d import Capacity, Controls, Engine, SceneBuilder
from jax2d.measure import max_work
from tests.engine.worlds import CAPACITY, builder, engine


def test_the_work_of_a_thruster_is_bounded_by_force_times_way():
    capacity = Capacity(polygons=1, circles=0, joints=0, thrusters=1)
    b = SceneBuilder(capacity, gravity=(0.0, 0.0))
    body = b.add_box(width=1, height=1, position=(0, 0))
    b.add_thruster(body, at=(0, 0), angle=0.0, power=3.0)
    world, one = b.build(), Engine(capacity)
    before = one.initial_state(*world)
    controls = Controls(motor=np.zeros(0, np.float32), thruster=np.ones(1, np.float32))
    after, _ = one.step(world.scene, before, controls, num_steps=2)
    # 30 N for 1/30 s on 1 kg: 1 m/s. From rest the bound is F (v + F t / m) t = 30 x 2 x 1/30 = 2 J for 0.5 J done.
    most = max_work(one.settings, 2 * one.settings.dt, world.scene, controls, before, after)
    assert float(after.velocity[0, 0]) == pytest.approx(1.0, rel=1e-5)
    assert float(most) == pytest.approx(2.0, rel=1e-5)


def test_the_work_of_a_motor_is_bounded_by_torque_times_target_times_time():
    b = builder(gravity=(0, 0))
    post, disc = b.add_circle(radius=0.1, fixed=True), b.add_circle(radius=1.0)
    b.add_revolute_joint(post, disc, at=(0, 0), motor_speed=0.5, motor_power=0.1)
    world = b.build()
    start = engine().initial_state(*world)
    controls = Controls(
        motor=np.full(CAPACITY.joints, -1, np.float32), thruster=np.zeros(CAPACITY.thrusters, np.float32)
    )
    # 0.1 x 900 rad/s^2 on a disc of pi kg, I = pi/2; 3 rad/s is the target.
    most = max_work(engine().settings, 0.5, world.scene, controls, start, start)
    assert float(most) == pytest.approx(90 * np.pi / 2 * 3 * 0.5, rel=1e-5)
