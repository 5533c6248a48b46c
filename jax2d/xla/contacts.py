"""The contacts of one world in one step: found, matched with the impulses of the step before, solved.

Soft contacts follow the soft-step solver of Box2D v3 (Solver2D study). Hard contacts (preset paper) follow the
appendix of the Kinetix paper, solved one after another or, as there, in batches.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import Capacity, Scene
from jax2d.xla import manifolds, published, vec2
from jax2d.xla.bodies import (
    Bodies,
    Motion,
    Pair,
    PairMotion,
    pair_motion,
    pair_up,
    pick,
    push_pair,
    put_back,
    relative_velocity,
)
from jax2d.xla.manifolds import Geometry, Points
from jax2d.xla.parameters import Parameters, Rules, Scalar

FEATURE_BITS, SHAPE_BITS = 12, 10  # of a key: a, then b, then the feature in the lowest bits


class Contacts(NamedTuple):
    """`K` slots; those in use come first, in ascending order of keys, and are solved in this order."""

    key: jax.Array  # [K] int32, -1 where free
    pair: Pair  # of [K]
    normal: jax.Array  # [K, 2]
    arm_a: jax.Array  # [K, 2] m, from the centres of mass, at the start of the step
    arm_b: jax.Array
    separation: jax.Array  # [K] m, at the start of the step
    mass_normal: jax.Array  # [K] kg
    mass_tangent: jax.Array
    impulse_normal: jax.Array  # [K] N s
    impulse_tangent: jax.Array
    friction: jax.Array  # [K]
    restitution: jax.Array
    approach: jax.Array  # [K] m/s, relative normal speed before solving, negative when approaching
    most_impulse: jax.Array  # [K] N s, largest normal impulse in this step
    against_fixed: jax.Array  # [K] bool
    overflow: jax.Array  # [] int32, points that found no slot
    swinging: jax.Array  # [] bool, a body with a contact turns too far in a step for contacts found once
    foreseen: manifolds.Foresight
    turns: published.Turns | None  # when each is solved, where the published package's order is asked for


class Memory(NamedTuple):
    """What is kept of contacts for those found next."""

    key: jax.Array  # [K] int32
    impulse: jax.Array  # [K, 2] N s


def remember(contacts: Contacts, bounces: jax.Array | bool = False) -> Memory:
    """Impulses for warm starting, none of what bounces [K] apart."""
    impulse = jnp.stack([contacts.impulse_normal, contacts.impulse_tangent], -1)
    return Memory(contacts.key, jnp.where(jnp.asarray(bounces)[..., None], 0, impulse))


def find(
    bodies: Bodies,
    geometry: Geometry,
    scene: Scene,
    memory: Memory,
    params: Parameters,
    rules: Rules,
    capacity: Capacity,
    dt: Scalar,
) -> Contacts:
    """Points of all pairs that may touch within `dt`, compacted into the slots of `memory`."""
    foreseen = manifolds.foresee(bodies, geometry, dt)
    points, a, b, overflow, swinging, turns = _points_in_use(
        bodies, geometry, foreseen, scene, params, rules, capacity, dt, slots=memory.key.shape[0]
    )
    pair = pair_up(bodies, a, b, points.exists)
    friction_a, friction_b = scene.friction[a], scene.friction[b]
    # Where the surfaces are apart each is met at its own point: they will have moved together by then.
    half_gap = points.normal * (0.5 * jnp.maximum(points.separation, 0))[:, None]
    arm_a = points.point - half_gap
    arm_b = points.point + half_gap - (bodies.position[b] - bodies.position[a])
    key = jnp.where(points.exists, (a << FEATURE_BITS + SHAPE_BITS) | (b << FEATURE_BITS) | points.feature, -1)
    impulse = jnp.where(params.warm_start, _remembered(key, memory), 0)
    velocity = relative_velocity(pair_motion(pair, bodies.motion), arm_a, arm_b)
    dynamic = bodies.is_dynamic
    return Contacts(
        key=key,
        pair=pair,
        normal=points.normal,
        arm_a=arm_a,
        arm_b=arm_b,
        separation=points.separation,
        mass_normal=pair_mass(pair, arm_a, arm_b, points.normal),
        mass_tangent=pair_mass(pair, arm_a, arm_b, vec2.right(points.normal)),
        impulse_normal=impulse[:, 0],
        impulse_tangent=impulse[:, 1],
        friction=mix_friction(friction_a, friction_b, params, rules),
        restitution=jnp.minimum(scene.restitution[a], scene.restitution[b]),
        approach=vec2.dot(points.normal, velocity),
        most_impulse=jnp.zeros_like(points.separation),
        against_fixed=~(dynamic[a] & dynamic[b]),
        overflow=overflow,
        swinging=swinging,
        foreseen=foreseen,
        turns=turns,
    )


def _points_in_use(
    bodies: Bodies,
    geometry: Geometry,
    foreseen: manifolds.Foresight,
    scene: Scene,
    params: Parameters,
    rules: Rules,
    capacity: Capacity,
    dt: Scalar,
    *,
    slots: int,
) -> tuple[Points, jax.Array, jax.Array, jax.Array, jax.Array, published.Turns | None]:
    """Points [slots] that exist, first and in order of pairs; their shapes a and b; overflow; swinging; turns."""
    is_soft = rules.is_soft
    reach = params.speculative_distance if is_soft else 0.0
    if capacity.shapes == 1:  # no pair at all, one slot
        zeros, none = jnp.zeros((slots, 2), bodies.position.dtype), jnp.zeros(slots, jnp.int32)
        return Points(zeros, zeros, zeros[:, 0], none, none > 0), none, none, none[0], none[0] > 0, None
    pairs = manifolds.pair_list(capacity)
    margin = manifolds.margins(foreseen, reach, ahead=is_soft)
    points = manifolds.collide(geometry, bodies, capacity, margin, rules)
    # Contact points and normals hold for small turns only: a rod that spins fast sweeps over what they say.
    swings = is_soft & ((geometry.extent - geometry.core) * jnp.square(bodies.motion.omega * dt) > reach)
    exists = points.exists & scene.can_touch[pairs.point_a, pairs.point_b]
    if "fixed_slots" in rules.published_details:
        exists &= ~published.is_fixed_pair(pairs, capacity)
    swinging = jnp.any(exists & (swings[pairs.point_a] | swings[pairs.point_b]))
    source = jnp.argsort(~exists, stable=True)[:slots]
    turns = published.turns(points.exists, scene, bodies.is_dynamic, pairs, capacity, rules)
    points, turns = jax.tree.map(lambda x: x[source], (points._replace(exists=exists), turns))
    overflow = jnp.maximum(jnp.sum(exists, dtype=jnp.int32) - slots, 0)
    return points, jnp.asarray(pairs.point_a)[source], jnp.asarray(pairs.point_b)[source], overflow, swinging, turns


def strays(bodies: Bodies, contacts: Contacts, can_touch: jax.Array, reach: Scalar, left: Scalar) -> jax.Array:
    """Whether two bodies that move on as they do for the `left` seconds of the step could meet without a contact, since
    they go farther than was foreseen: every margin has `reach` to spare. can_touch [n, n], at [lower, higher]."""
    foreseen, pair = contacts.foreseen, contacts.pair
    distance = manifolds.travel(bodies, foreseen.arm, left)
    farther = distance - foreseen.distance
    a, b = np.triu_indices(farther.shape[0], 1)
    d = bodies.position[b] - bodies.position[a]
    near = manifolds.bounds_overlap(foreseen, a, b, d, distance[a] + distance[b])
    has_contact = jnp.any(pair.is_a[:, a] & pair.is_b[:, b], axis=0)
    return jnp.any(can_touch[a, b] & near & ~has_contact & (farther[a] + farther[b] > reach))


def _remembered(key: jax.Array, memory: Memory) -> jax.Array:
    """Impulses [K, 2] that the step before stored under these keys, zero for new contacts."""
    is_same = (key[:, None] == memory.key[None]) & (key[:, None] >= 0)
    old = memory.impulse[jnp.argmax(is_same, axis=1)]
    return jnp.where(jnp.any(is_same, axis=1)[:, None], old, 0)


def mix_friction(a: jax.Array, b: jax.Array, params: Parameters, rules: Rules) -> jax.Array:
    mixed = a * a + b * b if rules.friction_mixing == "root_sum_square" else a * b
    return params.base_friction * vec2.sqrt_or_zero(mixed)


def pair_mass(pair: Pair, arm_a: jax.Array, arm_b: jax.Array, direction: jax.Array) -> jax.Array:
    ra, rb = vec2.cross(arm_a, direction), vec2.cross(arm_b, direction)
    return vec2.inverse_or_zero(pair.mass_a + pair.mass_b + pair.inertia_a * ra * ra + pair.inertia_b * rb * rb)


def warm_start(bodies: Bodies, contacts: Contacts) -> Bodies:
    """Applies the remembered impulses, all at once: they do not depend on one another."""
    impulse = (
        contacts.normal * contacts.impulse_normal[:, None]
        + vec2.right(contacts.normal) * contacts.impulse_tangent[:, None]
    )
    before = pair_motion(contacts.pair, bodies.motion)
    after = push_pair(before, contacts.pair, contacts.arm_a, contacts.arm_b, impulse)
    return bodies._replace(motion=put_back(bodies.motion, contacts.pair, before, after))


def current_separation(bodies: Bodies, contacts: Contacts) -> jax.Array:
    """[K] m. Anchors move and turn with their bodies; the normal stays as it was at the start of the step."""
    pair = contacts.pair
    moved = pick(pair.is_b, bodies.delta) - pick(pair.is_a, bodies.delta)
    arm_a = _turned_by(contacts.arm_a, pick(pair.is_a, bodies.turn))
    arm_b = _turned_by(contacts.arm_b, pick(pair.is_b, bodies.turn))
    return contacts.separation + vec2.dot(moved + arm_b - arm_a, contacts.normal)


def _turned_by(arm: jax.Array, turn: jax.Array) -> jax.Array:
    """What a turn adds to an arm. 1 - cos is written so that it keeps its digits for small turns."""
    one_minus_cos = 2 * jnp.square(jnp.sin(0.5 * turn))
    return vec2.left(arm) * jnp.sin(turn)[:, None] - arm * one_minus_cos[:, None]


def _in_batches(solve: Callable, motion: Motion, rows: Any, batch_size: int) -> tuple[Motion, Any]:
    """Solves `batch_size` slots at a time from the same velocities; neighbouring slots fall into different batches.

    Slots in use come first, so they are spread over as many batches as possible (paper, "Batched Impulse Resolution").
    """
    slots = jax.tree.leaves(rows)[0].shape[0]
    batches = -(-slots // batch_size)

    def split(x: jax.Array) -> jax.Array:
        padded = jnp.concatenate([x, jnp.zeros((batches * batch_size - slots, *x.shape[1:]), x.dtype)])
        return jnp.swapaxes(padded.reshape(batch_size, batches, *x.shape[1:]), 0, 1)

    def join(x: jax.Array) -> jax.Array:
        return jnp.swapaxes(x, 0, 1).reshape(batches * batch_size, *x.shape[2:])[:slots]

    motion, results = jax.lax.scan(solve, motion, jax.tree.map(split, rows))
    return motion, jax.tree.map(join, results)


def solve_soft(bodies: Bodies, contacts: Contacts, params: Parameters, *, use_bias: bool) -> tuple[Bodies, Contacts]:
    """One pass of the soft-step solver. With bias: pushes out of penetration softly; without (relax): takes back the
    velocity that the push added, and applies friction."""
    separation = current_separation(bodies, contacts)
    is_apart = separation > 0
    bias = jnp.where(is_apart, separation / params.h, 0)  # speculative: may close the gap, not more
    mass_scale, impulse_scale = jnp.ones_like(separation), jnp.zeros_like(separation)
    if use_bias:
        soft = jax.tree.map(
            lambda fixed, free: jnp.where(contacts.against_fixed, fixed, free), params.fixed_soft, params.contact_soft
        )
        push = jnp.maximum(soft.mass_scale * soft.bias_rate * separation, -params.push_out_speed)
        bias = jnp.where(is_apart, bias, push)
        mass_scale = jnp.where(is_apart, mass_scale, soft.mass_scale)
        impulse_scale = jnp.where(is_apart, impulse_scale, soft.impulse_scale)

    def solve(motion: Motion, row: tuple) -> tuple[Motion, tuple]:
        c, bias, mass_scale, impulse_scale = row
        before = of = pair_motion(c.pair, motion)
        vn = normal_speed(of, c)
        impulse = -c.mass_normal * (mass_scale * vn + bias) - impulse_scale * c.impulse_normal
        of, normal_total = push_apart(of, c, impulse)
        tangent_total = c.impulse_tangent
        if not use_bias:
            of, tangent_total = solve_friction(of, c, normal_total)
        return put_back(motion, c.pair, before, of), (normal_total, tangent_total)

    motion, (normal, tangent) = jax.lax.scan(solve, bodies.motion, (_rows(contacts), bias, mass_scale, impulse_scale))
    return bodies._replace(motion=motion), _with_impulses(contacts, normal, tangent)


class Leaving(NamedTuple):
    """Contacts while those that hit bounce."""

    speed: jax.Array  # [K] m/s to leave with, 0: does not bounce
    mass: jax.Array  # [K] kg that a push is taken to move
    before: jax.Array  # [K] m/s, normal speed before the last push


def solve_bounces(
    bodies: Bodies, contacts: Contacts, leaving: Leaving, is_first: jax.Array, rub: jax.Array, params: Parameters
) -> tuple[Bodies, Contacts, Leaving, jax.Array]:
    """A relax pass in which what bounces leaves with its speed, and rubs where asked. Also whether all of it already
    left, as far as any push can make it."""
    separation = current_separation(bodies, contacts)
    apart = jnp.maximum(separation, 0) / params.h

    def solve(motion: Motion, row: tuple[Row, Leaving, jax.Array]) -> tuple[Motion, tuple]:
        c, bounce, apart = row
        before = of = pair_motion(c.pair, motion)
        vn = normal_speed(of, c)
        bounces = bounce.speed > 0
        mass, is_settled = aim(c, bounce, vn, is_first)
        impulse = jnp.where(bounces, mass * (bounce.speed - vn), -c.mass_normal * (vn + apart))
        pushed, normal_total = push_apart(of, c, impulse)
        rubbed, tangent_total = solve_friction(pushed, c, normal_total)
        rubs = rub | ~bounces
        of = jax.tree.map(lambda x, y: jnp.where(rubs, x, y), rubbed, pushed)
        tangent_total = jnp.where(rubs, tangent_total, c.impulse_tangent)
        after = Leaving(bounce.speed, mass, vn)
        return put_back(motion, c.pair, before, of), (normal_total, tangent_total, after, is_settled | ~bounces)

    motion, (normal, tangent, leaving, settled) = jax.lax.scan(solve, bodies.motion, (_rows(contacts), leaving, apart))
    return bodies._replace(motion=motion), _with_impulses(contacts, normal, tangent), leaving, jnp.all(settled)


def aim(c: Row, bounce: Leaving, vn: jax.Array, is_first: jax.Array) -> tuple[jax.Array, jax.Array]:
    """(mass that the next push is taken to move, whether it has its speed or no push can give it any more).

    What the last push gave a bounce, joints and other contacts have shared out since. The next one pushes as if the
    contact moved the mass that it was seen to move (secant method); where others push against it, its pair's alone."""
    asked = bounce.speed - bounce.before
    kept = (vn - bounce.before) / jnp.where(asked == 0, 1, asked)
    is_settled = (jnp.abs(vn - bounce.speed) <= 0.002 * bounce.speed) | ((asked != 0) & (jnp.abs(kept) < 0.001))
    is_seen = (asked != 0) & (kept > 0) & (kept < 2)
    mass = jnp.where(is_seen, bounce.mass / jnp.clip(kept, 0.125, 2), c.mass_normal)
    return jnp.where(is_first | is_settled, bounce.mass, mass), is_settled & ~is_first


def normal_speed(of: PairMotion, c: Row) -> jax.Array:
    return vec2.dot(c.normal, relative_velocity(of, c.arm_a, c.arm_b))


def push_apart(of: PairMotion, c: Row, impulse: jax.Array) -> tuple[PairMotion, jax.Array]:
    """Adds a normal impulse, as far as the accumulated one stays positive; also the new total."""
    total = jnp.maximum(c.impulse_normal + impulse, 0)
    return push_pair(of, c.pair, c.arm_a, c.arm_b, c.normal * (total - c.impulse_normal)[..., None]), total


class Row(NamedTuple):
    """What solving a contact needs of it."""

    pair: Pair
    normal: jax.Array
    arm_a: jax.Array
    arm_b: jax.Array
    mass_normal: jax.Array
    mass_tangent: jax.Array
    impulse_normal: jax.Array
    impulse_tangent: jax.Array
    friction: jax.Array


def _rows(contacts: Contacts) -> Row:
    return Row(*(getattr(contacts, name) for name in Row._fields))


def _with_impulses(contacts: Contacts, normal: jax.Array, tangent: jax.Array) -> Contacts:
    most = jnp.maximum(contacts.most_impulse, normal)
    return contacts._replace(impulse_normal=normal, impulse_tangent=tangent, most_impulse=most)


def solve_friction(of: Any, c: Row, normal_total: jax.Array) -> tuple[Any, jax.Array]:
    tangent = vec2.right(c.normal)
    vt = vec2.dot(tangent, relative_velocity(of, c.arm_a, c.arm_b))
    most = c.friction * normal_total
    total = jnp.clip(c.impulse_tangent - c.mass_tangent * vt, -most, most)
    total = jnp.where(c.friction == 0, c.impulse_tangent, total)
    return push_pair(of, c.pair, c.arm_a, c.arm_b, tangent * (total - c.impulse_tangent)[..., None]), total


def leaving_speed(bodies: Bodies, contacts: Contacts, gravity: jax.Array, params: Parameters) -> jax.Array:
    """Speed with which what hit in this step must leave, [K] m/s; 0 where nothing bounces."""
    hits = (contacts.restitution > 0) & (contacts.approach <= -params.restitution_threshold)
    bounces = hits & (contacts.most_impulse != 0)
    return jnp.where(bounces, contacts.restitution * impact_speed(bodies, contacts, gravity, params.h), 0)


def impact_speed(bodies: Bodies, contacts: Contacts, gravity: jax.Array, h: Scalar) -> jax.Array:
    """Speed at the moment of impact, which falls somewhere inside the step, [K] m/s.

    Under a closing acceleration a, semi-implicit Euler keeps u^2/2 + a h u/2 + a s (u approach speed, s separation)
    exactly, so a bounce that leaves from where the body now is with the same value neither gains nor loses energy.
    """
    pair = contacts.pair
    falls = (pair.mass_a > 0).astype(gravity.dtype) - (pair.mass_b > 0).astype(gravity.dtype)
    a, u = vec2.dot(gravity, contacts.normal) * falls, -contacts.approach
    half = 0.5 * a * h
    fallen = contacts.separation - current_separation(bodies, contacts)
    twice_energy = u * u + 2 * half * u + 2 * a * fallen
    return vec2.sqrt_or_zero(half * half + twice_energy) + half


def solve_hard(
    bodies: Bodies, contacts: Contacts, params: Parameters, rules: Rules, capacity: Capacity
) -> tuple[Bodies, Contacts]:
    """One iteration of sequential impulses (paper, appendix Collision Resolution): restitution target and penetration
    bias in the numerator, accumulated impulse kept non-negative, friction by Coulomb's law."""
    bias = params.collision_correction / params.dt * jnp.maximum(-contacts.separation - params.slop, 0)
    wanted = bias - contacts.restitution * contacts.approach  # m/s, separating
    details, batch_size = rules.published_details, rules.solver_batch_size
    rows = _rows(contacts)
    if "arms_follow_joints" in details:
        rows = arms_from_here(bodies, rows)

    def solve(motion: Motion, row: tuple) -> tuple[Motion, tuple]:
        c, wanted = row
        before = of = pair_motion(c.pair, motion)
        vn = vec2.dot(c.normal, relative_velocity(of, c.arm_a, c.arm_b))
        normal_total = jnp.maximum(c.impulse_normal + c.mass_normal * (wanted - vn), 0)
        of = push_pair(of, c.pair, c.arm_a, c.arm_b, c.normal * (normal_total - c.impulse_normal)[..., None])
        of, tangent_total = solve_friction(of, c, normal_total)
        return put_back(motion, c.pair, before, of), (normal_total, tangent_total)

    if "solve_order" in details:
        motion, (normal, tangent) = _in_turn(solve, bodies.motion, rows, wanted, contacts, capacity, rules)
    elif batch_size == 1:
        motion, (normal, tangent) = jax.lax.scan(solve, bodies.motion, (rows, wanted))
    else:
        motion, (normal, tangent) = _in_batches(solve, bodies.motion, (rows, wanted), batch_size)
    contacts = _with_impulses(contacts, normal, tangent)
    if "last_pair" in details:
        assert contacts.turns is not None
        kept = ~contacts.turns.is_forgotten
        contacts = contacts._replace(
            impulse_normal=jnp.where(kept, normal, 0), impulse_tangent=jnp.where(kept, tangent, 0)
        )
    return bodies._replace(motion=motion), contacts


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


def _in_turn(
    solve: Callable,
    motion: Motion,
    rows: Row,
    wanted: jax.Array,
    contacts: Contacts,
    capacity: Capacity,
    rules: Rules,
) -> tuple[Motion, Any]:
    """Solves in the published package's order: one batch after another, the contacts of each from the same
    velocities."""
    assert contacts.turns is not None
    pair, batch = rows.pair, contacts.turns.batch

    def solve_batch(carry: tuple, now: jax.Array) -> tuple[tuple, None]:
        motion, (normal, tangent) = carry
        is_due = batch == now
        due = pair._replace(is_a=pair.is_a & is_due[:, None], is_b=pair.is_b & is_due[:, None])
        row = rows._replace(pair=due, impulse_normal=normal, impulse_tangent=tangent)
        motion, totals = solve(motion, (row, wanted))
        return (motion, jax.tree.map(lambda x, y: jnp.where(is_due, x, y), totals, (normal, tangent))), None

    batches = jnp.arange(published.num_batches(capacity, rules))
    start = (motion, (rows.impulse_normal, rows.impulse_tangent))
    (motion, totals), _ = jax.lax.scan(solve_batch, start, batches)
    return motion, totals
