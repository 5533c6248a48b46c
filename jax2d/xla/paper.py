"""Solver of preset `paper`: joints, motors and contacts by the appendix of the Kinetix paper.

Contacts are sequential impulses, one after another or, as there, in batches.
"""

from __future__ import annotations

from collections.abc import Callable
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
    apply_angular_impulse,
    apply_impulse,
    pair_velocities,
    pick,
    relative_velocity,
    scatter_velocities,
)
from jax2d.xla.contact_solver import Row, rows_of, solve_friction, with_impulses
from jax2d.xla.contacts import Contacts
from jax2d.xla.joints import JointImpulses, Joints, arms
from jax2d.xla.rules import Rules

# Joints and motors


def apply_motors(bodies: Bodies, joints: Joints, params: SolverNumbers) -> Bodies:
    """j = p tanh((w_b - w_a - s A) rho), weaker within params.motor_fade_angle of a limit it runs into. All at once (as
    in "Parallelised Computation"): no motor sees what another does in the same step."""
    fade = params.motor_fade_angle
    beyond = joints.start_angle - jnp.clip(joints.start_angle, joints.lower + fade, joints.upper - fade)
    into_limit = joints.is_limited & (beyond * joints.control > 0)
    power = joints.max_motor_impulse * jnp.where(into_limit, jnp.maximum(0, 1 - jnp.abs(beyond) / fade), 1)

    before = pair_velocities(joints.pair, bodies.velocities)
    excess = before.omega_b - before.omega_a - joints.motor_target
    angular_impulse = jnp.where(joints.is_driven, -power * jnp.tanh(excess * params.motor_decay), 0)
    after = apply_angular_impulse(before, joints.pair, angular_impulse)
    return bodies._replace(velocities=scatter_velocities(bodies.velocities, joints.pair, before, after))


def warm_start(bodies: Bodies, joints: Joints) -> tuple[Bodies, Joints]:
    arm_a, arm_b = arms(bodies, joints)
    before = pair_velocities(joints.pair, bodies.velocities)
    after = apply_impulse(before, joints.pair, arm_a, arm_b, joints.impulses.point)
    after = apply_angular_impulse(after, joints.pair, jnp.where(joints.is_fixed, joints.impulses.angular_impulse, 0))
    zero = jnp.zeros_like(joints.impulses.lower)
    impulses = joints.impulses._replace(lower=zero, upper=zero)
    return bodies._replace(
        velocities=scatter_velocities(bodies.velocities, joints.pair, before, after)
    ), joints._replace(impulses=impulses)


class JointRow(NamedTuple):
    """A joint as an iteration needs it: nothing here changes while iterating."""

    pair: Pair
    is_fixed: jax.Array
    is_limited: jax.Array
    axial_mass: jax.Array
    start_angle: jax.Array  # rad
    beyond: jax.Array  # rad by which a limit is exceeded, signed
    arm_a: jax.Array
    arm_b: jax.Array
    start_gap: jax.Array  # m, anchor of b from anchor of a at the start of the step


def solve(bodies: Bodies, joints: Joints, params: SolverNumbers) -> tuple[Bodies, Joints]:
    """One iteration over all joints: point (impulse along the relative velocity, velocity and positional correction),
    then the angle of fixed joints, or limits where they are exceeded."""
    arm_a, arm_b = arms(bodies, joints)
    rows = JointRow(
        pair=joints.pair,
        is_fixed=joints.is_fixed,
        is_limited=joints.is_limited & ~joints.is_fixed,
        axial_mass=joints.axial_mass,
        start_angle=joints.start_angle,
        beyond=joints.start_angle - jnp.clip(joints.start_angle, joints.lower, joints.upper),
        arm_a=arm_a,
        arm_b=arm_b,
        start_gap=joints.centre_gap + (arm_b - arm_a),
    )

    def solve_one(
        carry: tuple[Velocities, jax.Array], row_and_impulses: tuple[JointRow, JointImpulses]
    ) -> tuple[tuple[Velocities, jax.Array], JointImpulses]:
        (velocities, delta), (row, impulses) = carry, row_and_impulses
        pair = row.pair
        gap = row.start_gap + (pick(pair.is_b, delta) - pick(pair.is_a, delta))
        share = vec2.inverse_or_zero(pair.mass_a + pair.mass_b)
        before = of = pair_velocities(pair, velocities)
        of, impulses = solve_point(of, row, impulses, gap, share, params)
        of, impulses = solve_angular(of, row, impulses, params)
        correction = gap * (params.joint_position_correction * share)
        delta = delta + jnp.where(pair.is_a[:, None], correction * pair.mass_a, 0)
        delta = delta - jnp.where(pair.is_b[:, None], correction * pair.mass_b, 0)
        return (scatter_velocities(velocities, pair, before, of), delta), impulses

    (velocities, delta), impulses = jax.lax.scan(solve_one, (bodies.velocities, bodies.delta), (rows, joints.impulses))
    return bodies._replace(velocities=velocities, delta=delta), joints._replace(impulses=impulses)


def solve_point(
    of: PairVelocities, row: JointRow, impulses: JointImpulses, gap: jax.Array, share: jax.Array, params: SolverNumbers
) -> tuple[PairVelocities, JointImpulses]:
    pair = row.pair
    # The joint sits between the anchors, nearer to the heavier body's.
    at_a = row.arm_a + gap * (pair.mass_a * share)
    at_b = row.arm_b - gap * (pair.mass_b * share)
    relative = relative_velocity(of, at_a, at_b)
    direction = vec2.unit_or_zero(relative)
    ca, cb = vec2.cross(row.arm_a, direction), vec2.cross(row.arm_b, direction)
    effective = pair.mass_a + pair.mass_b + ca * ca * pair.inertia_a + cb * cb * pair.inertia_b
    impulse = (relative + gap * params.joint_velocity_correction) * (
        -params.joint_stiffness * vec2.inverse_or_zero(effective)
    )
    return apply_impulse(of, pair, row.arm_a, row.arm_b, impulse), impulses._replace(point=impulses.point + impulse)


def solve_angular(
    of: PairVelocities, row: JointRow, impulses: JointImpulses, params: SolverNumbers
) -> tuple[PairVelocities, JointImpulses]:
    speed = of.omega_b - of.omega_a
    held = -row.axial_mass * (speed + row.start_angle * params.fixed_angle_rate)
    leaves = row.is_limited & (row.beyond * speed > 0)  # not while it already returns
    limited = jnp.where(leaves, -row.axial_mass * (speed + row.beyond * params.limit_angle_rate), 0)
    angular_impulse = jnp.where(row.is_fixed, held, limited)
    total = jnp.where(row.is_fixed, impulses.angular_impulse + held, impulses.angular_impulse)
    return apply_angular_impulse(of, row.pair, angular_impulse), impulses._replace(angular_impulse=total)


# Contacts


def solve_hard(bodies: Bodies, contacts: Contacts, params: SolverNumbers, rules: Rules) -> tuple[Bodies, Contacts]:
    """One iteration of sequential impulses (paper, appendix Collision Resolution): restitution target and penetration
    bias in the numerator, accumulated impulse never negative, friction by Coulomb's law."""
    work = (rows_of(contacts), wanted_speed(contacts, params))
    velocities, (normal, tangent) = solve_work(bodies.velocities, work, rules.solver_batch_size)
    contacts = with_impulses(contacts, normal, tangent)
    return bodies._replace(velocities=velocities), contacts


def solve_work(velocities: Velocities, work: Any, batch_size: int) -> tuple[Velocities, Any]:
    """Solves all rows, `batch_size` at a time."""
    if batch_size == 1:
        return jax.lax.scan(solve_rows, velocities, work)
    return _in_batches(solve_rows, velocities, work, batch_size)


def wanted_speed(contacts: Contacts, params: SolverNumbers) -> jax.Array:
    """[K] m/s at which contacts shall separate: undoes penetration, and bounces."""
    bias = params.collision_correction / params.dt * jnp.maximum(-contacts.separation - params.slop, 0)
    return bias - contacts.restitution * contacts.approach


def solve_rows(velocities: Velocities, work: tuple[Row, jax.Array]) -> tuple[Velocities, tuple[jax.Array, jax.Array]]:
    """Velocities after the impulses of one contact, or of several from the same velocities; their new totals."""
    c, wanted = work
    before = of = pair_velocities(c.pair, velocities)
    vn = vec2.dot(c.normal, relative_velocity(of, c.arm_a, c.arm_b))
    normal_total = jnp.maximum(c.impulse_normal + c.mass_normal * (wanted - vn), 0)
    of = apply_impulse(of, c.pair, c.arm_a, c.arm_b, c.normal * (normal_total - c.impulse_normal)[..., None])
    of, tangent_total = solve_friction(of, c, normal_total)
    return scatter_velocities(velocities, c.pair, before, of), (normal_total, tangent_total)


def _in_batches(solve: Callable, velocities: Velocities, rows: Any, batch_size: int) -> tuple[Velocities, Any]:
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

    velocities, results = jax.lax.scan(solve, velocities, jax.tree.map(split, rows))
    return velocities, jax.tree.map(join, results)
