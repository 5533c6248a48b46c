"""Impacts, friction and rolling against closed forms."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from jax2d import Capacity
from tests.engine.oracle import regained_height, rotation
from tests.engine.promises.plan import Body, G, Joint, Plan, Point, bar, box, disc, polygon
from tests.engine.promises.promise import Promise, Solver, everywhere, motions

DT = 1 / 60
THROWN = Capacity(polygons=3, circles=0, joints=1, thrusters=0, vertices=6)
MANY = Capacity(polygons=26, circles=3, joints=26, thrusters=0)
NUM_THROWS, THROW_STEPS = 64, 12
MU = 0.4  # some throws slide, some stick
ROUGH = {"friction_coefficient": MU}
BOWL_M, FACETS, BOWL_RADII_M = 2.0, (8, 12, 16, 22), (0.1, 0.2)


# Thrown boxes


class Throw(NamedTuple):
    """A box in free flight without gravity."""

    width: float
    height: float
    angle: float
    position: Point
    velocity: Point
    spin: float

    @property
    def squared_radius(self) -> float:
        """Inertia over mass, m^2."""
        return (self.width**2 + self.height**2) / 12

    def corners_at(self, seconds: float) -> np.ndarray:
        """[4, 2] m."""
        x, y = self.width / 2, self.height / 2
        local = np.array([(-x, -y), (x, -y), (x, y), (-x, y)])
        centre = np.array(self.position) + seconds * np.array(self.velocity)
        return local @ rotation(self.angle + self.spin * seconds).T + centre

    def parts(self, num: int) -> tuple[Body, ...]:
        """The box cut across its width, moving as one."""
        found = []
        for k in range(num):
            off = rotation(self.angle) @ ((k + 0.5) / num * self.width - self.width / 2, 0.0)
            position = (self.position[0] + off[0], self.position[1] + off[1])
            velocity = (self.velocity[0] - self.spin * off[1], self.velocity[1] + self.spin * off[0])
            moves: dict[str, Any] = {"velocity": velocity, "spin": self.spin, "options": ROUGH}
            found.append(box(self.width / num, self.height, position, self.angle, **moves))
        return tuple(found)


class Impact(NamedTuple):
    """Where and when a box meets something fixed: the point, and the normal that pushes it."""

    seconds: float
    point: np.ndarray
    normal: np.ndarray


def at_a_floor(rng: np.random.Generator) -> Throw:
    """A corner ahead, a floor below."""
    width, height = (float(x) for x in rng.uniform(0.4, 1, 2))
    angle, spin, vx, vy = rng.uniform((0.3, -2, -3, -6), (1.2, 2, 3, -1.5))
    throw = Throw(width, height, float(angle), (0.0, 0.0), (float(vx), float(vy)), float(spin))
    lowest = throw.corners_at(0.0)[:, 1].min()
    return throw._replace(position=(0.0, float(rng.uniform(0.002, 0.1) - lowest)))


def at_a_corner(rng: np.random.Generator) -> Throw:
    """A face ahead, the upward corner of a fixed box below, at the origin."""
    width, height = (float(x) for x in rng.uniform(0.4, 1, 2))
    angle, spin, vx, vy = rng.uniform((-0.3, -2, -2, -6), (0.3, 2, 2, -1.5))
    offset = float(rng.uniform(-0.4, 0.4)) * width
    above = rotation(float(angle)) @ (offset, height / 2 + float(rng.uniform(0.002, 0.1)))
    return Throw(width, height, float(angle), (float(above[0]), float(above[1])), (float(vx), float(vy)), float(spin))


def meets_floor(throw: Throw) -> Impact | None:
    seconds = _first(lambda t: throw.corners_at(t)[:, 1].min())
    if seconds is None:
        return None
    corners = throw.corners_at(seconds)
    return Impact(seconds, corners[corners[:, 1].argmin()], np.array([0.0, 1.0]))


def meets_corner(throw: Throw) -> Impact | None:
    """None where the corner leaves the face's sides."""

    def height_of_face(seconds: float) -> float:
        away = -(np.array(throw.position) + seconds * np.array(throw.velocity))
        return -float((rotation(throw.angle + throw.spin * seconds).T @ away)[1]) - throw.height / 2

    seconds = _first(height_of_face)
    if seconds is None:
        return None
    turn = rotation(throw.angle + throw.spin * seconds)
    local = turn.T @ -(np.array(throw.position) + seconds * np.array(throw.velocity))
    return None if abs(local[0]) > 0.45 * throw.width else Impact(seconds, np.zeros(2), turn[:, 1])


def coulomb_impacts(throw: Throw, impact: Impact) -> list[tuple[np.ndarray, float]]:
    """Velocity and spin after an impact without bounce, by Coulomb's law for the impulse of it all, and for the force
    at every moment (Routh). They differ where a point that slides would stop on the way and be made to slide back."""
    velocity, spin, squared_radius = np.array(throw.velocity), throw.spin, throw.squared_radius
    arm = impact.point - (np.array(throw.position) + impact.seconds * velocity)
    normal, tangent = impact.normal, np.array([impact.normal[1], -impact.normal[0]])
    lever = np.array([_cross(arm, tangent), _cross(arm, normal)])
    response = np.eye(2) + np.outer(lever, lever) / squared_radius  # speed along tangent and normal, by impulse / mass
    approach = np.array([velocity @ tangent, velocity @ normal]) + spin * lever
    return [
        (velocity + push[0] * tangent + push[1] * normal, float(spin + lever @ push / squared_radius))
        for push in (push_at_once(response, approach), push_by_moments(response, approach))
    ]


def push_at_once(response: np.ndarray, approach: np.ndarray) -> np.ndarray:
    """Impulse by mass along tangent and normal: the point sticks in the end, or slides at Coulomb's limit."""
    push = np.linalg.solve(response, -approach)
    if abs(push[0]) > MU * push[1]:
        for side in (-1.0, 1.0):
            direction = np.array([side * MU, 1.0])
            push = direction * (-approach[1] / (response[1] @ direction))
            if push[1] > 0 and (approach + response @ push)[0] * side <= 0:
                break
    return push


def push_by_moments(response: np.ndarray, approach: np.ndarray) -> np.ndarray:
    """The same: friction is against the sliding of each moment, and holds the point once it has stopped, if it can."""
    direction = np.array([-math.copysign(MU, approach[0]), 1.0])
    rate = response @ direction
    until_still = -approach[0] / rate[0] if rate[0] * approach[0] <= 0 else math.inf
    push = min(until_still, -approach[1] / rate[1]) * direction
    holds = -response[0, 1] / response[0, 0]
    direction = np.array([np.clip(holds, -MU, MU), 1.0])
    return push - (approach + response @ push)[1] / (response[1] @ direction) * direction


TARGETS = {
    "corner of a box on a rough floor": (at_a_floor, meets_floor, box(20, 1, (0, -0.5), fixed=True, options=ROUGH)),
    "face of a box on a rough corner": (
        at_a_corner,
        meets_corner,
        box(1, 1, (0, -math.sqrt(0.5)), angle=math.pi / 4, fixed=True, options=ROUGH),
    ),
}


@functools.cache
def throws(target: str) -> list[tuple[Throw, Impact, int]]:
    """Throws, their impacts, and the sample after each at which nothing else has met the target."""
    rng = np.random.default_rng(3)
    thrown, meets, _ = TARGETS[target]
    found = []
    while len(found) < NUM_THROWS:
        throw = thrown(rng)
        impact = meets(throw)
        if impact is None or impact.seconds > (THROW_STEPS - 3) * DT:
            continue
        centre = np.array(throw.position) + impact.seconds * np.array(throw.velocity)
        angle, sample = throw.angle + throw.spin * impact.seconds, math.ceil(impact.seconds / DT) + 1
        leaves = [Throw(*throw[:2], angle, _xy(centre), _xy(v), spin) for v, spin in coulomb_impacts(throw, impact)]
        if all(is_clear(target, one, sample * DT - impact.seconds) for one in leaves):
            found.append((throw, impact, sample))
    return found


def is_clear(target: str, leaves: Throw, seconds: float) -> bool:
    """Whether only the point that met the target is near it, until `seconds` after the impact."""
    if target == "face of a box on a rough corner":
        return True  # it is the only corner
    heights = [np.sort(leaves.corners_at(t)[:, 1])[1] for t in np.linspace(0, seconds, 8)]
    return min(heights) > 0.05


@functools.cache
def thrown(target: str, parts: int, solver: Solver) -> list[tuple[np.ndarray, float]]:
    """(velocity of the centre of mass, spin) after each impact."""
    cases = throws(target)
    fixed = TARGETS[target][2]
    plans = []
    for throw, _, _ in cases:
        joints = [Joint(kind="weld", a=0, b=1, at=throw.position)] if parts == 2 else []
        plans.append(Plan((*throw.parts(parts), fixed), tuple(joints), gravity=(0.0, 0.0)))
    found = motions(solver, plans, THROWN, THROW_STEPS)
    return [
        (m.velocity[sample, :parts].mean(0), float(m.spin[sample, :parts].mean()))
        for m, (_, _, sample) in zip(found, cases, strict=True)
    ]


def impact_error(target: str, solver: Solver) -> float:
    """Share of its speed by which a box leaves otherwise than both closed forms say, the worst of 64."""
    found = thrown(target, 1, solver)
    at_once, by_moments = zip(*(coulomb_impacts(throw, impact) for throw, impact, _ in throws(target)), strict=True)
    return float(np.minimum(_errors(target, found, at_once), _errors(target, found, by_moments)).max())


def weld_error(target: str, solver: Solver) -> float:
    """Share of its speed by which two welded halves leave otherwise than the box in one piece, the worst of 64."""
    return float(_errors(target, thrown(target, 2, solver), thrown(target, 1, solver)).max())


# Scenes of their own


def bowl(num_facets: int, radius: float) -> Plan:
    """A smooth disc at rest on a facet of half a regular polygon."""
    angles = np.linspace(math.pi, 2 * math.pi, num_facets + 1)
    seams = BOWL_M * np.stack([np.cos(angles), np.sin(angles)], -1)
    smooth = {"friction": 0.0}
    bodies, places = [], []
    for start, end in itertools.pairwise(seams):
        tilt = math.atan2(*(end - start)[::-1])
        inward, middle = np.array([-math.sin(tilt), math.cos(tilt)]), (start + end) / 2
        length = float(np.linalg.norm(end - start))
        bodies.append(box(length, 0.2, _xy(middle - 0.1 * inward), tilt, fixed=True, options=smooth))
        places.append(_xy(middle + radius * inward))
    return Plan((disc(radius, places[num_facets // 8], options=smooth), *bodies))


def bowl_error(solver: Solver) -> float:
    """Share of the height that a disc regains by which it errs, the worst of eight bowls."""
    cases = [(num, radius) for num in FACETS for radius in BOWL_RADII_M]
    worst = 0.0
    for (num, radius), motion in zip(cases, motions(solver, [bowl(*case) for case in cases], MANY, 150), strict=True):
        path = motion.position[:, 0]
        lowest = -(BOWL_M * math.cos(math.pi / num / 2) - radius)
        risen = path[path[:, 0] > 0, 1].max() - lowest
        expected = regained_height(num, radius, num // 8, BOWL_M, G)
        worst = max(worst, abs(risen - expected) / expected)
    return worst


def chain_over_a_drum() -> Plan:
    """Links over half of a fixed drum, friction 0.3, and weights whose ratio is half-way, by Euler's exponent, to what
    would slip: e^(mu pi / 2)."""
    mu, radius, thickness, on_drum, hanging = 0.3, 0.5, 0.04, 12, 3
    rough = {"friction_coefficient": mu}
    turn = math.pi / on_drum
    reach = (radius + thickness / 2) / math.cos(turn / 2)  # of hinges from the centre
    length = 2 * (radius + thickness / 2) * math.tan(turn / 2)
    seams = [(-reach, -length * k) for k in range(hanging, 0, -1)]
    seams += [(reach * math.cos(a), reach * math.sin(a)) for a in np.linspace(math.pi, 0, on_drum + 1)]
    seams += [(reach, -length * k) for k in range(1, hanging + 1)]
    links = [_touching(bar(p, q, thickness, mass=0.05), rough) for p, q in itertools.pairwise(seams)]
    light, heavy = 2.0, 2.0 * math.exp(mu * math.pi / 2)
    weights = [box(0.2, 0.2, (x, y - 0.1), mass=m) for (x, y), m in ((seams[0], heavy), (seams[-1], light))]
    bodies = (disc(radius, fixed=True, options=rough), *weights, *links)
    joints = [Joint(a=k + 2, b=k + 3, at=seams[k]) for k in range(1, len(links))]
    joints += [Joint(a=1, b=3, at=seams[0]), Joint(a=2, b=len(bodies) - 1, at=seams[-1])]
    return Plan(bodies, tuple(joints))


def drum_slip(solver: Solver) -> float:
    """m, that the chain slips by from 0.5 to 3 s."""
    (motion,) = motions(solver, [chain_over_a_drum()], MANY, 180)
    return float(np.abs(motion.position[30:, 1:3, 1] - motion.position[30, 1:3, 1]).max())


def wedge_under_a_weight(slope: float, friction: float, *, guided: bool) -> Plan:
    """A wedge on a floor under a block of ten times its mass, which lies on its slope alone or slides on an upright
    rail: then the wedge is held by the friction of both of its faces."""
    rough = {"friction_coefficient": friction}
    rise = math.tan(slope)
    corners = [(0.0, 0.0), (2.0, 0.0), (0.0, 2.0 * rise)]
    wedge = polygon(corners, _xy(np.mean(corners, axis=0)), mass=1.0, options=rough)
    across, up = np.array([math.cos(slope), -math.sin(slope)]), np.array([math.sin(slope), math.cos(slope)])
    middle = np.array([1.0, rise]) + 0.2 * up
    sides = [_xy(x * across + y * up) for x, y in ((-0.25, -0.2), (0.25, -0.2), (0.25, 0.2), (-0.25, 0.2))]
    block = polygon(sides, _xy(middle), mass=10.0, options=rough)
    rail = Joint(kind="slider", a=0, b=2, at=_xy(middle), axis_angle=math.pi / 2)
    return Plan((box(10, 1, (0, -0.5), fixed=True, options=rough), wedge, block), (rail,) if guided else ())


def wedge_creep(solver: Solver) -> float:
    """m, that wedge or block moves by from 2 to 10 s, the worst of six that friction holds, three of them just so."""
    cases = ((0.2, 0.21, False), (0.2, 0.5, False), (0.5, 0.6, False), (0.3, 0.16, True), (0.3, 0.2, True))
    plans = [wedge_under_a_weight(*case[:2], guided=case[2]) for case in (*cases, (0.2, 0.3, True))]
    found = motions(solver, plans, THROWN, 600)
    return max(float(np.linalg.norm(m.position[-1] - m.position[120], axis=-1).max()) for m in found)


def hexagon(spin: float) -> Plan:
    """A hexagon of radius 0.5 m on a rough floor, flat, that turns about its right corner."""
    corners = [(0.5 * math.cos(a), 0.5 * math.sin(a)) for a in np.arange(6) * math.pi / 3]
    height = 0.5 * math.sqrt(0.75)
    rough = {"friction_coefficient": 2.0}
    # About the corner at (0.25, -height) from the centre.
    body = polygon(corners, (0.0, height), velocity=(spin * height, spin * 0.25), spin=-spin, options=rough)
    return Plan((box(20, 1, (0, -0.5), fixed=True, options=rough), body))


def hexagon_error(solver: Solver) -> float:
    """Share of the energy that a hexagon loses as it rolls onto its next face by which that is off, the worst of 8.

    About the next corner it keeps (5/12 + 1/2) of (5/12 + 1) of its spin, which is that of the start.
    """
    spins = np.linspace(3.0, 3.9, 8)
    worst = 0.0
    for spin, motion in zip(spins, motions(solver, [hexagon(float(s)) for s in spins], THROWN, 40), strict=True):
        height = 0.5 * math.sqrt(0.75)
        kinetic = 0.5 * ((motion.velocity[:, 1] ** 2).sum(-1) + 5 / 12 * 0.25 * motion.spin[:, 1] ** 2)
        energy = kinetic + G * (motion.position[:, 1, 1] - height)
        start = 0.5 * (17 / 12) * 0.25 * spin**2
        over = int(np.argmax(motion.angle[:, 1] < motion.angle[0, 1] - 1.2 * math.pi / 3))
        lost, expected = start - energy[over], start * (1 - (11 / 17) ** 2)
        worst = max(worst, abs(lost / expected - 1))
    return float(worst)


def promises() -> list[Promise]:
    impacts = [
        Promise(
            name=f"contact: {target}: closed form",
            unit="of its speed",
            limits=everywhere(0.05),
            measure=functools.partial(impact_error, target),
        )
        for target in TARGETS
    ]
    welds = [
        Promise(
            name=f"contact: {target}: welded halves against one piece",
            unit="of its speed",
            limits=everywhere(0.05),
            measure=functools.partial(weld_error, target),
        )
        for target in TARGETS
    ]
    others = [
        ("disc in a bowl of facets", "of its height", 0.02, bowl_error),
        ("chain over a drum at half of what holds", "m", 0.01, drum_slip),
        ("wedge under ten times its mass", "m", 0.001, wedge_creep),
        ("rolling hexagon", "of its loss", 0.05, hexagon_error),
    ]
    scenes = [
        Promise(name=f"contact: {name}", unit=unit, limits=everywhere(limit), measure=measure)
        for name, unit, limit, measure in others
    ]
    return [*impacts, *welds, *scenes]


# Inside


def _errors(
    target: str, found: Sequence[tuple[np.ndarray, float]], expected: Sequence[tuple[np.ndarray, float]]
) -> np.ndarray:
    """[64] of the speed of each throw."""
    return np.array(
        [
            max(float(np.linalg.norm(v - velocity)), abs(w - spin) * math.sqrt(throw.squared_radius))
            / math.hypot(*throw.velocity)
            for (throw, _, _), (v, w), (velocity, spin) in zip(throws(target), found, expected, strict=True)
        ]
    )


def _first(distance: Callable[[float], float]) -> float | None:
    """s, at which a distance that starts above 0 comes to 0, to 1e-9; None where it does not within the throw."""
    times = np.linspace(0, THROW_STEPS * DT, 800)
    below = [distance(t) <= 0 for t in times]
    if below[0] or not any(below):
        return None
    k = int(np.argmax(below))
    low, high = times[k - 1], times[k]
    for _ in range(30):
        middle = (low + high) / 2
        low, high = (low, middle) if distance(middle) <= 0 else (middle, high)
    return float(high)


def _touching(body: Body, options: dict[str, float]) -> Body:
    return dataclasses.replace(body, options=options)


def _cross(a: np.ndarray, b: np.ndarray) -> float:
    return float(a[0] * b[1] - a[1] * b[0])


def _xy(values: np.ndarray) -> Point:
    return (float(values[0]), float(values[1]))
