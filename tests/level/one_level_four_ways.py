"""One level as the generator, a level file, a public file and hand-written arrays would make it, each with an order of
corners and ends of its own: a box, a triangle, a wheel on a hinge, a second joint between the polygons, a thruster."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import JointKind, Joints, Thrusters
from kinetix_dist.level.derive import complete, derive
from kinetix_dist.level.draft import (
    DrivenJoints,
    DrivenThrusters,
    Shapes,
    draft_to_level,
    empty_draft,
    write_slot,
)
from kinetix_dist.level.kinetix_format import import_kinetix
from kinetix_dist.level.level import SIZES, Level, Role
from kinetix_dist.level.proposals import box_or_triangle
from kinetix_dist.level.schema import level_from_json
from kinetix_dist.level.walls import WALL_CENTRES_M, WALL_HALF_EXTENTS_M, empty_level, pad_vertices

CAPACITY = SIZES["m"]
BOX, TRIANGLE, WHEEL, GOAL = 4, 5, 6, 7
BOX_HALF_M, BOX_AT, BOX_ANGLE = (0.4, 0.15), (2.0, 2.0), 0.3
TRIANGLE_HALF_M, TRIANGLE_AT, TRIANGLE_ANGLE = (0.3, 0.2), (2.5, 2.2), -0.8  # half of the box that it is half of
WHEEL_RADIUS_M, WHEEL_ANGLE = 0.2, 1.0
GOAL_RADIUS_M, GOAL_AT = 0.3, (4.0, 1.0)
HINGE_ON_BOX = (-0.3, -0.1)  # the wheel is held at its centre
JOINT_ON_BOX = (0.35, 0.1)
THRUSTER_AT, THRUSTER_ANGLE = (0.2, 0.1), 2.0
SPEED, POWER, COLOUR = 1.5, 0.8, 2  # of the hinge, as seen from the box
LIMITS = (-0.5, 1.2)  # of the second joint, likewise: rad, of a slider m
AXIS = 0.4  # of a slider, frame of the box


def in_world(at: tuple[float, float], angle: float, point: tuple[float, float] | np.ndarray) -> np.ndarray:
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    return np.asarray(at) + turn @ np.asarray(point)


def in_frame(at: tuple[float, float], angle: float, point: np.ndarray) -> np.ndarray:
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    return turn.T @ (point - np.asarray(at))


WHEEL_AT = in_world(BOX_AT, BOX_ANGLE, HINGE_ON_BOX)
JOINT_ON_TRIANGLE = in_frame(TRIANGLE_AT, TRIANGLE_ANGLE, in_world(BOX_AT, BOX_ANGLE, JOINT_ON_BOX))


def by_generator(kind: JointKind) -> Level:
    """A draft, with each shape joined to the wheel or the triangle that was there before."""
    draft = empty_draft(CAPACITY)
    shapes = draft.shapes
    for slot, half, is_triangle, at, angle, role in (
        (BOX, BOX_HALF_M, False, BOX_AT, BOX_ANGLE, Role.GREEN),
        (TRIANGLE, TRIANGLE_HALF_M, True, TRIANGLE_AT, TRIANGLE_ANGLE, Role.NONE),
    ):
        corners, num_vertices = box_or_triangle(jnp.array(half), jnp.array(is_triangle), CAPACITY.vertices)
        row = _draft_shape(at, angle, role, vertices=corners, num_vertices=num_vertices)
        shapes = write_slot(shapes, jnp.array(slot), row, jnp.array(True))
    for slot, radius, at, angle, role in (
        (WHEEL, WHEEL_RADIUS_M, WHEEL_AT, WHEEL_ANGLE, Role.NONE),
        (GOAL, GOAL_RADIUS_M, GOAL_AT, 0.0, Role.BLUE),
    ):
        row = _draft_shape(at, angle, role, radius=jnp.array(radius), is_fixed=jnp.array(slot == GOAL))
        shapes = write_slot(shapes, jnp.array(slot), row, jnp.array(True))
    joints = draft.driven_joints
    for slot, (joint, colour) in enumerate(_joints_seen_from_others(kind)):
        row = DrivenJoints(joints=Joints(**{name: jnp.asarray(x) for name, x in joint.items()}), colour=colour)
        joints = write_slot(joints, jnp.array(slot), row, jnp.array(True))
    thruster = Thrusters(
        active=jnp.array(True),
        body=jnp.array(BOX),
        position=jnp.array(THRUSTER_AT),
        angle=jnp.array(THRUSTER_ANGLE),
        power=jnp.array(0.5),
    )
    thrusters = write_slot(
        draft.driven_thrusters, jnp.array(0), DrivenThrusters(thrusters=thruster, colour=jnp.array(1)), jnp.array(True)
    )
    draft = dataclasses.replace(draft, shapes=shapes, driven_joints=joints, driven_thrusters=thrusters)
    return jax.tree.map(np.asarray, derive(*draft_to_level(draft, CAPACITY)))


def by_file(kind: JointKind) -> Level:
    """A document; the triangle is drawn from its right angle, and the joint's ends are as in the draft."""
    right_angle = np.array([1.0, -1.0]) * 2 / 3 * TRIANGLE_HALF_M  # from the centroid, see box_or_triangle
    x, y = 2 * np.array(TRIANGLE_HALF_M)
    second = {"revolute": {"limits": [-LIMITS[1], -LIMITS[0]]}, "fixed": {}, "prismatic": {"limits": list(LIMITS)}}
    axis = {"axis": AXIS - (TRIANGLE_ANGLE - BOX_ANGLE) + math.pi} if kind == JointKind.PRISMATIC else {}
    return level_from_json(
        {
            "format": "kinetix-dist-level",
            "version": 1,
            "name": "four_ways",
            "size": "m",
            "shapes": [
                {
                    "id": "box",
                    "type": "box",
                    "width": 2 * BOX_HALF_M[0],
                    "height": 2 * BOX_HALF_M[1],
                    "position": list(BOX_AT),
                    "angle": BOX_ANGLE,
                    "role": "green",
                },
                {
                    "id": "triangle",
                    "type": "polygon",
                    "vertices": [[0.0, 0.0], [0.0, y], [-x, 0.0]],
                    "position": in_world(TRIANGLE_AT, TRIANGLE_ANGLE, right_angle).tolist(),
                    "angle": TRIANGLE_ANGLE,
                },
                {
                    "id": "wheel",
                    "type": "circle",
                    "radius": WHEEL_RADIUS_M,
                    "position": WHEEL_AT.tolist(),
                    "angle": WHEEL_ANGLE,
                },
                {
                    "id": "goal",
                    "type": "circle",
                    "radius": GOAL_RADIUS_M,
                    "position": list(GOAL_AT),
                    "role": "blue",
                    "fixed": True,
                },
            ],
            "joints": [
                {
                    "type": "revolute",
                    "a": "wheel",
                    "b": "box",
                    "anchor": WHEEL_AT.tolist(),
                    "motor": {"speed": -SPEED, "power": POWER, "colour": COLOUR},
                },
                {
                    "type": kind.name.lower(),
                    "a": "triangle",
                    "b": "box",
                    "anchor": in_world(BOX_AT, BOX_ANGLE, JOINT_ON_BOX).tolist(),
                    **second[kind.name.lower()],
                    **axis,
                },
            ],
            "thrusters": [
                {"shape": "box", "position": list(THRUSTER_AT), "angle": THRUSTER_ANGLE, "power": 0.5, "colour": 1}
            ],
        }
    )


def by_public_file(kind: JointKind) -> Level:
    """A public document as the public editor and generator write one: corners clockwise from (+, +), the polygon first
    in a joint; and a triangle whose frame begins at one of its corners."""
    right_angle = np.array([1.0, -1.0]) * 2 / 3 * TRIANGLE_HALF_M
    x, y = 2 * np.array(TRIANGLE_HALF_M)
    signs = [(1, 1), (1, -1), (-1, -1), (-1, 1)]
    centres = np.array(WALL_CENTRES_M)
    offset = np.zeros((4, 2))
    offset[1:3], centres[1:3] = centres[1:3], 0.0  # side walls are not drawn about their position there
    walls = [
        _public_shape(
            centres[i], 0.0, vertices=[offset[i] + np.array(s) * WALL_HALF_EXTENTS_M[i] for s in signs], fixed=True
        )
        for i in range(4)
    ]
    box = _public_shape(BOX_AT, BOX_ANGLE, vertices=[np.array(s) * BOX_HALF_M for s in signs], role=1)
    triangle_at = in_world(TRIANGLE_AT, TRIANGLE_ANGLE, right_angle)
    triangle = _public_shape(triangle_at, TRIANGLE_ANGLE, vertices=[(-x, 0.0), (0.0, y), (0.0, 0.0)])
    wheel = _public_shape(WHEEL_AT, WHEEL_ANGLE, radius=WHEEL_RADIUS_M)
    goal = _public_shape(GOAL_AT, 0.0, radius=GOAL_RADIUS_M, role=2, fixed=True)
    unused = _public_shape((0.0, 0.0), 0.0, radius=0.0) | {"active": False}
    hinge = _public_joint(BOX, WHEEL, HINGE_ON_BOX, (0.0, 0.0), WHEEL_ANGLE - BOX_ANGLE) | {
        "motor_on": True,
        "motor_speed": SPEED,
        "motor_power": POWER,
        "motor_binding": COLOUR,
    }
    on_triangle = in_frame(tuple(triangle_at), TRIANGLE_ANGLE, in_world(BOX_AT, BOX_ANGLE, JOINT_ON_BOX))
    second = _public_joint(BOX, TRIANGLE, JOINT_ON_BOX, on_triangle, TRIANGLE_ANGLE - BOX_ANGLE)
    if kind == JointKind.REVOLUTE:
        second |= {"motor_has_joint_limits": True, "min_rotation": LIMITS[0], "max_rotation": LIMITS[1]}
    thruster = {
        "object_index": BOX,
        "relative_position": _point(THRUSTER_AT),
        "rotation": THRUSTER_ANGLE,
        "power": 0.5,
        "active": True,
        "thruster_binding": 1,
    }
    return import_kinetix(
        {
            "env_state": {
                "polygon": [*walls, box, triangle],
                "circle": [wheel, goal, unused],
                "joint": [hinge, second | {"is_fixed_joint": kind == JointKind.FIXED}],
                "thruster": [thruster, thruster | {"active": False}],
                "gravity": _point((0.0, -9.81)),
            }
        }
    )


def by_hand(kind: JointKind) -> Level:
    """Arrays, with corners from anywhere and the ends as in the draft."""
    level = empty_level(CAPACITY)
    scene = level.scene
    for wall in range(4):
        scene.shapes.vertices[wall] = np.roll(scene.shapes.vertices[wall], wall, axis=0)
    box = np.array([(-1, 1), (-1, -1), (1, -1), (1, 1)]) * BOX_HALF_M
    corners = np.array([(-1, -1), (1, -1), (1, 1)]) - np.array([1, -1]) / 3
    triangle = np.roll(corners * TRIANGLE_HALF_M, 1, axis=0)
    is_fixed = np.asarray(scene.shapes.active).copy()
    for slot, at, angle, role in (
        (BOX, BOX_AT, BOX_ANGLE, Role.GREEN),
        (TRIANGLE, TRIANGLE_AT, TRIANGLE_ANGLE, Role.NONE),
        (WHEEL, WHEEL_AT, WHEEL_ANGLE, Role.NONE),
        (GOAL, GOAL_AT, 0.0, Role.BLUE),
    ):
        scene.shapes.active[slot] = True
        level.position[slot], level.angle[slot], level.shape_role[slot] = at, angle, role
    is_fixed[GOAL] = True
    for slot, polygon in ((BOX, box), (TRIANGLE, triangle)):
        scene.shapes.vertices[slot] = pad_vertices(polygon, CAPACITY)
        scene.shapes.num_vertices[slot] = len(polygon)
    scene.shapes.radius[:2] = WHEEL_RADIUS_M, GOAL_RADIUS_M
    for slot, (joint, colour) in enumerate(_joints_seen_from_others(kind)):
        for name, value in joint.items():
            getattr(scene.joints, name)[slot] = value
        level.motor_colour[slot] = colour
    scene.thrusters.active[0], scene.thrusters.body[0] = True, BOX
    scene.thrusters.position[0], scene.thrusters.angle[0] = THRUSTER_AT, THRUSTER_ANGLE
    scene.thrusters.power[0], level.thruster_colour[0] = 0.5, 1
    return complete(level, is_fixed)


def _joints_seen_from_others(kind: JointKind) -> list[tuple[dict[str, Any], int]]:
    """Hinge and second joint with the wheel and the triangle as a, the box as b: fields of `Joints`, colour."""
    common = {"active": True, "b": BOX, "drive": 0, "has_limits": False, "lower_limit": 0.0, "upper_limit": 0.0}
    hinge = common | {
        "kind": int(JointKind.REVOLUTE),
        "a": WHEEL,
        "anchor_a": (0.0, 0.0),
        "anchor_b": HINGE_ON_BOX,
        "rest_angle": BOX_ANGLE - WHEEL_ANGLE,
        "axis_angle": 0.0,
        "motor_on": True,
        "motor_speed": -SPEED,
        "motor_power": POWER,
    }
    rest = BOX_ANGLE - TRIANGLE_ANGLE
    slides = kind == JointKind.PRISMATIC
    limits = LIMITS if slides else (-LIMITS[1], -LIMITS[0])
    second = common | {
        "kind": int(kind),
        "a": TRIANGLE,
        "anchor_a": tuple(JOINT_ON_TRIANGLE),
        "anchor_b": JOINT_ON_BOX,
        "rest_angle": rest,
        "axis_angle": AXIS + rest + math.pi if slides else 0.0,
        "motor_on": False,
        "motor_speed": 0.0,
        "motor_power": 0.0,
        "has_limits": kind != JointKind.FIXED,
        "lower_limit": limits[0] if kind != JointKind.FIXED else 0.0,
        "upper_limit": limits[1] if kind != JointKind.FIXED else 0.0,
    }
    return [(hinge, COLOUR), (second, 0)]


def _draft_shape(at: Any, angle: float, role: Role, **form: Any) -> Shapes:
    values = {
        "active": True,
        "position": np.asarray(at, np.float32),
        "angle": angle,
        "vertices": np.zeros((CAPACITY.vertices, 2), np.float32),
        "num_vertices": 0,
        "radius": 0.0,
        "role": int(role),
        "is_fixed": False,
        "body": 0,
        "num_joints": 0,
        "added_at": 0,
    }
    return Shapes(**{name: jnp.asarray(value) for name, value in (values | form).items()})


def _point(values: Any) -> dict[str, float]:
    return {"0": float(values[0]), "1": float(values[1])}


def _public_shape(
    at: Any, angle: float, *, vertices: Any = (), radius: float = 0.0, role: int = 0, fixed: bool = False
) -> dict[str, Any]:
    padded = [*vertices, *[(0.0, 0.0)] * (4 - len(vertices))]
    return {
        "position": _point(at),
        "rotation": angle,
        "velocity": _point((0.0, 0.0)),
        "angular_velocity": 0.0,
        "inverse_mass": 0.0 if fixed else 1.0,
        "friction": 1.0,
        "restitution": 0.0,
        "collision_mode": 2 if len(vertices) == 4 and fixed else 1,
        "active": True,
        "n_vertices": len(vertices),
        "vertices": {str(i): _point(corner) for i, corner in enumerate(padded)},
        "radius": radius,
        "role": role,
        "density": 1.0,
    }


def _public_joint(a: int, b: int, on_a: Any, on_b: Any, rotation: float) -> dict[str, Any]:
    return {
        "a_index": a,
        "b_index": b,
        "a_relative_pos": _point(on_a),
        "b_relative_pos": _point(on_b),
        "active": True,
        "motor_speed": 0.0,
        "motor_power": 0.0,
        "motor_on": False,
        "motor_has_joint_limits": False,
        "min_rotation": 0.0,
        "max_rotation": 0.0,
        "is_fixed_joint": False,
        "rotation": rotation,
        "motor_binding": 0,
    }
