"""Order: slots of shapes and joints, ends of joints and first corners of polygons decide nothing.

A world in another order moves the same within what rounding may make (`frame.py` says how much that is). A scene that
is its own mirror image stays one.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable

import numpy as np

from jax2d import Capacity
from tests.engine.promises import frame
from tests.engine.promises.frame import GROUNDED, JOINTED, STEPS, Kind, difference
from tests.engine.promises.plan import (
    Joint,
    Plan,
    box,
    disc,
    with_bodies_in_order,
    with_ends_swapped,
    with_first_corner,
)
from tests.engine.promises.promise import Motion, Promise, Solver, everywhere, motions

SYMMETRIC = Capacity(polygons=11, circles=16, joints=10, thrusters=0)
CUE_M_S = 5.0
BREAK_STEPS = 60


def in_other_slots(plan: Plan, rng: np.random.Generator) -> tuple[Plan, np.ndarray]:
    """(plan, place of each former body in it)."""
    order = rng.permutation(len(plan.bodies))
    return with_bodies_in_order(plan, [int(k) for k in order]), np.argsort(order)


def joints_in_other_slots(plan: Plan, rng: np.random.Generator) -> tuple[Plan, np.ndarray]:
    joints = tuple(plan.joints[k] for k in rng.permutation(len(plan.joints)))
    springs = tuple(plan.springs[k] for k in rng.permutation(len(plan.springs)))
    return plan._replace(joints=joints, springs=springs), np.arange(len(plan.bodies))


def ends_swapped(plan: Plan, *kinds: str) -> Plan:
    """Joints of these kinds, and springs, seen from their other bodies."""
    joints = tuple(with_ends_swapped(joint) if joint.kind in kinds else joint for joint in plan.joints)
    springs = tuple(
        dataclasses.replace(spring, a=spring.b, b=spring.a, at_a=spring.at_b, at_b=spring.at_a)
        for spring in plan.springs
    )
    return plan._replace(joints=joints, springs=springs)


def ends_of_pivots_swapped(plan: Plan, _: np.random.Generator) -> tuple[Plan, np.ndarray]:
    return ends_swapped(plan, "hinge", "weld"), np.arange(len(plan.bodies))


def ends_of_sliders_swapped(plan: Plan, _: np.random.Generator) -> tuple[Plan, np.ndarray]:
    return ends_swapped(plan, "slider"), np.arange(len(plan.bodies))


def other_first_corners(plan: Plan, rng: np.random.Generator) -> tuple[Plan, np.ndarray]:
    bodies = tuple(with_first_corner(body, int(rng.integers(1, 3))) if body.corners else body for body in plan.bodies)
    return plan._replace(bodies=bodies), np.arange(len(plan.bodies))


ORDERS: dict[str, Callable[[Plan, np.random.Generator], tuple[Plan, np.ndarray]]] = {
    "slots of shapes": in_other_slots,
    "slots of joints": joints_in_other_slots,
    "ends of hinges and welds": ends_of_pivots_swapped,
    "ends of sliders": ends_of_sliders_swapped,
    "first corners": other_first_corners,
}


def order_error(name: str, kind: Kind, solver: Solver) -> float:
    """Largest difference that another order makes, of what rounding may make."""
    base, most = frame.unchanged(solver, kind), frame.allowed(solver, kind, 1.0)
    changed = [ORDERS[name](plan, np.random.default_rng(seed)) for seed, plan in enumerate(frame.worlds(kind))]
    found = motions(solver, [plan for plan, _ in changed], frame.CAPACITY, STEPS)
    seen = [Motion(*(x[:, place] for x in motion)) for motion, (_, place) in zip(found, changed, strict=True)]
    return float(max(difference(b, s) / m for b, s, m in zip(base, seen, most, strict=True)))


# Scenes that are their own mirror image


def billiard_break() -> Plan:
    """A cue ball straight into the tip of a triangle of fifteen that touch, e = 0.9, no gravity."""
    radius, bounces = 0.1, {"restitution": 0.9, "friction": 0.0}
    balls = [disc(radius, (0, -1.0), velocity=(0, CUE_M_S), options=bounces)]
    for row in range(5):
        y = row * math.sqrt(3) * radius
        balls += [disc(radius, ((2 * k - row) * radius, y), options=bounces) for k in range(row + 1)]
    return Plan(tuple(balls), gravity=(0.0, 0.0))


def bridge() -> Plan:
    """Nine planks between two posts under two heavy boxes."""
    planks = [box(0.4, 0.1, (0.4 * (k - 4), 1.0)) for k in range(9)]
    posts = [box(0.4, 2.0, (side * 2.0, 0.0), fixed=True) for side in (-1, 1)]
    joints = [Joint(a=k, b=k + 1, at=(0.4 * (k - 3.5), 1.0)) for k in range(8)]
    joints += [Joint(a=9, b=0, at=(-1.8, 1.0)), Joint(a=10, b=8, at=(1.8, 1.0))]
    weights = [disc(0.15, (side * 0.8, 1.3), density=10.0) for side in (-1, 1)]
    return Plan((*planks, *posts, *weights), tuple(joints))


def pile() -> Plan:
    """Balls and boxes that fall onto a floor, left and right alike."""
    floor = box(8, 0.5, (0, -0.25), fixed=True)
    boxes = [box(0.4, 0.4, (side * x, y), angle=side * turn) for x, y, turn in PILE for side in (-1, 1)]
    balls = [
        disc(0.2, (side * 0.25, 2.0 + 0.5 * k), options={"restitution": 0.3}) for k in range(3) for side in (-1, 1)
    ]
    return Plan((floor, *boxes, *balls, disc(0.25, (0, 4.0))))


PILE = ((0.21, 0.25, 0.0), (0.5, 0.9, 0.4), (1.1, 0.6, 0.9), (0.35, 1.5, -0.3))


def cross() -> Plan:
    """Five boxes welded to a cross, dropped flat on a floor."""
    places = [(0, 1), (-0.5, 1), (0.5, 1), (0, 1.5), (0, 0.5)]
    joints = [
        Joint(kind="weld", a=0, b=k, at=(places[k][0] / 2, (1 + places[k][1]) / 2)) for k in range(1, len(places))
    ]
    floor = box(8, 0.5, (0, -0.25), fixed=True)
    return Plan((*(box(0.5, 0.5, place) for place in places), floor), tuple(joints))


SCENES: dict[str, Callable[[], Plan]] = {
    "billiard break": billiard_break,
    "bridge": bridge,
    "pile": pile,
    "welded cross dropped flat": cross,
}


def partners(plan: Plan) -> np.ndarray:
    """The body that each body's mirror image is."""
    at = np.array([body.position for body in plan.bodies])
    apart = np.linalg.norm(at[:, None] * (-1, 1) - at[None], axis=-1)
    assert apart.min(1).max() < 1e-12
    return apart.argmin(1)


@functools.cache
def symmetric_motion(name: str, solver: Solver) -> Motion:
    return motions(solver, [SCENES[name]()], SYMMETRIC, 60)[0]


def asymmetry(name: str, solver: Solver) -> float:
    """m, the most by which a centre is not where the mirror image of its partner is, within a second."""
    motion, other = symmetric_motion(name, solver), partners(SCENES[name]())
    image = motion.position[:, other] * (-1, 1)
    return float(np.linalg.norm(motion.position - image, axis=-1).max())


def break_asymmetry(solver: Solver) -> float:
    """Share of the cue's speed by which the two halves of a billiard break differ after a second."""
    motion, other = symmetric_motion("billiard break", solver), partners(billiard_break())
    image = motion.velocity[-1, other] * (-1, 1)
    return float(np.linalg.norm(motion.velocity[-1] - image, axis=-1).max() / CUE_M_S)


def promises() -> list[Promise]:
    orders = [
        Promise(
            name=f"order: {name}, {kind.name}",
            unit="of rounding's",
            limits=everywhere(1.0),
            measure=functools.partial(order_error, name, kind),
        )
        for name in ORDERS
        for kind in (JOINTED, GROUNDED)
    ]
    symmetric = [
        Promise(
            name=f"order: symmetric {name}",
            unit="m",
            limits=everywhere(1e-4),
            measure=functools.partial(asymmetry, name),
        )
        for name in SCENES
    ]
    halves = Promise(
        name="order: speeds of the halves of a billiard break",
        unit="of the cue's speed",
        limits=everywhere(0.01),
        measure=break_asymmetry,
    )
    return [*orders, *symmetric, halves]
