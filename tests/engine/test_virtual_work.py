"""Mechanisms near balance accelerate as float64 of the same bodies and joints says, and that is what mechanics says."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.engine.promises import mechanisms
from tests.engine.promises.cases import Broken, assert_kept, cases
from tests.engine.promises.mechanisms import MECHANISMS, STEPS, Mechanism
from tests.engine.promises.plan import G, Joint, Plan, bar, disc
from tests.engine.promises.promise import Promise
from tests.engine.promises.rigid_bodies import RigidBodies

FLOOR = "a contact takes the roller for free of the lift that bears on it, and pushes too little in each pass"
BROKEN = [
    Broken("virtual work: scissor lift", ("draft", "standard"), FLOOR),
    Broken("virtual work: rise of a scissor lift", ("draft",), FLOOR),
]


@pytest.mark.parametrize(("promise", "preset", "backend"), cases(mechanisms.promises(), BROKEN))
def test_mechanism_moves_as_in_float64(promise: Promise, preset: str, backend: str):
    assert_kept(promise, preset, backend)


# The float64 that they are judged by


def test_float64_pendulum_has_the_period_of_the_formula():
    length, swing = 1.0, 1.2
    bob = disc(0.2, (length * math.sin(swing), -length * math.cos(swing)))
    plan = Plan((disc(0.05, fixed=True), bob), (Joint(a=0, b=1, at=(0, 0)),))
    mean, other = 1.0, math.cos(swing / 2)
    for _ in range(8):
        mean, other = (mean + other) / 2, math.sqrt(mean * other)
    period = 2 * math.pi * math.sqrt((length**2 + 0.2**2 / 2) / (G * length)) / mean
    q, v = RigidBodies(plan).motion(period, 4)
    np.testing.assert_allclose(q[-1], q[0], atol=1e-9)  # at rest where it began
    np.testing.assert_allclose(v[-1], 0, atol=1e-7)


def test_float64_scissor_lift_is_held_by_what_virtual_work_asks_for():
    """Bars of 0.4 kg a stage rise by 1/2, 3/2 and 5/2 of what a stage does, 2 kg on top by three times that."""
    mechanism = MECHANISMS["scissor lift"]()
    risen_kg = 0.4 * (0.5 + 1.5 + 2.5) + 2.0 * 3
    expected = G * risen_kg / math.tan(math.radians(40))
    assert -mechanism.forces(1.0)[mechanism.pushed][0] == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("name", sorted(MECHANISMS))
def test_float64_mechanism_keeps_its_energy_and_its_joints(name: str):
    mechanism: Mechanism = MECHANISMS[name]()
    bodies = mechanism.bodies(1.05)
    q, v = mechanisms.exact(name, 1.05)
    assert len(q) == STEPS + 1
    assert np.ptp(bodies.energy(q, v)) < 1e-5  # J; of the toggle, which comes near its dead centre, 1e-6
    for joint in mechanism.plan.joints:
        ends = [_anchor(mechanism.plan, body, joint.at, q[:, body]) for body in (joint.a, joint.b)]
        gap = ends[1] - ends[0]
        along = (math.cos(joint.axis_angle), math.sin(joint.axis_angle))
        across = gap @ (-along[1], along[0]) if joint.kind == "slider" else np.linalg.norm(gap, axis=-1)
        assert np.abs(across).max() < 1e-9


def test_what_float64_does_not_have_is_refused():
    plan = Plan((disc(0.1, fixed=True), bar((0, 0), (1, 0), 0.1)), (Joint(a=0, b=1, at=(0, 0), limits=(-1, 1)),))
    with pytest.raises(ValueError, match="springs, limits and motors"):
        RigidBodies(plan)


def _anchor(plan: Plan, body: int, at: tuple[float, float], q: np.ndarray) -> np.ndarray:
    start = plan.bodies[body]
    arm, turn = np.subtract(at, start.position), q[:, 2] - start.angle
    c, s = np.cos(turn), np.sin(turn)
    return q[:, :2] + np.stack([c * arm[0] - s * arm[1], s * arm[0] + c * arm[1]], -1)
