"""Friction: sliding, holding and rolling."""

from __future__ import annotations

import math

import numpy as np

from jax2d.builder import SceneBuilder
from jax2d.fidelity.closed_forms.form import ClosedForms, relative_error
from jax2d.fidelity.study_scene import Error
from jax2d.fidelity.trajectory import Trajectory
from jax2d.fidelity.units import G

FORMS = ClosedForms()


@FORMS.add("slide_to_stop", metric="distance error / v^2 / (2 mu g)", seconds=1.5)
def slide_to_stop(b: SceneBuilder) -> Error:
    speed, mu = 3.0, 0.3
    b.add_box(width=20, height=1, position=(0, -0.5), fixed=True, friction=mu)
    box = b.add_box(width=0.6, height=0.2, position=(0, 0.1), velocity=(speed, 0), friction=mu)
    return lambda trajectory: relative_error(trajectory.position[-1, box, 0], speed**2 / (2 * mu * G))


def _slope(b: SceneBuilder, angle: float, mu: float) -> tuple[np.ndarray, np.ndarray]:
    """A plane that falls to the right through the origin: (downhill, normal) unit vectors."""
    normal = np.array([math.sin(angle), math.cos(angle)])
    b.add_box(width=20, height=1, angle=-angle, position=-0.5 * normal, fixed=True, friction=mu)
    return np.array([math.cos(angle), -math.sin(angle)]), normal


@FORMS.add("incline_slide", metric="distance error / g (sin a - mu cos a) t^2 / 2", seconds=1.0)
def incline_slide(b: SceneBuilder) -> Error:
    angle, mu = 0.5, 0.3
    downhill, normal = _slope(b, angle, mu)
    box = b.add_box(width=0.6, height=0.2, angle=-angle, position=0.1 * normal, friction=mu)
    acceleration = G * (math.sin(angle) - mu * math.cos(angle))
    return lambda trajectory: relative_error(
        float(trajectory.position[-1, box] @ downhill), acceleration * trajectory.time[-1] ** 2 / 2
    )


@FORMS.add("incline_hold", metric="creep in 5 s / box width (mu > tan a)", seconds=5.0)
def incline_hold(b: SceneBuilder) -> Error:
    angle, mu, width = 0.25, 0.4, 0.6
    downhill, normal = _slope(b, angle, mu)
    box = b.add_box(width=width, height=0.2, angle=-angle, position=0.1 * normal, friction=mu)
    return lambda trajectory: abs(float(trajectory.position[-1, box] @ downhill)) / width


@FORMS.add("incline_roll", metric="distance error / (2/3 g sin a) t^2 / 2", seconds=1.0)
def incline_roll(b: SceneBuilder) -> Error:
    angle = 0.3
    downhill, normal = _slope(b, angle, 1.0)
    disc = b.add_circle(radius=0.2, position=0.2 * normal)
    return lambda trajectory: relative_error(
        float(trajectory.position[-1, disc] @ downhill), 2 / 3 * G * math.sin(angle) * trajectory.time[-1] ** 2 / 2
    )


@FORMS.add("incline_slip", metric="larger of distance and angle error (mu < tan(a)/3)", seconds=1.0)
def incline_slip(b: SceneBuilder) -> Error:
    angle, mu, radius = 0.5, 0.1, 0.2
    downhill, normal = _slope(b, angle, mu)
    disc = b.add_circle(radius=radius, position=radius * normal, friction=mu)

    def error(trajectory: Trajectory) -> float:
        half_t2 = trajectory.time[-1] ** 2 / 2
        distance = G * (math.sin(angle) - mu * math.cos(angle)) * half_t2
        turned = -2 * mu * G * math.cos(angle) / radius * half_t2
        return max(
            relative_error(float(trajectory.position[-1, disc] @ downhill), distance),
            relative_error(trajectory.angle[-1, disc], turned),
        )

    return error


@FORMS.add("spin_to_roll", metric="speed error / (w0 r / 3)", seconds=1.0)
def spin_to_roll(b: SceneBuilder) -> Error:
    radius, mu, spin_before = 0.2, 0.5, 20.0
    b.add_box(width=20, height=1, position=(0, -0.5), fixed=True, friction=mu)
    disc = b.add_circle(radius=radius, position=(0, radius), friction=mu, angular_velocity=-spin_before)
    return lambda trajectory: relative_error(trajectory.velocity[-1, disc, 0], spin_before * radius / 3)


@FORMS.add("slide_to_roll", metric="distance error / distance (v0 -> 2/3 v0)", seconds=1.0)
def slide_to_roll(b: SceneBuilder) -> Error:
    radius, mu, speed = 0.2, 0.5, 3.0
    b.add_box(width=20, height=1, position=(0, -0.5), fixed=True, friction=mu)
    disc = b.add_circle(radius=radius, position=(0, radius), friction=mu, velocity=(speed, 0))
    slipping = speed / (3 * mu * G)  # s
    slipped = speed * slipping - mu * G * slipping**2 / 2
    return lambda trajectory: relative_error(
        trajectory.position[-1, disc, 0], slipped + 2 / 3 * speed * (trajectory.time[-1] - slipping)
    )
