"""Builds one world by hand, with errors that name the remedy.

    builder = SceneBuilder(Capacity(polygons=2, circles=1, joints=1, thrusters=0))
    floor = builder.add_box(width=10, height=1, position=(0, -0.5), fixed=True)
    box = builder.add_box(width=1, height=1, position=(0, 0.5))
    ball = builder.add_circle(radius=0.2, position=(0, 1.2))
    builder.add_revolute_joint(box, ball, at=(0, 1.0), motor_speed=1.0)
    world = builder.build()
    state = engine.initial_state(*world)

Units: m, kg, s, rad; positions in the world frame. Functions that add a shape return its index.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np

from jax2d import terrain
from jax2d.builder_checks import (
    LARGEST,
    SMALLEST_RADIUS_M,
    Point,
    SceneError,
    SceneFullError,
    a_number,
    check_polygon,
    finite,
    positive,
)
from jax2d.fields import empty
from jax2d.scene import Capacity, JointKind, Scene
from jax2d.shapes import polygon_integrals
from jax2d.whole_numbers import whole_number


class BuiltWorld(NamedTuple):
    """One world, in the order in which Engine.initial_state takes it."""

    scene: Scene
    position: np.ndarray  # [n, 2] m
    angle: np.ndarray  # [n] rad
    velocity: np.ndarray  # [n, 2] m/s
    angular_velocity: np.ndarray  # [n] rad/s


class _Body(NamedTuple):
    """What shapes of both kinds have, checked."""

    shape: dict[str, float]  # fields of `Shapes`
    angle: float
    velocity: list[float]
    angular_velocity: float


class SceneBuilder:
    """Adds shapes, joints and thrusters to an empty world of the given capacity. A refused call adds nothing."""

    def __init__(self, capacity: Capacity, *, gravity: Point = (0.0, -9.81)):
        self.capacity = capacity
        self._gravity = np.asarray(finite("gravity", gravity, 2), np.float32)
        n = capacity.shapes
        self._polygons = self._circles = self._joints = self._thrusters = 0
        self._apart: set[tuple[int, int]] = set()
        self._position = np.zeros((n, 2), np.float32)
        self._angle = np.zeros(n, np.float32)
        self._velocity = np.zeros((n, 2), np.float32)
        self._angular_velocity = np.zeros(n, np.float32)
        self._scene = empty(Scene, capacity.sizes)

    # Shapes

    def add_polygon(
        self,
        vertices: Sequence[Point],
        *,
        position: Point = (0.0, 0.0),
        angle: float = 0.0,
        density: float = 1.0,
        friction: float = 1.0,
        restitution: float = 0.0,
        fixed: bool = False,
        velocity: Point = (0.0, 0.0),
        angular_velocity: float = 0.0,
    ) -> int:
        """A convex polygon. `vertices` run counter-clockwise about any origin, which comes to `position`;
        the shape's position in a state is its centre of mass."""
        corners = check_polygon(vertices, self.capacity.vertices)
        area, centroid, inertia = polygon_integrals(corners)
        body = _body(area, inertia, angle, density, friction, restitution, fixed, velocity, angular_velocity)
        at = np.asarray(finite("position", position, 2)) + _rotate(centroid, body.angle)
        index = self._take("polygons", self._polygons)
        self._polygons += 1
        padded = np.concatenate([corners, np.repeat(corners[-1:], self.capacity.vertices - len(corners), 0)])
        self._scene.shapes.vertices[index] = padded - centroid
        self._scene.shapes.num_vertices[index] = len(corners)
        self._set_shape(index, at, body)  # the given velocity is that of the centre of mass
        return index

    def add_box(self, *, width: float, height: float, **options: object) -> int:
        """A rectangle centred on `position`; options as for add_polygon."""
        x, y = positive("width", width) / 2, positive("height", height) / 2
        return self.add_polygon([(-x, -y), (x, -y), (x, y), (-x, y)], **options)  # type: ignore[arg-type]

    def add_circle(
        self,
        *,
        radius: float,
        position: Point = (0.0, 0.0),
        angle: float = 0.0,
        density: float = 1.0,
        friction: float = 1.0,
        restitution: float = 0.0,
        fixed: bool = False,
        velocity: Point = (0.0, 0.0),
        angular_velocity: float = 0.0,
    ) -> int:
        """A disc."""
        radius = positive("radius", radius)
        if radius < SMALLEST_RADIUS_M:
            raise SceneError(f"radius is {radius:g}; it must be at least {SMALLEST_RADIUS_M:.2g} m")
        area = math.pi * radius**2
        inertia = 0.5 * area * radius**2
        body = _body(area, inertia, angle, density, friction, restitution, fixed, velocity, angular_velocity)
        at = np.asarray(finite("position", position, 2))
        slot = self._take("circles", self._circles)
        self._circles += 1
        self._scene.shapes.radius[slot] = radius
        index = self.capacity.polygons + slot
        self._set_shape(index, at, body)
        return index

    def add_terrain(
        self,
        points: Sequence[Point],
        *,
        thickness: float = 0.5,
        density: float = 1.0,
        friction: float = 1.0,
        restitution: float = 0.0,
    ) -> list[int]:
        """Ground along a line of points, which lies to the right of its direction: below a line that runs to the right.
        A fixed polygon from each point to the next, `thickness` m deep; what slides or rolls over the joints does not
        feel them (`terrain.py` says why). Tiles between two crests have 6 vertices. Returns the shapes."""
        try:
            line = np.asarray(points, np.float64)
        except (TypeError, ValueError):
            line = np.zeros(0)
        deep = positive("thickness", thickness)
        if not (np.abs(line) <= LARGEST).all():
            raise SceneError(f"points hold NaN or more than {LARGEST:g}; give finite coordinates in metres")
        if (wrong := terrain.wrong_with(line, deep)) is not None:
            raise SceneError(wrong)
        corners = list(terrain.tiles(line, deep))
        if (most := max(map(len, corners))) > self.capacity.vertices:
            raise SceneError(f"at its crests the terrain has tiles of {most} vertices; use Capacity(vertices={most})")
        if (needed := self._polygons + len(corners)) > self.capacity.polygons:
            raise SceneFullError(
                f"terrain of {len(corners)} tiles, and {self._polygons} of {self.capacity.polygons} polygons used; "
                f"build with Capacity(polygons={needed}) or more"
            )
        look = {"density": density, "friction": friction, "restitution": restitution}
        return [
            self.add_polygon(tile - at, position=at, fixed=True, **look)  # type: ignore[arg-type]
            for tile, at in zip(corners, line)
        ]

    def keep_apart(self, a: int, b: int) -> None:
        """Lets two shapes pass through each other. Shapes that a joint connects do so already."""
        a, b = self._shape("a", a), self._shape("b", b)
        if a == b:
            raise SceneError(f"shape {a} kept apart from itself; name two different shapes")
        self._apart.add((a, b))

    # Joints and thrusters

    def add_revolute_joint(
        self,
        a: int,
        b: int,
        *,
        at: Point,
        motor_speed: float | None = None,
        motor_power: float = 1.0,
        limits: tuple[float, float] | None = None,
    ) -> int:
        """Holds a and b together at the world point `at`. With `motor_speed` (in units of
        settings.base_motor_speed) a control drives b relative to a; `limits` bound angle_b - angle_a, counted
        from how they stand now, in rad."""
        return self._add_joint(a, b, at, _drive(motor_speed, motor_power, limits))

    def add_prismatic_joint(
        self,
        a: int,
        b: int,
        *,
        at: Point,
        axis_angle: float,
        motor_speed: float | None = None,
        motor_power: float = 1.0,
        limits: tuple[float, float] | None = None,
    ) -> int:
        """Lets b slide along the world angle `axis_angle` (rad), which turns with a, without turning against a. With
        `motor_speed` (in units of settings.base_slider_speed) a control drives b along the axis; `limits` bound how
        far it has slid from where it stands now, in m."""
        a = self._shape("a", a)
        local_axis = a_number("axis_angle", axis_angle) - float(self._angle[a])
        values = {"kind": JointKind.PRISMATIC, "axis_angle": local_axis}
        return self._add_joint(a, b, at, values | _drive(motor_speed, motor_power, limits))

    def add_fixed_joint(self, a: int, b: int, *, at: Point) -> int:
        """Welds a and b together as they stand."""
        return self._add_joint(a, b, at, {"kind": JointKind.FIXED})

    def add_thruster(self, body: int, *, at: Point, angle: float, power: float = 1.0) -> int:
        """A thruster at the world point `at` that pushes its body towards the world angle `angle`."""
        body = self._shape("body", body)
        if self._is_fixed(body):
            raise SceneError(f"thruster on shape {body}, which is fixed and would not move; put it on one that can")
        position = self._to_local(body, at)
        local_angle, power = a_number("angle", angle) - self._angle[body], positive("power", power)
        index = self._take("thrusters", self._thrusters)
        self._thrusters += 1
        thrusters = self._scene.thrusters
        thrusters.active[index] = True
        thrusters.body[index] = body
        thrusters.position[index] = position
        thrusters.angle[index] = local_angle
        thrusters.power[index] = power
        return index

    def build(self) -> BuiltWorld:
        """The scene and how it starts. The builder can be added to and built again."""
        n = self.capacity.shapes
        can_touch = ~np.eye(n, dtype=bool)
        joints = self._scene.joints
        joined = list(zip(joints.a[joints.active], joints.b[joints.active], strict=True))
        for a, b in [*joined, *self._apart]:
            can_touch[a, b] = can_touch[b, a] = False
        scene = jax.tree.map(np.copy, self._scene).replace(shapes={"can_touch": can_touch}, gravity=self._gravity)
        starts = (self._position, self._angle, self._velocity, self._angular_velocity)
        return BuiltWorld(scene, *(x.copy() for x in starts))

    # Inside

    def _take(self, kind: str, used: int) -> int:
        room = getattr(self.capacity, kind)
        if used == room:
            raise SceneFullError(f"{used} of {room} {kind} used; build with Capacity({kind}={room + 1}) or more")
        return used

    def _set_shape(self, index: int, position: np.ndarray, body: _Body) -> None:
        shapes = self._scene.shapes
        shapes.active[index] = True
        for name, value in body.shape.items():
            getattr(shapes, name)[index] = value
        self._position[index] = position
        self._angle[index] = body.angle
        self._velocity[index] = body.velocity
        self._angular_velocity[index] = body.angular_velocity

    def _add_joint(self, a: int, b: int, at: Point, values: dict[str, float]) -> int:
        a, b = self._shape("a", a), self._shape("b", b)
        if a == b:
            raise SceneError(f"joint from shape {a} to itself; name two different shapes")
        if self._is_fixed(a) and self._is_fixed(b):
            raise SceneError(f"joint of shapes {a} and {b}, which are both fixed and would not move; leave it out")
        anchors = self._to_local(a, at), self._to_local(b, at)
        index = self._take("joints", self._joints)
        self._joints += 1
        joints = self._scene.joints
        joints.active[index] = True
        joints.a[index], joints.b[index] = a, b
        joints.anchor_a[index], joints.anchor_b[index] = anchors
        joints.rest_angle[index] = self._angle[b] - self._angle[a]
        for name, value in values.items():
            getattr(joints, name)[index] = value
        return index

    def _is_fixed(self, shape: int) -> bool:
        return self._scene.shapes.inverse_mass[shape] == 0

    def _shape(self, name: str, index: int) -> int:
        try:
            number = whole_number(name, index)
            if 0 <= number < self.capacity.shapes and self._scene.shapes.active[number]:
                return number
        except ValueError:
            pass
        raise SceneError(
            f"{name} is {index!r}, which is no shape of this scene; use what add_polygon or add_circle gave"
        )

    def _to_local(self, body: int, at: Point) -> np.ndarray:
        return _rotate(np.asarray(finite("at", at, 2)) - self._position[body], -float(self._angle[body]))


def _drive(motor_speed: float | None, motor_power: float, limits: tuple[float, float] | None) -> dict[str, float]:
    """Fields of `Joints` for a motor and limits."""
    values: dict[str, float] = {}
    if motor_speed is not None:
        values |= {"motor_on": True, "motor_speed": a_number("motor_speed", motor_speed)}
        values |= {"motor_power": positive("motor_power", motor_power)}
    if limits is not None:
        lower, upper = finite("limits", limits, 2)
        if lower > upper:
            raise SceneError(f"limits {lower:g} to {upper:g} are empty; give the smaller number first")
        if not lower <= 0 <= upper:
            raise SceneError(
                f"limits {lower:g} to {upper:g} leave out 0, which is how the shapes stand now; limits count from "
                "there: add the shapes where they are within the limits"
            )
        values |= {"has_limits": True, "lower_limit": lower, "upper_limit": upper}
    return values


def _body(
    area: float,
    second_moment: float,
    angle: float,
    density: float,
    friction: float,
    restitution: float,
    fixed: bool,
    velocity: Point,
    angular_velocity: float,
) -> _Body:
    """`second_moment`: of area about the centre of mass, m^4."""
    density = positive("density", density)
    friction, restitution = a_number("friction", friction), a_number("restitution", restitution)
    if friction < 0:
        raise SceneError(f"friction is {friction:g}; it must be 0 or more")
    if not 0 <= restitution <= 1:
        raise SceneError(f"restitution is {restitution:g}; it must be from 0 to 1")
    speed, spin = finite("velocity", velocity, 2), a_number("angular_velocity", angular_velocity)
    if fixed and (any(speed) or spin):
        raise SceneError("a fixed shape cannot move: drop its velocity, or fixed=True")
    mass, inertia = density * area, density * second_moment
    if not fixed and not all(1 / LARGEST <= x <= LARGEST for x in (mass, inertia)):
        raise SceneError(
            f"the shape has a mass of {mass:g} kg and an inertia of {inertia:g} kg m^2; both must be from "
            f"{1 / LARGEST:g} to {LARGEST:g}: change its size or density"
        )
    shape = {
        "inverse_mass": 0.0 if fixed else 1.0 / mass,
        "inverse_inertia": 0.0 if fixed else 1.0 / inertia,
        "density": density,
        "friction": friction,
        "restitution": restitution,
    }
    return _Body(shape, a_number("angle", angle), speed, spin)


def _rotate(v: np.ndarray, angle: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([c * v[0] - s * v[1], s * v[0] + c * v[1]])
