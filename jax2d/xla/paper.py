"""The joint and motor rules of the Kinetix paper (appendices Joints, Motors), for preset paper."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jax2d.xla import vec2
from jax2d.xla.bodies import (
    Bodies,
    Motion,
    Pair,
    PairMotion,
    pair_motion,
    pick,
    push_pair,
    put_back,
    relative_velocity,
    twist_pair,
)
from jax2d.xla.joints import JointImpulses, Joints, arms
from jax2d.xla.parameters import Parameters


def apply_motors(bodies: Bodies, joints: Joints, params: Parameters) -> Bodies:
    """j = p tanh((w_b - w_a - s A) rho), weaker within params.motor_fade_angle of a limit it runs into. All at once (as
    in "Parallelised Computation"): no motor sees what another does in the same step."""
    fade = params.motor_fade_angle
    beyond = joints.start_angle - jnp.clip(joints.start_angle, joints.lower + fade, joints.upper - fade)
    into_limit = joints.is_limited & (beyond * joints.control > 0)
    power = joints.motor_most * jnp.where(into_limit, jnp.maximum(0, 1 - jnp.abs(beyond) / fade), 1)

    before = pair_motion(joints.pair, bodies.motion)
    excess = before.omega_b - before.omega_a - joints.motor_target
    twist = jnp.where(joints.is_driven, -power * jnp.tanh(excess * params.motor_decay), 0)
    after = twist_pair(before, joints.pair, twist)
    return bodies._replace(motion=put_back(bodies.motion, joints.pair, before, after))


def warm_start(bodies: Bodies, joints: Joints) -> tuple[Bodies, Joints]:
    arm_a, arm_b = arms(bodies, joints)
    before = pair_motion(joints.pair, bodies.motion)
    after = push_pair(before, joints.pair, arm_a, arm_b, joints.impulses.point)
    after = twist_pair(after, joints.pair, jnp.where(joints.is_fixed, joints.impulses.twist, 0))
    zero = jnp.zeros_like(joints.impulses.lower)
    impulses = joints.impulses._replace(lower=zero, upper=zero)
    return bodies._replace(motion=put_back(bodies.motion, joints.pair, before, after)), joints._replace(
        impulses=impulses
    )


class Row(NamedTuple):
    """What an iteration needs of a joint: nothing here changes while iterating."""

    pair: Pair
    is_fixed: jax.Array
    is_limited: jax.Array
    axial_mass: jax.Array
    start_angle: jax.Array  # rad
    beyond: jax.Array  # rad by which a limit is exceeded, signed
    arm_a: jax.Array
    arm_b: jax.Array
    start_gap: jax.Array  # m, anchor of b from anchor of a at the start of the step


def solve(bodies: Bodies, joints: Joints, params: Parameters) -> tuple[Bodies, Joints]:
    """One iteration over all joints: point (impulse along the relative velocity, velocity and positional correction),
    then the angle of fixed joints, or limits where they are exceeded."""
    arm_a, arm_b = arms(bodies, joints)
    rows = Row(
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
        carry: tuple[Motion, jax.Array], row_and_impulses: tuple[Row, JointImpulses]
    ) -> tuple[tuple[Motion, jax.Array], JointImpulses]:
        (motion, delta), (row, impulses) = carry, row_and_impulses
        pair = row.pair
        gap = row.start_gap + (pick(pair.is_b, delta) - pick(pair.is_a, delta))
        share = vec2.inverse_or_zero(pair.mass_a + pair.mass_b)
        before = of = pair_motion(pair, motion)
        of, impulses = solve_point(of, row, impulses, gap, share, params)
        of, impulses = solve_twist(of, row, impulses, params)
        correction = gap * (params.joint_position_correction * share)
        delta = delta + jnp.where(pair.is_a[:, None], correction * pair.mass_a, 0)
        delta = delta - jnp.where(pair.is_b[:, None], correction * pair.mass_b, 0)
        return (put_back(motion, pair, before, of), delta), impulses

    (motion, delta), impulses = jax.lax.scan(solve_one, (bodies.motion, bodies.delta), (rows, joints.impulses))
    return bodies._replace(motion=motion, delta=delta), joints._replace(impulses=impulses)


def solve_point(
    of: PairMotion, row: Row, impulses: JointImpulses, gap: jax.Array, share: jax.Array, params: Parameters
) -> tuple[PairMotion, JointImpulses]:
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
    return push_pair(of, pair, row.arm_a, row.arm_b, impulse), impulses._replace(point=impulses.point + impulse)


def solve_twist(
    of: PairMotion, row: Row, impulses: JointImpulses, params: Parameters
) -> tuple[PairMotion, JointImpulses]:
    speed = of.omega_b - of.omega_a
    held = -row.axial_mass * (speed + row.start_angle * params.fixed_angle_rate)
    leaves = row.is_limited & (row.beyond * speed > 0)  # not while it already returns
    limited = jnp.where(leaves, -row.axial_mass * (speed + row.beyond * params.limit_angle_rate), 0)
    twist = jnp.where(row.is_fixed, held, limited)
    total = jnp.where(row.is_fixed, impulses.twist + held, impulses.twist)
    return twist_pair(of, row.pair, twist), impulses._replace(twist=total)
