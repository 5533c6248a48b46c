"""Measures of a state: energy, work, momentum, joint error. Functions of one world; vmap for batches."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jax2d.constants import CONSTANTS as C
from jax2d.fields import Array
from jax2d.scene import Controls, JointDrive, JointKind, Joints, Scene, Springs, State
from jax2d.settings import Settings


def _masses(scene: Scene) -> tuple[jax.Array, jax.Array]:
    """(mass [n] kg, inertia [n] kg m^2) of movable shapes, zero for fixed and inactive ones."""
    inverse_mass = jnp.where(scene.shapes.active, scene.shapes.inverse_mass, 0.0)
    inverse_inertia = jnp.where(scene.shapes.active, scene.shapes.inverse_inertia, 0.0)
    mass = jnp.where(inverse_mass > 0, 1.0 / jnp.where(inverse_mass > 0, inverse_mass, 1.0), 0.0)
    inertia = jnp.where(inverse_inertia > 0, 1.0 / jnp.where(inverse_inertia > 0, inverse_inertia, 1.0), 0.0)
    return mass, inertia


def kinetic_energy(scene: Scene, state: State) -> jax.Array:
    """Joules, [] of one world."""
    mass, inertia = _masses(scene)
    speed_squared = jnp.sum(jnp.square(state.velocity), -1)
    return 0.5 * jnp.sum(mass * speed_squared + inertia * jnp.square(state.angular_velocity))


def potential_energy(scene: Scene, state: State) -> jax.Array:
    """Joules above the origin along gravity, [] of one world."""
    mass, _ = _masses(scene)
    # The highest precision: a GPU would otherwise round factors to 10 bits.
    return -jnp.sum(mass * jnp.matmul(state.position, scene.gravity, precision="highest"))


def elastic_energy(scene: Scene, state: State) -> jax.Array:
    """Joules in springs, [] of one world."""
    springs = scene.springs
    stretch = spring_lengths(scene, state) - springs.rest_length
    return 0.5 * jnp.sum(jnp.where(springs.active, springs.stiffness * jnp.square(stretch), 0.0))


def energy(scene: Scene, state: State) -> jax.Array:
    """Kinetic, potential and elastic, Joules, [] of one world."""
    energy = kinetic_energy(scene, state) + potential_energy(scene, state)
    return energy + elastic_energy(scene, state) if scene.springs.active.shape[-1] else energy


def momentum(scene: Scene, state: State) -> jax.Array:
    """kg m/s, [2]."""
    mass, _ = _masses(scene)
    return jnp.sum(mass[:, None] * state.velocity, axis=0)


def angular_momentum(scene: Scene, state: State) -> jax.Array:
    """kg m^2/s about the world origin, []."""
    mass, inertia = _masses(scene)
    x, v = state.position, state.velocity
    orbital = mass * (x[:, 0] * v[:, 1] - x[:, 1] * v[:, 0])
    return jnp.sum(orbital + inertia * state.angular_velocity)


def max_work(
    settings: Settings, seconds: float, scene: Scene, controls: Controls, before: State, after: State
) -> jax.Array:
    """J that motors and thrusters can have done under constant controls between two states, [].

    A motor does at most torque x target x time, a thruster force x speed at its place x time: the faster of before and
    after, and what it adds itself.
    """
    inverse_mass, inverse_inertia = jnp.asarray(scene.shapes.inverse_mass), jnp.asarray(scene.shapes.inverse_inertia)
    joints = scene.joints
    slides = jnp.asarray(joints.is_kind(JointKind.PRISMATIC))
    # Of a slider at most, since turning bodies yield more.
    inverse = jnp.where(slides, inverse_mass[joints.a], inverse_inertia[joints.a])
    inverse += jnp.where(slides, inverse_mass[joints.b], inverse_inertia[joints.b])
    mass = jnp.where(inverse > 0, 1.0 / jnp.where(inverse > 0, inverse, 1.0), 0.0)
    driven = jnp.asarray(joints.active) & joints.motor_on & ~jnp.asarray(joints.is_kind(JointKind.FIXED))
    base_power = jnp.where(slides, settings.base_slider_power, settings.base_motor_power)
    base_speed = jnp.where(slides, settings.base_slider_speed, settings.base_motor_speed)
    force = base_power * jnp.asarray(joints.motor_power) * mass
    share = jnp.where(joints.is_drive(JointDrive.SERVO), 1.0, jnp.abs(controls.motor))  # of its speed
    target = base_speed * jnp.abs(joints.motor_speed) * share
    motors = jnp.where(driven, force * target * seconds, 0.0)

    body = scene.thrusters.body
    force = settings.base_thruster_power * jnp.asarray(scene.thrusters.power) * controls.thruster
    arm = jnp.linalg.norm(scene.thrusters.position, axis=-1)

    def speed_there(state: State) -> jax.Array:
        spin = jnp.asarray(state.angular_velocity)
        return jnp.linalg.norm(state.velocity, axis=-1)[body] + arm * jnp.abs(spin[body])

    compliance = inverse_mass[body] + arm**2 * inverse_inertia[body]
    speed = jnp.maximum(speed_there(before), speed_there(after)) + force * compliance * seconds
    thrusters = jnp.where(scene.thrusters.active, force * speed * seconds, 0.0)
    return jnp.sum(motors) + jnp.sum(thrusters)


def joint_gaps(scene: Scene, state: State) -> jax.Array:
    """Distance between the two anchors of each joint, of a slider across its axis, [J] m; zero for inactive joints."""
    return _joint_gaps(scene.joints, state.position, state.angle)


def joint_turns(scene: Scene, state: State) -> jax.Array:
    """Angle by which each weld and slider is off the one that it holds, [J] rad; zero for hinges and inactive ones."""
    return _joint_turns(scene.joints, state.angle)


def are_open(joints: Joints, position: Array, angle: Array) -> jax.Array:
    """[J] bool: joints that do not hold, of shapes at `position` [n, 2] m and `angle` [n] rad.

    A joint is open where its gap is above 1 cm or its turn above 0.05 rad (`constants.py`). Joints that contradict each
    other are (a bar pinned at two points that are farther apart than its holes), those of a mechanism that starts
    apart, and those that more pulls at than the solver holds.
    """
    return (_joint_gaps(joints, position, angle) > C.open_gap) | (_joint_turns(joints, angle) > C.open_turn)


def length_errors(scene: Scene, state: State) -> jax.Array:
    """Return the length of each spring beyond its limits, [S] m.

    A rope or spring is beyond its limit if it is longer than `max_length` or shorter than `min_length`; a rod has one
    length. 0 within the limits and for inactive springs.
    """
    return _length_errors(scene.springs, state.position, state.angle)


def are_beyond_limits(springs: Springs, position: Array, angle: Array) -> jax.Array:
    """Return [S] bool, springs, ropes and rods that are beyond their limits by more than 1 cm.

    They are pulled by more than the solver holds, contradict each other, or start too long or too short.

    Args:
      position: [n, 2] m, of all shapes.
      angle: [n] rad.
    """
    return _length_errors(springs, position, angle) > C.open_gap


def num_open(scene: Scene, position: Array, angle: Array) -> jax.Array:
    """Return the number of joints, ropes and rods that do not hold, [] int32: `Touching.open_joints`.

    Those between two bodies that never yield are not counted, since the solver has nothing to move.
    """
    shapes = scene.shapes
    is_movable = shapes.active & ((shapes.inverse_mass > 0) | (shapes.inverse_inertia > 0))

    def count(ends: Joints | Springs, fails: jax.Array) -> jax.Array:
        return jnp.sum(fails & (is_movable[ends.a] | is_movable[ends.b]), dtype=jnp.int32)

    joints, springs = scene.joints, scene.springs
    number = count(joints, are_open(joints, position, angle))
    return number + count(springs, are_beyond_limits(springs, position, angle))


def spring_lengths(scene: Scene, state: State) -> jax.Array:
    """Distance between the two anchors of each spring, [S] m, active or not."""
    return _spring_lengths(scene.springs, state.position, state.angle)


def _spring_lengths(springs: Springs, position: Array, angle: Array) -> jax.Array:
    return jnp.linalg.norm(_gap(springs, position, angle), axis=-1)


def _length_errors(springs: Springs, position: Array, angle: Array) -> jax.Array:
    length = _spring_lengths(springs, position, angle)
    error = jnp.maximum(length - springs.max_length, springs.min_length - length)
    return jnp.where(springs.active, jnp.maximum(error, 0), 0)


def _joint_gaps(joints: Joints, position: Array, angle: Array) -> jax.Array:
    gap = _gap(joints, position, angle)
    axis_angle = joints.axis_angle + angle[joints.a]
    across = jnp.abs(jnp.cos(axis_angle) * gap[:, 1] - jnp.sin(axis_angle) * gap[:, 0])
    distance = jnp.where(joints.is_kind(JointKind.PRISMATIC), across, jnp.linalg.norm(gap, axis=-1))
    return jnp.where(joints.active, distance, 0.0)


def _joint_turns(joints: Joints, angle: Array) -> jax.Array:
    turn = angle[joints.b] - angle[joints.a] - joints.rest_angle
    held = joints.active & ~joints.is_kind(JointKind.REVOLUTE)
    return jnp.where(held, jnp.abs(turn - 2 * jnp.pi * jnp.round(turn / (2 * jnp.pi))), 0.0)


def _gap(ends: Joints | Springs, position: Array, angle: Array) -> jax.Array:
    """Anchor on b from anchor on a, [k, 2] m."""

    def anchor(body: Array, local: Array) -> jax.Array:
        c, s = jnp.cos(angle[body]), jnp.sin(angle[body])
        turned = jnp.stack([c * local[..., 0] - s * local[..., 1], s * local[..., 0] + c * local[..., 1]], -1)
        return position[body] + turned

    return anchor(ends.b, ends.anchor_b) - anchor(ends.a, ends.anchor_a)


def overlaps(scene: Scene, position: Array, angle: Array) -> jax.Array:
    """Depth of each pair of shapes that may touch and overlaps, [n, n] m, symmetric; 0 for any other pair.

    By separating axes, as contacts are found: the least distance by which moving along one normal frees the pair.
    """
    polygons = scene.shapes.vertices.shape[0]
    x = jnp.asarray(position, jnp.float32)
    c, s = jnp.cos(angle[:polygons])[:, None], jnp.sin(angle[:polygons])[:, None]
    local = jnp.asarray(scene.shapes.vertices)
    # Corners relative to the own centre, so that positions far from the origin keep their precision.
    corner = jnp.stack([c * local[..., 0] - s * local[..., 1], s * local[..., 0] + c * local[..., 1]], -1)
    slot = jnp.arange(corner.shape[1])
    used = slot < scene.shapes.num_vertices[:, None]
    following = jnp.where(slot + 1 < scene.shapes.num_vertices[:, None], slot + 1, 0)
    edge = jnp.take_along_axis(corner, following[..., None], 1) - corner
    length = jnp.linalg.norm(edge, axis=-1, keepdims=True)
    normal = jnp.stack([edge[..., 1], -edge[..., 0]], -1) / jnp.where(length > 0, length, 1.0)
    between = x[None, :] - x[:, None]  # [n, n, 2] from the first centre to the second
    face = jnp.sum(normal * corner, -1)  # [P, V] distance of each face from the own centre

    def along(offset: jax.Array) -> jax.Array:  # [P, m, 2] -> [P, m, V]
        return jnp.einsum("pmd,pvd->pmv", offset, normal, precision="highest") - face[:, None]

    reach = jnp.einsum("pvd,qkd->pqvk", normal, corner, precision="highest")
    nearest = along(between[:polygons, :polygons]) + jnp.min(jnp.where(used[None, :, None], reach, jnp.inf), -1)
    polygon_polygon = jnp.max(jnp.where(used[:, None], nearest, -jnp.inf), -1)
    polygon_polygon = jnp.maximum(polygon_polygon, polygon_polygon.T)
    radius = jnp.asarray(scene.shapes.radius)
    centres = jnp.where(used[:, None], along(between[:polygons, polygons:]), -jnp.inf)
    to_corner = jnp.linalg.norm(between[:polygons, polygons:, None] - corner[:, None], axis=-1)
    inside = jnp.max(centres, -1)
    # Outside and beyond the ends of its face, a corner is what is nearest.
    beyond = _beyond_face(between[:polygons, polygons:], corner, edge, jnp.argmax(centres, -1))
    distance = jnp.where((inside > 0) & beyond, jnp.min(jnp.where(used[:, None], to_corner, jnp.inf), -1), inside)
    polygon_circle = distance - radius
    circle_circle = jnp.linalg.norm(between[polygons:, polygons:], axis=-1) - radius[:, None] - radius[None]
    upper = jnp.concatenate([polygon_polygon, polygon_circle], 1)
    lower = jnp.concatenate([polygon_circle.T, circle_circle], 1)
    separation = jnp.concatenate([upper, lower], 0)
    active = jnp.asarray(scene.shapes.active)
    meets = jnp.asarray(scene.shapes.can_touch) & active[:, None] & active[None]
    movable = active & (jnp.asarray(scene.shapes.inverse_mass) + jnp.asarray(scene.shapes.inverse_inertia) > 0)
    meets &= movable[:, None] | movable[None]
    return jnp.where(meets, jnp.maximum(-separation, 0.0), 0.0)


def _beyond_face(point: jax.Array, corner: jax.Array, edge: jax.Array, face: jax.Array) -> jax.Array:
    """[P, C] bool: the point [P, C, 2] lies beside the ends of the face [P, C] of its polygon."""
    rows = jnp.arange(corner.shape[0])[:, None]
    start, run = corner[rows, face], edge[rows, face]
    share = jnp.sum((point - start) * run, -1)
    return (share < 0) | (share > jnp.sum(run * run, -1))
