"""Report of the contacts of a step, where an engine is built with `report_contacts`; see warp/native/report.h.

Contacts may be found several times in a step. Impulses of one key add up, wherever in the step they acted, and a
contact that is gone before the end keeps its slot.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jax2d.contact_report import ContactReport, contact_report
from jax2d.scene import Capacity
from jax2d.xla import vec2
from jax2d.xla.bodies import Bodies, pick
from jax2d.xla.contact_solver import current_separation, moved_apart, turned_arms
from jax2d.xla.contacts import Contacts


class Tally(NamedTuple):
    """A report in the making: K slots, and of each of the K contacts found last:"""

    key: jax.Array  # [K] int32, -1 where free
    point: jax.Array  # [K, 2] m
    normal: jax.Array  # [K, 2]
    separation: jax.Array  # [K] m
    impulse: jax.Array  # [K, 2] N s on b, world frame
    dropped: jax.Array  # [] int32
    slot: jax.Array  # [K] int32, K where it has none
    acted: jax.Array  # [K, 2] N s, normal and tangential, that have been counted, or are of an earlier step


def nothing(capacity: Capacity, dtype: jnp.dtype) -> Tally:
    slots = capacity.contact_slots
    none, pairs = jnp.zeros(slots, dtype), jnp.zeros((slots, 2), dtype)
    no_slot = jnp.full(slots, slots, jnp.int32)
    return Tally(jnp.full(slots, -1, jnp.int32), pairs, pairs, none, pairs, jnp.zeros((), jnp.int32), no_slot, pairs)


def begin(tally: Tally, contacts: Contacts) -> Tally:
    """Contacts have just been found, with impulses that have acted already."""
    slots, in_use = tally.key.shape[0], contacts.key >= 0
    is_same = (contacts.key[:, None] == tally.key[None]) & in_use[:, None]
    is_new = in_use & ~jnp.any(is_same, axis=1)
    used = jnp.sum(tally.key >= 0, dtype=jnp.int32)
    new_slot = used + jnp.cumsum(is_new, dtype=jnp.int32) - 1
    slot = jnp.where(is_new, jnp.minimum(new_slot, slots), jnp.argmax(is_same, axis=1).astype(jnp.int32))
    slot = jnp.where(in_use, slot, slots)
    return tally._replace(
        key=tally.key.at[slot].set(contacts.key, mode="drop"),
        dropped=tally.dropped + jnp.sum(in_use & (slot == slots), dtype=jnp.int32),
        slot=slot,
        acted=_impulses(contacts),
    )


def warm_start(tally: Tally) -> Tally:
    """Adds all warm-start impulses."""
    return tally._replace(acted=jnp.zeros_like(tally.acted))


def add(tally: Tally, contacts: Contacts) -> Tally:
    """Counts what has acted since the last time."""
    now = _impulses(contacts)
    return add_impulse(tally, contacts, now - tally.acted)._replace(acted=now)


def add_impulse(tally: Tally, contacts: Contacts, more: jax.Array) -> Tally:
    """more [K, 2] N s: normal, tangential. They add up as vectors: a contact found again may have another normal."""
    vector = contacts.normal * more[:, :1] + vec2.right(contacts.normal) * more[:, 1:]
    return tally._replace(impulse=tally.impulse.at[tally.slot].add(vector, mode="drop"))


def locate(tally: Tally, bodies: Bodies, contacts: Contacts) -> Tally:
    """Records the points of contacts, midway between both surfaces as their bodies stand."""
    is_a, is_b = contacts.pair.is_a, contacts.pair.is_b
    turned_a, turned_b = turned_arms(bodies, contacts)
    on_a, on_b = contacts.arm_a + turned_a, contacts.arm_b + turned_b
    apart = pick(is_b, bodies.position) - pick(is_a, bodies.position) + moved_apart(bodies, contacts)
    point = pick(is_a, bodies.position + bodies.delta) + on_a + 0.5 * (apart + on_b - on_a)
    separation = current_separation(bodies, contacts)
    return tally._replace(
        point=tally.point.at[tally.slot].set(point, mode="drop"),
        normal=tally.normal.at[tally.slot].set(contacts.normal, mode="drop"),
        separation=tally.separation.at[tally.slot].set(separation, mode="drop"),
    )


def report_of(tally: Tally) -> ContactReport:
    return contact_report(
        tally.key,
        point=tally.point,
        normal=tally.normal,
        separation=tally.separation,
        impulse=tally.impulse,
        dropped=tally.dropped,
    )


def _impulses(contacts: Contacts) -> jax.Array:
    return jnp.stack([contacts.impulse_normal, contacts.impulse_tangent], -1)
