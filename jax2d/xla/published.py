"""The details of the published package (jax2d 1.0.2) that the paper does not prescribe, for comparison with it.

Each acts only where `Settings.published_details` names it; the names and what they mean are in
jax2d/published_details.py.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import Capacity, Scene
from jax2d.xla import vec2
from jax2d.xla.bodies import Bodies, Motion
from jax2d.xla.parameters import Rules, Scalar

if TYPE_CHECKING:
    from jax2d.xla.manifolds import PairList

REFERENCE_BIAS_M = 0.01
FIXED_SLOTS = 4  # polygons meant for floor, walls and ceiling
CLIP_POSITION_M = 15.0


def centre_inside(
    normal: jax.Array, separation: jax.Array, face_distance: jax.Array, radius: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Normal [2] and separation [] of a circle's centre that is inside a polygon or on its edge."""
    return jnp.where(face_distance == 0, 0, normal), jnp.where(face_distance < 0, -radius, separation)


def clip_and_keep_depth(ends: jax.Array, n: jax.Array, face_length: jax.Array) -> jax.Array:
    """Ends [2, 2] of the incident edge, relative to the start of the reference face, moved over it."""
    along = vec2.left(n)
    u = jnp.clip(vec2.dot(ends, along), 0, face_length)
    return u[:, None] * along + vec2.dot(ends, n)[:, None] * n


def is_fixed_pair(pairs: PairList, capacity: Capacity) -> np.ndarray:
    """[points] bool: both shapes are polygons in slots meant for floor and walls."""
    return pairs.point_b < min(FIXED_SLOTS, capacity.polygons)


def move_and_clip(bodies: Bodies, dt: Scalar, max_speed: Scalar, max_omega: Scalar) -> Bodies:
    """Semi-implicit Euler, then every coordinate is clipped. What is clipped is counted."""
    velocity, omega = bodies.motion
    dynamic = bodies.is_dynamic
    delta = bodies.delta + jnp.where(dynamic[:, None], velocity * dt, 0)
    outside = jnp.abs(bodies.position + delta) > CLIP_POSITION_M
    to_border = jnp.sign(bodies.position + delta) * CLIP_POSITION_M - bodies.position
    motion = Motion(jnp.clip(velocity, -max_speed, max_speed), jnp.clip(omega, -max_omega, max_omega))
    acted = jnp.any(outside | (motion.velocity != velocity), axis=-1) | (motion.omega != omega)
    return bodies._replace(
        motion=motion,
        delta=jnp.where(outside, to_border, delta),
        turn=bodies.turn + jnp.where(dynamic, omega * dt, 0),
        limited=bodies.limited + jnp.sum(acted & dynamic, dtype=jnp.int32),
    )


class Turns(NamedTuple):
    """When the points of a step are solved."""

    batch: jax.Array  # [points] int32, number of the batch in an iteration
    is_forgotten: jax.Array  # [points] bool, its impulse is dropped after every iteration


class Queue(NamedTuple):
    """Points in the order in which the published package goes through them. Numpy, of one capacity.

    It has four groups, one after another: the deepest point of every polygon pair, the other points of polygon pairs,
    circle and polygon (circle by circle), circle and circle. Each is cut into batches of its own.
    """

    group: np.ndarray  # [points] of the group
    is_before: np.ndarray  # [points, points] bool, the other stands earlier in the same group
    is_beside: np.ndarray  # [points, points] bool, the other is in the same group
    first_batch: np.ndarray  # [4] number of the group's first batch
    batches: np.ndarray  # [4]
    pairs: np.ndarray  # [4] of the group, in contact or not
    is_last: np.ndarray  # [points] bool, of the last pair of its group, whose last batches are not full


def num_batches(capacity: Capacity, rules: Rules) -> int:
    from jax2d.xla.manifolds import pair_list

    return int(_queue(pair_list(capacity), capacity, rules).batches.sum())


def _queue(pairs: PairList, capacity: Capacity, rules: Rules) -> Queue:
    a, b = pairs.point_a, pairs.point_b
    is_circle_a, is_circle_b = a >= capacity.polygons, b >= capacity.polygons
    is_second = ~is_circle_b & (np.arange(len(a)) > 0) & (a == np.roll(a, 1)) & (b == np.roll(b, 1))
    group = np.where(is_circle_a, 3, np.where(is_circle_b, 2, np.where(is_second, 1, 0)))
    is_listed = np.ones(len(a), bool)
    if "fixed_slots" in rules.published_details:
        is_listed = ~is_fixed_pair(pairs, capacity)
    # Circle and polygon go circle by circle, all others by their first shape.
    major, minor = np.where(group == 2, b, a), np.where(group == 2, a, b)
    place = major * capacity.shapes + minor
    is_beside = (group[:, None] == group) & is_listed
    is_before = is_beside & (place < place[:, None])
    count = np.array([np.sum((group == g) & is_listed) for g in range(4)])
    batches = -(-count // rules.solver_batch_size)
    is_last = np.zeros(len(a), bool)
    for g in range(4):
        if count[g] % rules.solver_batch_size:
            is_last |= (group == g) & (place == np.max(place, where=(group == g) & is_listed, initial=-1))
    return Queue(group, is_before, is_beside, np.cumsum(batches) - batches, batches, count, is_last)


def turns(
    overlaps: jax.Array, scene: Scene, is_dynamic: jax.Array, pairs: PairList, capacity: Capacity, rules: Rules
) -> Turns | None:
    """Turns of all points; `overlaps` [points] bool says which exist. None where nothing depends on them.

    Pairs in contact are spread over the batches of their group. Those of one body, held by joints, count too, although
    they are not solved.
    """
    if not rules.published_details & {"solve_order", "last_pair"}:
        return None
    queue = _queue(pairs, capacity, rules)
    a, b = pairs.point_a, pairs.point_b
    is_one_body = _bodies_of_joints(scene, capacity.shapes)
    both_fixed = ~is_dynamic[a] & ~is_dynamic[b] & scene.shape_active[a] & scene.shape_active[b]
    in_contact = overlaps & (scene.can_touch[a, b] | is_one_body[a, b] | both_fixed)
    # The two points of a pair have their turns by the first.
    first = np.where(queue.group == 1, np.arange(len(a)) - 1, np.arange(len(a)))
    counted = in_contact[first].astype(jnp.int32)
    rank = jnp.sum(jnp.where(queue.is_before, counted, 0), axis=1)
    total = jnp.sum(jnp.where(queue.is_beside, counted, 0), axis=1)
    group = queue.group
    spread = (queue.pairs[group] - total + rank) % np.maximum(queue.batches[group], 1)
    return Turns(batch=queue.first_batch[group] + spread, is_forgotten=jnp.asarray(queue.is_last))


def _bodies_of_joints(scene: Scene, num_shapes: int) -> jax.Array:
    """[n, n] bool: shapes that joints connect, however many lie between."""
    body = jnp.arange(num_shapes)
    for joint in range(scene.joint_active.shape[0]):
        a, b = body[scene.joint_a[joint]], body[scene.joint_b[joint]]
        merged = jnp.where(body == b, a, body)
        body = jnp.where(scene.joint_active[joint], merged, body)
    index = jnp.arange(num_shapes)
    return (body[:, None] == body) & (index[:, None] != index)
