"""Neighbours: what another island does, 30 m away and in slots before or after, changes no bit of this one."""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np

from jax2d import BuiltWorld, Capacity
from tests.engine.promises.plan import Joint, Plan, box, disc, shifted, together
from tests.engine.promises.promise import Motion, Promise, Solver, everywhere, motion_of, motions

CAPACITY = Capacity(polygons=11, circles=8, joints=5, thrusters=0)
AWAY_M = (30.0, 0.0)
STEPS = 300
# Sums of the reference go by slot, so that other slots beside an island change how it rounds: 7e-6 after a second of
# the dumbbell, whose bounces make 11 rad/s of it by the end.
REFERENCE_STEPS, REFERENCE_ROUNDING = 60, 1e-4
FLOOR = {"width": 6.0, "height": 0.5, "position": (0.0, -0.25), "fixed": True}


def stack() -> Plan:
    """Five boxes, set down unevenly."""
    boxes = [box(0.5, 0.5, (0.02 * k * (-1) ** k, 0.26 + 0.51 * k)) for k in range(5)]
    return Plan((box(**FLOOR), *boxes))


def bouncing_disc() -> Plan:
    """A disc that falls 1 m and bounces with e = 1."""
    floor = box(**FLOOR, options={"restitution": 1.0})
    return Plan((floor, disc(0.1, (0, 1.1), options={"restitution": 1.0})))


def pendulum() -> Plan:
    bodies = (box(0.2, 0.2, (0, 2), fixed=True), box(1.0, 0.1, (0.5, 2)))
    return Plan(bodies, (Joint(a=0, b=1, at=(0, 2)),))


def car() -> Plan:
    """A chassis on two wheels, one of them driven, that runs into a box."""
    bodies = (
        box(**FLOOR),
        box(1.0, 0.2, (-1, 0.4)),
        disc(0.2, (-1.4, 0.25)),
        disc(0.2, (-0.6, 0.25)),
        box(0.3, 0.3, (1, 0.16)),
    )
    return Plan(
        bodies,
        (Joint(a=1, b=2, at=(-1.4, 0.25), speed=-8.0, strength=0.5), Joint(a=1, b=3, at=(-0.6, 0.25))),
    )


def welded_tree() -> Plan:
    """Five boxes welded together, dropped on an edge."""
    places = [(0, 1.2), (0.4, 1.3), (-0.4, 1.1), (0.5, 1.6), (-0.5, 0.8)]
    boxes = [box(0.4, 0.2, place, angle=0.3 * k, density=1.0 + k) for k, place in enumerate(places)]
    parents = {2: 1, 3: 1, 4: 2, 5: 3}
    joints = [
        Joint(kind="weld", a=a, b=b, at=tuple(np.add(places[a - 1], places[b - 1]) / 2)) for b, a in parents.items()
    ]
    return Plan((box(**FLOOR), *boxes), tuple(joints))


def dumbbell() -> Plan:
    """Two discs welded to a bar, dropped aslant: they bounce together with e = 1."""
    elastic = {"restitution": 1.0}
    bodies = (
        box(**FLOOR, options=elastic),
        box(0.8, 0.1, (0, 1.2), angle=0.4, options=elastic),
        *(disc(0.15, (side * 0.4 * np.cos(0.4), 1.2 + side * 0.4 * np.sin(0.4)), options=elastic) for side in (-1, 1)),
    )
    joints = [Joint(kind="weld", a=1, b=b, at=bodies[b].position) for b in (2, 3)]
    return Plan(bodies, tuple(joints))


def jam() -> Plan:
    """A disc deep in a fixed box and in a fixed disc, hinged to a free box."""
    bodies = (
        box(2.0, 4.0, (1.0, 0.5), fixed=True),
        disc(0.3, (-0.3, 0.6), fixed=True),
        disc(0.35, (0.0, 0.4)),
        box(0.5, 0.4, (-0.2, 0.4), angle=0.4),
    )
    return Plan(bodies, (Joint(a=3, b=2, at=(0.0, 0.4)),))


def fast_spinner() -> Plan:
    """A rod that spins at 50 rad/s on a floor among two balls."""
    bodies = (box(**FLOOR), box(1.0, 0.1, (0, 0.8), spin=50.0), disc(0.2, (-0.9, 0.2)), disc(0.2, (0.9, 0.2)))
    return Plan(bodies)


def stirrer() -> Plan:
    """A kinematic bar that turns at 6 rad/s in a trough with six balls."""
    walls = [box(0.2, 2.0, (side * 1.4, 1.0), fixed=True) for side in (-1, 1)]
    bar = box(2.2, 0.1, (0, 1.2), kinematic=True, spin=6.0)
    balls = [disc(0.15, (-0.9 + 0.36 * k, 0.2 + 0.4 * (k % 2)), options={"restitution": 0.5}) for k in range(6)]
    return Plan((box(**FLOOR), *walls, bar, *balls))


def billiards() -> Plan:
    """A disc that hits a row of three at 80 m/s, e = 1, between four walls."""
    elastic = {"restitution": 1.0}
    sides = [box(1.0, 4.0, (side * 3.0, 1.5), fixed=True, options=elastic) for side in (-1, 1)]
    lids = [box(7.0, 1.0, (0, y), fixed=True, options=elastic) for y in (-0.5, 3.5)]
    row = [disc(0.2, (0.41 * k, 0.21), options=elastic) for k in range(3)]
    cue = disc(0.2, (-2.0, 0.3), velocity=(80.0, 0.0), options=elastic)
    return Plan((*sides, *lids, *row, cue))


def empty_slots() -> Plan:
    """A box and a disc, whose slots are made inactive."""
    return Plan((box(0.3, 0.3), disc(0.2, (1, 1))))


ISLANDS: dict[str, Callable[[], Plan]] = {
    "stack": stack,
    "bouncing disc": bouncing_disc,
    "pendulum": pendulum,
    "car": car,
    "welded tree": welded_tree,
    "dumbbell": dumbbell,
}
NEIGHBOURS: dict[str, Callable[[], Plan]] = {
    "jam": jam,
    "spinner": fast_spinner,
    "stirrer": stirrer,
    "bouncing disc": bouncing_disc,
    "billiards": billiards,
    "empty slots": empty_slots,
}


@functools.cache
def alone(island: str, solver: Solver) -> tuple[Motion, Motion]:
    """Twice, as one batch: XLA rounds otherwise in a batch of another size."""
    first, second = motions(solver, [ISLANDS[island]()] * 2, CAPACITY, STEPS)
    return first, second


@functools.cache
def beside(island: str, neighbour: str, solver: Solver) -> tuple[Motion, Motion]:
    """Motion of an island that comes before its neighbour in the slots, and of one that comes after it."""
    here, there = ISLANDS[island](), shifted(NEIGHBOURS[neighbour](), AWAY_M)
    plans = together(here, there), together(there, here)
    first = [0, len(there.bodies)]  # body of the island
    neighbours = [range(len(here.bodies), len(plans[0].bodies)), range(len(there.bodies))]
    worlds = [plan.build(CAPACITY) for plan in plans]
    if neighbour == "empty slots":
        worlds = [
            _without(world, plan.slots(CAPACITY)[bodies])
            for world, plan, bodies in zip(worlds, plans, neighbours, strict=True)
        ]
    found = [
        motion_of(p, t, CAPACITY) for p, t in zip(plans, solver.trajectories(worlds, CAPACITY, STEPS), strict=True)
    ]
    mine = [Motion(*(x[:, k : k + len(here.bodies)] for x in m)) for m, k in zip(found, first, strict=True)]
    return mine[0], mine[1]


def change(island: str, neighbour: str, solver: Solver) -> float:
    """Largest change of any number of an island's motion, m, rad, m/s or rad/s; of the reference beyond rounding."""
    steps, rounding = (STEPS + 1, 0.0) if solver.backend == "warp" else (REFERENCE_STEPS, REFERENCE_ROUNDING)
    pairs = zip(alone(island, solver), beside(island, neighbour, solver), strict=True)
    changes = [np.abs(x - y)[:steps].max() for one, other in pairs for x, y in zip(one, other, strict=True)]
    worst = float(np.max(changes))
    return 0.0 if worst <= rounding else worst - rounding


def height_change(solver: Solver) -> float:
    """m, by which a disc that bounces a metre high with e = 1 is at another height beside a stirrer, at any time."""
    pairs = zip(alone("bouncing disc", solver), beside("bouncing disc", "stirrer", solver), strict=True)
    return float(max(np.abs(one.position[:, 1, 1] - other.position[:, 1, 1]).max() for one, other in pairs))


def promises() -> list[Promise]:
    same = [
        Promise(
            name=f"neighbours: {island} beside {neighbour}",
            unit="any number",
            limits=everywhere(0.0),
            measure=functools.partial(change, island, neighbour),
        )
        for island in ISLANDS
        for neighbour in NEIGHBOURS
    ]
    height = Promise(
        name="neighbours: height of a disc with e = 1 beside a stirrer",
        unit="m",
        limits=everywhere(0.01),
        measure=height_change,
    )
    return [*same, height]


def _without(world: BuiltWorld, slots: np.ndarray) -> BuiltWorld:
    active = np.array(world.scene.shapes.active)
    active[slots] = False
    return world._replace(scene=world.scene.replace(shapes={"active": active}))
