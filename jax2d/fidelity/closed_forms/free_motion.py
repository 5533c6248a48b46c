"""Free motion: gravity, thrusters, spin."""

from __future__ import annotations

import math

import numpy as np

from jax2d.builder import SceneBuilder
from jax2d.fidelity.closed_forms.form import ClosedForms, distance, relative_error
from jax2d.fidelity.study_scene import Error
from jax2d.fidelity.trajectory import Trajectory
from jax2d.fidelity.units import THRUST, G

FORMS = ClosedForms()


@FORMS.add("free_fall", metric="height error / height fallen", seconds=1.5)
def free_fall(b: SceneBuilder) -> Error:
    ball = b.add_circle(radius=0.1)
    return lambda trajectory: relative_error(trajectory.position[-1, ball, 1], -G * trajectory.time[-1] ** 2 / 2)


@FORMS.add("projectile", metric="distance from the parabola / distance flown", seconds=1.0)
def projectile(b: SceneBuilder) -> Error:
    ball = b.add_circle(radius=0.1, velocity=(3.0, 8.0))

    def error(trajectory: Trajectory) -> float:
        t = trajectory.time[-1]
        expected = np.array([3.0 * t, 8.0 * t - G * t**2 / 2])
        return distance(trajectory.position[-1, ball], expected) / float(np.linalg.norm(expected))

    return error


@FORMS.add("thruster_push", metric="distance error / F t^2 / 2m", seconds=1.0, gravity=0.0, control=1.0)
def thruster_push(b: SceneBuilder) -> Error:
    box = b.add_box(width=1, height=0.5, density=2)  # 1 kg
    b.add_thruster(box, at=(0, 0), angle=0.0, power=0.3)

    def error(trajectory: Trajectory) -> float:
        expected = 0.3 * THRUST * trajectory.time[-1] ** 2 / 2
        return distance(trajectory.position[-1, box], (expected, 0.0)) / expected

    return error


@FORMS.add("thruster_couple", metric="angle error / F d t^2 / 2I", seconds=2.0, gravity=0.0, control=1.0)
def thruster_couple(b: SceneBuilder) -> Error:
    box = b.add_box(width=1, height=1)  # I = 1/6 kg m^2
    b.add_thruster(box, at=(0.5, 0), angle=math.pi / 2, power=0.01)
    b.add_thruster(box, at=(-0.5, 0), angle=-math.pi / 2, power=0.01)
    return lambda trajectory: relative_error(
        trajectory.angle[-1, box], 0.01 * THRUST * 1.0 * 6.0 * trajectory.time[-1] ** 2 / 2
    )


@FORMS.add("spin", metric="angle error / angle turned", seconds=3.0, gravity=0.0)
def spin(b: SceneBuilder) -> Error:
    triangle = b.add_polygon([(0, 0), (1, 0), (0, 0.7)], angular_velocity=7.0, velocity=(1, 0))
    return lambda trajectory: relative_error(trajectory.angle[-1, triangle], 7.0 * trajectory.time[-1])
