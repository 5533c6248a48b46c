"""Exact line search over what contacts of an island with joints have got in a pass with bias.

A contact pushes as if it moved its two bodies alone. Joints answer, and its speed is another one then: that of a light
roller below a lift is nearly what it was. So all impulses that contacts of an island have got in the pass, and what
joints answer to them, are taken 1 + more times, such that the energy of what is still wrong is least:

    (1 + more) d M d = -(impulses) (what was wrong before)

where d is what contacts have changed of velocities, projected onto what joints allow, and d M d includes what contacts
yield. That is the same whatever the order of contacts. Contacts do not pull, and motors and limits stay within their
bounds as far as they answer to contacts. Impacts know their joints already (`contact_solver.solve_impact`): islands
with one stay as they are.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jax2d.constants import CONSTANTS as C
from jax2d.solver_numbers import SolverNumbers
from jax2d.xla import axial_rows, joint_system, vec2
from jax2d.xla import joints as joints_of
from jax2d.xla.active_set import ActiveSet, marked
from jax2d.xla.bodies import Bodies, Pair, Velocities, apply_impulse, pair_velocities, scatter_velocities
from jax2d.xla.bounces import Solved
from jax2d.xla.branching import choose, in_any_world
from jax2d.xla.contact_solver import Given, Row, rows_now, with_impulses
from jax2d.xla.contacts import Contacts
from jax2d.xla.islands import Islands, by_body
from jax2d.xla.joints import Joints, PlacedJoints


def apply(
    now: Solved,
    given: Given,
    placed: PlacedJoints,
    islands: Islands,
    params: SolverNumbers,
    active: ActiveSet,
) -> tuple[Bodies, Contacts]:
    """Bodies and contacts with 1 + more times what a pass has `given`. Joints have not answered yet: their next round
    does, to all of it."""
    bodies, joints, contacts = now
    if joints.is_held.shape[0] == 0:
        return bodies, contacts
    is_jointed = islands.whole(marked(bodies, joints.pair, joints.is_held))
    is_pushed = islands.whole(marked(bodies, contacts.pair, given.slope != 0))
    is_hit = islands.whole(marked(bodies, contacts.pair, given.is_hit))
    pushed = is_jointed & is_pushed & ~is_hit

    def searched() -> tuple[Bodies, Contacts]:
        rows = rows_now(bodies, contacts, 0.5 * params.h)
        more = jnp.where(pushed, _more(now, given, rows, placed, islands, active), 0)
        is_of = (contacts.pair.is_a | contacts.pair.is_b) & bodies.is_dynamic
        added = given.impulse * jnp.max(jnp.where(is_of, more, -1), axis=1)
        velocities = _pushed(bodies.velocities, rows, added)
        normal = jnp.maximum(contacts.impulse_normal + added, 0)
        return bodies._replace(velocities=velocities), with_impulses(contacts, normal, contacts.impulse_tangent)

    def chosen() -> tuple[Bodies, Contacts]:
        return choose(jnp.any(pushed), searched(), (bodies, contacts))

    return jax.lax.cond(in_any_world(jnp.any(pushed)), chosen, lambda: (bodies, contacts))


def _pushed(velocities: Velocities, rows: Row, impulse: jax.Array) -> Velocities:
    """Velocities after normal impulses [K] of contacts."""
    was = pair_velocities(rows.pair, velocities)
    after = apply_impulse(was, rows.pair, rows.arm_a, rows.arm_b, rows.normal * impulse[:, None])
    return scatter_velocities(velocities, rows.pair, was, after)


def _more(now: Solved, given: Given, rows: Row, placed: PlacedJoints, islands: Islands, active: ActiveSet) -> jax.Array:
    """[n] how much more of what contacts have got each body's island takes."""
    bodies, joints, contacts = now
    num_joints = joints.is_held.shape[0]
    mass, inertia = vec2.inverse_or_zero(bodies.inverse_mass), vec2.inverse_or_zero(bodies.inverse_inertia)
    # From rest: as the difference of two velocities it would have their rounding.
    rest = jax.tree.map(jnp.zeros_like, bodies.velocities)
    v, w = _pushed(rest, rows, given.impulse)
    moved = jnp.where(bodies.is_dynamic, mass * vec2.dot(v, v) + inertia * w * w, 0)
    # What joints answer to what contacts have changed.
    is_held = joints_of.held_rows(joints, joints.axes)
    is_held &= jnp.tile(active.includes_joined(joints.pair, joints.together), 3)
    change = jnp.where(bodies.is_dynamic[:, None], jnp.concatenate([v, w[:, None]], -1), 0).ravel()
    wrong = jnp.where(is_held, joint_system.times(placed.system.rows, change), 0)
    answer = -joint_system.solve(placed.system, is_held, wrong)
    spent = jnp.sum((-answer * wrong).reshape(3, num_joints), axis=0)

    moved = islands.sums(moved)
    slope = islands.sums(by_body(bodies, ((contacts.pair, given.slope),))) - 0.5 * moved
    yielded = by_body(bodies, ((contacts.pair, given.yielded),)) - by_body(bodies, ((joints.pair, spent),))
    curve = moved + islands.sums(yielded)
    most_of_contacts = _times(contacts.impulse_normal, -given.impulse)
    third = answer[-num_joints:]
    most_of_axes = _most_of_axes(joints, joints_of.row_impulses(joints)[-num_joints:] + third, third)
    most = jnp.minimum(
        _least(bodies, islands, contacts.pair, most_of_contacts), _least(bodies, islands, joints.pair, most_of_axes)
    )
    bend = curve + C.least_curve * moved
    more = jnp.clip(-(slope + curve) / jnp.where(bend > 0, bend, 1), -1, most)
    return jnp.where(bend > 0, more, 0)


def _times(room: jax.Array, taken: jax.Array) -> jax.Array:
    """How often there is room for what is taken at a time."""
    return jnp.where(taken > 0, jnp.maximum(room, 0) / jnp.where(taken > 0, taken, 1), C.far_distance)


def _most_of_axes(joints: Joints, total: jax.Array, change: jax.Array) -> jax.Array:
    """[J] how often the change of an axis' impulse leaves what is held within what holds it."""
    axes, has_axis = joints.axes, joints_of.has_axis(joints)
    drives = has_axis & axes.is_held & ~axes.is_limit
    lower, upper = (has_axis & (axes.holds == limit) for limit in (axial_rows.LOWER, axial_rows.UPPER))
    up, down = _times(axes.most - total, change), _times(total - axes.least, -change)
    far = jnp.full_like(total, C.far_distance)
    up = jnp.where(drives, up, jnp.where(upper, _times(axes.pushing - total, change), far))
    down = jnp.where(drives, down, jnp.where(lower, _times(total - axes.pushing, -change), far))
    return jnp.minimum(up, down)


def _least(bodies: Bodies, islands: Islands, pair: Pair, numbers: jax.Array) -> jax.Array:
    """[n] the least of the numbers of pairs in each body's island."""
    ends = (pair.is_a | pair.is_b) & bodies.is_dynamic
    in_island = jnp.any(islands.together[:, None] & ends, axis=-1)
    return jnp.min(jnp.where(in_island, numbers, C.far_distance), axis=1, initial=C.far_distance)
