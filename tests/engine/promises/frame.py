"""Frames: a world that drifts, is turned, mirrored or shifted moves as it did, to rounding.

A rounding is off by half a unit in the last place either way. Worlds make that grow, or jump: what touches in one
sub-step or in the next ends millimetres apart. So each world says itself what rounding may do: copies of it start
elsewhere, by up to one rounding a step of the largest number in it, and a frame takes it no further away than copies
are from each other and from where they began.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from jax2d import Capacity
from tests.engine.promises.plan import (
    Body,
    G,
    Joint,
    Plan,
    Point,
    Spring,
    adrift,
    box,
    disc,
    mirrored,
    polygon,
    shifted,
    turned,
)
from tests.engine.promises.promise import Motion, Promise, Solver, everywhere, motions

CAPACITY = Capacity(polygons=9, circles=4, joints=6, thrusters=0, springs=2)
NUM_WORLDS, NUM_MOVED = 16, 24
MOVED_SIZES = 6  # each half of the one before
STEPS, DT = 20, 1 / 60
MACHINE_STEPS, MACHINE_SPEEDS = 60, range(26, 46, 2)
EPSILON = float(np.finfo(np.float32).eps)
TURN_RAD, SHIFT_M = 0.7, (100.0, 0.0)
LEVER_M = 0.3  # by which angles count as distances
DRIFTS_M_S = (0.1, 3.0, 20.0, 60.0)


class Kind(NamedTuple):
    """A kind of drawn worlds."""

    name: str
    grounded: bool = False  # with gravity, a floor and a wall; else in free flight
    touching: bool = True


JOINTED, FLYING, GROUNDED = Kind("joints alone", touching=False), Kind("in flight"), Kind("on a floor", grounded=True)


def drawn_world(seed: int, kind: Kind) -> Plan:
    """Boxes, triangles and discs on a jittered lattice that fly about, some of them joined."""
    rng = np.random.default_rng(seed)
    places = [(0.5 * x, 0.5 * y) for y in range(3) for x in range(3)]
    bodies = [_drawn_body(rng, place, is_disc=k in (2, 4, 6)) for k, place in enumerate(places)]
    if not kind.touching:
        bodies = [dataclasses.replace(body, options=body.options | {"mask": 0}) for body in bodies]
    options_of = [("hinge", {}), ("weld", {}), ("slider", {"limits": (-0.1, 0.1)}), ("hinge", {"limits": (-0.3, 0.3)})]
    options_of += [("hinge", {"speed": 3.0, "strength": 0.1}), ("slider", {"speed": 0.5, "strength": 0.5})]
    joints = []
    for k in rng.permutation(len(options_of))[:4]:
        joint_kind, options = options_of[k]
        a = int(rng.integers(len(bodies) - 3))
        b = a + int(rng.choice([1, 3])) if a % 3 < 2 else a + 3
        if any({a, b} == {joint.a, joint.b} for joint in joints):
            continue
        at = _between(bodies[a], bodies[b], rng)
        joints.append(Joint(kind=joint_kind, a=a, b=b, at=at, axis_angle=float(rng.uniform(-3, 3)), **options))
    springs = (_spring(bodies, 0, 8, 20.0), _spring(bodies, 2, 6, 50.0))
    if kind.grounded:
        bodies += [box(6, 0.4, (0.5, -0.5), fixed=True), box(0.3, 3, (1.6, 0.5), angle=0.1, fixed=True)]
    gravity = (0.0, -G) if kind.grounded else (0.0, 0.0)
    return Plan(tuple(bodies), tuple(joints), springs, gravity)


def machine() -> Plan:
    """A frame with a driven wheel, an arm between limits, a driven slider that hammers a loose ball, a weld, a spring,
    and a box that rests on the wheel."""
    bodies = (
        box(1.2, 0.2, (0, 0), density=2.0),
        disc(0.25, (-0.5, -0.1), density=1.5),
        box(0.6, 0.1, (0.8, 0.0)),
        box(0.5, 0.1, (1.3, 0.0)),
        box(0.2, 0.2, (0.2, 0.3)),
        box(0.3, 0.2, (-0.5, -0.45), velocity=(0.0, 0.5)),
        disc(0.12, (0.5, 0.32)),
        polygon([(0, 0), (0.4, 0), (0.1, 0.3)], (-0.4, 0.35)),
        box(0.1, 0.6, (0.9, 0.45)),
    )
    joints = (
        Joint(a=0, b=1, at=(-0.5, -0.1), speed=6.0, strength=0.3),
        Joint(a=0, b=2, at=(0.55, 0.0), speed=2.0, strength=0.2, limits=(-0.5, 0.5)),
        Joint(a=2, b=3, at=(1.07, 0.0), limits=(-0.3, 0.3)),
        Joint(kind="slider", a=0, b=4, at=(0.2, 0.3), axis_angle=0.0, speed=1.0, strength=2.0, limits=(-0.1, 0.3)),
        Joint(kind="weld", a=0, b=7, at=(-0.4, 0.2)),
    )
    springs = (Spring(a=0, b=5, at_a=(-0.2, -0.1), at_b=(-0.5, -0.45), options={"stiffness": 30.0, "damping": 0.3}),)
    return Plan(bodies, joints, springs, (0.0, 0.0))


class Frame(NamedTuple):
    """A change of frame."""

    name: str
    change: Callable[[Plan], Plan]
    seen: Callable[[Motion], Motion]  # the motion of the changed world, as it is in the frame of the first
    scale: float = 1.0  # largest number, m or m/s, that it brings
    kinds: tuple[Kind, ...] = (JOINTED, GROUNDED)


def drift(speed: float) -> Frame:
    velocity = (0.6 * speed, 0.8 * speed)

    def seen(motion: Motion) -> Motion:
        way = DT * np.arange(len(motion.position))[:, None, None] * velocity
        return motion._replace(position=motion.position - way)

    return Frame(f"drift of {speed:g} m/s", lambda plan: adrift(plan, velocity), seen, speed, (JOINTED, FLYING))


def _turned_back(motion: Motion) -> Motion:
    c, s = math.cos(TURN_RAD), math.sin(TURN_RAD)
    return motion._replace(position=motion.position @ np.array([[c, -s], [s, c]]), angle=motion.angle - TURN_RAD)


FRAMES = (
    *(drift(speed) for speed in DRIFTS_M_S),
    Frame("turn", lambda plan: turned(plan, TURN_RAD), _turned_back),
    Frame("mirror", mirrored, lambda m: m._replace(position=m.position * (-1.0, 1.0), angle=-m.angle)),
    Frame(
        "shift of 100 m",
        lambda plan: shifted(plan, SHIFT_M),
        lambda m: m._replace(position=m.position - SHIFT_M),
        100.0,
    ),
)


def worlds(kind: Kind) -> list[Plan]:
    return [drawn_world(seed, kind) for seed in range(NUM_WORLDS)]


def difference(one: Motion, other: Motion) -> float:
    """m, largest by which a centre is elsewhere or a body is turned otherwise, at any time."""
    angles = np.abs(np.remainder(one.angle - other.angle + np.pi, 2 * np.pi) - np.pi).max()
    return max(float(np.linalg.norm(one.position - other.position, axis=-1).max()), LEVER_M * float(angles))


@functools.cache
def unchanged(solver: Solver, kind: Kind) -> list[Motion]:
    """Motion of each drawn world."""
    return motions(solver, worlds(kind), CAPACITY, STEPS)


@functools.cache
def allowed(solver: Solver, kind: Kind, scale: float) -> np.ndarray:
    """m, that a frame may change each drawn world by: numbers in it are as large as `scale`, m or m/s."""
    by = STEPS * rounding(scale)
    copies = [copy for plan in worlds(kind) for copy in copies_of(plan, NUM_MOVED, by)]
    found = motions(solver, copies, CAPACITY, STEPS)
    of_world = [found[i : i + NUM_MOVED] for i in range(0, len(found), NUM_MOVED)]
    bases = unchanged(solver, kind)
    return np.array([by + spread([base, *apart]) for base, apart in zip(bases, of_world, strict=True)])


def rounding(scale: float) -> float:
    """Largest error of one rounding of numbers as large as `scale`, or as 1."""
    return EPSILON / 2 * max(1.0, scale)


def spread(found: Sequence[Motion]) -> float:
    """m, largest difference of any two."""
    return max(difference(one, other) for one, other in itertools.combinations(found, 2))


def copies_of(plan: Plan, number: int, most: float) -> list[Plan]:
    """Copies moved by up to `most`, many of them by far less: a jump is largest just where it begins."""
    return [moved(plan, seed, most / 2 ** (seed % MOVED_SIZES)) for seed in range(number)]


def moved(plan: Plan, seed: int, by: float) -> Plan:
    """The same world, moved by up to so much: m, rad, m/s and rad/s of what is not fixed."""
    rng = np.random.default_rng(1000 + seed)

    def near(body: Body) -> Body:
        if body.fixed:
            return body
        d = rng.uniform(-by, by, 6)
        return dataclasses.replace(
            body,
            position=(body.position[0] + d[0], body.position[1] + d[1]),
            velocity=(body.velocity[0] + d[2], body.velocity[1] + d[3]),
            angle=body.angle + d[4],
            spin=body.spin + d[5],
        )

    return plan._replace(bodies=tuple(map(near, plan.bodies)))


def frame_error(frame: Frame, kind: Kind, solver: Solver) -> float:
    """Largest difference that the frame makes, of what rounding may make."""
    found = motions(solver, [frame.change(plan) for plan in worlds(kind)], CAPACITY, STEPS)
    base, most = unchanged(solver, kind), allowed(solver, kind, frame.scale)
    return float(max(difference(b, frame.seen(f)) / m for b, f, m in zip(base, found, most, strict=True)))


def machine_error(solver: Solver) -> float:
    """m, the largest difference that ten speeds make to a machine in a second. In double none makes one (3e-11 m)."""
    plan, frames = machine(), [drift(float(speed)) for speed in MACHINE_SPEEDS]
    base, *drifting = motions(solver, [plan, *(frame.change(plan) for frame in frames)], CAPACITY, MACHINE_STEPS)
    return max(difference(base, frame.seen(found)) for frame, found in zip(frames, drifting, strict=True))


def promises() -> list[Promise]:
    drawn = [
        Promise(
            name=f"frame: {frame.name}, {kind.name}",
            unit="of rounding's",
            limits=everywhere(1.0),
            measure=functools.partial(frame_error, frame, kind),
        )
        for frame in FRAMES
        for kind in frame.kinds
    ]
    jointed = Promise(
        name="frame: machine of jointed parts at 26 to 44 m/s",
        unit="m",
        limits={"draft": 0.001, "standard": 0.001, "fine": 0.002},
        measure=machine_error,
    )
    return [*drawn, jointed]


def _drawn_body(rng: np.random.Generator, place: Point, is_disc: bool) -> Body:
    position = (place[0] + float(rng.uniform(-0.03, 0.03)), place[1] + float(rng.uniform(-0.03, 0.03)))
    vx, vy, spin = rng.uniform((-2, -2, -4), (2, 2, 4))
    fields = {"velocity": (float(vx), float(vy)), "spin": float(spin), "density": float(np.exp(rng.uniform(-1, 1)))}
    options = {"restitution": float(rng.choice([0.0, 0.5, 1.0])), "friction": float(rng.uniform(0, 1.5))}
    if is_disc:
        return disc(float(rng.uniform(0.12, 0.2)), position, options=options, **fields)
    width, height = (float(side) for side in rng.uniform(0.15, 0.3, 2))
    angle = float(rng.uniform(-3, 3))
    if rng.random() < 0.3:
        corners = [(0.0, 0.0), (width, 0.0), (0.3 * width, height)]
        return polygon(corners, position, angle=angle, options=options, **fields)
    return box(width, height, position, angle, options=options, **fields)


def _between(a: Body, b: Body, rng: np.random.Generator) -> Point:
    dx, dy = rng.uniform(-0.05, 0.05, 2)
    return ((a.position[0] + b.position[0]) / 2 + float(dx), (a.position[1] + b.position[1]) / 2 + float(dy))


def _spring(bodies: Sequence[Body], a: int, b: int, stiffness: float) -> Spring:
    options = {"stiffness": stiffness, "damping": 0.2}
    return Spring(a=a, b=b, at_a=bodies[a].position, at_b=bodies[b].position, options=options)
