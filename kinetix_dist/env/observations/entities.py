"""Entity observations: a world as a set of polygons, circles, joints and thrusters, with four attention masks.

An observation is kept in two parts, because memory is what a rollout runs out of:

    StaticObs     what cannot change in an episode; computed once a level
    DynamicObs    how bodies move and who touches whom; 28 n + 4 n bytes a world and step (S: 224, M: 288, L: 512)

`observe(static, dynamic)` joins them to an `EntityObs`, the input of a policy, when (and where) it is needed.

Features, in the order of the public package:

    shape       position 2, velocity 2, inverse mass, inverse inertia, density, tanh(angular velocity / 10),
                role one-hot 4, sin, cos, friction, restitution                                           16
    polygon     shape, 0, vertices 2 V (unused -1), is triangle, gravity_y / 10               19 + 2 V =  27
    circle      shape, radius, 1, gravity_y / 10                                                          19
    joint       active, is fixed, anchor on `from` 2, anchor on `to` 2, sin and cos of the rest angle      8
                motor speed, power, on, has limits, colour one-hot 4, sin and cos of the lower limit,
                sin and cos of the upper limit, lower - rest, upper - rest (all 14 zero for fixed joints) 22
                is prismatic, sin and cos of its axis in the frame of `from` (zero for others); its limits
                stand as lower - rest and upper - rest, in m, and their sines and cosines are zero        25
    thruster    active, position 2, colour one-hot 2, sin, cos, power                                      8

What differs from the public package, so that what is the same is seen the same:
- inverse mass and inertia x stand as 0.2 log(1 + x): small shapes have 1/inertia of 100 to 2,500, which saturates a
  first layer of tanh and hides all other features of such a shape;
- the row of a joint seen from b is that of the joint with its ends swapped (`swap_ends`: rest angle, speed and limits
  of the other sign): it says which end is which, and the two rows do not depend on which end is called a;
- masks 2 and 3 have True on the diagonal and are symmetric, and shapes that cannot collide do not touch: there a shape
  does not see itself, only one slot of a touching pair sees the other, and joined shapes that overlap touch;
- numbers that nothing depends on are zero: of a motor that is off (speed, power, colour), the colour of one that runs
  by itself, of limits that are not there, and the rest angle of a hinge without limits. Makers of levels fill them in
  differently.
`kinetix_entities.py` is the observation with none of these differences.

Rows of things that do not exist are zero. Units: m, m/s, rad, 1/kg; powers and speeds in units of the engine
settings, as in `Scene`. Every joint gives two rows: row j is seen from a, row J + j from b.

Attention masks [4, n, n], symmetric, True on the diagonal of active shapes, False wherever a shape is inactive:
0 all shapes; 1 connected by any number of joints; 2 connected by one joint; 3 touching now.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import Array, Capacity, JointKind, Joints, pack_bits, touch_matrix
from kinetix_dist.env.observations.observation import ENTITIES, Moving, Observation
from kinetix_dist.level.canonical import swap_ends
from kinetix_dist.level.derive import connections
from kinetix_dist.level.level import NUM_MOTOR_COLOURS, NUM_THRUSTER_COLOURS, Level, Role, obeying_motors

BODY_ENTRIES = ("position_x", "position_y", "velocity_x", "velocity_y", "tanh_spin", "sin_angle", "cos_angle")
NUM_BODY_FEATURES = len(BODY_ENTRIES)
NUM_CIRCLE_FEATURES = 19
NUM_JOINT_FEATURES = 25
NUM_THRUSTER_FEATURES = 8
JOINT_COLOUR = slice(12, 12 + NUM_MOTOR_COLOURS)  # columns of the one-hot colour, in `kinetix_entities.py` too
THRUSTER_COLOUR = slice(3, 3 + NUM_THRUSTER_COLOURS)
NUM_ATTENTION_MASKS = 4
INVERSE_MASS_SCALE = 0.2  # 0.2 log(1 + 2,500) = 1.6
ANGULAR_VELOCITY_SCALE = 10.0  # rad/s; tanh squashes what spins faster
GRAVITY_SCALE = 10.0  # m/s^2


def num_polygon_features(capacity: Capacity) -> int:
    """27 with the usual 4 vertices."""
    return 19 + 2 * capacity.vertices


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class DynamicObs:
    """Part that changes from step to step. Leading axes: worlds, or time and worlds."""

    bodies: Array  # [W, n, 7] float32: position 2, velocity 2, tanh(angular velocity / 10), sin, cos
    touching: Array  # [W, n, words] uint32, see `jax2d.scene.Touching`; zero right after a reset


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class StaticObs:
    """Part that a level fixes. `polygons` and `circles` are their rows without the seven numbers of `bodies`."""

    polygons: Array  # [W, P, 20] (19 + 2 V - 7)
    circles: Array  # [W, C, 12]
    joints: Array  # [W, 2 J, 25]
    thrusters: Array  # [W, T, 8]
    shape_mask: Array  # [W, n] bool
    joint_mask: Array  # [W, 2 J] bool
    thruster_mask: Array  # [W, T] bool
    joint_from: Array  # [W, 2 J] int32 shape index, 0 for joints that do not exist
    joint_to: Array  # [W, 2 J] int32
    thruster_owner: Array  # [W, T] int32
    connected_any: Array  # [W, n, words] uint32, row i bit j: a chain of joints leads from i to j (or i is j)
    connected_one: Array  # [W, n, words] uint32, row i bit j: a joint holds i and j (or i is j)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class EntityObs:
    """A whole observation, the input of a policy. See the module docstring for features and masks."""

    polygons: Array  # [W, P, 27]
    circles: Array  # [W, C, 19]
    joints: Array  # [W, 2 J, 25]
    thrusters: Array  # [W, T, 8]
    shape_mask: Array  # [W, n] bool, polygons first
    joint_mask: Array  # [W, 2 J] bool
    thruster_mask: Array  # [W, T] bool
    joint_from: Array  # [W, 2 J] int32 shape index
    joint_to: Array  # [W, 2 J] int32
    thruster_owner: Array  # [W, T] int32
    attention_masks: Array  # [W, 4, n, n] bool


class EntityObservation(Observation):
    """The functions below as the object that others are given."""

    gives = ENTITIES
    entries = {"bodies": BODY_ENTRIES}
    masks = {"bodies": "shape_mask", "touching": "shape_mask"}

    def static(self, levels: Level) -> StaticObs:
        return static_obs(levels)

    def dynamic(self, moving: Moving) -> DynamicObs:
        return dynamic_obs(moving)

    def join(self, static: StaticObs, dynamic: DynamicObs) -> EntityObs:
        return observe(static, dynamic)


def observe(static: StaticObs, dynamic: DynamicObs) -> EntityObs:
    """The whole observation. `dynamic` may have leading axes more than `static`, such as time: [T, W, ...]."""
    leading = dynamic.bodies.shape[:-2]
    static = jax.tree.map(lambda x: jnp.broadcast_to(x, leading + x.shape[static.shape_mask.ndim - 1 :]), static)
    num_polygons, num_shapes = static.polygons.shape[-2], static.shape_mask.shape[-1]
    bodies = jnp.where(static.shape_mask[..., None], dynamic.bodies, 0.0)
    both_active = static.shape_mask[..., :, None] & static.shape_mask[..., None, :]
    touching = (touch_matrix(dynamic.touching, num_shapes) | np.eye(num_shapes, dtype=bool)) & both_active
    return EntityObs(
        polygons=_join_features(bodies[..., :num_polygons, :], static.polygons),
        circles=_join_features(bodies[..., num_polygons:, :], static.circles),
        joints=static.joints,
        thrusters=static.thrusters,
        shape_mask=static.shape_mask,
        joint_mask=static.joint_mask,
        thruster_mask=static.thruster_mask,
        joint_from=static.joint_from,
        joint_to=static.joint_to,
        thruster_owner=static.thruster_owner,
        attention_masks=jnp.stack(
            [
                both_active,
                touch_matrix(static.connected_any, num_shapes),
                touch_matrix(static.connected_one, num_shapes),
                touching,
            ],
            axis=-3,
        ),
    )


def dynamic_obs(moving: Moving) -> DynamicObs:
    """[W, ...] on every field."""
    spin = jnp.tanh(moving.angular_velocity / ANGULAR_VELOCITY_SCALE)
    rotation = jnp.stack([spin, jnp.sin(moving.angle), jnp.cos(moving.angle)], axis=-1)
    bodies = jnp.concatenate([moving.position, moving.velocity, rotation], axis=-1)
    return DynamicObs(bodies=bodies.astype(jnp.float32), touching=moving.touching)


def static_obs(levels: Level) -> StaticObs:
    """Features of a batch of levels ([W, ...] on every field) that no step can change."""
    shapes = levels.scene.shapes
    return assemble_static_obs(
        levels,
        inverse_mass=_compressed(shapes.inverse_mass),
        inverse_inertia=_compressed(shapes.inverse_inertia),
        vertices=shapes.vertices,
        joints=_joint_features(levels),
    )


def assemble_static_obs(
    levels: Level, *, inverse_mass: Array, inverse_inertia: Array, vertices: Array, joints: Array
) -> StaticObs:
    """Static features of a batch of levels, with these numbers as they are to be seen.

    inverse_mass, inverse_inertia [W, n]; vertices [W, P, V, 2]; joints [W, 2 J, features]: as seen from a, then from b.
    """
    scene = levels.scene
    num_polygons = scene.shapes.vertices.shape[1]
    shape = jnp.concatenate(
        [
            inverse_mass[..., None],
            inverse_inertia[..., None],
            scene.shapes.density[..., None],
            jax.nn.one_hot(levels.shape_role, len(Role), dtype=jnp.float32),
            scene.shapes.friction[..., None],
            scene.shapes.restitution[..., None],
        ],
        axis=-1,
    )
    gravity = jnp.broadcast_to((scene.gravity[:, None, 1:] / GRAVITY_SCALE), (*shape.shape[:2], 1))
    polygon_shape, circle_shape = shape[:, :num_polygons], shape[:, num_polygons:]
    polygon_gravity, circle_gravity = gravity[:, :num_polygons], gravity[:, num_polygons:]
    corners = _polygon_features(vertices, scene.shapes.num_vertices)
    polygons = jnp.concatenate([polygon_shape, corners, polygon_gravity], axis=-1)
    radius = scene.shapes.radius[..., None]
    circles = jnp.concatenate([circle_shape, radius, jnp.ones_like(radius), circle_gravity], axis=-1)
    joint_mask = jnp.concatenate([scene.joints.active, scene.joints.active], axis=1)
    both_active = scene.shapes.active[:, :, None] & scene.shapes.active[:, None, :]
    connected_one, connected_any = (
        connected & both_active
        for connected in connections(scene.joints.a, scene.joints.b, scene.joints.active, both_active.shape[-1])
    )
    return StaticObs(
        polygons=_masked(polygons, scene.shapes.active[:, :num_polygons]),
        circles=_masked(circles, scene.shapes.active[:, num_polygons:]),
        joints=_masked(joints, joint_mask),
        thrusters=_masked(_thruster_features(levels), scene.thrusters.active),
        shape_mask=scene.shapes.active,
        joint_mask=joint_mask,
        thruster_mask=scene.thrusters.active,
        joint_from=jnp.where(joint_mask, jnp.concatenate([scene.joints.a, scene.joints.b], axis=1), 0),
        joint_to=jnp.where(joint_mask, jnp.concatenate([scene.joints.b, scene.joints.a], axis=1), 0),
        thruster_owner=jnp.where(scene.thrusters.active, scene.thrusters.body, 0),
        connected_any=pack_bits(connected_any),
        connected_one=pack_bits(connected_one),
    )


def _polygon_features(vertices: Array, num_vertices: Array) -> Array:
    """0 for polygon, vertices with -1 in unused slots, is triangle: [W, P, 2 V + 2]."""
    num_vertices = num_vertices[..., None]
    is_used = jnp.arange(vertices.shape[2]) < num_vertices
    vertices = jnp.where(is_used[..., None], vertices, -1.0)
    flat = vertices.reshape(*vertices.shape[:2], -1)
    return jnp.concatenate([jnp.zeros_like(flat[..., :1]), flat, (num_vertices <= 3).astype(flat.dtype)], axis=-1)


def _joint_features(levels: Level) -> Array:
    """[W, 2 J, 25]: joints as seen from a, then the same joints as seen from b."""
    joints = levels.scene.joints
    obeys = obeying_motors(levels)[..., None]  # what runs by itself has the colour of no action
    colour = jnp.where(obeys, jax.nn.one_hot(levels.motor_colour, NUM_MOTOR_COLOURS, dtype=jnp.float32), 0.0)
    return jnp.concatenate([_seen_from_a(joints, colour), _seen_from_a(swap_ends(joints), colour)], axis=1)


def _seen_from_a(joints: Joints, colour: Array) -> Array:
    """[W, J, 25]"""
    is_fixed, slides = (joints.is_kind(kind)[..., None] for kind in (JointKind.FIXED, JointKind.PRISMATIC))
    is_limited = jnp.asarray(joints.has_limits)[..., None] & ~is_fixed
    turns = is_limited & ~slides
    drives = jnp.asarray(joints.motor_on)[..., None] & ~is_fixed
    motor = jnp.stack([joints.motor_speed, joints.motor_power, joints.motor_on], axis=-1)
    limits = jnp.stack([joints.lower_limit, joints.upper_limit], axis=-1)
    parts = [
        jnp.asarray(joints.active)[..., None],
        is_fixed,
        joints.anchor_a,
        joints.anchor_b,
        jnp.where(is_limited | is_fixed | slides, sin_cos(joints.rest_angle), 0.0),
        jnp.where(drives, motor, 0.0),
        is_limited,
        colour,
        jnp.where(turns, sin_cos(joints.lower_limit), 0.0),
        jnp.where(turns, sin_cos(joints.upper_limit), 0.0),
        jnp.where(is_limited, jnp.where(slides, limits, limits - joints.rest_angle[..., None]), 0.0),
        slides,
        jnp.where(slides, sin_cos(joints.axis_angle), 0.0),
    ]
    return jnp.concatenate([jnp.asarray(part, jnp.float32) for part in parts], axis=-1)


def sin_cos(angle: Array) -> Array:
    """[..., 2]"""
    return jnp.stack([jnp.sin(angle), jnp.cos(angle)], axis=-1)


def _thruster_features(levels: Level) -> Array:
    scene = levels.scene
    colour = jax.nn.one_hot(levels.thruster_colour, NUM_THRUSTER_COLOURS, dtype=jnp.float32)
    direction = jnp.stack(
        [jnp.sin(scene.thrusters.angle), jnp.cos(scene.thrusters.angle), scene.thrusters.power], axis=-1
    )
    active = scene.thrusters.active[..., None].astype(jnp.float32)
    return jnp.concatenate([active, scene.thrusters.position, colour, direction], axis=-1)


def _compressed(inverse_mass: Array) -> Array:
    """An inverse mass or inertia as a number of order one, 0 for fixed shapes."""
    return INVERSE_MASS_SCALE * jnp.log1p(inverse_mass)


def _masked(features: Array, mask: Array) -> Array:
    return jnp.where(mask[..., None], features, 0.0).astype(jnp.float32)


def _join_features(bodies: Array, static: Array) -> Array:
    """Puts the seven moving numbers of each shape among its static ones, in the order of the module docstring."""
    return jnp.concatenate(
        [
            bodies[..., :4],  # position, velocity
            static[..., :3],  # inverse mass, inverse inertia, density
            bodies[..., 4:5],  # angular velocity
            static[..., 3:7],  # role
            bodies[..., 5:],  # sin, cos
            static[..., 7:],  # friction, restitution and what is particular to polygons or circles
        ],
        axis=-1,
    )
