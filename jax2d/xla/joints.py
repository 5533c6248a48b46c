"""Joints of one world: motor, limits, the relative angle of fixed joints, and the common point.

Body b is held to body a. Angles are angle_b - angle_a - rest angle. Solved one after another, in slot order.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jax2d.scene import Controls, JointKind, Scene, State
from jax2d.solver_numbers import Softness, SolverNumbers
from jax2d.xla import vec2
from jax2d.xla.bodies import (
    Bodies,
    Pair,
    PairVelocities,
    Velocities,
    apply_angular_impulse,
    apply_impulse,
    pair_up,
    pair_velocities,
    pick,
    relative_velocity,
    scatter_velocities,
)


class JointImpulses(NamedTuple):
    """Accumulated over steps."""

    point: jax.Array  # [J, 2] N s
    angular_impulse: jax.Array  # [J] N m s, of the motor, or of a fixed joint's angle
    lower: jax.Array  # [J] N m s
    upper: jax.Array


class Joints(NamedTuple):
    """`J` joints in one step; what holds nothing (`is_held` False) is masked out."""

    is_held: jax.Array  # [J] bool, active and with a body that can move
    is_fixed: jax.Array  # [J] bool
    is_driven: jax.Array  # [J] bool, a motor with a control
    is_limited: jax.Array  # [J] bool
    pair: Pair  # of [J]
    local_a: jax.Array  # [J, 2] m, anchors in the bodies' frames
    local_b: jax.Array
    angle_a: jax.Array  # [J] rad, of the bodies at the start of the step
    angle_b: jax.Array
    centre_gap: jax.Array  # [J, 2] m, centre of b from centre of a at the start of the step
    start_angle: jax.Array  # [J] rad, at the start of the step
    axial_mass: jax.Array  # [J] kg m^2
    control: jax.Array  # [J]
    motor_target: jax.Array  # [J] rad/s
    max_motor_impulse: jax.Array  # [J] N m s, largest impulse of one sub-step
    lower: jax.Array  # [J] rad
    upper: jax.Array
    impulses: JointImpulses


def load(state: State, params: SolverNumbers) -> JointImpulses:
    impulse = jnp.where(params.warm_start, state.joint_impulse, 0)
    return JointImpulses(impulse[:, :2], impulse[:, 2], impulse[:, 3], impulse[:, 4])


def prepare(bodies: Bodies, scene: Scene, impulses: JointImpulses, controls: Controls, params: SolverNumbers) -> Joints:
    a, b = scene.joints.a, scene.joints.b
    is_held = scene.joints.active & (bodies.is_dynamic[a] | bodies.is_dynamic[b])
    pair = pair_up(bodies, a, b, is_held)
    axial_mass = vec2.inverse_or_zero(pair.inertia_a + pair.inertia_b)
    is_driven = scene.joints.motor_on & ~scene.joints.is_kind(JointKind.FIXED) & (controls.motor != 0)
    angular_impulse = jnp.where(is_driven | scene.joints.is_kind(JointKind.FIXED), impulses.angular_impulse, 0)
    return Joints(
        is_held=is_held,
        is_fixed=scene.joints.is_kind(JointKind.FIXED),
        is_driven=is_driven,
        is_limited=scene.joints.has_limits,
        pair=pair,
        local_a=scene.joints.anchor_a,
        local_b=scene.joints.anchor_b,
        angle_a=bodies.angle[a],
        angle_b=bodies.angle[b],
        centre_gap=bodies.position[b] - bodies.position[a],
        start_angle=bodies.angle[b] - bodies.angle[a] - scene.joints.rest_angle,
        axial_mass=axial_mass,
        control=controls.motor,
        motor_target=controls.motor * scene.joints.motor_speed * params.base_motor_speed,
        # The power is the angular acceleration that the motor can give to the pair of bodies alone.
        max_motor_impulse=params.h * params.base_motor_power * scene.joints.motor_power * axial_mass,
        lower=scene.joints.lower_limit,
        upper=scene.joints.upper_limit,
        impulses=impulses._replace(angular_impulse=angular_impulse),
    )


def store(joints: Joints, state: State) -> jax.Array:
    """Impulses as in `State.joint_impulse`; joints that hold nothing keep what they had."""
    i = joints.impulses
    solved = jnp.concatenate([i.point, i.angular_impulse[:, None], i.lower[:, None], i.upper[:, None]], axis=1)
    return jnp.where(joints.is_held[:, None], solved, state.joint_impulse)


def arms(bodies: Bodies, joints: Joints) -> tuple[jax.Array, jax.Array]:
    """From the centres of mass to the anchors as the bodies stand now, [J, 2] m."""
    pair = joints.pair
    arm_a = vec2.rotated(vec2.rotated(joints.local_a, joints.angle_a), pick(pair.is_a, bodies.turn))
    arm_b = vec2.rotated(vec2.rotated(joints.local_b, joints.angle_b), pick(pair.is_b, bodies.turn))
    return arm_a, arm_b


def current_angle(bodies: Bodies, joints: Joints) -> jax.Array:
    return joints.start_angle + pick(joints.pair.is_b, bodies.turn) - pick(joints.pair.is_a, bodies.turn)


def current_gap(bodies: Bodies, joints: Joints, arm_a: jax.Array, arm_b: jax.Array) -> jax.Array:
    """Anchor of b from anchor of a, [J, 2] m."""
    moved = pick(joints.pair.is_b, bodies.delta) - pick(joints.pair.is_a, bodies.delta)
    return joints.centre_gap + moved + (arm_b - arm_a)


def warm_start(bodies: Bodies, joints: Joints) -> Bodies:
    arm_a, arm_b = arms(bodies, joints)
    before = pair_velocities(joints.pair, bodies.velocities)
    after = apply_impulse(before, joints.pair, arm_a, arm_b, joints.impulses.point)
    after = apply_angular_impulse(
        after, joints.pair, joints.impulses.angular_impulse + joints.impulses.lower - joints.impulses.upper
    )
    return bodies._replace(velocities=scatter_velocities(bodies.velocities, joints.pair, before, after))


class Row(NamedTuple):
    """What one pass needs of a joint: nothing here changes while velocities are solved."""

    pair: Pair
    is_fixed: jax.Array
    is_driven: jax.Array
    is_limited: jax.Array
    axial_mass: jax.Array
    motor_target: jax.Array
    max_motor_impulse: jax.Array
    angle: jax.Array  # rad
    lower_room: jax.Array  # rad left before the limit, negative beyond it
    upper_room: jax.Array
    arm_a: jax.Array
    arm_b: jax.Array
    gap: jax.Array  # m
    point_mass: jax.Array  # [2, 2], inverse of K


def solve_soft(
    bodies: Bodies, joints: Joints, params: SolverNumbers, *, use_bias: bool, motors: bool = True
) -> tuple[Bodies, Joints]:
    """One pass over all joints: motor and limits, or the angle of a fixed joint; then the common point. No `motors`
    in a bounce: a torque does nothing in an instant."""
    arm_a, arm_b = arms(bodies, joints)
    angle = current_angle(bodies, joints)
    rows = Row(
        pair=joints.pair,
        is_fixed=joints.is_fixed,
        is_driven=joints.is_driven & motors,
        is_limited=joints.is_limited & ~joints.is_fixed,
        axial_mass=joints.axial_mass,
        motor_target=joints.motor_target,
        max_motor_impulse=joints.max_motor_impulse,
        angle=angle,
        lower_room=angle - joints.lower,
        upper_room=joints.upper - angle,
        arm_a=arm_a,
        arm_b=arm_b,
        gap=current_gap(bodies, joints, arm_a, arm_b),
        point_mass=point_mass(joints.pair, arm_a, arm_b),
    )
    soft = params.joint if use_bias else Softness(0.0, 1.0, 0.0)

    def solve(velocities: Velocities, row_and_impulses: tuple[Row, JointImpulses]) -> tuple[Velocities, JointImpulses]:
        row, impulses = row_and_impulses
        before = of = pair_velocities(row.pair, velocities)
        of, impulses = solve_motor_or_angle(of, row, impulses, params, soft)
        of, impulses = solve_limits(of, row, impulses, params, soft, use_bias=use_bias)
        of, impulses = solve_point(of, row, impulses, params, soft)
        return scatter_velocities(velocities, row.pair, before, of), impulses

    velocities, impulses = jax.lax.scan(solve, bodies.velocities, (rows, joints.impulses))
    return bodies._replace(velocities=velocities), joints._replace(impulses=impulses)


def solve_motor_or_angle(
    of: PairVelocities, row: Row, impulses: JointImpulses, params: SolverNumbers, soft: Softness
) -> tuple[PairVelocities, JointImpulses]:
    """A motor is a velocity constraint with a bounded torque: dt changes neither its target nor its strength."""
    speed = of.omega_b - of.omega_a
    driven = jnp.clip(
        impulses.angular_impulse - row.axial_mass * (speed - row.motor_target),
        -row.max_motor_impulse,
        row.max_motor_impulse,
    )
    turn_back = jnp.clip(soft.bias_rate * row.angle, -params.joint_turn_speed, params.joint_turn_speed)
    corrected = row.axial_mass * soft.mass_scale * (speed + turn_back)
    held = impulses.angular_impulse - corrected - soft.impulse_scale * impulses.angular_impulse
    total = jnp.where(row.is_fixed, held, jnp.where(row.is_driven, driven, impulses.angular_impulse))
    return apply_angular_impulse(of, row.pair, total - impulses.angular_impulse), impulses._replace(
        angular_impulse=total
    )


def solve_limits(
    of: PairVelocities, row: Row, impulses: JointImpulses, params: SolverNumbers, soft: Softness, *, use_bias: bool
) -> tuple[PairVelocities, JointImpulses]:
    speed = of.omega_b - of.omega_a
    lower = limit_impulse(row, row.lower_room, speed, impulses.lower, params, soft, use_bias=use_bias)
    of = apply_angular_impulse(of, row.pair, lower - impulses.lower)
    speed = of.omega_a - of.omega_b
    upper = limit_impulse(row, row.upper_room, speed, impulses.upper, params, soft, use_bias=use_bias)
    of = apply_angular_impulse(of, row.pair, impulses.upper - upper)
    return of, impulses._replace(lower=lower, upper=upper)


def limit_impulse(
    row: Row,
    room: jax.Array,
    speed: jax.Array,
    accumulated: jax.Array,
    params: SolverNumbers,
    soft: Softness,
    *,
    use_bias: bool,
) -> jax.Array:
    """New total of a one-sided limit; `speed` is that at which room grows."""
    # Not softened when violated: a strong motor would lean into a limit that yields.
    turn_back = jnp.maximum(soft.bias_rate * room, -params.joint_turn_speed) if use_bias else 0
    bias = jnp.where(room > 0, room / params.h, turn_back)
    impulse = -row.axial_mass * (speed + bias)
    return jnp.where(row.is_limited, jnp.maximum(accumulated + impulse, 0), accumulated)


def solve_point(
    of: PairVelocities, row: Row, impulses: JointImpulses, params: SolverNumbers, soft: Softness
) -> tuple[PairVelocities, JointImpulses]:
    pull = vec2.clamp_length(row.gap * soft.bias_rate, params.joint_pull_speed)
    wrong = relative_velocity(of, row.arm_a, row.arm_b) + pull
    needed = jnp.stack([vec2.dot(row.point_mass[0], wrong), vec2.dot(row.point_mass[1], wrong)])
    impulse = -needed * soft.mass_scale - impulses.point * soft.impulse_scale
    of = apply_impulse(of, row.pair, row.arm_a, row.arm_b, impulse)
    return of, impulses._replace(point=impulses.point + impulse)


def motor_work(bodies: Bodies, joints: Joints) -> jax.Array:
    """J, what motors have added to the bodies' energy in this sub-step."""
    of = pair_velocities(joints.pair, bodies.velocities)
    work = jnp.maximum(joints.impulses.angular_impulse * (of.omega_b - of.omega_a), 0)
    return jnp.sum(jnp.where(joints.is_driven & joints.is_held, work, 0))


def point_mass(pair: Pair, ra: jax.Array, rb: jax.Array) -> jax.Array:
    """Inverse of K, the 2 x 2 inverse effective mass of the common point, [J, 2, 2]."""
    mass = pair.mass_a + pair.mass_b
    k11 = mass + pair.inertia_a * ra[:, 1] * ra[:, 1] + pair.inertia_b * rb[:, 1] * rb[:, 1]
    k12 = -pair.inertia_a * ra[:, 0] * ra[:, 1] - pair.inertia_b * rb[:, 0] * rb[:, 1]
    k22 = mass + pair.inertia_a * ra[:, 0] * ra[:, 0] + pair.inertia_b * rb[:, 0] * rb[:, 0]
    determinant = k11 * k22 - k12 * k12
    is_regular = determinant != 0
    inverse = jnp.where(is_regular, 1 / jnp.where(is_regular, determinant, 1), 0)
    rows = jnp.stack([jnp.stack([k22, -k12], -1), jnp.stack([-k12, k11], -1)], -2)
    return inverse[:, None, None] * rows
