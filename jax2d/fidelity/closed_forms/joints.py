"""Joints between bodies that are free, hang or balance."""

from __future__ import annotations

import numpy as np

from jax2d.builder import SceneBuilder
from jax2d.fidelity.closed_forms.form import ClosedForms, distance, relative_error
from jax2d.fidelity.study_scene import Error
from jax2d.fidelity.trajectory import Trajectory
from jax2d.fidelity.units import G

FORMS = ClosedForms()


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
