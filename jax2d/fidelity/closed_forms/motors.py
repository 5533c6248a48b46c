"""Motors: running up, stalling, lifting."""

from __future__ import annotations

import math

from jax2d.builder import SceneBuilder
from jax2d.fidelity.closed_forms.form import ClosedForms, relative_error
from jax2d.fidelity.extrema import peak
from jax2d.fidelity.study_scene import Error
from jax2d.fidelity.trajectory import Trajectory
from jax2d.fidelity.units import MOTOR_ACCELERATION, MOTOR_SPEED, G

FORMS = ClosedForms()


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
