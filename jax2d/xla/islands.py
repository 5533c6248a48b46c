"""Islands: bodies that contacts, joints and springs join, directly or by others that can be pushed.

What holds takes energy from an island, or none. Where one has more kinetic energy once it is relaxed than the sub-step
began with, when forces had acted and nothing had been solved, impulses are not solved yet, or warm-start impulses from
another place of the bodies are far off; bodies that jam do that. It is solved again, alone, and where that does not
help its energy is bounded.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jax2d.constants import CONSTANTS as C
from jax2d.solver_numbers import Scalar
from jax2d.xla import bodies as bodies_of
from jax2d.xla import contact_solver, vec2
from jax2d.xla import joints as joints_of
from jax2d.xla import springs as springs_of
from jax2d.xla.bodies import Bodies, Pair, Velocities
from jax2d.xla.contacts import Contacts
from jax2d.xla.joints import Joints
from jax2d.xla.rows import Constraints


class Islands(NamedTuple):
    together: jax.Array  # [n, n] bool, in one island
    anchored: jax.Array  # [n] bool, in an island that is held by what cannot be pushed
    in_group: jax.Array  # [n, n] bool, their contacts are found together: islands on one kinematic body, and that body

    def whole(self, bodies: jax.Array) -> jax.Array:
        """[n] bool, bodies of the islands of these [n]."""
        return jnp.any(self.together & bodies, axis=1)

    def whole_groups(self, bodies: jax.Array) -> jax.Array:
        """[n] bool, bodies of the groups of these [n]."""
        return jnp.any(self.in_group & bodies, axis=1)

    def sums(self, numbers: jax.Array) -> jax.Array:
        """[n] sums of numbers of bodies [n] over the island of each."""
        return jnp.sum(jnp.where(self.together, numbers, 0), axis=1)

    @property
    def first(self) -> jax.Array:
        """[n] int32, the first body of the island of each."""
        return jnp.argmax(self.together, axis=1).astype(jnp.int32)


def find(bodies: Bodies, contacts: Contacts, joints: Joints) -> Islands:
    n = bodies.inverse_mass.shape[0]
    together, anchored = jnp.eye(n, dtype=bool), jnp.zeros(n, bool)
    in_group = together
    held = (
        (contacts.pair, contacts.key >= 0),
        (joints.pair, joints.is_held),
        (joints.springs.pair, joints.springs.is_held),
    )
    for pair, is_held in held:
        moving_a, moving_b = (body & bodies.moves & is_held[:, None] for body in (pair.is_a, pair.is_b))
        in_group |= _joined(moving_a, moving_b)
        a, b = (body & bodies.is_dynamic & is_held[:, None] for body in (pair.is_a, pair.is_b))
        together |= _joined(a, b)
        has_a, has_b = jnp.any(a, axis=1, keepdims=True), jnp.any(b, axis=1, keepdims=True)
        anchored |= jnp.any((a & ~has_b) | (b & ~has_a), axis=0)
    for _ in range(math.ceil(math.log2(max(n, 2)))):  # twice as far each time
        together, in_group = (x.astype(jnp.float32) @ x.astype(jnp.float32) > 0 for x in (together, in_group))
    return Islands(together, jnp.any(together & anchored, axis=1), in_group)


def _joined(a: jax.Array, b: jax.Array) -> jax.Array:
    """[n, n] bool, from the bodies of pairs, [..., n] bool each."""
    one_way = jnp.any(a[:, :, None] & b[:, None, :], axis=0)
    return one_way | one_way.T


def drift(islands: Islands, bodies: Bodies, velocities: Velocities) -> jax.Array:
    """[n, 2] m/s, velocity of the centre of mass of each body's island, 0 where something fixed holds it.

    Islands that nothing fixed holds are as free to move as any: what they gain or may have is not to depend on that.
    """
    mass = jnp.where(islands.together, vec2.inverse_or_zero(bodies.inverse_mass)[None], 0)  # [n, n] kg
    momentum = jnp.sum(mass[..., None] * velocities.velocity, axis=1)
    of_centre = momentum * vec2.inverse_or_zero(jnp.sum(mass, axis=1))[:, None]
    return jnp.where(islands.anchored[:, None], 0, of_centre)


class EnergyBound(NamedTuple):
    """Kinetic energy that may be left to each body beside the work of motors, springs and what carries."""

    energy: jax.Array  # [n] J
    drift: jax.Array  # [n, 2] m/s, that it is relative to
    h: Scalar  # s, of the sub-step


def energy_bound(bodies: Bodies, v_substep_start: Velocities, drift: jax.Array, h: Scalar) -> EnergyBound:
    mass = vec2.inverse_or_zero(bodies.inverse_mass)
    before = bodies_of.kinetic_energy(bodies, v_substep_start, drift)
    return EnergyBound(before * (1 + h * C.slack_rate) + h * C.slack_power * mass, drift, h)


def energy_gained(
    islands: Islands, bodies: Bodies, joints: Joints, rows: Constraints, contacts: Contacts, bound: EnergyBound
) -> tuple[jax.Array, jax.Array]:
    """[n] J, what the island of each body has more than it may have, and the work that motors, springs and what carries
    have done to it."""
    gain = bodies_of.kinetic_energy(bodies, bodies.velocities, bound.drift) - bound.energy
    work = (
        (contacts.pair, contact_solver.surface_work(bodies, contacts, bound.h)),
        (joints.pair, joints_of.motor_work(bodies, joints, rows) + joints_of.kinematic_work(bodies, joints, rows)),
        (
            joints.springs.pair,
            springs_of.work(bodies, joints.springs) + springs_of.kinematic_work(bodies, joints.springs),
        ),
    )
    gain, work = islands.sums(gain), islands.sums(by_body(bodies, work))
    return jnp.where(bodies.is_dynamic & (gain > 0), jnp.maximum(gain - work, 0), 0), work


def limit_gains(
    islands: Islands,
    solved: tuple[Bodies, Joints, Contacts],
    v_substep_start: Velocities,
    bound: EnergyBound,
    gained: tuple[jax.Array, jax.Array],
) -> tuple[Bodies, Joints, Contacts]:
    """Bounds the energy of islands that no pass has brought to rest. gained: see `energy_gained`.

    Their bodies get the share of all that contacts and joints have changed in the sub-step that leaves them what they
    may have. Impulses of contacts and springs, for the next warm start, keep more: what presses goes on to press.
    """
    (bodies, joints, contacts), (gains, work) = solved, gained
    too_much = gains > 0
    mass, inertia = vec2.inverse_or_zero(bodies.inverse_mass), vec2.inverse_or_zero(bodies.inverse_inertia)
    start = _turned(islands, bodies, v_substep_start)
    now = bodies.velocities
    changed, spun = now.velocity - start.velocity, now.omega - start.omega
    linear = islands.sums(mass * vec2.dot(start.velocity - bound.drift, changed) + inertia * start.omega * spun) - work
    quadratic = islands.sums(0.5 * (mass * vec2.dot(changed, changed) + inertia * spun * spun))
    room = islands.sums(bound.energy - bodies_of.kinetic_energy(bodies, start, bound.drift))
    quadratic = jnp.where(too_much, quadratic, 0)
    left = share_within(room, linear, quadratic)
    kept = share_within(room + C.kept_gain * islands.sums(mass), linear, quadratic)
    has_any = left > 0  # what is not finite has none
    velocity = start.velocity + jnp.where(has_any[:, None], changed, 0) * left[:, None]
    omega = start.omega + jnp.where(has_any, spun, 0) * left
    velocity = jnp.where(too_much[:, None], velocity, now.velocity)
    omega = jnp.where(too_much, omega, now.omega)

    def scaled(pair: Pair, impulses: jax.Array) -> jax.Array:
        its_bodies = (pair.is_a | pair.is_b) & bodies.is_dynamic
        by = jnp.min(jnp.where(its_bodies, kept, 1), axis=-1)
        factor = joints_of.like(by, impulses)
        return jnp.where(factor > 0, impulses, 0) * factor

    springs, rolling = joints.springs, contacts.rolling_impulse
    return (
        bodies._replace(velocities=Velocities(velocity, omega)),
        joints._replace(springs=springs._replace(impulse=scaled(springs.pair, springs.impulse))),
        contacts._replace(
            impulse_normal=scaled(contacts.pair, contacts.impulse_normal),
            impulse_tangent=scaled(contacts.pair, contacts.impulse_tangent),
            rolling_impulse=None if rolling is None else scaled(contacts.pair, rolling),
        ),
    )


def share_within(room: jax.Array, linear: jax.Array, quadratic: jax.Array) -> jax.Array:
    """The largest share s of changes of velocity that changes energies by no more than `room`, J: linear s +
    quadratic s^2. In a form that loses no digits where a change is far too large."""
    inverse = vec2.inverse_or_zero(quadratic)
    half = 0.5 * linear * inverse
    root = vec2.sqrt_or_zero(jnp.maximum(half * half + room * inverse, 0))
    share = jnp.where(half > 0, room * inverse * vec2.inverse_or_zero(root + half), root - half)
    return jnp.where(quadratic > 0, jnp.where(share > 0, jnp.minimum(share, 1), 0), 1)


def _turned(islands: Islands, bodies: Bodies, v_substep_start: Velocities) -> Velocities:
    """Velocities that a sub-step began with. Islands that nothing holds are turned, as one piece, to the angular
    momentum that they have now: bodies have moved since."""
    mass, inertia = vec2.inverse_or_zero(bodies.inverse_mass), vec2.inverse_or_zero(bodies.inverse_inertia)
    weights = jnp.where(islands.together, mass[None], 0)  # [n, n] kg
    total = jnp.sum(weights, axis=1)
    place = bodies.position + bodies.delta
    centre = (weights @ place) * vec2.inverse_or_zero(total)[:, None]
    arm = place - centre
    now = bodies.velocities
    momentum = islands.sums(
        inertia * (now.omega - v_substep_start.omega) + mass * vec2.cross(arm, now.velocity - v_substep_start.velocity)
    )
    turn = momentum * vec2.inverse_or_zero(islands.sums(inertia + mass * vec2.dot(arm, arm)))
    stuck = islands.whole(bodies.is_dynamic & ((mass == 0) | (inertia == 0)))  # a body cannot turn or be shifted
    turn = jnp.where(islands.anchored | stuck | ~bodies.is_dynamic, 0, turn)
    return Velocities(v_substep_start.velocity + vec2.left(arm) * turn[:, None], v_substep_start.omega + turn)


def by_body(bodies: Bodies, parts: tuple[tuple[Pair, jax.Array], ...]) -> jax.Array:
    """[n] sums of numbers of constraints, each at a body of its pair that can be pushed."""
    total = jnp.zeros_like(bodies.inverse_mass)
    for pair, number in parts:
        is_a, is_b = pair.is_a & bodies.is_dynamic, pair.is_b & bodies.is_dynamic
        body = is_a | (is_b & ~jnp.any(is_a, axis=1, keepdims=True))
        total += jnp.sum(jnp.where(body, number[:, None], 0), axis=0)
    return total
