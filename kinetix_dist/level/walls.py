"""The box every level is played in, and a level with nothing else in it.

Walls are the first four polygons of every level: floor, left wall, right wall, ceiling. They are fixed, a few metres
thick so that nothing fast can be on the far side of one after a step, and touch everything (collision mode 2). The
free space is 0..5 m wide and 0.4..5 m high, as in the public levels.
"""

from __future__ import annotations

import numpy as np

from jax2d.scene import Capacity, Scene
from kinetix_dist.level.level import NUM_WALLS, WORLD_SIZE_M, Level

FLOOR_TOP_M = 0.4  # height of the ground above the origin of the world
WALL_NAMES = ("floor", "left_wall", "right_wall", "ceiling")  # polygon slots 0-3
COLLIDES_WITH_ALL = 2  # collision mode of walls
COLLIDES_NORMALLY = 1
PASSES_THROUGH = 0  # passes through shapes of mode 0 and 1, is stopped by mode 2

_MIDDLE_M = 0.5 * WORLD_SIZE_M
_SLAB_HALF_HEIGHT_M = 5.2  # floor and ceiling, deeper than a body can move in a step
WALL_CENTRES_M = np.array(
    [
        [_MIDDLE_M, FLOOR_TOP_M - _SLAB_HALF_HEIGHT_M],
        [-_MIDDLE_M, _MIDDLE_M],
        [WORLD_SIZE_M + _MIDDLE_M, _MIDDLE_M],
        [_MIDDLE_M, WORLD_SIZE_M + _SLAB_HALF_HEIGHT_M],
    ],
    np.float32,
)
WALL_HALF_EXTENTS_M = np.array(
    [
        [_MIDDLE_M, _SLAB_HALF_HEIGHT_M],
        [_MIDDLE_M, _MIDDLE_M],
        [_MIDDLE_M, _MIDDLE_M],
        [_MIDDLE_M, _SLAB_HALF_HEIGHT_M],
    ],
    np.float32,
)
_CORNERS = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]], np.float32)  # counter-clockwise
_PADDING_HALF_EXTENT_M = 0.1  # inactive polygons are small boxes: never degenerate, never seen


def pad_vertices(vertices: np.ndarray, capacity: Capacity) -> np.ndarray:
    """`[k, 2]` corners as `[V, 2]`: unused slots repeat the last corner."""
    fill = np.repeat(vertices[-1:], capacity.vertices - len(vertices), axis=0)
    return np.concatenate([vertices, fill]).astype(np.float32)


def empty_level(capacity: Capacity) -> Level:
    """A level (numpy arrays) of the four walls alone; every other slot is inactive."""
    if capacity.polygons < NUM_WALLS or capacity.vertices < 4:
        raise ValueError(
            f"a level needs {NUM_WALLS} polygons of 4 corners for its walls; capacity has "
            f"{capacity.polygons} polygons of at most {capacity.vertices}"
        )
    num_shapes, num_joints, num_thrusters = capacity.shapes, capacity.joints, capacity.thrusters
    half_extents = np.full((capacity.polygons, 2), _PADDING_HALF_EXTENT_M, np.float32)
    half_extents[:NUM_WALLS] = WALL_HALF_EXTENTS_M
    is_wall = np.arange(num_shapes) < NUM_WALLS
    position = np.zeros((num_shapes, 2), np.float32)
    position[:NUM_WALLS] = WALL_CENTRES_M

    def zeros(*shape: int) -> np.ndarray:
        return np.zeros(shape, np.float32)

    scene = Scene(
        shape_active=is_wall.copy(),
        inverse_mass=zeros(num_shapes),
        inverse_inertia=zeros(num_shapes),
        density=np.ones(num_shapes, np.float32),
        friction=np.ones(num_shapes, np.float32),
        restitution=zeros(num_shapes),
        vertices=np.stack([pad_vertices(_CORNERS * half, capacity) for half in half_extents]),
        num_vertices=np.full(capacity.polygons, 4, np.int32),
        radius=np.full(capacity.circles, _PADDING_HALF_EXTENT_M, np.float32),
        can_touch=np.zeros((num_shapes, num_shapes), bool),
        joint_active=np.zeros(num_joints, bool),
        joint_a=np.zeros(num_joints, np.int32),
        joint_b=np.zeros(num_joints, np.int32),
        joint_anchor_a=zeros(num_joints, 2),
        joint_anchor_b=zeros(num_joints, 2),
        joint_is_fixed=np.zeros(num_joints, bool),
        joint_rest_angle=zeros(num_joints),
        motor_on=np.zeros(num_joints, bool),
        motor_speed=np.ones(num_joints, np.float32),
        motor_power=np.ones(num_joints, np.float32),
        has_limits=np.zeros(num_joints, bool),
        lower_limit=zeros(num_joints),
        upper_limit=zeros(num_joints),
        thruster_active=np.zeros(num_thrusters, bool),
        thruster_body=np.zeros(num_thrusters, np.int32),
        thruster_position=zeros(num_thrusters, 2),
        thruster_angle=zeros(num_thrusters),
        thruster_power=np.ones(num_thrusters, np.float32),
        gravity=np.array([0.0, -9.81], np.float32),
    )
    return Level(
        scene=scene,
        position=position,
        angle=zeros(num_shapes),
        velocity=zeros(num_shapes, 2),
        angular_velocity=zeros(num_shapes),
        shape_role=np.zeros(num_shapes, np.int32),
        collision_mode=np.where(is_wall, COLLIDES_WITH_ALL, COLLIDES_NORMALLY).astype(np.int32),
        motor_colour=np.zeros(num_joints, np.int32),
        motor_auto=np.zeros(num_joints, bool),
        thruster_colour=np.zeros(num_thrusters, np.int32),
    )
