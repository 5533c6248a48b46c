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

import itertools
import math
from typing import Any, NamedTuple, Unpack

import jax
import numpy as np

from jax2d import terrain
from jax2d.builder_checks import (
    LARGEST,
    SMALLEST_RADIUS_M,
    Point,
    Points,
    SceneError,
    SceneFullError,
    check_polygon,
    direction,
    finite,
    in_units,
    one_of,
    positive,
)
from jax2d.builder_options import (
    POSE_AND_MOTION,
    Body,
    BodyKeywords,
    BodyOptions,
    Filter,
    MaterialKeywords,
    MotorOptions,
    PrismaticKeywords,
    PrismaticMotor,
    RevoluteKeywords,
    RevoluteMotor,
    SpringKeywords,
    SpringOptions,
    body_of,
)
from jax2d.checks import check_type
from jax2d.fields import empty
from jax2d.scene import Capacity, JointKind, Scene
from jax2d.settings import Settings, checked_settings
from jax2d.shapes import polygon_integrals
from jax2d.whole_numbers import whole_number


class BuiltWorld(NamedTuple):
    """One world, in the order in which Engine.initial_state takes it."""

    scene: Scene
    position: np.ndarray  # [n, 2] m
    angle: np.ndarray  # [n] rad
    velocity: np.ndarray  # [n, 2] m/s
    angular_velocity: np.ndarray  # [n] rad/s


class SceneBuilder:
    """Adds shapes and what acts on them to an empty world of the given capacity. A refused call adds nothing."""

    def __init__(self, capacity: Capacity, *, gravity: Point = (0.0, -9.81), settings: Settings | None = None):
        """`settings`: those of the engine, whose base_* numbers turn torques, forces and speeds into the units of a
        scene; by default those that all presets have."""
        check_type("capacity", capacity, Capacity)
        self.capacity = capacity
        self.settings = checked_settings(settings)
        self._gravity = np.asarray(finite("gravity", gravity, 2), np.float32)
        n = capacity.shapes
        self._polygons = self._circles = self._joints = self._springs = self._thrusters = 0
        self._apart: set[tuple[int, int]] = set()
        self._filters: dict[int, Filter] = {}
        self._position = np.zeros((n, 2), np.float32)
        self._angle = np.zeros(n, np.float32)
        self._velocity = np.zeros((n, 2), np.float32)
        self._angular_velocity = np.zeros(n, np.float32)
        self._scene = empty(Scene, capacity.sizes)

    # Shapes

    def add_polygon(self, vertices: Points, **options: Unpack[BodyKeywords]) -> int:
        """A convex polygon; options are the fields of `BodyOptions`. `vertices` run counter-clockwise about any origin,
        which comes to `position`; the shape's position in a state is its centre of mass."""
        corners = check_polygon(vertices, self.capacity.vertices)
        area, centroid, inertia = polygon_integrals(corners)
        body = body_of(area, inertia, BodyOptions.of(**options), self.capacity, self.settings)
        index = self._take("polygons", self._polygons)
        self._polygons += 1
        padded = np.concatenate([corners, np.repeat(corners[-1:], self.capacity.vertices - len(corners), 0)])
        self._scene.shapes.vertices[index] = padded - centroid
        self._scene.shapes.num_vertices[index] = len(corners)
        self._set_shape(index, body, centroid)  # the given velocity is that of the centre of mass
        return index

    def add_box(self, *, width: float, height: float, **options: Unpack[BodyKeywords]) -> int:
        """A rectangle centred on `position`; options as for add_polygon."""
        x, y = positive("width", width) / 2, positive("height", height) / 2
        return self.add_polygon([(-x, -y), (x, -y), (x, y), (-x, y)], **options)

    def add_circle(self, *, radius: float, **options: Unpack[BodyKeywords]) -> int:
        """A disc; options as for add_polygon."""
        radius = positive("radius", radius)
        if radius < SMALLEST_RADIUS_M:
            raise SceneError(f"radius is {radius:g}; it must be at least {SMALLEST_RADIUS_M:.2g} m")
        area = math.pi * radius**2
        body = body_of(area, 0.5 * area * radius**2, BodyOptions.of(**options), self.capacity, self.settings)
        slot = self._take("circles", self._circles)
        self._circles += 1
        self._scene.shapes.radius[slot] = radius
        index = self.capacity.polygons + slot
        self._set_shape(index, body, np.zeros(2))
        return index

    def add_terrain(self, points: Points, *, thickness: float = 0.5, **options: Unpack[MaterialKeywords]) -> list[int]:
        """Ground along a line of points, which lies to the right of its direction: below a line that runs to the right.
        A fixed polygon from each point to the next, `thickness` m deep; what slides or rolls over the joints does not
        feel them (`terrain.py` says why). Tiles between two crests have 6 vertices. Options as for add_polygon, but for
        where a shape is and how it moves. Returns the shapes."""
        if wrong := [name for name in options if name in POSE_AND_MOTION]:
            raise SceneError(f"{wrong[0]} of terrain, which is where its points are and stays there; leave it out")
        try:
            line = np.asarray(points, np.float64)
        except (TypeError, ValueError, OverflowError):
            line = np.zeros(0)
        deep = positive("thickness", thickness)
        if not (np.abs(line) <= LARGEST).all():
            raise SceneError(f"points hold NaN or more than {LARGEST:g}; give finite coordinates in metres")
        if (mistake := terrain.wrong_with(line, deep)) is not None:
            raise SceneError(mistake)
        corners = list(terrain.tiles(line, deep))
        if (most := max(map(len, corners))) > self.capacity.vertices:
            raise SceneError(f"at its crests the terrain has tiles of {most} vertices; use Capacity(vertices={most})")
        if (needed := self._polygons + len(corners)) > self.capacity.polygons:
            raise SceneFullError(
                f"terrain of {len(corners)} tiles, and {self._polygons} of {self.capacity.polygons} polygons used; "
                f"build with Capacity(polygons={needed}) or more"
            )
        return [
            self.add_polygon(tile - line[i], position=line[i], fixed=True, **options) for i, tile in enumerate(corners)
        ]

    def keep_apart(self, a: int, b: int) -> None:
        """Lets two shapes pass through each other. Shapes that a joint connects do so already; `category` and `mask`
        do it for many."""
        a, b = self._shape("a", a), self._shape("b", b)
        if a == b:
            raise SceneError(f"shape {a} kept apart from itself; name two different shapes")
        self._apart.add((a, b))

    # Joints, springs and thrusters

    def add_revolute_joint(
        self,
        a: int,
        b: int,
        *,
        at: Point,
        **motor: Unpack[RevoluteKeywords],
    ) -> int:
        """Holds a and b together at the world point `at`. `limits` bound angle_b - angle_a, counted from how they stand
        now, in rad. With a speed a control drives b relative to a: `speed` in rad/s, or `motor_speed` in units of
        settings.base_motor_speed; `max_torque` in N m, or `motor_power` (1 by default), see builder_options.py.
        `drive`: "velocity", "brake" (control 0 holds still) or "servo" (control -1 to 1 is a position between the
        limits)."""
        return self._add_joint(a, b, at, JointKind.REVOLUTE, RevoluteMotor(**motor))

    def add_prismatic_joint(
        self,
        a: int,
        b: int,
        *,
        at: Point,
        axis_angle: float,
        **motor: Unpack[PrismaticKeywords],
    ) -> int:
        """Lets b slide along the world angle `axis_angle` (rad), which turns with a, not turning against a. `limits`
        bound how far it has slid from where it stands now, in m. With a speed a control drives b along the axis:
        `speed` in m/s, or `motor_speed` in units of settings.base_slider_speed; `max_force` in N, with the bodies as
        they stand now, or `motor_power` (1 by default). `drive` as in add_revolute_joint."""
        return self._add_joint(
            a, b, at, JointKind.PRISMATIC, PrismaticMotor(**motor), direction("axis_angle", axis_angle)
        )

    def add_fixed_joint(self, a: int, b: int, *, at: Point) -> int:
        """Welds a and b together as they stand."""
        return self._add_joint(a, b, at, JointKind.FIXED)

    def add_spring(
        self,
        a: int,
        b: int,
        *,
        at_a: Point,
        at_b: Point,
        **spring: Unpack[SpringKeywords],
    ) -> int:
        """A spring and damper from the world point `at_a` on a to `at_b` on b: `stiffness` in N/m about `rest_length`
        (m, as now by default), `damping` in N s/m, limits of the length in m. The two shapes may still touch."""
        return self._add_spring(a, b, at_a, at_b, SpringOptions(**spring))

    def add_rope(self, a: int, b: int, *, at_a: Point, at_b: Point, length: float | None = None) -> int:
        """Keeps two points at most `length` m apart, by default as far as now."""
        longest = self._apart_now(at_a, at_b) if length is None else length
        return self._add_spring(a, b, at_a, at_b, SpringOptions(max_length=longest))

    def add_rod(self, a: int, b: int, *, at_a: Point, at_b: Point) -> int:
        """Keeps two points as far apart as they are now."""
        length = self._apart_now(at_a, at_b)
        return self._add_spring(a, b, at_a, at_b, SpringOptions(min_length=length, max_length=length))

    def add_thruster(
        self, body: int, *, at: Point, angle: float, power: float | None = None, force: float | None = None
    ) -> int:
        """A thruster at the world point `at` that pushes its body towards the world angle `angle`, with `force` in N or
        `power` (1 by default) in units of settings.base_thruster_power."""
        body = self._shape("body", body)
        if self._has_no_mass(body):
            state = (
                "kinematic and moves as its velocity says" if self._is_kinematic(body) else "fixed and would not move"
            )
            raise SceneError(f"thruster on shape {body}, which is {state}; put it on one that can be pushed")
        one_of(("power", power), ("force", force))
        if force is not None:
            power = in_units("force", positive("force", force), self.settings, "base_thruster_power")
        position = self._to_local(body, at)
        local_angle = direction("angle", angle) - self._angle[body]
        power = positive("power", 1.0 if power is None else power)
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
        for (a, of_a), (b, of_b) in itertools.combinations(self._filters.items(), 2):
            can_touch[a, b] = can_touch[b, a] = of_a.lets_touch(of_b)
        joints = self._scene.joints
        joined = list(zip(joints.a[joints.active], joints.b[joints.active], strict=True))
        for a, b in [*joined, *self._apart]:
            can_touch[a, b] = can_touch[b, a] = False
        scene = jax.tree.map(np.copy, self._scene).replace(shapes={"can_touch": can_touch}, gravity=self._gravity)
        starts = (self._position, self._angle, self._velocity, self._angular_velocity)
        return BuiltWorld(scene, *(x.copy() for x in starts))

    # Inside

    def _take(self, kind: str, used: int) -> int:
        slots = getattr(self.capacity, kind)
        if used == slots:
            raise SceneFullError(f"{used} of {slots} {kind} used; build with Capacity({kind}={slots + 1}) or more")
        return used

    def _set_shape(self, index: int, body: Body, centre: np.ndarray) -> None:
        """`centre` [2] m: of mass, from where `position` is, in the body frame."""
        shapes = self._scene.shapes
        shapes.active[index] = True
        for name, value in body.shape.items():
            getattr(shapes, name)[index] = value
        self._position[index] = np.asarray(body.position) + _rotate(centre, body.angle)
        self._angle[index] = body.angle
        self._velocity[index] = body.velocity
        self._angular_velocity[index] = body.angular_velocity
        self._filters[index] = body.filter

    def _add_joint(
        self, a: int, b: int, at: Point, kind: JointKind, motor: MotorOptions | None = None, world_axis: float = 0.0
    ) -> int:
        a, b = self._two_shapes("joint", a, b)
        values: dict[str, Any] = {"active": True, "kind": kind, "a": a, "b": b}
        values |= {"anchor_a": self._to_local(a, at), "anchor_b": self._to_local(b, at)}
        values["rest_angle"] = self._angle[b] - self._angle[a]
        if kind == JointKind.PRISMATIC:
            values["axis_angle"] = world_axis - float(self._angle[a])
        if motor is not None:
            inverse = sum(self._inverse_moved(body, at, kind, world_axis) for body in (a, b))
            values |= motor.fields(kind, self.settings, 1 / inverse)
        index = self._take("joints", self._joints)
        self._joints += 1
        for name, value in values.items():
            getattr(self._scene.joints, name)[index] = value
        return index

    def _add_spring(self, a: int, b: int, at_a: Point, at_b: Point, options: SpringOptions) -> int:
        a, b = self._two_shapes("spring", a, b)
        values = {"active": True, "a": a, "b": b, **options.fields(self._apart_now(at_a, at_b))}
        values |= {"anchor_a": self._to_local(a, at_a, "at_a"), "anchor_b": self._to_local(b, at_b, "at_b")}
        index = self._take("springs", self._springs)
        self._springs += 1
        for name, value in values.items():
            getattr(self._scene.springs, name)[index] = value
        return index

    @staticmethod
    def _apart_now(at_a: Point, at_b: Point) -> float:
        return math.dist(finite("at_a", at_a, 2), finite("at_b", at_b, 2))

    def _two_shapes(self, what: str, a: int, b: int) -> tuple[int, int]:
        a, b = self._shape("a", a), self._shape("b", b)
        if a == b:
            raise SceneError(f"{what} from shape {a} to itself; name two different shapes")
        if self._has_no_mass(a) and self._has_no_mass(b):
            state = "fixed and would not move"
            if self._is_kinematic(a) or self._is_kinematic(b):
                state = "fixed or kinematic, and which nothing can push"
            raise SceneError(f"{what} of shapes {a} and {b}, which are both {state}; leave it out")
        return a, b

    def _inverse_moved(self, body: int, at: Point, kind: JointKind, world_axis: float) -> float:
        """Inverse mass of one body along a motor's axis: 1/(kg m^2), of a slider 1/kg."""
        shapes = self._scene.shapes
        mass, inertia = float(shapes.inverse_mass[body]), float(shapes.inverse_inertia[body])
        if kind != JointKind.PRISMATIC:
            return inertia
        x, y = np.asarray(finite("at", at, 2)) - self._position[body]
        lever = x * math.sin(world_axis) - y * math.cos(world_axis)
        return mass + inertia * lever**2

    def _has_no_mass(self, shape: int) -> bool:
        return self._scene.shapes.inverse_mass[shape] == 0

    def _is_kinematic(self, shape: int) -> bool:
        return bool(self._scene.shapes.kinematic[shape])

    def _shape(self, name: str, index: int) -> int:
        try:
            shape = whole_number(name, index)
            if 0 <= shape < self.capacity.shapes and self._scene.shapes.active[shape]:
                return shape
        except ValueError:
            pass
        raise SceneError(
            f"{name} is {index!r}, which is no shape of this scene; use what add_polygon or add_circle gave"
        )

    def _to_local(self, body: int, at: Point, name: str = "at") -> np.ndarray:
        return _rotate(np.asarray(finite(name, at, 2)) - self._position[body], -float(self._angle[body]))


def _rotate(v: np.ndarray, angle: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([c * v[0] - s * v[1], s * v[0] + c * v[1]])
