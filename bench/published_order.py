"""Order in which the published package (jax2d 1.0.2) solves contacts, for details "solve_order" and "last_pair"."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import Capacity, Scene
from jax2d.xla.bodies import Velocities
from jax2d.xla.branching import choose
from jax2d.xla.contact_solver import Row
from jax2d.xla.pairs import PairList, pair_list

FIXED_SLOTS = 4  # polygons meant for floor, walls and ceiling


class Published(NamedTuple):
    """Choice of details (names in `published_solver.DETAILS`), and of the contacts that a batch holds."""

    details: frozenset[str]
    batch_size: int = 16


class SolveOrder(NamedTuple):
    """Order in which the points of a step are solved."""

    batch: jax.Array  # [points] int32, number of the batch in an iteration
    is_dropped: jax.Array  # [points] bool, its impulse is dropped after every iteration


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


def is_fixed_pair(pairs: PairList, capacity: Capacity) -> np.ndarray:
    """[points] bool: both shapes are polygons in slots meant for floor and walls."""
    return pairs.point_b < min(FIXED_SLOTS, capacity.polygons)


def num_batches(capacity: Capacity, published: Published) -> int:
    return int(_queue(pair_list(capacity), capacity, published).batches.sum())


def _queue(pairs: PairList, capacity: Capacity, published: Published) -> Queue:
    a, b = pairs.point_a, pairs.point_b
    is_circle_a, is_circle_b = a >= capacity.polygons, b >= capacity.polygons
    is_second = ~is_circle_b & (np.arange(len(a)) > 0) & (a == np.roll(a, 1)) & (b == np.roll(b, 1))
    group = np.where(is_circle_a, 3, np.where(is_circle_b, 2, np.where(is_second, 1, 0)))
    is_listed = np.ones(len(a), bool)
    if "fixed_slots" in published.details:
        is_listed = ~is_fixed_pair(pairs, capacity)
    # Circle and polygon go circle by circle, all others by their first shape.
    major, minor = np.where(group == 2, b, a), np.where(group == 2, a, b)
    order = major * capacity.shapes + minor
    is_beside = (group[:, None] == group) & is_listed
    is_before = is_beside & (order < order[:, None])
    count = np.array([np.sum((group == g) & is_listed) for g in range(4)])
    batches = -(-count // published.batch_size)
    is_last = np.zeros(len(a), bool)
    for g in range(4):
        if count[g] % published.batch_size:
            is_last |= (group == g) & (order == np.max(order, where=(group == g) & is_listed, initial=-1))
    return Queue(group, is_before, is_beside, np.cumsum(batches) - batches, batches, count, is_last)


def solve_order(
    overlaps: jax.Array, scene: Scene, is_dynamic: jax.Array, pairs: PairList, capacity: Capacity, published: Published
) -> SolveOrder:
    """Order of all points; `overlaps` [points] bool says which exist.

    Pairs in contact are spread over the batches of their group. Those of one body, held by joints, count too, although
    they are not solved.
    """
    queue = _queue(pairs, capacity, published)
    a, b = pairs.point_a, pairs.point_b
    is_one_body = _bodies_of_joints(scene, capacity.shapes)
    both_fixed = ~is_dynamic[a] & ~is_dynamic[b] & scene.shapes.active[a] & scene.shapes.active[b]
    in_contact = overlaps & (scene.shapes.can_touch[a, b] | is_one_body[a, b] | both_fixed)
    # The two points of a pair are solved in the order of the first.
    first = np.where(queue.group == 1, np.arange(len(a)) - 1, np.arange(len(a)))
    counted = in_contact[first].astype(jnp.int32)
    rank = jnp.sum(jnp.where(queue.is_before, counted, 0), axis=1)
    total = jnp.sum(jnp.where(queue.is_beside, counted, 0), axis=1)
    group = queue.group
    spread = (queue.pairs[group] - total + rank) % np.maximum(queue.batches[group], 1)
    return SolveOrder(batch=jnp.asarray(queue.first_batch[group] + spread), is_dropped=jnp.asarray(queue.is_last))


def _bodies_of_joints(scene: Scene, num_shapes: int) -> jax.Array:
    """[n, n] bool: shapes that joints connect, however many lie between."""
    body = jnp.arange(num_shapes)
    for joint in range(scene.joints.active.shape[0]):
        a, b = body[scene.joints.a[joint]], body[scene.joints.b[joint]]
        merged = jnp.where(body == b, a, body)
        body = jnp.where(scene.joints.active[joint], merged, body)
    index = jnp.arange(num_shapes)
    return (body[:, None] == body) & (index[:, None] != index)


def in_turn(
    solve: Callable,
    velocities: Velocities,
    rows: Row,
    wanted: jax.Array,
    order: SolveOrder,
    num_batches: int,
) -> tuple[Velocities, Any]:
    """Solves in the published package's order: one batch after another, the contacts of each from the same
    velocities."""
    pair, batch = rows.pair, order.batch

    def solve_batch(carry: tuple, now: jax.Array) -> tuple[tuple, None]:
        velocities, (normal, tangent) = carry
        is_due = batch == now
        due = pair._replace(is_a=pair.is_a & is_due[:, None], is_b=pair.is_b & is_due[:, None])
        row = rows._replace(pair=due, impulse_normal=normal, impulse_tangent=tangent)
        velocities, totals = solve(velocities, (row, wanted))
        return (velocities, choose(is_due, totals, (normal, tangent))), None

    batches = jnp.arange(num_batches)
    start = (velocities, (rows.impulse_normal, rows.impulse_tangent))
    (velocities, totals), _ = jax.lax.scan(solve_batch, start, batches)
    return velocities, totals
