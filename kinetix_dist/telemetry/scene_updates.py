"""Pictures of a rollout as foxglove.SceneUpdate messages, which the 3D panel of Foxglove shows.

    fixed = fixed_scene(rollout, times)               one message: parts that never move
    for message in moving_scenes(rollout, times): ... one message a state: all other parts

Each part of the display list (shape, joint, thruster, spring) is an entity: "shape 3", "joint 0". Its polygons and
discs are triangle lists, its outlines and lines are lines; points stay in the frame of the body, and the pose of a
primitive moves them. Parts that never move are messages of a topic of their own: a viewer that jumps in time shows
the last message of each topic, so that one message a rollout is enough, and each message of what moves is whole.

The plane of a world is z = 0; a primitive that is painted later lies LAYER_M higher.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from jax2d.display_list import DISC, JOINT, LINE, POLYGON, Primitive, display_list, world_points
from jax2d.palette import HINGE, LINE_WIDTH, MOTOR_PALETTE
from kinetix_dist.telemetry.recording import Rollout

FRAME = "world"
LAYER_M = 0.001  # between two primitives: no two of them share a plane, and all look flat
DISC_CORNERS = 32
NS_PER_S = 1_000_000_000
MOTOR_FORWARD, MOTOR_BACKWARD = MOTOR_PALETTE[0], MOTOR_PALETTE[1]


def fixed_scene(rollout: Rollout, time_ns: int) -> bytes:
    """Message of the parts that never move; it deletes those of the rollout before."""
    return _Scene(rollout, is_fixed=True).message(0, time_ns)


def moving_scenes(rollout: Rollout, times_ns: Sequence[int]) -> Iterator[bytes]:
    """Messages of all other parts, one a state: flames and motors as they are commanded in that state."""
    scene = _Scene(rollout, is_fixed=False)
    for state, time_ns in enumerate(times_ns):
        yield scene.message(state, time_ns)


class _Scene:
    """One message, which is built once and then changed from state to state: most of it stays the same."""

    def __init__(self, rollout: Rollout, *, is_fixed: bool) -> None:
        self._rollout = rollout
        # Plain numbers, which a message takes ten times as fast as those of numpy; of float32, whose doubles end in
        # zeros and are half as large once they are compressed.
        self._position = rollout.position.tolist()
        half = np.float32(0.5) * rollout.angle
        self._turn = np.stack([np.sin(half), np.cos(half)], axis=-1).tolist()
        self._update = SceneUpdate()
        self._rigid: list[tuple[Any, int]] = []  # pose, body
        self._bent: list[tuple[Any, Primitive]] = []  # a primitive whose points change, too
        self._motors: list[tuple[Any, int]] = []  # colour, joint
        display = display_list(rollout.level.scene, rollout.level.shape_role)
        moving_parts = {p.part for p in display.primitives if _moves(p, rollout)}
        entities: dict[tuple[str, int], SceneEntity] = {}
        for layer, primitive in enumerate(display.primitives):
            if (primitive.part in moving_parts) is is_fixed:
                continue
            if primitive.part not in entities:
                entities[primitive.part] = self._update.entities.add(frame_id=FRAME, id="{} {}".format(*primitive.part))
            self._add(entities[primitive.part], primitive, LAYER_M * layer)

    def message(self, state: int, time_ns: int) -> bytes:
        """The message of one state. That of the first deletes the entities of an earlier rollout."""
        seconds, nanoseconds = divmod(time_ns, NS_PER_S)
        for entity in self._update.entities:
            entity.timestamp.seconds, entity.timestamp.nanos = seconds, nanoseconds
        del self._update.deletions[:]
        if state == 0:
            deletion = self._update.deletions.add(type=SceneEntityDeletion.ALL)
            deletion.timestamp.seconds, deletion.timestamp.nanos = seconds, nanoseconds
        position, turn = self._position[state], self._turn[state]
        for pose, body in self._rigid:
            pose.position.x, pose.position.y = position[body]
            pose.orientation.z, pose.orientation.w = turn[body]
        for shown, primitive in self._bent:
            self._bend(shown, primitive, state)
        for colour, joint in self._motors:
            _set_colour(colour, self._motor_colour(joint, state))
        return self._update.SerializeToString()

    def _add(self, entity: SceneEntity, primitive: Primitive, z: float) -> None:
        if primitive.kind in (POLYGON, DISC):
            corners = _outline(primitive)
            filled = entity.triangles.add(indices=_fan(len(corners)))
            self._place(filled, primitive, corners, z)
            kind, number = primitive.part
            is_motor = kind == JOINT and primitive.outline is None
            if is_motor and bool(self._rollout.level.scene.joints.motor_on[number]):
                self._motors.append((filled.color, number))
            if primitive.outline is not None:
                ring = entity.lines.add(type=LinePrimitive.LINE_LOOP)
                self._place(ring, primitive, corners, z + 0.5 * LAYER_M)
                _set_width(ring, LINE_WIDTH, primitive.outline)
        else:
            line = entity.lines.add(type=LinePrimitive.LINE_STRIP)
            self._place(line, primitive, primitive.points, z)
            _set_width(line, primitive.width, primitive.fill)

    def _place(self, shown: Any, primitive: Primitive, points: np.ndarray, z: float) -> None:
        """Adds points to a primitive of a message, and notes what changes in it."""
        shown.pose.position.z, shown.pose.orientation.w = z, 1.0
        _set_colour(shown.color, primitive.fill)
        if _is_rigid(primitive):
            _set_points(shown, points)
            self._rigid.append((shown.pose, primitive.body))
        else:
            self._bent.append((shown, primitive))

    def _bend(self, shown: Any, primitive: Primitive, state: int) -> None:
        """Points in the world. Those of a flame that is out are removed: nothing is drawn without points."""
        rollout = self._rollout
        fire = rollout.thruster[state] if state < rollout.num_steps else None
        points = world_points(primitive, rollout.position[state], rollout.angle[state], fire)
        del shown.points[:]
        if primitive.kind == POLYGON:
            del shown.indices[:]
        if points is not None:
            _set_points(shown, points)
            if primitive.kind == POLYGON:
                shown.indices.extend(_fan(len(points)))

    def _motor_colour(self, joint: int, state: int) -> Sequence[float]:
        drive = self._rollout.motor[state, joint] if state < self._rollout.num_steps else 0.0
        return MOTOR_FORWARD if drive > 0 else MOTOR_BACKWARD if drive < 0 else HINGE


def _moves(primitive: Primitive, rollout: Rollout) -> bool:
    """Its body moves, or what is drawn of it changes."""
    shapes, joints = rollout.level.scene.shapes, rollout.level.scene.joints
    has_motor = primitive.part[0] == JOINT and bool(joints.motor_on[primitive.part[1]])
    is_held = shapes.inverse_mass[primitive.body] == 0 and not shapes.kinematic[primitive.body]
    return has_motor or not is_held or not (_is_rigid(primitive) or primitive.upright is not None)


def _is_rigid(primitive: Primitive) -> bool:
    """Its points are fixed in the frame of its body."""
    return primitive.kind in (POLYGON, DISC, LINE) and primitive.upright is None and primitive.thruster is None


def _outline(primitive: Primitive) -> np.ndarray:
    """Corners [k, 2] m of a polygon or a disc, counter-clockwise."""
    if primitive.kind == POLYGON:
        return primitive.points
    turn = np.linspace(0, 2 * math.pi, DISC_CORNERS, endpoint=False)
    return primitive.points[0] + primitive.radius * np.stack([np.cos(turn), np.sin(turn)], axis=-1)


def _fan(num_corners: int) -> list[int]:
    """Corners of the triangles that fill a convex polygon, three numbers a triangle."""
    return [corner for second in range(1, num_corners - 1) for corner in (0, second, second + 1)]


def _set_points(shown: Any, points: np.ndarray) -> None:
    for x, y in points.astype(float).tolist():
        shown.points.add(x=x, y=y)


def _set_colour(colour: Any, values: Sequence[float]) -> None:
    colour.r, colour.g, colour.b, colour.a = (*(round(value) / 255 for value in values), 1.0)


def _set_width(line: Any, pixels: float, colour: Sequence[float]) -> None:
    line.thickness, line.scale_invariant = pixels, True
    _set_colour(line.color, colour)
