"""Mechanisms near balance, and a double pendulum, against the same bodies and joints in float64.

A mechanism is held by the force that virtual work asks for, and is pushed by 5 % more or less than that. What is left
over accelerates it, so that an error of a hundredth of the forces in its joints would be a fifth of the figure.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from jax2d import Capacity
from tests.engine.promises.plan import Body, Joint, Plan, Point, bar, box, disc
from tests.engine.promises.promise import Promise, Solver, motion_under, motions
from tests.engine.promises.rigid_bodies import RigidBodies

CAPACITY = Capacity(polygons=8, circles=4, joints=14, thrusters=0, extended_shapes=True)
STEPS, DT = 30, 1 / 60
FROM_STEP = 12  # gaps have settled
ACCELERATION = {"draft": 0.05, "standard": 0.03, "fine": 0.01}
PASSES = {"mask": 0}  # touches nothing


class Mechanism(NamedTuple):
    """Bodies and joints at rest, a force that holds them, and the body that is watched."""

    plan: Plan
    pushed: int
    along: Point
    load: int
    on_floor: tuple[int, ...] = ()

    def bodies(self, share: float) -> RigidBodies:
        """Float64, pushed by a share of the balancing force."""
        return RigidBodies(self.plan, forces=self.forces(share), on_floor=self.on_floor)

    def forces(self, share: float) -> dict[int, Point]:
        balance = RigidBodies(self.plan, on_floor=self.on_floor).balancing_force(self.pushed, self.along)
        return {self.pushed: (share * balance * self.along[0], share * balance * self.along[1])}


def scissor_lift() -> Mechanism:
    """Three stages of 1 m bars at 40 degrees, two discs of 1 kg on top, a roller pushed along the floor."""
    width, height = math.cos(math.radians(40)), math.sin(math.radians(40))
    ground = box(6, 1, (0.5, -0.6), fixed=True, options={"friction": 0.0})
    bodies, joints = [ground], []
    left, right = 0, len(bodies) + 6  # the bodies below at the left and the right: the ground and the roller
    for stage in range(3):
        y = stage * height
        rising, falling = len(bodies), len(bodies) + 1
        bodies += [bar((0, y), (width, y + height), 0.04, mass=0.2), bar((0, y + height), (width, y), 0.04, mass=0.2)]
        joints += [
            Joint(a=left, b=rising, at=(0, y)),
            Joint(a=right, b=falling, at=(width, y)),
            Joint(a=rising, b=falling, at=(width / 2, y + height / 2)),
        ]
        left, right = falling, rising
    roller = len(bodies)
    bodies.append(disc(0.1, (width, 0.0), mass=0.2, options={"friction": 0.0}))
    tops = [len(bodies), len(bodies) + 1]
    bodies += [disc(0.1, (x, 3 * height), mass=1.0, options=PASSES) for x in (0, width)]
    joints += [Joint(a=left, b=tops[0], at=(0, 3 * height)), Joint(a=right, b=tops[1], at=(width, 3 * height))]
    return Mechanism(Plan(tuple(bodies), tuple(joints)), roller, (-1.0, 0.0), tops[0], on_floor=(roller,))


def pantograph() -> Mechanism:
    """Four bars that copy what a point does to another, three times as far from the pivot, where 1 kg hangs."""
    pivot, tracer, pen = np.zeros(2), np.array([0.3, 0.05]), np.array([0.9, 0.15])
    elbow = np.array([0.35, 0.75])  # of the large triangle
    upper = pivot + (elbow - pivot) / 3
    lower = tracer + elbow - upper
    points = {"pivot": pivot, "upper": upper, "elbow": elbow, "lower": lower, "pen": pen, "tracer": tracer}
    at = {name: (float(x), float(y)) for name, (x, y) in points.items()}
    bodies = (
        box(0.2, 0.2, (0, -0.3), fixed=True),
        bar(at["pivot"], at["elbow"], 0.05, mass=0.3),
        bar(at["elbow"], at["pen"], 0.05, mass=0.3),
        bar(at["upper"], at["tracer"], 0.05, mass=0.2),
        bar(at["tracer"], at["lower"], 0.05, mass=0.2),
        disc(0.06, at["tracer"], mass=0.1, options=PASSES),
        disc(0.08, at["pen"], mass=1.0, options=PASSES),
    )
    joints = (
        Joint(a=0, b=1, at=at["pivot"]),
        Joint(a=1, b=2, at=at["elbow"]),
        Joint(a=1, b=3, at=at["upper"]),
        Joint(a=3, b=4, at=at["tracer"]),
        Joint(a=4, b=2, at=at["lower"]),
        Joint(a=4, b=5, at=at["tracer"]),
        Joint(a=2, b=6, at=at["pen"]),
    )
    return Mechanism(Plan(bodies, joints), 5, (0.0, 1.0), 6)


def roberval_balance() -> Mechanism:
    """Two beams on a post carry upright bars with weights welded on, one near and one far: where does not matter."""
    post = box(0.1, 0.8, (0, 0), fixed=True)
    bodies: list[Body] = [post]
    bodies += [bar((-0.5, y), (0.5, y), 0.04, mass=0.3) for y in (-0.2, 0.2)]
    bodies += [bar((x, -0.3), (x, 0.3), 0.04, mass=0.3) for x in (-0.5, 0.5)]
    bodies += [box(0.2, 0.2, (x, 0.3), mass=2.0, options=PASSES) for x in (-1.1, 0.6)]
    joints = [Joint(a=0, b=beam, at=(0, y)) for beam, y in ((1, -0.2), (2, 0.2))]
    joints += [
        Joint(a=beam, b=side, at=(x, y)) for beam, y in ((1, -0.2), (2, 0.2)) for side, x in ((3, -0.5), (4, 0.5))
    ]
    joints += [Joint(kind="weld", a=side, b=load, at=(x, 0.3)) for side, load, x in ((3, 5, -0.5), (4, 6, 0.5))]
    # Twice the weight on the left, which the push on the right has to hold.
    bodies[5] = dataclasses.replace(bodies[5], density=2 * bodies[5].density)
    return Mechanism(Plan(tuple(bodies), tuple(joints)), 6, (0.0, -1.0), 5)


def toggle() -> Mechanism:
    """Two bars, bent at the knee, under a press of 20 kg on a slider; the knee is pushed."""
    knee, top = (0.3, 0.5), (0.0, 1.0)
    bodies = (
        box(1.0, 0.2, (0, -0.2), fixed=True),
        bar((0, 0), knee, 0.05, mass=0.4),
        bar(knee, top, 0.05, mass=0.4),
        disc(0.05, knee, mass=0.1, options=PASSES),
        box(0.4, 0.3, (0, 1.0), mass=20.0, options=PASSES),
    )
    joints = (
        Joint(a=0, b=1, at=(0, 0)),
        Joint(a=1, b=2, at=knee),
        Joint(a=1, b=3, at=knee),
        Joint(a=2, b=4, at=top),
        Joint(kind="slider", a=0, b=4, at=top, axis_angle=math.pi / 2),
    )
    return Mechanism(Plan(bodies, joints), 3, (-1.0, 0.0), 4)


def differential_pulley() -> Mechanism:
    """A beam with arms of 0.5 and 0.4 m whose hangers carry a yoke, from the middle of which 10 kg hang: the load
    moves by a twentieth of the end of the beam's long arm, where the hand is."""
    bodies = (
        box(0.2, 0.2, (0, 0.3), fixed=True),
        bar((-0.5, 0), (1.0, 0), 0.05, mass=0.5),
        bar((-0.5, 0), (-0.5, -0.6), 0.04, mass=0.1),
        bar((0.4, 0), (0.4, -0.6), 0.04, mass=0.1),
        bar((-0.5, -0.6), (0.4, -0.6), 0.05, mass=0.4),
        disc(0.15, (-0.05, -0.6), mass=10.0, options=PASSES),
        disc(0.05, (1.0, 0), mass=0.1, options=PASSES),
    )
    joints = (
        Joint(a=0, b=1, at=(0, 0)),
        Joint(a=1, b=2, at=(-0.5, 0)),
        Joint(a=1, b=3, at=(0.4, 0)),
        Joint(a=2, b=4, at=(-0.5, -0.6)),
        Joint(a=3, b=4, at=(0.4, -0.6)),
        Joint(a=4, b=5, at=(-0.05, -0.6)),
        Joint(a=1, b=6, at=(1.0, 0)),
    )
    return Mechanism(Plan(bodies, joints), 6, (0.0, 1.0), 6)


def four_bar() -> Mechanism:
    """A crank of 0.3 m, a coupler of 0.8 m with 3 kg at its middle, a rocker of 0.6 m; the crank's end is pushed."""
    crank = (0.3 * math.cos(2.2), 0.3 * math.sin(2.2))
    span = np.array([0.8, 0.0]) - crank
    length, angle = float(np.hypot(*span)), math.atan2(span[1], span[0])
    turn = math.acos((0.8**2 + length**2 - 0.6**2) / (2 * 0.8 * length))
    far = (crank[0] + 0.8 * math.cos(angle + turn), crank[1] + 0.8 * math.sin(angle + turn))
    middle = ((crank[0] + far[0]) / 2, (crank[1] + far[1]) / 2)
    bodies = (
        box(1.0, 0.1, (0.4, -0.2), fixed=True),
        bar((0, 0), crank, 0.05, mass=0.3),
        bar(crank, far, 0.05, mass=0.3),
        bar((0.8, 0), far, 0.05, mass=0.3),
        disc(0.1, middle, mass=3.0, options=PASSES),
        disc(0.05, crank, mass=0.1, options=PASSES),
    )
    joints = (
        Joint(a=0, b=1, at=(0, 0)),
        Joint(a=1, b=2, at=crank),
        Joint(a=0, b=3, at=(0.8, 0)),
        Joint(a=3, b=2, at=far),
        Joint(a=2, b=4, at=middle),
        Joint(a=1, b=5, at=crank),
    )
    push = (math.sin(2.2), -math.cos(2.2))
    return Mechanism(Plan(bodies, joints), 5, push, 4)


MECHANISMS: dict[str, Callable[[], Mechanism]] = {
    "scissor lift": scissor_lift,
    "pantograph": pantograph,
    "Roberval balance": roberval_balance,
    "toggle": toggle,
    "differential pulley": differential_pulley,
    "four-bar": four_bar,
}


@functools.cache
def exact(name: str, share: float) -> tuple[np.ndarray, np.ndarray]:
    """(positions, velocities) [STEPS + 1, n, 3] of a mechanism in float64."""
    return MECHANISMS[name]().bodies(share).motion(STEPS * DT, STEPS)


def acceleration_error(name: str, share: float, solver: Solver) -> float:
    """Share of the load's change of velocity, from 0.2 to 0.5 s, by which it differs from that in float64."""
    mechanism = MECHANISMS[name]()
    found = motion_under(solver, mechanism.plan, mechanism.forces(share), CAPACITY, STEPS)
    _, v = exact(name, share)
    expected = v[-1, mechanism.load, :2] - v[FROM_STEP, mechanism.load, :2]
    gained = found.velocity[-1, mechanism.load] - found.velocity[FROM_STEP, mechanism.load]
    return float(np.linalg.norm(gained - expected) / np.linalg.norm(expected))


def scissor_rise_error(share: float, solver: Solver) -> float:
    """Share of what the top of the scissor lift rises or sinks by within 0.5 s by which it differs from float64."""
    mechanism = scissor_lift()
    found = motion_under(solver, mechanism.plan, mechanism.forces(share), CAPACITY, STEPS)
    height = exact("scissor lift", share)[0][:, mechanism.load, 1]
    return float(abs((found.position[-1, mechanism.load, 1] - height[-1]) / (height[-1] - height[0])))


def double_pendulum() -> Plan:
    """A bar of 0.1 kg between a pivot and a bar of 2 kg, both 0.5 m long, let go from the horizontal."""
    bodies = (
        disc(0.05, fixed=True),
        bar((0, 0), (0.5, 0), 0.05, mass=0.1),
        bar((0.5, 0), (1.0, 0), 0.1, mass=2.0),
    )
    return Plan(bodies, (Joint(a=0, b=1, at=(0, 0)), Joint(a=1, b=2, at=(0.5, 0))))


def double_pendulum_error(solver: Solver) -> float:
    """m, farthest that a centre is within 2 s from where it is in float64."""
    (found,) = motions(solver, [double_pendulum()], CAPACITY, 120)
    return float(np.linalg.norm(found.position - _exact_double_pendulum()[..., :2], axis=-1).max())


@functools.cache
def _exact_double_pendulum() -> np.ndarray:
    return RigidBodies(double_pendulum()).motion(2.0, 120)[0]


def promises() -> list[Promise]:
    near_balance = [
        Promise(
            name=f"virtual work: {name}, pushed by {share:.0%} of its balance",
            unit="of its acceleration",
            limits=ACCELERATION,
            measure=functools.partial(acceleration_error, name, share),
        )
        for name in MECHANISMS
        for share in (0.95, 1.05)
    ]
    rises = [
        Promise(
            name=f"virtual work: rise of a scissor lift, pushed by {share:.0%} of its balance",
            unit="of its rise",
            limits=ACCELERATION,
            measure=functools.partial(scissor_rise_error, share),
        )
        for share in (0.95, 1.05)
    ]
    pendulum = Promise(
        name="double pendulum with a light bar",
        unit="m",
        limits={"draft": 0.3, "standard": 0.06, "fine": 0.06},
        measure=double_pendulum_error,
    )
    return [*near_balance, *rises, pendulum]
