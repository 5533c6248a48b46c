"""Impacts that go from disc to disc: which contacts share in them, and with which speeds their bodies leave.

Contacts that are solved together bounce as if their bodies were one. Bodies that meet in one point pass an impact on
instead: impact after impact, the fastest first, each with the restitution of its contact, from the velocities with
which the bodies came. What that leaves of a contact's speed is what its bounce aims at. Impacts of one speed are one:
a ball that meets two alike goes straight on, whichever comes first in the list.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jax2d.constants import CONSTANTS as C
from jax2d.xla import vec2
from jax2d.xla.active_set import has_one_of, marked
from jax2d.xla.bodies import (
    Bodies,
    Velocities,
    apply_impulse,
    pair_velocities,
    pick,
)
from jax2d.xla.branching import in_any_world
from jax2d.xla.contact_solver import normal_speed, rows_of
from jax2d.xla.contacts import Contacts
from jax2d.xla.islands import Islands


def propagate(
    bodies: Bodies, v_at_detection: Velocities, contacts: Contacts, islands: Islands, rebound_target: jax.Array
) -> tuple[jax.Array, Contacts]:
    """`rebound_target` [K] m/s, the speeds that bounces aim at, 0 where nothing bounces, and the contacts. Those that
    passed an impact on are impacts themselves: their impulses do not last. `v_at_detection`: velocities when contacts
    were found."""
    passes_on = _passes_on(contacts)
    hit = _bodies_of(contacts, passes_on & (rebound_target > 0))
    next_in_line = passes_on & ~contacts.against_fixed & (rebound_target == 0) & (contacts.restitution > 0)
    called_for = islands.whole(marked(bodies, contacts.pair, next_in_line & has_one_of(contacts.pair, hit)))
    passes_on &= has_one_of(contacts.pair, called_for)

    def impacts() -> tuple[jax.Array, jax.Array]:
        none = jnp.zeros_like(hit)
        (velocities, _, again, factor), _ = jax.lax.scan(
            _impact(contacts, passes_on, _in_one_island(bodies, contacts, islands), rebound_target),
            (v_at_detection, none, none, jnp.ones_like(rebound_target)),
            jnp.arange(C.max_impacts),
        )
        is_passed = passes_on & has_one_of(contacts.pair, again & bodies.is_dynamic)
        speed = _normal_speed(contacts, velocities)
        return jnp.where(is_passed, jnp.where(speed > C.settled_speed, factor * speed, 0), rebound_target), is_passed

    nothing = (rebound_target, jnp.zeros_like(passes_on))
    rebound_target, is_passed = jax.lax.cond(in_any_world(jnp.any(called_for)), impacts, lambda: nothing)
    return rebound_target, contacts._replace(is_impact=contacts.is_impact | is_passed)


def _impact(contacts: Contacts, passes_on: jax.Array, together: jax.Array, rebound_target: jax.Array):
    """One impact in each island: that of the contacts whose bodies approach fastest, if any do. together [K, K] bool,
    in one island."""
    index_of = jnp.arange(passes_on.shape[0])

    def impact(carry: tuple, index: jax.Array) -> tuple[tuple, None]:
        velocities, once, again, factor = carry
        closing = jnp.where(passes_on, -_normal_speed(contacts, velocities), 0)
        is_behind = (closing > closing[:, None]) | ((closing == closing[:, None]) & (index_of < index_of[:, None]))
        is_fastest = (closing > C.settled_speed) & ~jnp.any(together & is_behind, axis=1)
        # The moment of the impact falls inside the step: its speed is that of the bounce.
        is_first = is_fastest & (index == 0) & (rebound_target > 0)
        own = rebound_target / jnp.where(is_first, contacts.restitution * closing, 1)
        of_island = together & is_first
        factor = jnp.where(jnp.any(of_island, axis=1), jnp.sum(jnp.where(of_island, own, 0), axis=1), factor)
        speed = (1 - C.simultaneous_share) * jnp.max(jnp.where(together & is_fastest, closing, 0), axis=1)
        is_next = (speed > 0) & (closing >= speed)
        both = _bodies_of(contacts, is_next)
        moved = _collide_at_once(contacts, is_next, together, closing, speed, velocities)
        return (moved, once | both, again | (once & both), factor), None

    return impact


def _collide_at_once(
    contacts: Contacts,
    chosen: jax.Array,
    together: jax.Array,
    closing: jax.Array,
    speed: jax.Array,
    velocities: Velocities,
) -> Velocities:
    """The chosen contacts, which close at `closing` [K] m/s, leave with their restitution, all at once: pass after pass
    until none of an island changes by much of its `speed` [K] m/s."""
    pair = contacts.pair
    zero = jax.tree.map(jnp.zeros_like, pair_velocities(pair, velocities))
    unit = apply_impulse(zero, pair, contacts.arm_a, contacts.arm_b, contacts.normal)
    by_a, by_b = _rows(unit.velocity_a, unit.omega_a), _rows(unit.velocity_b, unit.omega_b)  # by 1 N s
    of_a = -_rows(contacts.normal, vec2.cross(contacts.arm_a, contacts.normal))
    of_b = _rows(contacts.normal, vec2.cross(contacts.arm_b, contacts.normal))
    mass = vec2.inverse_or_zero(jnp.sum(of_a * by_a, -1) + jnp.sum(of_b * by_b, -1))
    wanted = contacts.restitution * closing

    # Bodies one by one, not as one sum over all contacts: that would be rounded by what other islands have.
    def one_contact(moving: jax.Array, row: tuple) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        is_a, is_b, of_a, of_b, by_a, by_b, mass, wanted, acts, given = row
        wrong = jnp.dot(of_a, pick(is_a, moving)) + jnp.dot(of_b, pick(is_b, moving)) - wanted
        total = jnp.where(acts, jnp.maximum(given - wrong * mass, 0), given)
        more = total - given
        moving += jnp.where(is_a[:, None], more * by_a, 0) + jnp.where(is_b[:, None], more * by_b, 0)
        return moving, (total, jnp.where(more == 0, 0, jnp.abs(wrong)))

    def one_pass(carry: tuple) -> tuple:
        moving, given, going, passes = carry
        rows = (pair.is_a, pair.is_b, of_a, of_b, by_a, by_b, mass, wanted, going, given)
        moving, (given, wrong) = jax.lax.scan(one_contact, moving, rows)
        is_settled = ~jnp.any(together & (wrong >= C.simultaneous_share * speed), axis=1)
        return moving, given, going & ~is_settled, passes + 1

    start = (_rows(velocities.velocity, velocities.omega), jnp.zeros_like(closing), chosen, jnp.zeros((), jnp.int32))
    moving, *_ = jax.lax.while_loop(lambda carry: jnp.any(carry[2]) & (carry[3] < C.max_impacts), one_pass, start)
    return Velocities(moving[:, :2], moving[:, 2])


def _rows(vectors: jax.Array, numbers: jax.Array) -> jax.Array:
    return jnp.concatenate([vectors, numbers[:, None]], -1)


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


def _in_one_island(bodies: Bodies, contacts: Contacts, islands: Islands) -> jax.Array:
    """[K, K] bool, contacts of one island."""
    is_of = (contacts.pair.is_a | contacts.pair.is_b) & bodies.is_dynamic
    island = jnp.min(jnp.where(is_of, islands.first, islands.first.shape[0]), axis=1)
    return island[:, None] == island
