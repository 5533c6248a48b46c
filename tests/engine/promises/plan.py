"""Plans: worlds as data, which can be turned, mirrored, shifted, set adrift, joined and given in another order.

Positions are those of centres of mass, in float64. `build` makes an engine's world of a plan, `rigid_bodies.py` its
motion in float64.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple, TypeVar

import numpy as np

from jax2d import BuiltWorld, Capacity, SceneBuilder

Point = tuple[float, float]
G = 9.81  # m/s^2


@dataclasses.dataclass(frozen=True, kw_only=True)
class Body:
    """A disc (`radius`) or a convex polygon (`corners`, about its centre of mass)."""

    radius: float | None = None  # m
    corners: tuple[Point, ...] = ()  # m, counter-clockwise
    position: Point = (0.0, 0.0)  # m
    angle: float = 0.0  # rad
    velocity: Point = (0.0, 0.0)  # m/s
    spin: float = 0.0  # rad/s
    density: float = 1.0  # kg/m^2
    fixed: bool = False
    kinematic: bool = False
    options: dict[str, Any] = dataclasses.field(default_factory=dict)  # others of `SceneBuilder.add_polygon`

    @property
    def moves_freely(self) -> bool:
        return not (self.fixed or self.kinematic)

    @property
    def mass(self) -> float:
        """kg."""
        return self.density * _area_and_second_moment(self)[0]

    @property
    def inertia(self) -> float:
        """kg m^2."""
        return self.density * _area_and_second_moment(self)[1]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Joint:
    """A joint at a world point of the bodies as they start."""

    kind: Literal["hinge", "weld", "slider"] = "hinge"
    a: int
    b: int
    at: Point
    axis_angle: float = 0.0  # rad, world frame, of a slider
    limits: tuple[float, float] | None = None  # rad, of a slider m
    speed: float | None = None  # rad/s or m/s of its motor, which always acts
    strength: float = 0.0  # N m or N of the motor


@dataclasses.dataclass(frozen=True, kw_only=True)
class Spring:
    """A spring and damper between world points of the bodies as they start."""

    a: int
    b: int
    at_a: Point
    at_b: Point
    options: dict[str, float]  # of `SceneBuilder.add_spring`


Element = TypeVar("Element", Joint, Spring)


class Plan(NamedTuple):
    """One world."""

    bodies: tuple[Body, ...]
    joints: tuple[Joint, ...] = ()
    springs: tuple[Spring, ...] = ()
    gravity: Point = (0.0, -G)

    def slots(self, capacity: Capacity) -> np.ndarray:
        """Shape of each body in the world that `build` makes."""
        is_disc = np.array([body.radius is not None for body in self.bodies])
        return np.where(is_disc, capacity.polygons + np.cumsum(is_disc) - 1, np.cumsum(~is_disc) - 1)

    def build(self, capacity: Capacity) -> BuiltWorld:
        """Bodies and joints take slots in the plan's order."""
        b = SceneBuilder(capacity, gravity=self.gravity)
        slots = [int(slot) for slot in self.slots(capacity)]
        for body in self.bodies:
            options: dict[str, Any] = {"position": body.position, "angle": body.angle, "density": body.density}
            options |= {"fixed": body.fixed, "kinematic": body.kinematic, **body.options}
            if not body.fixed:
                options |= {"velocity": body.velocity, "angular_velocity": body.spin}
            if body.radius is not None:
                b.add_circle(radius=body.radius, **options)
            else:
                b.add_polygon(body.corners, **options)
        for joint in self.joints:
            _add_joint(b, joint, slots)
        for spring in self.springs:
            b.add_spring(slots[spring.a], slots[spring.b], at_a=spring.at_a, at_b=spring.at_b, **spring.options)
        return b.build()


def box(width: float, height: float, position: Point = (0.0, 0.0), angle: float = 0.0, **fields: Any) -> Body:
    """`fields`: of `Body`; `mass` in kg in place of its density."""
    x, y = width / 2, height / 2
    corners = ((-x, -y), (x, -y), (x, y), (-x, y))
    return _with_mass(Body(corners=corners, position=position, angle=angle, **_without_mass(fields)), fields)


def disc(radius: float, position: Point = (0.0, 0.0), **fields: Any) -> Body:
    """`fields` as of `box`."""
    return _with_mass(Body(radius=radius, position=position, **_without_mass(fields)), fields)


def polygon(corners: Sequence[Point], position: Point = (0.0, 0.0), **fields: Any) -> Body:
    """Corners about any origin, moved so that the centre of mass is at `position`."""
    points = np.asarray(corners, np.float64)
    x, y = points.T
    cross = x * np.roll(y, -1) - np.roll(x, -1) * y
    centre = ((points + np.roll(points, -1, 0)) * cross[:, None]).sum(0) / (3 * cross.sum())
    body = Body(corners=tuple(map(_point, points - centre)), position=position, **_without_mass(fields))
    return _with_mass(body, fields)


def bar(start: Point, end: Point, width: float, **fields: Any) -> Body:
    """A box from one point to another that touches nothing. `fields` as of `box`."""
    (x0, y0), (x1, y1) = start, end
    middle, angle = ((x0 + x1) / 2, (y0 + y1) / 2), math.atan2(y1 - y0, x1 - x0)
    return box(math.dist(start, end), width, middle, angle, options={"mask": 0}, **fields)


# Transformations


def adrift(plan: Plan, velocity: Point) -> Plan:
    """The same world in a frame that moves."""
    vx, vy = velocity
    return _with_bodies(plan, lambda body: {"velocity": (body.velocity[0] + vx, body.velocity[1] + vy)})


def shifted(plan: Plan, by: Point) -> Plan:
    def move(point: Point) -> Point:
        return (point[0] + by[0], point[1] + by[1])

    return _moved(_with_bodies(plan, lambda body: {"position": move(body.position)}), move, lambda axis: axis)


def turned(plan: Plan, angle: float) -> Plan:
    """Turned about the origin, with its gravity."""
    c, s = math.cos(angle), math.sin(angle)

    def turn(v: Point) -> Point:
        return (c * v[0] - s * v[1], s * v[0] + c * v[1])

    def of(body: Body) -> dict[str, Any]:
        return {
            "position": turn(body.position),
            "velocity": turn(body.velocity),
            "angle": math.remainder(body.angle + angle, math.tau),
        }

    return _moved(_with_bodies(plan, of), turn, lambda axis: axis + angle)._replace(gravity=turn(plan.gravity))


def mirrored(plan: Plan) -> Plan:
    """x becomes -x. Angles, spins, hinges' limits and motors change their sign."""

    def mirror(v: Point) -> Point:
        return (-v[0], v[1])

    def of(body: Body) -> dict[str, Any]:
        return {
            "corners": tuple(mirror(corner) for corner in reversed(body.corners)),
            "position": mirror(body.position),
            "velocity": mirror(body.velocity),
            "angle": -body.angle,
            "spin": -body.spin,
        }

    plan = _moved(_with_bodies(plan, of), mirror, lambda axis: math.pi - axis)
    joints = tuple(joint if joint.kind == "slider" else _negated(joint) for joint in plan.joints)
    return plan._replace(joints=joints, gravity=mirror(plan.gravity))


def together(first: Plan, second: Plan) -> Plan:
    """Both in one world, with the gravity of the first; its bodies and joints come first."""
    n = len(first.bodies)
    joints, springs = (
        _with_ends(second.joints, lambda body: body + n),
        _with_ends(second.springs, lambda body: body + n),
    )
    return Plan(first.bodies + second.bodies, first.joints + joints, first.springs + springs, first.gravity)


def with_bodies_in_order(plan: Plan, order: Sequence[int]) -> Plan:
    """Body k of the result is body order[k]."""
    place = {old: new for new, old in enumerate(order)}
    joints, springs = _with_ends(plan.joints, place.__getitem__), _with_ends(plan.springs, place.__getitem__)
    return plan._replace(bodies=tuple(plan.bodies[old] for old in order), joints=joints, springs=springs)


def with_ends_swapped(joint: Joint) -> Joint:
    """The same joint, seen from its other body."""
    return dataclasses.replace(_negated(joint), a=joint.b, b=joint.a)


def with_first_corner(body: Body, first: int) -> Body:
    """The same polygon, given from another corner on."""
    return dataclasses.replace(body, corners=body.corners[first:] + body.corners[:first])


# Inside


def _with_ends(elements: Sequence[Element], number: Callable[[int], int]) -> tuple[Element, ...]:
    """Elements between other bodies: `number` gives the new number of each."""
    return tuple(dataclasses.replace(element, a=number(element.a), b=number(element.b)) for element in elements)


def _add_joint(b: SceneBuilder, joint: Joint, slots: Sequence[int]) -> None:
    ends = slots[joint.a], slots[joint.b]
    if joint.kind == "weld":
        b.add_fixed_joint(*ends, at=joint.at)
        return
    options: dict[str, Any] = {"limits": joint.limits, "speed": joint.speed}
    if joint.kind == "hinge":
        strength: dict[str, Any] = {"max_torque": joint.strength} if joint.speed is not None else {}
        b.add_revolute_joint(*ends, at=joint.at, **options, **strength)
    else:
        strength = {"max_force": joint.strength} if joint.speed is not None else {}
        b.add_prismatic_joint(*ends, at=joint.at, axis_angle=joint.axis_angle, **options, **strength)


def _negated(joint: Joint) -> Joint:
    limits = None if joint.limits is None else (-joint.limits[1], -joint.limits[0])
    return dataclasses.replace(joint, limits=limits, speed=None if joint.speed is None else -joint.speed)


def _with_bodies(plan: Plan, change: Any) -> Plan:
    return plan._replace(bodies=tuple(dataclasses.replace(body, **change(body)) for body in plan.bodies))


def _moved(plan: Plan, move: Any, turn_axis: Any) -> Plan:
    """Joints and springs of a plan whose points are moved."""
    joints = tuple(
        dataclasses.replace(joint, at=move(joint.at), axis_angle=turn_axis(joint.axis_angle)) for joint in plan.joints
    )
    springs = tuple(
        dataclasses.replace(spring, at_a=move(spring.at_a), at_b=move(spring.at_b)) for spring in plan.springs
    )
    return plan._replace(joints=joints, springs=springs)


def _without_mass(fields: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in fields.items() if name != "mass"}


def _with_mass(body: Body, fields: dict[str, Any]) -> Body:
    if "mass" not in fields:
        return body
    return dataclasses.replace(body, density=fields["mass"] / _area_and_second_moment(body)[0])


def _area_and_second_moment(body: Body) -> tuple[float, float]:
    """m^2, and m^4 about the centre of mass."""
    if body.radius is not None:
        area = math.pi * body.radius**2
        return area, area * body.radius**2 / 2
    points = np.asarray(body.corners, np.float64)
    after = np.roll(points, -1, 0)
    cross = points[:, 0] * after[:, 1] - after[:, 0] * points[:, 1]
    squares = (points * points + points * after + after * after).sum(1)
    return float(cross.sum() / 2), float((cross * squares).sum() / 12)


def _point(values: np.ndarray) -> Point:
    return (float(values[0]), float(values[1]))
