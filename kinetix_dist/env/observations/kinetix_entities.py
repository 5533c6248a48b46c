"""The entity observation of the public Kinetix package, number for number: what its trained policies have learned from.

Features are those of `entities.py` (polygons 27, circles 19, joints 22, thrusters 8) in the package's way:

- inverse masses and inertias are raw, and discs have the package's inertia, m r^2 / 4 instead of m r^2 / 2;
- corners run clockwise from the first one on; the frames of the side walls begin at the origin of the world and their
  corners at the upper left;
- the first J rows of joints are seen from b, the others from a. Both have the same rest angle, speed and limits, and
  those of motors that are off and of hinges without limits are seen too;
- a slider, which the package does not have, is seen as a hinge without limits.

Attention masks: 0 all shapes and 1 connected by any number of joints are as in `entities.py`. In 2, connected by one
joint, a shape does not see itself. 3, touching now, is one-way: of two polygons or two circles the lower slot sees the
other, of a circle and a polygon the circle. Shapes that overlap touch there even where they never collide, because
they are joined or both fixed, but for two walls. Nothing touches before the first step of an episode.

The package shows contacts as they were found before the last physics step, this observation those after it. Rows of
what does not exist are zero here; in the package they hold numbers that its masks hide.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import Array, JointKind, pack_bits, touch_matrix
from kinetix_dist.env.observations.entities import (
    BODY_ENTRIES,
    NUM_CIRCLE_FEATURES,
    NUM_THRUSTER_FEATURES,
    DynamicObs,
    EntityObs,
    StaticObs,
    assemble_static_obs,
    dynamic_obs,
    observe,
    sin_cos,
)
from kinetix_dist.env.observations.observation import ENTITIES, Moving, Observation
from kinetix_dist.level.level import NUM_MOTOR_COLOURS, NUM_WALLS, Level
from kinetix_dist.level.overlap import separation, world_corners
from kinetix_dist.level.walls import COLLIDES_WITH_ALL

NUM_FEATURES = {"polygon": 27, "circle": NUM_CIRCLE_FEATURES, "joint": 22, "thruster": NUM_THRUSTER_FEATURES}
DISC_INERTIA_RATIO = 2.0  # inverse inertia of a disc in the package / ours
SIDE_WALLS = (1, 2)  # polygon slots
_CORNERS_OF_SIDE_WALLS = (1, 0, 3, 2)  # of ours, which run counter-clockwise from (+, +): clockwise from (-, +)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class KinetixDynamicObs:
    """Part that changes from step to step. Leading axes: worlds, or time and worlds."""

    entities: DynamicObs
    has_stepped: Array  # [W] bool, false right after a reset


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class KinetixStaticObs:
    """Part that a level fixes."""

    entities: StaticObs
    frame_origin: Array  # [W, n, 2] m, of the package's frame of a shape, in ours; zero but for side walls
    vertices: Array  # [W, P, V, 2] m, as in `Scene`
    may_overlap: Array  # [W, n, words] uint32, row i bit j: touch in the package where they overlap, and never collide


class KinetixEntityObservation(Observation):
    """See above."""

    gives = ENTITIES
    entries = {"entities/bodies": BODY_ENTRIES}
    masks = {"entities/bodies": "entities/shape_mask", "entities/touching": "entities/shape_mask"}

    def static(self, levels: Level) -> KinetixStaticObs:
        frame_origin = _frame_origin(levels)
        entities = assemble_static_obs(
            levels,
            inverse_mass=levels.scene.shapes.inverse_mass,
            inverse_inertia=_inverse_inertia(levels),
            vertices=_clockwise(levels, frame_origin),
            joints=_joint_features(levels, frame_origin),
        )
        num_joints = levels.motor_colour.shape[1]
        # The package has the ends the other way round: the first rows are seen from b.
        entities = dataclasses.replace(
            entities,
            joints=jnp.roll(entities.joints, num_joints, axis=1),
            joint_from=entities.joint_to,
            joint_to=entities.joint_from,
            thrusters=_thrusters_in_frames(entities, frame_origin),
        )
        return KinetixStaticObs(
            entities=entities,
            frame_origin=frame_origin,
            vertices=levels.scene.shapes.vertices,
            may_overlap=pack_bits(_may_overlap(levels)),
        )

    def dynamic(self, moving: Moving) -> KinetixDynamicObs:
        return KinetixDynamicObs(entities=dynamic_obs(moving), has_stepped=moving.has_stepped)

    def join(self, static: KinetixStaticObs, dynamic: KinetixDynamicObs) -> EntityObs:
        bodies = dynamic.entities.bodies
        # Side walls have angle 0: their frame has the axes of the world.
        seen = bodies.at[..., :2].add(static.frame_origin)
        obs = observe(static.entities, dataclasses.replace(dynamic.entities, bodies=seen))
        num_shapes = obs.shape_mask.shape[-1]
        never_collide = touch_matrix(static.may_overlap, num_shapes)
        overlapping = _overlap(bodies, static.vertices, obs.circles[..., _RADIUS]) & never_collide
        touching = obs.attention_masks[..., 3, :, :] | overlapping & dynamic.has_stepped[..., None, None]
        masks = [
            obs.attention_masks[..., 0, :, :],
            obs.attention_masks[..., 1, :, :],
            obs.attention_masks[..., 2, :, :] & ~np.eye(num_shapes, dtype=bool),
            touching & _sees(obs.polygons.shape[-2], num_shapes),
        ]
        return dataclasses.replace(obs, attention_masks=jnp.stack(masks, axis=-3))


_RADIUS = 16  # column of a circle's row


def _frame_origin(levels: Level) -> Array:
    """[W, n, 2] m: the origin of the world seen from the side walls, zero for all other shapes."""
    slot = np.arange(levels.angle.shape[1])[:, None]
    return jnp.where(np.isin(slot, SIDE_WALLS), -jnp.asarray(levels.position), 0.0)


def _inverse_inertia(levels: Level) -> Array:
    shapes = levels.scene.shapes
    is_circle = np.arange(levels.angle.shape[1]) >= shapes.vertices.shape[1]
    return shapes.inverse_inertia * np.where(is_circle, np.float32(DISC_INERTIA_RATIO), np.float32(1.0))


def _clockwise(levels: Level, frame_origin: Array) -> Array:
    """[W, P, V, 2] m: corners in the package's order and frames."""
    shapes = levels.scene.shapes
    num_polygons, num_slots = shapes.vertices.shape[1:3]
    slot = np.arange(num_slots)
    source = jnp.where(slot == 0, 0, jnp.asarray(shapes.num_vertices)[..., None] - slot) % num_slots
    is_side_wall = np.isin(np.arange(num_polygons), SIDE_WALLS)[:, None]
    padding = tuple(range(len(_CORNERS_OF_SIDE_WALLS), num_slots))
    source = jnp.where(is_side_wall, np.array(_CORNERS_OF_SIDE_WALLS + padding), source)
    corners = jnp.take_along_axis(jnp.asarray(shapes.vertices), source[..., None], axis=2)
    return corners - frame_origin[:, :num_polygons, None]


def _joint_features(levels: Level, frame_origin: Array) -> Array:
    """[W, 2 J, 22]: joints as seen from a, then the same joints as seen from b."""
    joints = levels.scene.joints
    is_fixed, slides = (joints.is_kind(kind)[..., None] for kind in (JointKind.FIXED, JointKind.PRISMATIC))
    is_limited = jnp.asarray(joints.has_limits)[..., None] & ~slides
    limits = jnp.stack([joints.lower_limit, joints.upper_limit], axis=-1)
    limit_parts = [
        sin_cos(joints.lower_limit),
        sin_cos(joints.upper_limit),
        limits - jnp.asarray(joints.rest_angle)[..., None],
    ]
    of_hinge = [
        jnp.stack([joints.motor_speed, joints.motor_power, joints.motor_on], axis=-1),
        is_limited,
        jax.nn.one_hot(levels.motor_colour, NUM_MOTOR_COLOURS, dtype=jnp.float32),
        *(jnp.where(is_limited, part, 0.0) for part in limit_parts),
    ]
    hinge = jnp.where(is_fixed, 0.0, jnp.concatenate(of_hinge, axis=-1))

    def anchor(local: Array, body: Array) -> Array:
        return local - jnp.take_along_axis(frame_origin, jnp.asarray(body)[..., None], axis=1)

    anchor_a, anchor_b = anchor(joints.anchor_a, joints.a), anchor(joints.anchor_b, joints.b)
    kind = jnp.concatenate([jnp.asarray(joints.active)[..., None], is_fixed], axis=-1)
    rest = sin_cos(joints.rest_angle)
    rows = [
        jnp.concatenate([kind, one, other, rest, hinge], axis=-1)
        for one, other in ((anchor_a, anchor_b), (anchor_b, anchor_a))
    ]
    return jnp.concatenate(rows, axis=1).astype(jnp.float32)


def _thrusters_in_frames(entities: StaticObs, frame_origin: Array) -> Array:
    """[W, T, 8]"""
    origin = jnp.take_along_axis(frame_origin, entities.thruster_owner[..., None], axis=1)
    position = entities.thrusters[..., 1:3] - jnp.where(entities.thruster_mask[..., None], origin, 0.0)
    return entities.thrusters.at[..., 1:3].set(position)


def _may_overlap(levels: Level) -> Array:
    """[W, n, n] bool, symmetric: active pairs whose modes let them touch, but that the engine never lets collide."""
    shapes, mode = levels.scene.shapes, jnp.asarray(levels.collision_mode)
    num_shapes = mode.shape[1]
    both_active = shapes.active[:, :, None] & shapes.active[:, None, :]
    either_all = (mode[:, :, None] == COLLIDES_WITH_ALL) | (mode[:, None, :] == COLLIDES_WITH_ALL)
    meets = either_all | (mode[:, :, None] * mode[:, None, :] > 0)
    is_wall = np.arange(num_shapes) < NUM_WALLS
    other = ~np.eye(num_shapes, dtype=bool) & ~(is_wall[:, None] & is_wall[None, :])
    return both_active & meets & other & ~jnp.asarray(shapes.can_touch)


def _overlap(bodies: Array, vertices: Array, radius: Array) -> Array:
    """[..., n, n] bool, true for i < j whose shapes overlap and for the mirror image. bodies [..., n, 7]."""
    leading, num_shapes = bodies.shape[:-2], bodies.shape[-2]
    vertices = jnp.broadcast_to(vertices, (*leading, *vertices.shape[-3:]))
    num_polygons, num_slots = vertices.shape[-3:-1]
    angle = jnp.arctan2(bodies[..., 5], bodies[..., 6])
    centres = jnp.broadcast_to(
        bodies[..., num_polygons:, None, :2], (*leading, num_shapes - num_polygons, num_slots, 2)
    )
    corners = world_corners(bodies[..., :num_polygons, :2], angle[..., :num_polygons], vertices)
    corners = jnp.concatenate([corners, centres], axis=-3)
    radii = jnp.concatenate([jnp.zeros((*leading, num_polygons), jnp.float32), radius], axis=-1)
    one, other = np.triu_indices(num_shapes, k=1)
    gap = separation
    for _ in range(len(leading) + 1):
        gap = jax.vmap(gap)
    is_pair = gap(corners[..., one, :, :], radii[..., one], corners[..., other, :, :], radii[..., other]) < 0.0
    matrix = jnp.zeros((*leading, num_shapes, num_shapes), bool).at[..., one, other].set(is_pair)
    return matrix | jnp.swapaxes(matrix, -1, -2)


def _sees(num_polygons: int, num_shapes: int) -> np.ndarray:
    """[n, n] bool: which of two shapes that touch sees the other in the package."""
    slot = np.arange(num_shapes)
    is_circle = slot >= num_polygons
    alike = is_circle[:, None] == is_circle[None, :]
    return np.where(alike, slot[:, None] < slot[None, :], is_circle[:, None])
