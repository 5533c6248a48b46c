"""Impacts that go from disc to disc: which contacts share in them, and with which speeds their bodies leave.

Contacts that are solved together bounce as if their bodies were one. Bodies that meet in one point pass an impact on
instead: impact after impact, the fastest first, each with the restitution of its contact, from the velocities with
which the bodies came. What that leaves of a contact's speed is what its bounce aims at.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jax2d.constants import CONSTANTS as C
from jax2d.xla.bodies import (
    Bodies,
    Velocities,
    apply_impulse,
    pair_mass,
    pair_velocities,
    scatter_velocities,
)
from jax2d.xla.branching import choose, in_any_world
from jax2d.xla.contact_solver import normal_speed, rows_of
from jax2d.xla.contacts import Contacts


def propagate(
    bodies: Bodies, v_at_detection: Velocities, contacts: Contacts, rebound_target: jax.Array
) -> tuple[jax.Array, Contacts]:
    """`rebound_target` [K] m/s, the speeds that bounces aim at, 0 where nothing bounces, and the contacts. Those that
    passed an impact on are impacts themselves: their impulses do not last. `v_at_detection`: velocities when contacts
    were found."""
    passes_on = _passes_on(contacts)
    hit = _bodies_of(contacts, passes_on & (rebound_target > 0))
    next_in_line = passes_on & ~contacts.against_fixed & (rebound_target == 0) & (contacts.restitution > 0)
    is_called_for = jnp.any(next_in_line & _has_one_of(contacts, hit))

    def impacts() -> tuple[jax.Array, jax.Array]:
        none = jnp.zeros_like(hit)
        (velocities, _, again, factor), _ = jax.lax.scan(
            _impact(contacts, passes_on, rebound_target),
            (v_at_detection, none, none, jnp.ones_like(rebound_target[0])),
            jnp.arange(C.max_impacts),
        )
        is_passed = is_called_for & passes_on & _has_one_of(contacts, again & bodies.is_dynamic)
        speed = _normal_speed(contacts, velocities)
        return jnp.where(is_passed, jnp.where(speed > C.settled_speed, factor * speed, 0), rebound_target), is_passed

    nothing = (rebound_target, jnp.zeros_like(passes_on))
    rebound_target, is_passed = jax.lax.cond(in_any_world(is_called_for), impacts, lambda: nothing)
    return rebound_target, contacts._replace(is_impact=contacts.is_impact | is_passed)


def _impact(contacts: Contacts, passes_on: jax.Array, rebound_target: jax.Array):
    """One impact: that of the contact whose bodies approach fastest, if any does."""

    def impact(carry: tuple, index: jax.Array) -> tuple[tuple, None]:
        velocities, once, again, factor = carry
        closing = jnp.where(passes_on, -_normal_speed(contacts, velocities), 0)
        k = jnp.argmax(closing)
        speed, restitution, normal = closing[k], contacts.restitution[k], contacts.normal[k]
        pair, arm_a, arm_b = jax.tree.map(lambda x: x[k], (contacts.pair, contacts.arm_a, contacts.arm_b))
        # The moment of the impact falls inside the step: its speed is that of the bounce.
        is_first = (index == 0) & (rebound_target[k] > 0)
        factor = jnp.where(is_first, rebound_target[k] / jnp.where(is_first, restitution * speed, 1), factor)
        before = pair_velocities(pair, velocities)
        impulse = (1 + restitution) * speed * pair_mass(pair, arm_a, arm_b, normal)
        after = apply_impulse(before, pair, arm_a, arm_b, normal * impulse)
        both = pair.is_a | pair.is_b
        moved = scatter_velocities(velocities, pair, before, after)
        return choose(speed > C.settled_speed, (moved, once | both, again | (once & both), factor), carry), None

    return impact


def _passes_on(contacts: Contacts) -> jax.Array:
    """[K] bool, meets in one point and has touched."""
    return contacts.of_disc & (contacts.max_impulse > 0)


def skips_bounces(contacts: Contacts, separation: jax.Array) -> jax.Array:
    """[K] bool, a disc that has not come yet: it is hit in the next step, by what then has left."""
    return contacts.of_disc & (separation > 0) & (contacts.restitution > 0) & (contacts.max_impulse == 0)


def _normal_speed(contacts: Contacts, velocities: Velocities) -> jax.Array:
    return normal_speed(pair_velocities(contacts.pair, velocities), rows_of(contacts))


def _bodies_of(contacts: Contacts, chosen: jax.Array) -> jax.Array:
    """[n] bool, bodies of the chosen contacts [K]."""
    return jnp.any((contacts.pair.is_a | contacts.pair.is_b) & chosen[:, None], axis=0)


def _has_one_of(contacts: Contacts, bodies: jax.Array) -> jax.Array:
    """[K] bool, one of the contact's two is among the bodies [n]."""
    return jnp.any((contacts.pair.is_a | contacts.pair.is_b) & bodies, axis=-1)
