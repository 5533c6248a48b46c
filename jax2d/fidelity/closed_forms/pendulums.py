"""Pendulums: periods and energy."""

from __future__ import annotations

import math

import numpy as np

from jax2d.builder import SceneBuilder
from jax2d.fidelity.closed_forms.form import Build, ClosedForms, relative_error
from jax2d.fidelity.extrema import zero_crossings
from jax2d.fidelity.study_scene import Error
from jax2d.fidelity.trajectory import Trajectory
from jax2d.fidelity.units import G

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
