"""Soft contacts in one pass of the soft-step solver of Box2D v3 (Solver2D study), solved one after another."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jax2d.solver_numbers import SolverNumbers
from jax2d.xla import vec2
from jax2d.xla.bodies import (
    Bodies,
    Pair,
    PairVelocities,
    Velocities,
    apply_impulse,
    pair_mass,
    pair_velocities,
    pick,
    relative_velocity,
    scatter_velocities,
)
from jax2d.xla.contacts import Contacts


def warm_start(bodies: Bodies, contacts: Contacts) -> Bodies:
    """Applies the remembered impulses, all at once: they do not depend on one another."""
    impulse = (
        contacts.normal * contacts.impulse_normal[:, None]
        + vec2.right(contacts.normal) * contacts.impulse_tangent[:, None]
    )
    before = pair_velocities(contacts.pair, bodies.velocities)
    after = apply_impulse(before, contacts.pair, *arms_now(bodies, contacts), impulse)
    return bodies._replace(velocities=scatter_velocities(bodies.velocities, contacts.pair, before, after))


def moved_apart(bodies: Bodies, contacts: Contacts) -> jax.Array:
    """How b has moved against a since the contact was found, [K, 2] m."""
    return pick(contacts.pair.is_b, bodies.delta) - pick(contacts.pair.is_a, bodies.delta)


def arms_now(bodies: Bodies, contacts: Contacts) -> tuple[jax.Array, jax.Array]:
    """Where impulses act, [K, 2] m from both centres. Where both bodies can move it is one point, wherever they have
    gone since: an impulse at two points would change what both have of angular momentum. What is fixed takes any, so
    that the other's own surface is the point."""
    apart = contacts.normal * jnp.maximum(contacts.separation, 0)[:, None] + moved_apart(bodies, contacts)
    apart = jnp.where(contacts.against_fixed[:, None], 0, apart)
    share = contacts.follows_b[:, None]
    return contacts.arm_a + apart * share, contacts.arm_b - apart * (1 - share)


def current_separation(bodies: Bodies, contacts: Contacts) -> jax.Array:
    """[K] m. Surfaces move and turn with their bodies; the normal stays as it was at the start of the step."""
    (arm_a, arm_b), moved = turned_arms(bodies, contacts), moved_apart(bodies, contacts)
    return contacts.separation + vec2.dot(moved + arm_b - arm_a, contacts.normal)


def turned_arms(bodies: Bodies, contacts: Contacts) -> tuple[jax.Array, jax.Array]:
    """What turning has added to the arms of a and b, [K, 2] m. On a face the point of a disc stays below its centre:
    turned with one that rolls it would rise, and the disc sink."""
    turn_b = jnp.where(contacts.disc_on_face, 0, pick(contacts.pair.is_b, bodies.turn))
    turn_a = pick(contacts.pair.is_a, bodies.turn)
    return _turned_by(contacts.arm_a, turn_a), _turned_by(contacts.arm_b, turn_b)


def _turned_by(arm: jax.Array, turn: jax.Array) -> jax.Array:
    """What a turn adds to an arm. 1 - cos is written so that it keeps its digits for small solve_order."""
    one_minus_cos = 2 * jnp.square(jnp.sin(0.5 * turn))
    return vec2.left(arm) * jnp.sin(turn)[:, None] - arm * one_minus_cos[:, None]


def solve_soft(bodies: Bodies, contacts: Contacts, params: SolverNumbers, *, use_bias: bool) -> tuple[Bodies, Contacts]:
    """One pass of the soft-step solver. With bias: pushes out of penetration softly; without (relax): takes back the
    velocity that the push added, and applies friction."""
    separation = current_separation(bodies, contacts)
    is_apart = separation > 0
    bias = jnp.where(is_apart, separation / params.h, 0)  # speculative: may close the gap, not more
    mass_scale, impulse_scale = jnp.ones_like(separation), jnp.zeros_like(separation)
    if use_bias:
        soft = jax.tree.map(
            lambda fixed, free: jnp.where(contacts.against_fixed, fixed, free), params.fixed, params.contact
        )
        push = jnp.maximum(soft.mass_scale * soft.bias_rate * separation, -params.push_out_speed)
        bias = jnp.where(is_apart, bias, push)
        mass_scale = jnp.where(is_apart, mass_scale, soft.mass_scale)
        impulse_scale = jnp.where(is_apart, impulse_scale, soft.impulse_scale)

    def solve(velocities: Velocities, row: tuple) -> tuple[Velocities, tuple]:
        c, bias, mass_scale, impulse_scale = row
        before = of = pair_velocities(c.pair, velocities)
        vn = normal_speed(of, c)
        impulse = -c.mass_normal * (mass_scale * vn + bias) - impulse_scale * c.impulse_normal
        of, normal_total = push_apart(of, c, impulse)
        tangent_total = c.impulse_tangent
        if not use_bias:
            of, tangent_total = solve_friction(of, c, normal_total)
        return scatter_velocities(velocities, c.pair, before, of), (normal_total, tangent_total)

    velocities, (normal, tangent) = jax.lax.scan(
        solve, bodies.velocities, (rows_now(bodies, contacts), bias, mass_scale, impulse_scale)
    )
    return bodies._replace(velocities=velocities), with_impulses(contacts, normal, tangent)


def normal_speed(of: PairVelocities, c: Row) -> jax.Array:
    return vec2.dot(c.normal, relative_velocity(of, c.arm_a, c.arm_b))


def push_apart(of: PairVelocities, c: Row, impulse: jax.Array) -> tuple[PairVelocities, jax.Array]:
    """Adds a normal impulse, as far as the accumulated one stays positive; also the new total."""
    total = jnp.maximum(c.impulse_normal + impulse, 0)
    return apply_impulse(of, c.pair, c.arm_a, c.arm_b, c.normal * (total - c.impulse_normal)[..., None]), total


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


def rows_of(contacts: Contacts) -> Row:
    return Row(*(getattr(contacts, name) for name in Row._fields))


def rows_now(bodies: Bodies, contacts: Contacts) -> Row:
    """As the bodies stand now, which `rows_of` has as they stood when the contacts were found."""
    arm_a, arm_b = arms_now(bodies, contacts)
    return rows_of(contacts)._replace(
        arm_a=arm_a,
        arm_b=arm_b,
        mass_normal=pair_mass(contacts.pair, arm_a, arm_b, contacts.normal),
        mass_tangent=pair_mass(contacts.pair, arm_a, arm_b, vec2.right(contacts.normal)),
    )


def with_impulses(contacts: Contacts, normal: jax.Array, tangent: jax.Array) -> Contacts:
    max_impulse = jnp.maximum(contacts.max_impulse, normal)
    return contacts._replace(impulse_normal=normal, impulse_tangent=tangent, max_impulse=max_impulse)


def solve_friction(of: Any, c: Row, normal_total: jax.Array) -> tuple[Any, jax.Array]:
    tangent = vec2.right(c.normal)
    vt = vec2.dot(tangent, relative_velocity(of, c.arm_a, c.arm_b))
    max_friction = c.friction * normal_total
    total = jnp.clip(c.impulse_tangent - c.mass_tangent * vt, -max_friction, max_friction)
    total = jnp.where(c.friction == 0, c.impulse_tangent, total)
    return apply_impulse(of, c.pair, c.arm_a, c.arm_b, tangent * (total - c.impulse_tangent)[..., None]), total
