"""Joints with a formula: pendulums, rods and chains at rest, motors."""

from __future__ import annotations

import math

import numpy as np

from jax2d.builder import SceneBuilder
from jax2d.fidelity.closed_forms.form import Build, ClosedForms, distance, relative_error
from jax2d.fidelity.study_scene import Error
from jax2d.fidelity.trajectory import Trajectory, peak, zero_crossings
from jax2d.fidelity.units import MOTOR_ACCELERATION, MOTOR_SPEED, G

FORMS = ClosedForms()


def _agm(a: float, b: float) -> float:
    while abs(a - b) > 1e-14:
        a, b = (a + b) / 2, math.sqrt(a * b)
    return a


def _hang(b: SceneBuilder, swing: float, length: float = 1.0, radius: float = 0.2) -> int:
    """A disc on a fixed pivot at the origin, `swing` rad from the vertical."""
    pivot = b.add_circle(radius=0.05, fixed=True)
    bob = b.add_circle(radius=radius, position=(length * math.sin(swing), -length * math.cos(swing)))
    b.add_revolute_joint(pivot, bob, at=(0, 0))
    return bob


def _pendulum_period(swing: float, length: float = 1.0, radius: float = 0.2) -> float:
    inertia_over_mass = length**2 + radius**2 / 2
    return 2 * math.pi * math.sqrt(inertia_over_mass / (G * length)) / _agm(1.0, math.cos(swing / 2))


def _pendulum(swing: float) -> Build:
    period = _pendulum_period(swing)

    def build(b: SceneBuilder) -> Error:
        bob = _hang(b, swing)

        def error(trajectory: Trajectory) -> float:
            # From rest it turns back after half a period and again after a whole one; the start is no crossing.
            turns = zero_crossings(trajectory.angular_velocity[1:, bob], trajectory.interval) + trajectory.interval
            return relative_error(turns[1], period) if len(turns) > 1 else 1.0

        return error

    return build


for _swing in (0.2, 1.0, 2.0, 2.8):
    _seconds = math.ceil(1.2 * _pendulum_period(_swing))
    FORMS.add(f"pendulum_{_swing:g}", metric="period error / period", seconds=_seconds)(_pendulum(_swing))


@FORMS.add("pendulum_energy", metric="energy change in 10 s / swing energy", seconds=10.0)
def pendulum_energy(b: SceneBuilder) -> Error:
    swing = 1.0
    _hang(b, swing)
    swing_energy = math.pi * 0.2**2 * G * (1 - math.cos(swing))

    def error(trajectory: Trajectory) -> float:
        energy = trajectory.energy()
        # Over the last two periods, so that what swings to and fro within one does not count as drift.
        tail = max(1, round(2 * _pendulum_period(swing) / trajectory.interval))
        return abs(float(energy[-tail:].mean() - energy[0])) / swing_energy

    return error


@FORMS.add("double_pendulum", metric="largest energy change in 3 s / energy above rest", seconds=3.0)
def double_pendulum(b: SceneBuilder) -> Error:
    arm, swing, radius = 0.5, 2.0, 0.1
    knee = np.array([arm * math.sin(swing), -arm * math.cos(swing)])
    pivot = b.add_circle(radius=0.05, fixed=True)
    upper = b.add_circle(radius=radius, position=knee)
    lower = b.add_circle(radius=radius, position=2 * knee)
    b.add_revolute_joint(pivot, upper, at=(0, 0))
    b.add_revolute_joint(upper, lower, at=knee)
    b.keep_apart(pivot, lower)
    above_rest = math.pi * radius**2 * G * 3 * arm * (1 - math.cos(swing))

    def error(trajectory: Trajectory) -> float:
        energy = trajectory.energy()
        return float(np.abs(energy - energy[0]).max()) / above_rest

    return error


# Joints at rest


@FORMS.add("jointed_pair", metric="larger of change in P / P and L / L in 10 s", seconds=10.0, gravity=0.0)
def jointed_pair(b: SceneBuilder) -> Error:
    left = b.add_box(width=1, height=0.4, velocity=(0.5, 1.0), angular_velocity=2.0)
    # Compatible with the joint: at the start the anchors of both move alike.
    right = b.add_box(width=0.8, height=0.3, position=(0.9, 0), velocity=(0.5, 2.0))
    b.add_revolute_joint(left, right, at=(0.5, 0))

    def error(trajectory: Trajectory) -> float:
        linear, angular = trajectory.momentum(), trajectory.angular_momentum()
        linear_change = distance(linear[-1], linear[0]) / float(np.linalg.norm(linear[0]))
        return max(linear_change, relative_error(angular[-1], angular[0]))

    return error


def _chain(b: SceneBuilder, end_density: float) -> float:
    """Three links of 0.5 m hanging from a pivot at the origin; the last of another density. Returns the weight in N."""
    length, width = 0.5, 0.1
    previous = b.add_circle(radius=0.05, fixed=True)
    links = [
        b.add_box(width=width, height=length, position=(0, -length * (i + 0.5)), density=density)
        for i, density in enumerate((1.0, 1.0, end_density))
    ]
    for i, link in enumerate(links):
        b.add_revolute_joint(previous, link, at=(0, -length * i))
        previous = link
    b.keep_apart(links[0], links[2])
    return length * width * (2.0 + end_density) * G


def _widest_gap_at_rest(trajectory: Trajectory) -> float:
    """m, between anchors in the world frame, which here is near the origin."""
    anchor_a, anchor_b = trajectory.anchors()
    return float(np.linalg.norm(anchor_b[-1] - anchor_a[-1], axis=-1).max())


@FORMS.add("chain_gap", metric="widest joint gap at rest / link length", seconds=5.0)
def chain_gap(b: SceneBuilder) -> Error:
    _chain(b, 1.0)
    return lambda trajectory: _widest_gap_at_rest(trajectory) / 0.5


@FORMS.add("heavy_chain_gap", metric="widest joint gap at rest / link length (last link 50 x)", seconds=5.0)
def heavy_chain_gap(b: SceneBuilder) -> Error:
    _chain(b, 50.0)
    return lambda trajectory: _widest_gap_at_rest(trajectory) / 0.5


@FORMS.add("chain_force", metric="force in the top joint - weight / weight", seconds=5.0, needs_joint_force=True)
def chain_force(b: SceneBuilder) -> Error:
    weight = _chain(b, 1.0)

    def error(trajectory: Trajectory) -> float:
        assert trajectory.joint_force is not None
        return relative_error(float(np.linalg.norm(trajectory.joint_force[-1, 0])), weight)

    return error


@FORMS.add("lever_balance", metric="tilt after 3 s, rad (m1 d1 = m2 d2)", seconds=3.0)
def lever_balance(b: SceneBuilder) -> Error:
    pivot = b.add_circle(radius=0.05, fixed=True)
    beam = b.add_box(width=3, height=0.1)
    near = b.add_box(width=0.4, height=0.4, position=(-0.6, 0), density=2)
    far = b.add_box(width=0.4, height=0.4, position=(1.2, 0), density=1)
    b.add_revolute_joint(pivot, beam, at=(0, 0))
    b.add_fixed_joint(beam, near, at=(-0.6, 0))
    b.add_fixed_joint(beam, far, at=(1.2, 0))
    for weight in (near, far):
        b.keep_apart(pivot, weight)
    return lambda trajectory: abs(float(trajectory.angle[-1, beam]))


# Motors


@FORMS.add("motor_run_up", metric="angle error / angle turned", seconds=1.5, gravity=0.0, control=1.0)
def motor_run_up(b: SceneBuilder) -> Error:
    power, speed = 0.02, 2.0
    base = b.add_box(width=1, height=1, fixed=True)
    wheel = b.add_circle(radius=0.3)
    b.add_revolute_joint(base, wheel, at=(0, 0), motor_speed=speed, motor_power=power)
    acceleration, target = power * MOTOR_ACCELERATION, speed * MOTOR_SPEED
    reached = target / acceleration  # s
    return lambda trajectory: relative_error(trajectory.angle[-1, wheel], target * (trajectory.time[-1] - reached / 2))


ARM_M, ARM_WIDTH_M = 1.0, 0.2
ARM_KG = ARM_M * ARM_WIDTH_M
ARM_INERTIA = ARM_KG * (ARM_M**2 + ARM_WIDTH_M**2) / 12  # kg m^2 about its centre


def _arm(b: SceneBuilder, angle: float, torque: float) -> int:
    """A rod hanging `angle` rad from the vertical on a motor of that torque (N m) at the origin."""
    base = b.add_box(width=0.2, height=0.2, fixed=True)
    position = (ARM_M / 2 * math.sin(angle), -ARM_M / 2 * math.cos(angle))
    arm = b.add_box(width=ARM_WIDTH_M, height=ARM_M, position=position, angle=angle)
    power = torque / (MOTOR_ACCELERATION * ARM_INERTIA)
    b.add_revolute_joint(base, arm, at=(0, 0), motor_speed=2.0, motor_power=power)
    return arm


@FORMS.add("motor_stall", metric="angle from m g l sin th = torque after 2 s, rad", seconds=2.0, control=1.0)
def motor_stall(b: SceneBuilder) -> Error:
    angle = 0.8
    arm = _arm(b, angle, ARM_KG * G * ARM_M / 2 * math.sin(angle))
    return lambda trajectory: abs(float(trajectory.angle[-1, arm]) - angle)


@FORMS.add(
    "motor_lift", metric="error of the highest angle / angle (work = m g l (1 - cos th))", seconds=2.0, control=1.0
)
def motor_lift(b: SceneBuilder) -> Error:
    highest = 1.2
    arm = _arm(b, 0.0, ARM_KG * G * ARM_M / 2 * (1 - math.cos(highest)) / highest)

    def error(trajectory: Trajectory) -> float:
        return relative_error(peak(trajectory.angle[:, arm]), highest)

    return error
