"""Restitution: what hit in a step leaves with its share of the speed of the impact. What is jointed to it or touches it
has a part in that.

Once the sub-steps are solved, rounds of passes over joints and contacts of an island go on until its every bounce has
its speed. They change velocities only: impulses for warm-starting the next step are those of before, since a bounce
does not last. Bounces give an island no more energy than it had when contacts were found, and motors, thrusters and
moving surfaces have added since."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jax2d.constants import CONSTANTS as C
from jax2d.solver_numbers import Scalar, SolverNumbers
from jax2d.xla import joints as joints_of
from jax2d.xla import springs as springs_of
from jax2d.xla import vec2
from jax2d.xla.active_set import ActiveSet, has_one_of, marked
from jax2d.xla.bodies import Bodies, Velocities, pair_velocities, scatter_velocities
from jax2d.xla.branching import choose, in_any_world
from jax2d.xla.contact_solver import (
    Row,
    current_separation,
    normal_speed,
    push_apart,
    rows_now,
    solve_friction,
    solve_rolling,
    surface_work,
    with_impulses,
)
from jax2d.xla.contacts import Contacts, hits
from jax2d.xla.impact_propagation import skips_bounces
from jax2d.xla.islands import Islands, by_body, share_within
from jax2d.xla.joints import Joints, PlacedJoints
from jax2d.xla.rows import Constraints
from jax2d.xla.rules import Rules


class Round(NamedTuple):
    bodies: Bodies
    joints: Joints
    contacts: Contacts
    targets: BounceTargets
    going: jax.Array  # [n] bool, bodies of islands that are not done
    settled: jax.Array  # [n] bool, in their islands everything leaves with its speed, as far as any push can make it
    friction_applied: jax.Array  # [n] bool, friction has acted


class EnergyLimit(NamedTuple):
    """Energy that bounces must not exceed."""

    max_energy: jax.Array  # [n] J, see `energy`: summed over an island
    carried: jax.Array  # [n] J, what moving surfaces and kinematic bodies have done
    gravity: jax.Array  # [2] m/s^2


class Solved(NamedTuple):
    """A world while it is solved."""

    bodies: Bodies
    joints: Joints
    contacts: Contacts


def bounce(
    now: Solved,
    placed: PlacedJoints,
    islands: Islands,
    rebound_target: jax.Array,
    energy_limit: EnergyLimit,
    params: SolverNumbers,
    rules: Rules,
) -> tuple[Bodies, jax.Array | None]:
    """Bodies after the bounces of one world, and, where contacts are reported, what contacts gave them by that, [K, 2]
    N s; `rebound_target` [K] m/s is zero where a contact does not bounce."""
    bodies, joints, contacts = now

    def rounds() -> tuple[Velocities, jax.Array | None]:
        def one_round(now: Round, index: jax.Array) -> tuple[Round, None]:
            bodies, joints, contacts = now.bodies, now.joints, now.contacts
            active = ActiveSet.of(now.going)
            bodies, joints, _ = joints_of.solve_soft(bodies, joints, placed, params, active, use_bias=False)
            is_last = index == rules.bounce_rounds - 1
            with_friction = now.going & ~now.friction_applied & (now.settled | is_last)
            bodies, contacts, targets, unsettled = solve_bounces(
                bodies, contacts, now.targets, index == 0, active, with_friction, params
            )
            settled = ~islands.whole(marked(bodies, contacts.pair, unsettled))
            going = now.going & ~(settled & now.friction_applied)
            friction_applied = now.friction_applied | with_friction
            return Round(bodies, joints, contacts, targets, going, settled, friction_applied), None

        targets = BounceTargets(
            rebound_target, rows_now(bodies, contacts, -0.5 * params.h).mass_normal, contacts.approach
        )
        going = islands.whole(marked(bodies, contacts.pair, rebound_target > 0))
        no = jnp.zeros_like(going)
        start = Round(bodies, joints, contacts, targets, going, settled=no, friction_applied=no)
        end, _ = jax.lax.scan(one_round, start, jnp.arange(rules.bounce_rounds))
        carried = carried_work(end.bodies, end.joints, placed.rows, end.contacts, params.h)
        by_bounces = energy_limit._replace(carried=carried - energy_limit.carried)
        velocities, share = limit(bodies, end.bodies, islands, by_bounces, params.h)
        if not rules.report_contacts:
            return velocities, None
        normal = end.contacts.impulse_normal - contacts.impulse_normal
        tangent = end.contacts.impulse_tangent - contacts.impulse_tangent
        is_of = (contacts.pair.is_a | contacts.pair.is_b) & bodies.is_dynamic
        of_contact = jnp.min(jnp.where(is_of, share, 1), axis=1)
        return velocities, of_contact[:, None] * jnp.stack([normal, tangent], -1)

    # Worlds are stepped together, and mostly nothing bounces in any of them.
    none = jnp.zeros((*rebound_target.shape, 2), rebound_target.dtype) if rules.report_contacts else None
    velocities, impulses = jax.lax.cond(
        in_any_world(jnp.any(rebound_target > 0)), rounds, lambda: (bodies.velocities, none)
    )
    return bodies._replace(velocities=velocities), impulses


def energy(bodies: Bodies, velocities: Velocities, gravity: jax.Array, h: Scalar) -> jax.Array:
    """[n] J, that of semi-implicit Euler, which keeps m |v + g h / 2|^2 / 2 - m g.x in free flight to the last digit;
    zero of height is where each body was when contacts were found."""
    mass, inertia = vec2.inverse_or_zero(bodies.inverse_mass), vec2.inverse_or_zero(bodies.inverse_inertia)
    midway = velocities.velocity + 0.5 * h * gravity
    kinetic = 0.5 * (mass * vec2.dot(midway, midway) + inertia * velocities.omega * velocities.omega)
    return kinetic - mass * vec2.dot(bodies.delta, gravity)


def carried_work(bodies: Bodies, joints: Joints, rows: Constraints, contacts: Contacts, h: Scalar) -> jax.Array:
    """[n] J, what moving surfaces and kinematic bodies have done in this sub-step."""
    parts = (
        (contacts.pair, surface_work(bodies, contacts, h)),
        (joints.pair, joints_of.kinematic_work(bodies, joints, rows)),
        (joints.springs.pair, springs_of.kinematic_work(bodies, joints.springs)),
    )
    return by_body(bodies, parts)


def driven_work(bodies: Bodies, joints: Joints, rows: Constraints) -> jax.Array:
    """[n] J, what motors and springs have done in this sub-step."""
    parts = (
        (joints.pair, joints_of.motor_work(bodies, joints, rows)),
        (joints.springs.pair, springs_of.work(bodies, joints.springs)),
    )
    return by_body(bodies, parts)


def limit(
    before: Bodies, after: Bodies, islands: Islands, energy_limit: EnergyLimit, h: Scalar
) -> tuple[Velocities, jax.Array]:
    """Scales changes of velocity so that bounces leave an island no more energy than there is. Where several bodies,
    joints or friction share in an impact, restitution contact by contact may request more. Then all of the island gets
    the same share of its change of velocity, returned too, [n]: joints and contacts stay solved. What moving surfaces
    have done to what bounced is theirs to give."""
    max_energy, carried, gravity = islands.sums(energy_limit.max_energy), energy_limit.carried, energy_limit.gravity
    mass, inertia = vec2.inverse_or_zero(before.inverse_mass), vec2.inverse_or_zero(before.inverse_inertia)
    change = jax.tree.map(jnp.subtract, after.velocities, before.velocities)
    midway = before.velocities.velocity + 0.5 * h * gravity
    linear = mass * vec2.dot(midway, change.velocity) + inertia * before.velocities.omega * change.omega
    linear = islands.sums(linear - carried)
    quadratic = islands.sums(
        0.5 * (mass * vec2.dot(change.velocity, change.velocity) + inertia * change.omega * change.omega)
    )
    was = islands.sums(energy(before, before.velocities, gravity, h))
    too_much = (was + linear + quadratic > max_energy + C.energy_rounding * quadratic) & (quadratic > 0)
    share = share_within(jnp.maximum(max_energy - was, 0), linear, jnp.where(too_much, quadratic, 0))
    velocity = before.velocities.velocity + share[:, None] * change.velocity
    omega = before.velocities.omega + share * change.omega
    limited = Velocities(
        jnp.where(too_much[:, None], velocity, after.velocities.velocity),
        jnp.where(too_much, omega, after.velocities.omega),
    )
    return limited, jnp.where(too_much, share, 1)


class BounceTargets(NamedTuple):
    """Contacts while those that hit bounce."""

    speed: jax.Array  # [K] m/s to leave with, 0: does not bounce
    mass: jax.Array  # [K] kg that a push is taken to move
    before: jax.Array  # [K] m/s, normal speed before the last push


def solve_bounces(
    bodies: Bodies,
    contacts: Contacts,
    targets: BounceTargets,
    is_first: jax.Array,
    active: ActiveSet,
    with_friction: jax.Array,
    params: SolverNumbers,
) -> tuple[Bodies, Contacts, BounceTargets, jax.Array]:
    """A relax pass in which what bounces leaves with its speed, with friction for bodies of `with_friction` [n] bool.
    Also where it did not leave with it yet, [K] bool, as far as any push can make it."""
    separation = current_separation(bodies, contacts)
    # Where an impact went through, nothing is left to be closed.
    is_closed = (separation <= C.touching_distance) | (contacts.of_disc & contacts.is_impact)
    apart = jnp.where(is_closed, 0, separation / params.h)

    def solve(velocities: Velocities, row: tuple) -> tuple[Velocities, tuple]:
        c, bounce, apart, is_left_out, with_friction = row
        before = of = pair_velocities(c.pair, velocities)
        vn = normal_speed(of, c)
        bounces = bounce.speed > 0
        mass, has_converged = update_secant_mass(c, bounce, vn, is_first)
        impulse = jnp.where(bounces, mass * (bounce.speed - vn), -c.mass_normal * (vn + apart))
        pushed, normal_total = push_apart(of, c, impulse)
        friction_applied, tangent_total = solve_friction(pushed, c, normal_total)
        friction_applied, rolling_total = solve_rolling(friction_applied, c, normal_total)
        has_friction = with_friction | ~bounces
        of = choose(has_friction, friction_applied, pushed)
        tangent_total = jnp.where(has_friction, tangent_total, c.impulse_tangent)
        if rolling_total is not None:
            rolling_total = jnp.where(has_friction, rolling_total, c.rolling_impulse)
        totals = (normal_total, tangent_total, rolling_total)
        solved = (of, totals, BounceTargets(bounce.speed, mass, vn), bounces & ~has_converged)
        unsolved = (before, (c.impulse_normal, c.impulse_tangent, c.rolling_impulse), bounce, jnp.array(False))
        of, totals, after, is_unsettled = choose(is_left_out, unsolved, solved)
        return scatter_velocities(velocities, c.pair, before, of), (*totals, after, is_unsettled)

    is_left_out = skips_bounces(contacts, separation) | ~active.includes(contacts.pair)
    has_friction = has_one_of(contacts.pair, with_friction)
    rows = rows_now(bodies, contacts, -0.5 * params.h)
    velocities, (normal, tangent, rolling, targets, unsettled) = jax.lax.scan(
        solve, bodies.velocities, (rows, targets, apart, is_left_out, has_friction)
    )
    contacts = with_impulses(contacts._replace(rolling_impulse=rolling), normal, tangent)
    return bodies._replace(velocities=velocities), contacts, targets, unsettled


def update_secant_mass(
    c: Row, bounce: BounceTargets, vn: jax.Array, is_first: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """(mass that the next push is taken to move, whether it has its speed or no push can give it any more).

    What the last push gave a bounce, joints and other contacts have shared out since. The next one pushes as if the
    contact moved the mass that it was seen to move (secant method); where others push against it, its pair's alone."""
    requested = bounce.speed - bounce.before
    gained = (vn - bounce.before) / jnp.where(requested == 0, 1, requested)
    has_converged = (jnp.abs(vn - bounce.speed) <= C.bounce_tolerance * bounce.speed) | (
        (requested != 0) & (jnp.abs(gained) < C.min_gained_share)
    )
    is_seen = (requested != 0) & (gained > 0) & (gained < C.max_secant_share)
    mass = jnp.where(is_seen, bounce.mass / jnp.clip(gained, C.min_secant_share, C.max_secant_share), c.mass_normal)
    return jnp.where(is_first | has_converged, bounce.mass, mass), has_converged & ~is_first


def rebound_speed(bodies: Bodies, contacts: Contacts, gravity: jax.Array, params: SolverNumbers) -> jax.Array:
    """Speed with which what hit in this step must leave, [K] m/s; 0 where nothing bounces."""
    bounces = hits(contacts.restitution, contacts.approach, params) & (contacts.max_impulse != 0)
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
