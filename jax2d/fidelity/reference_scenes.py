"""Scenes without a formula: joints, motors, limits, welds, friction, impacts and piles, for 1 to 2 s.

    @reference_scene("double_pendulum_path", seconds=1.5, length=1.0)
    def double_pendulum_path(b: SceneBuilder) -> None: ...

Each function adds its bodies to a builder. Their true trajectory is computed once (`references.py`). Where neighbouring
trajectories part exponentially (pendulums, piles) they are followed only as long as the reference solution holds.
Impacts do not bounce where several bodies or joints share them, since what restitution means there differs from engine
to engine. A coefficient of friction mu is that between two shapes which both carry it (`units.with_plain_friction`).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np

from jax2d.builder import BuiltWorld, SceneBuilder
from jax2d.fidelity.study_scene import by_name
from jax2d.fidelity.units import MOTOR_ACCELERATION, G
from jax2d.scene import Capacity

# One capacity for all scenes, so that one compiled engine runs them all.
CAPACITY = Capacity(polygons=7, circles=7, joints=6, thrusters=2)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReferenceScene:
    """A scene, how long it is followed, and what its errors are divided by."""

    name: str
    seconds: float
    length: float  # m, of what moves or of how far it moves
    control: float  # of every motor and thruster
    compared_from: float  # s: a pile is compared where it has come to rest
    build: Callable[[SceneBuilder], None]

    def world(self, capacity: Capacity = CAPACITY) -> BuiltWorld:
        builder = SceneBuilder(capacity, gravity=(0.0, -G))
        self.build(builder)
        return builder.build()


_declared: list[ReferenceScene] = []


def reference_scene(
    name: str, *, seconds: float, length: float, control: float = 0.0, compared_from: float = 0.0
) -> Callable[[Callable[[SceneBuilder], None]], Callable[[SceneBuilder], None]]:
    def register(build: Callable[[SceneBuilder], None]) -> Callable[[SceneBuilder], None]:
        _declared.append(
            ReferenceScene(
                name=name, seconds=seconds, length=length, control=control, compared_from=compared_from, build=build
            )
        )
        return build

    return register


def _link(b: SceneBuilder, start: np.ndarray, angle: float, length: float, width: float, friction: float = 1.0) -> int:
    """A rod from `start`, `angle` rad from hanging down."""
    middle = start + length / 2 * np.array([math.sin(angle), -math.cos(angle)])
    return b.add_box(width=width, height=length, position=middle, angle=angle, friction=friction)


def _hanging(b: SceneBuilder, angles: tuple[float, ...], length: float, width: float = 0.06) -> list[int]:
    """Rods one below the other, each at its angle from the vertical, from a fixed pivot at the origin."""
    links = [b.add_circle(radius=0.05, fixed=True)]
    at = np.zeros(2)
    for angle in angles:
        links.append(_link(b, at, angle, length, width))
        b.add_revolute_joint(links[-2], links[-1], at=at)
        at = at + length * np.array([math.sin(angle), -math.cos(angle)])
    for i, a in enumerate(links):
        for c in links[i + 2 :]:
            b.keep_apart(a, c)
    return links[1:]


# Pendulums


@reference_scene("double_pendulum_path", seconds=1.5, length=1.0)
def double_pendulum_path(b: SceneBuilder) -> None:
    _hanging(b, (2.0, 2.5), 0.5)


@reference_scene("triple_pendulum", seconds=1.2, length=1.2)
def triple_pendulum(b: SceneBuilder) -> None:
    _hanging(b, (math.pi / 2, math.pi / 2, math.pi / 2), 0.4)


@reference_scene("limited_pendulum", seconds=2.0, length=1.0)
def limited_pendulum(b: SceneBuilder) -> None:
    """The lower rod swings out to a limit of its knee and back to the other."""
    pivot = b.add_circle(radius=0.05, fixed=True)
    upper = _link(b, np.zeros(2), 1.2, 0.5, 0.08)
    knee = 0.5 * np.array([math.sin(1.2), -math.cos(1.2)])
    lower = _link(b, knee, 1.2, 0.5, 0.06)
    b.add_revolute_joint(pivot, upper, at=(0, 0))
    b.add_revolute_joint(upper, lower, at=knee, limits=(-0.3, 0.5))
    b.keep_apart(pivot, lower)


@reference_scene("two_link_arm", seconds=1.5, length=1.5, control=1.0)
def two_link_arm(b: SceneBuilder) -> None:
    """A shoulder whose motor is weaker than the load it meets, an elbow whose motor runs into its limit."""
    base = b.add_box(width=0.2, height=0.2, fixed=True)
    upper = _link(b, np.zeros(2), 0.3, 1.0, 0.2)
    elbow = np.array([math.sin(0.3), -math.cos(0.3)])
    lower = _link(b, elbow, 0.3, 0.5, 0.1)
    mass, inertia = 1.0 * 0.2, 1.0 / 60  # kg, kg m^2 of the upper link about its centre, to which its motor is scaled
    torque = 1.2 * mass * G * 0.5
    b.add_revolute_joint(base, upper, at=(0, 0), motor_speed=0.6, motor_power=torque / (MOTOR_ACCELERATION * inertia))
    b.add_revolute_joint(upper, lower, at=elbow, motor_speed=0.8, motor_power=0.3, limits=(-1.0, 1.0))


# Impacts and friction


@reference_scene("tumbling_box", seconds=1.2, length=1.0)
def tumbling_box(b: SceneBuilder) -> None:
    """Corner after corner meets the floor and bounces (e = 0.6), without friction."""
    b.add_box(width=20, height=1, position=(0, -0.5), fixed=True, friction=0, restitution=0.6)
    b.add_box(
        width=0.5,
        height=0.3,
        position=(0, 1.2),
        angle=0.4,
        velocity=(1.0, 0.0),
        angular_velocity=2.0,
        friction=0,
        restitution=0.6,
    )


@reference_scene("box_into_stack", seconds=0.7, length=1.0)
def box_into_stack(b: SceneBuilder) -> None:
    """A stack hit by a box, without friction, as in `circles_poured`."""
    mu, height = 0.0, 0.4
    b.add_box(width=20, height=1, position=(0, -0.5), fixed=True, friction=mu)
    for i, width in enumerate((0.6, 0.5, 0.4)):  # no corner above a corner
        b.add_box(width=width, height=height, position=(0, height * (i + 0.5)), friction=mu)
    b.add_box(width=0.3, height=0.2, position=(-1.2, 0.75), angle=0.2, velocity=(5, 1), density=2, friction=mu)


@reference_scene("circles_poured", seconds=1.2, length=1.0, compared_from=1.0)
def circles_poured(b: SceneBuilder) -> None:
    """Six discs fall into a valley of two slopes, where they come to rest."""
    mu = 0.0
    b.add_polygon([(-2.0, 1.2), (-2.0, -0.2), (0.0, -0.2), (0.0, 0.0)], fixed=True, friction=mu)
    b.add_polygon([(0.0, 0.0), (0.0, -0.2), (2.0, -0.2), (2.0, 1.0)], fixed=True, friction=mu)
    for i, (x, y, radius) in enumerate(
        [
            (-0.9, 0.85, 0.15),
            (-0.35, 0.5, 0.12),
            (0.25, 0.5, 0.14),
            (0.8, 0.75, 0.13),
            (-0.55, 1.0, 0.12),
            (0.45, 1.0, 0.15),
        ]
    ):
        b.add_circle(radius=radius, position=(x, y), friction=mu, density=1.0 + 0.2 * i)


@reference_scene("chain_wall", seconds=1.2, length=1.2)
def chain_wall(b: SceneBuilder) -> None:
    """Three links with a disc at the end swing from the horizontal against a wall."""
    mu = 0.3
    b.add_box(width=0.4, height=4, position=(-0.5, -1.0), fixed=True, friction=mu)
    links = _hanging(b, (math.pi / 2,) * 3, 0.3)
    disc = b.add_circle(radius=0.12, position=(0.9, 0.0), density=4.0, friction=mu)
    b.add_revolute_joint(links[-1], disc, at=(0.9, 0.0))
    for link in links[:-1]:
        b.keep_apart(link, disc)
    b.keep_apart(b.capacity.polygons, disc)


@reference_scene("pinball", seconds=1.0, length=1.0)
def pinball(b: SceneBuilder) -> None:
    """A disc bounces (e = 0.5), with friction, from peg to peg."""
    how = {"friction": 0.3, "restitution": 0.5}
    for x, y in ((0.05, 0.0), (0.45, -0.35), (-0.25, -0.5), (0.2, -0.95), (-0.6, -0.9)):
        b.add_circle(radius=0.08, position=(x, y), fixed=True, **how)
    b.add_circle(radius=0.1, position=(0.0, 0.7), **how)
    b.add_box(width=6, height=0.4, position=(0, -1.6), fixed=True, **how)


@reference_scene("stack_on_cart", seconds=0.8, length=1.0, control=1.0)
def stack_on_cart(b: SceneBuilder) -> None:
    """Two boxes slide and tip on a plank that a thruster pulls away below them."""
    mu = 0.4
    b.add_box(width=20, height=1, position=(0, -0.5), fixed=True, friction=0)
    plank = b.add_box(width=3.6, height=0.1, position=(0, 0.05), friction=mu)
    b.add_box(width=0.5, height=0.4, position=(1.0, 0.3), friction=mu)
    b.add_box(width=0.2, height=0.5, position=(0.95, 0.75), friction=mu)
    b.add_thruster(plank, at=(0, 0.05), angle=0.0, power=0.4)


def _ragdoll(b: SceneBuilder, *, limits: bool, friction: float) -> list[int]:
    """Trunk at the origin, head, two arms and two legs: [trunk, left arm, right arm, legs, head]; only the head's
    neck has limits unless `limits`."""
    trunk = b.add_box(width=0.25, height=0.5, friction=friction)
    parts = [trunk]
    for at, angle, length, reach in (
        ((-0.12, 0.2), -1.3, 0.4, (-1.2, 1.2)),
        ((0.12, 0.2), 1.2, 0.4, (-1.0, 0.6)),
        ((-0.08, -0.23), -0.4, 0.5, (-0.5, 0.6)),
        ((0.08, -0.23), 0.5, 0.5, (-0.6, 0.5)),
    ):
        parts.append(_link(b, np.array(at), angle, length, 0.1, friction=friction))
        b.add_revolute_joint(trunk, parts[-1], at=at, limits=reach if limits else None)
    parts.append(b.add_circle(radius=0.12, position=(0.0, 0.37), friction=friction))
    b.add_revolute_joint(trunk, parts[-1], at=(0.0, 0.25), limits=(-0.4, 0.4))
    for i, a in enumerate(parts):
        for c in parts[i + 1 :]:
            b.keep_apart(a, c)
    return parts


@reference_scene("ragdoll_swing", seconds=1.5, length=1.5)
def ragdoll_swing(b: SceneBuilder) -> None:
    """One hand holds on to a bar."""
    parts = _ragdoll(b, limits=False, friction=0.5)
    at = np.array([-0.12 + 0.4 * math.sin(-1.3), 0.2 - 0.4 * math.cos(-1.3)])
    bar = b.add_circle(radius=0.03, position=at, fixed=True)
    b.add_revolute_joint(bar, parts[1], at=at)
    for part in parts:
        b.keep_apart(bar, part)


@reference_scene("ragdoll_slope", seconds=0.8, length=1.0)
def ragdoll_slope(b: SceneBuilder) -> None:
    """A ragdoll falls on a slope of 0.35 rad, limbs at their limits. The least certain of all: what an impact of
    several bodies with friction leaves depends on where in a step it falls, however short the step."""
    _ragdoll(b, limits=True, friction=0.5)
    slope = 0.35
    normal = np.array([math.sin(slope), math.cos(slope)])
    surface = -0.85 * np.array([0.0, 1.0])
    b.add_box(width=20, height=1, angle=-slope, position=surface - 0.5 * normal, fixed=True, friction=0.5)


@reference_scene("catapult", seconds=1.0, length=2.0)
def catapult(b: SceneBuilder) -> None:
    """A counterweight welded to one end of a lever falls; a box slides off the other and flies."""
    mu, tilt = 0.8, -0.3  # rad: the end with the box is low
    along = np.array([math.cos(tilt), math.sin(tilt)])
    up = np.array([-math.sin(tilt), math.cos(tilt)])
    pivot = b.add_circle(radius=0.05, fixed=True)
    lever = b.add_box(width=2.4, height=0.1, angle=tilt, friction=mu)
    b.add_revolute_joint(pivot, lever, at=(0, 0))
    weight = b.add_box(width=0.5, height=0.5, position=-1.0 * along - 0.3 * up, angle=tilt, density=5)
    b.add_fixed_joint(lever, weight, at=-1.0 * along - 0.05 * up)
    b.add_box(width=0.3, height=0.2, position=0.95 * along + 0.15 * up, angle=tilt, friction=mu)


# Machines


@reference_scene("car_over_bumps", seconds=2.0, length=2.0, control=1.0)
def car_over_bumps(b: SceneBuilder) -> None:
    """A body on two driven wheels goes up and down two wedges."""
    mu, radius = 0.8, 0.2
    b.add_box(width=20, height=1, position=(0, -0.5), fixed=True, friction=mu)
    for x in (0.9, 1.8):
        b.add_polygon([(x - 0.3, 0.0), (x + 0.3, 0.0), (x, 0.08)], fixed=True, friction=mu)
    body = b.add_box(width=1.0, height=0.3, position=(0, 0.35), friction=mu)
    for x in (-0.4, 0.4):
        wheel = b.add_circle(radius=radius, position=(x, radius), friction=mu)
        b.add_revolute_joint(body, wheel, at=(x, radius), motor_speed=-1.5, motor_power=0.15)


@reference_scene("thruster_craft", seconds=2.0, length=2.0, control=1.0)
def thruster_craft(b: SceneBuilder) -> None:
    """Two unequal thrusters and a welded fin; a load swings below."""
    hull = b.add_box(width=0.8, height=0.2)
    fin = b.add_box(width=0.1, height=0.4, position=(0.35, 0.25))
    b.add_fixed_joint(hull, fin, at=(0.35, 0.1))
    load = _link(b, np.array([0.0, -0.1]), 0.5, 0.5, 0.08)
    b.add_revolute_joint(hull, load, at=(0.0, -0.1))
    b.keep_apart(fin, load)
    b.add_thruster(hull, at=(-0.35, -0.1), angle=math.pi / 2, power=0.14)
    b.add_thruster(hull, at=(0.35, -0.1), angle=math.pi / 2, power=0.15)


REFERENCE_SCENES = by_name(_declared)
