"""Preset `paper` with the details of the published package (jax2d 1.0.2): the oracle of its tests.

The reference solver, jax2d/xla, follows the paper's appendix. The package does other things where the appendix
prescribes something else or nothing; each is a name in `DETAILS`, and with all of them a step is the package's own to
rounding (docs/engine_solver.md). One step of one world reads as `step.paper_step` does.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp

from bench import published_order
from bench.published_order import Published, SolveOrder, is_fixed_pair
from jax2d.scene import Capacity, Controls, Scene, State, only_what_acts
from jax2d.settings import Settings
from jax2d.solver_numbers import Scalar, SolverNumbers, solver_numbers
from jax2d.xla import bodies as bodies_of
from jax2d.xla import contact_solver, contacts, forces, geometry, manifolds, paper, polygon_pairs, vec2
from jax2d.xla import joints as joints_of
from jax2d.xla.bodies import Bodies, Velocities, pair_mass, pick
from jax2d.xla.contact_solver import Row
from jax2d.xla.contacts import ContactCache, Contacts, Context, PointsInUse
from jax2d.xla.geometry import Geometry, Polygons
from jax2d.xla.manifolds import Motion, Points
from jax2d.xla.pairs import bounds_overlap, pair_list
from jax2d.xla.prediction import predict_travel
from jax2d.xla.rules import Rules, rules_of

DETAILS: dict[str, str] = {
    # Manifolds
    "reference_bias": "the reference face is that of the polygon in the lower slot unless the other overlaps 1 cm less",
    "clip_keeps_depth": "clipping the incident face moves a corner along the reference face and keeps its depth",
    "deepest_depth": "both points of a manifold get the deepest depth",
    "centre_inside": "a circle whose centre is inside a polygon is as deep as its radius; on the edge it has no normal",
    "coincident_circles": "circles with the same centre have no normal and never separate",
    "fixed_slots": "polygons in slots 0 to 3, meant for floor and walls, never collide with each other",
    # Solving
    "warm_start_by_depth": "impulses are matched by pair and order of depth",
    "solve_order": "by kind of pair, deepest points first, over batches that start where the number in contact says",
    "arms_follow_joints": "contact arms lead from centres of mass as the joints' positional correction has moved them",
    "last_pair": "impulses of the last pair of a kind are dropped in every iteration unless its batches are full",
    "state_clips": "after a step coordinates are clipped to 15 m and velocities to max_speed a component",
}

REFERENCE_BIAS_M = 0.01
CLIP_POSITION_M = 15.0


def step(
    capacity: Capacity, settings: Settings, published: Published, scene: Scene, state: State, controls: Controls
) -> tuple[State, jax.Array]:
    """Steps a batch of worlds once; also the contacts [W] that found no slot. Computes in the precision of `state`."""
    if unknown := published.details - DETAILS.keys():
        raise ValueError(f"{min(unknown)!r} is no detail; known: {', '.join(DETAILS)}")
    dtype = state.position.dtype

    def cast(x: Any) -> jax.Array:
        x = jnp.asarray(x)
        return x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x

    scene, state, controls = jax.tree.map(cast, (only_what_acts(scene), state, controls))
    rules = rules_of(settings)
    return _step_worlds(capacity, rules, published, scene, state, controls, solver_numbers(settings))


@functools.partial(jax.jit, static_argnums=(0, 1, 2))
def _step_worlds(
    capacity: Capacity,
    rules: Rules,
    published: Published,
    scene: Scene,
    state: State,
    controls: Controls,
    params: SolverNumbers,
) -> tuple[State, jax.Array]:
    def step_world(scene: Scene, state: State, controls: Controls) -> tuple[State, jax.Array]:
        context = Context(scene, params, rules, capacity)
        return _paper_step(context, state, controls, published)

    return jax.vmap(step_world)(scene, state, controls)


def _paper_step(context: Context, state: State, controls: Controls, published: Published) -> tuple[State, jax.Array]:
    scene, params, rules, _ = context
    details = published.details
    bodies = bodies_of.load(scene, state)
    joints = joints_of.prepare(bodies, scene, joints_of.load(state, params), controls, params)
    joints = joints._replace(start_angle=joints_of.counted_angle(bodies, scene))
    bodies = bodies._replace(wraps=jnp.zeros_like(bodies.wraps))
    bodies = bodies_of.apply_gravity(bodies, scene.gravity, params.dt)
    cache = ContactCache(state.contact_key, state.contact_impulse)
    found, order = find(bodies, geometry.build(scene, bodies), cache, context, published)
    bodies = paper.apply_motors(bodies, joints, params)
    bodies = forces.apply(bodies, forces.load(bodies, scene, controls, params), params.dt)
    bodies, found = contact_solver.warm_start(bodies, found)
    bodies, joints = paper.warm_start(bodies, joints)

    def iteration(carry: tuple, _: None) -> tuple[tuple, None]:
        bodies, joints, found = carry
        bodies, joints = paper.solve(bodies, joints, params)
        bodies, found = solve_contacts(bodies, found, order, context, published)
        return (bodies, joints, found), None

    (bodies, joints, found), _ = jax.lax.scan(iteration, (bodies, joints, found), length=rules.substeps)
    move = move_and_clip if "state_clips" in details else bodies_of.move
    bodies = move(bodies, params.dt, params.max_speed, params.max_angular_speed)
    ended, last = bodies_of.end_step(bodies), contacts.cache_of(found)
    after = dataclasses.replace(
        state,
        position=ended.position,
        angle=ended.angle,
        velocity=ended.velocities.velocity,
        angular_velocity=ended.velocities.omega,
        joint_impulse=joints_of.store(joints, state),
        contact_key=last.key,
        contact_impulse=last.impulse,
    )
    return after, found.overflow


def find(
    bodies: Bodies, shapes: Geometry, cache: ContactCache, context: Context, published: Published
) -> tuple[Contacts, SolveOrder]:
    """Contacts of one world, and the order in which they are solved."""
    scene, params, _, capacity = context
    pairs, slots = pair_list(capacity), cache.key.shape[0]
    points = collide(bodies, shapes, context, published.details)
    exists = points.exists & scene.shapes.can_touch[pairs.point_a, pairs.point_b]
    if "fixed_slots" in published.details:
        exists &= ~is_fixed_pair(pairs, capacity)
    order = published_order.solve_order(points.exists, scene, bodies.is_dynamic, pairs, capacity, published)
    source = jnp.argsort(~exists, stable=True)[:slots]
    points, order = jax.tree.map(lambda x: x[source], (points._replace(exists=exists), order))
    in_use = PointsInUse(
        points=points,
        a=jnp.asarray(pairs.point_a)[source],
        b=jnp.asarray(pairs.point_b)[source],
        overflow=jnp.maximum(jnp.sum(exists, dtype=jnp.int32) - slots, 0),
        unsteady=jnp.zeros_like(bodies.slowed),
        predicted=predict_travel(bodies, shapes, params.dt),
    )
    return contacts.from_points(in_use, bodies, shapes, cache, context, params.dt), order


# Manifolds


def collide(bodies: Bodies, shapes: Geometry, context: Context, details: frozenset[str]) -> Points:
    """Points of all pairs, in order of pairs."""
    pairs, rules, first_circle = pair_list(context.capacity), context.rules, context.capacity.polygons
    polygons, radius = shapes.polygons, shapes.radius
    kinds = (
        (pairs.polygon_polygon, polygon_polygon, polygons, polygons, 0, 0),
        (pairs.polygon_circle, polygon_circle, polygons, radius, 0, first_circle),
        (pairs.circle_circle, circle_circle, radius, radius, first_circle, first_circle),
    )
    found = []
    for kind, collide_one, of_a, of_b, first_a, first_b in kinds:
        if not len(kind):
            continue
        a, b = kind[:, 0], kind[:, 1]
        d = bodies.position[b] - bodies.position[a]
        one = jax.tree.map(lambda x, i=a - first_a: x[i], of_a)
        other = jax.tree.map(lambda x, i=b - first_b: x[i], of_b)
        points = jax.vmap(functools.partial(collide_one, rules=rules, details=details))(one, other, d)
        near = bounds_overlap(shapes, a, b, d, jnp.zeros(len(a), d.dtype))
        points = points._replace(exists=points.exists & near[:, None])
        found.append(jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), points))
    return jax.tree.map(lambda *xs: jnp.concatenate(xs)[pairs.order], *found)


def _still(d: jax.Array) -> Motion:
    """Motion that the solver of the paper does not look at."""
    return Motion(jnp.zeros_like(d), jnp.zeros_like(d[0]), 0.0, 0.0)


def circle_circle(
    radius_a: jax.Array, radius_b: jax.Array, d: jax.Array, *, rules: Rules, details: frozenset[str]
) -> Points:
    points = manifolds.circle_circle(radius_a, radius_b, d, jnp.zeros_like(d), jnp.zeros_like(radius_a), rules=rules)
    if "coincident_circles" not in details:
        return points
    normal = vec2.unit_or_zero(d)
    return points._replace(normal=normal[None], point=(normal * radius_a)[None])


def polygon_circle(
    polygon: Polygons, radius: jax.Array, centre: jax.Array, *, rules: Rules, details: frozenset[str]
) -> Points:
    points = manifolds.polygon_circle(polygon, radius, centre, _still(centre), jnp.zeros_like(radius), rules=rules)
    if "centre_inside" not in details:
        return points
    distances = jnp.where(polygon.is_corner, vec2.dot(polygon.normal, centre - polygon.corner), -jnp.inf)
    face_distance = jnp.max(distances)
    normal = jnp.where(face_distance == 0, 0, points.normal)
    return points._replace(normal=normal, separation=jnp.where(face_distance < 0, -radius, points.separation))


def polygon_polygon(a: Polygons, b: Polygons, d: jax.Array, *, rules: Rules, details: frozenset[str]) -> Points:
    if not details & {"reference_bias", "clip_keeps_depth", "deepest_depth", "warm_start_by_depth", "solve_order"}:
        return polygon_pairs.polygon_polygon(a, b, d, _still(d), jnp.zeros_like(d[0]), rules=rules)
    zero = jnp.zeros_like(d)
    depth_a, edge_a = polygon_pairs.max_separation(a, zero, b, d)
    depth_b, edge_b = polygon_pairs.max_separation(b, d, a, zero)
    of_a, of_b = (depth_a, edge_a), (depth_b, edge_b)
    if "reference_bias" in details:
        is_b = depth_b > depth_a + REFERENCE_BIAS_M
        of_a, of_b = (jnp.zeros_like(depth_a), edge_a), (jnp.where(is_b, 1, -1).astype(d.dtype), edge_b)
    faces = polygon_pairs.find_faces(a, b, d, of_a, of_b, _still(d), rules)
    points = polygon_pairs.points_of(faces, rules)
    if "clip_keeps_depth" in details:
        ends = jnp.stack([faces.lower_end, faces.upper_end]) - faces.start
        clipped = clip_and_keep_depth(ends, faces.normal, faces.length)
        points = polygon_pairs.clipped_points(faces, clipped + faces.start, rules)
    depth = points.separation
    points = points._replace(exists=points.exists & (depth <= 0))
    if "deepest_depth" in details:
        points = points._replace(separation=jnp.full(2, jnp.maximum(depth_a, depth_b)))
    points = points._replace(
        normal=jnp.broadcast_to(jnp.where(faces.flipped, -points.normal, points.normal), (2, 2)),
        feature=points.feature.astype(jnp.int32),
        exists=points.exists & (depth_a <= 0) & (depth_b <= 0),
    )
    if details & {"warm_start_by_depth", "solve_order"}:
        points = jax.tree.map(lambda x: jnp.where(depth[0] <= depth[1], x, x[::-1]), points)
    if "warm_start_by_depth" in details:
        points = points._replace(feature=jnp.arange(2, dtype=jnp.int32))
    return points


def clip_and_keep_depth(ends: jax.Array, n: jax.Array, face_length: jax.Array) -> jax.Array:
    """Ends [2, 2] of the incident edge, relative to the start of the reference face, moved over it."""
    along = vec2.left(n)
    u = jnp.clip(vec2.dot(ends, along), 0, face_length)
    return u[:, None] * along + vec2.dot(ends, n)[:, None] * n


# Solving


def solve_contacts(
    bodies: Bodies, found: Contacts, order: SolveOrder, context: Context, published: Published
) -> tuple[Bodies, Contacts]:
    """One iteration over all contacts."""
    _, params, _, capacity = context
    details = published.details
    rows, wanted = contact_solver.rows_of(found), paper.wanted_speed(found, params)
    if "arms_follow_joints" in details:
        rows = arms_from_here(bodies, rows)
    work = (rows, wanted)
    if "solve_order" in details:
        num_batches = published_order.num_batches(capacity, published)
        velocities, totals = published_order.in_turn(
            paper.solve_rows, bodies.velocities, rows, wanted, order, num_batches
        )
    else:
        velocities, totals = paper.solve_work(bodies.velocities, work, published.batch_size)
    found = contact_solver.with_impulses(found, *totals)
    if "last_pair" in details:
        found = contacts.reset_impulses(found, order.is_dropped)
    return bodies._replace(velocities=velocities), found


def move_and_clip(bodies: Bodies, dt: Scalar, max_speed: Scalar, max_omega: Scalar) -> Bodies:
    """Semi-implicit Euler, then every coordinate is clipped. What is clipped is counted."""
    velocity, omega = bodies.velocities
    dynamic = bodies.is_dynamic
    delta = bodies.delta + jnp.where(dynamic[:, None], velocity * dt, 0)
    outside = jnp.abs(bodies.position + delta) > CLIP_POSITION_M
    to_border = jnp.sign(bodies.position + delta) * CLIP_POSITION_M - bodies.position
    velocities = Velocities(jnp.clip(velocity, -max_speed, max_speed), jnp.clip(omega, -max_omega, max_omega))
    acted = jnp.any(outside | (velocities.velocity != velocity), axis=-1) | (velocities.omega != omega)
    return bodies._replace(
        velocities=velocities,
        delta=jnp.where(outside, to_border, delta),
        turn=bodies.turn + jnp.where(dynamic, omega * dt, 0),
        limited=bodies.limited + jnp.sum(acted & dynamic, dtype=jnp.int32),
    )


def arms_from_here(bodies: Bodies, rows: Row) -> Row:
    """Arms lead to the same points from where the positional correction of joints has moved the bodies."""
    pair = rows.pair
    arm_a, arm_b = rows.arm_a - pick(pair.is_a, bodies.delta), rows.arm_b - pick(pair.is_b, bodies.delta)
    return rows._replace(
        arm_a=arm_a,
        arm_b=arm_b,
        mass_normal=pair_mass(pair, arm_a, arm_b, rows.normal),
        mass_tangent=pair_mass(pair, arm_a, arm_b, vec2.right(rows.normal)),
    )
