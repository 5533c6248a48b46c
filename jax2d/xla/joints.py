"""Joints of one world: motor, limits, the angle of welds, and the rows that hold the two bodies together; springs with
them.

Body b is held to body a. Angles are angle_b - angle_a - rest angle. Solved one after another, in slot order. Every
constraint is a row of a Jacobian, so that all kinds of joints are one code path:

                       driven and limited along            held by two rows
    revolute, fixed    the angle                           x and y of the common point
    prismatic          the axis                            across the axis, and the angle
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jax2d.constants import CONSTANTS as C
from jax2d.scene import Controls, JointDrive, JointKind, Scene, State
from jax2d.softened_joints import is_softened
from jax2d.solver_numbers import Scalar, Softness, SolverNumbers
from jax2d.xla import angles, vec2
from jax2d.xla import springs as springs_of
from jax2d.xla.active_set import ActiveSet, marked
from jax2d.xla.bodies import (
    Bodies,
    Pair,
    PairVelocities,
    Velocities,
    is_slowed,
    pair_up,
    pair_velocities,
    pick,
    scatter_velocities,
)
from jax2d.xla.branching import choose
from jax2d.xla.drives import Servo, servo_of, speed_towards
from jax2d.xla.rows import (
    Constraints,
    Jacobian,
    arms,
    current_gap,
    held_answer,
    held_mass,
    inverse_driven_mass,
    inverse_mass,
    push,
    speed_along,
    welded_mass,
    work_of_kinematic,
    wrong_of_drive,
)
from jax2d.xla.rules import Rules
from jax2d.xla.springs import SpringImpulses, Springs


class JointImpulses(NamedTuple):
    """Accumulated over steps."""

    point: jax.Array  # [J, 2] N s; of a slider across its axis (N s) and about it (N m s)
    angular_impulse: jax.Array  # [J] N m s, of the motor (of a slider N s), or of a fixed joint's angle
    lower: jax.Array  # [J] N m s, of a slider N s
    upper: jax.Array


class WarmStart(NamedTuple):
    """Impulses of joints and springs that a step starts with, those of the step before."""

    joints: JointImpulses
    springs: SpringImpulses


class Joints(NamedTuple):
    """`J` joints in one step, and the springs; what holds nothing (`is_held` False) is masked out."""

    is_held: jax.Array  # [J] bool, active and with a body that can move
    is_fixed: jax.Array  # [J] bool
    is_softened: jax.Array  # [J] bool, see softened_joints.py
    is_prismatic: jax.Array  # [J] bool
    is_driven: jax.Array  # [J] bool, a motor with a control, a brake or a servo
    is_servo: jax.Array  # [J] bool
    is_exact: jax.Array  # [J] bool, brakes and servos
    is_limited: jax.Array  # [J] bool
    pair: Pair  # of [J]
    axis_angle: jax.Array  # [J] rad, frame of a
    local_a: jax.Array  # [J, 2] m, anchors in the bodies' frames
    local_b: jax.Array
    angle_a: jax.Array  # [J] rad, of the bodies at the start of the step
    angle_b: jax.Array
    centre_gap: jax.Array  # [J, 2] m, centre of b from centre of a at the start of the step
    start_angle: jax.Array  # [J] rad, at the start of the step
    axial_mass: jax.Array  # [J] kg m^2, of a slider kg
    control: jax.Array  # [J]
    motor_target: jax.Array  # [J] rad/s, of a slider m/s
    max_motor_impulse: jax.Array  # [J] N m s, largest impulse of one sub-step; of a slider N s
    motor_mass: jax.Array  # [J] kg m^2, of a slider kg, that a motor aims with
    servo: Servo
    lower: jax.Array  # [J] rad, of a slider m
    upper: jax.Array
    impulses: JointImpulses
    springs: Springs

    def warm_start_impulses(self) -> WarmStart:
        return WarmStart(self.impulses, self.springs.impulses)

    def with_zero_impulses(self) -> Joints:
        nothing = jax.tree.map(jnp.zeros_like, self.warm_start_impulses())
        return self._replace(impulses=nothing.joints, springs=self.springs._replace(impulses=nothing.springs))


def load(state: State, params: SolverNumbers) -> WarmStart:
    impulse = jnp.where(params.warm_start, state.joint_impulse, 0)
    joints = JointImpulses(impulse[:, :2], impulse[:, 2], impulse[:, 3], impulse[:, 4])
    return WarmStart(joints, springs_of.load(state, params))


def prepare(bodies: Bodies, scene: Scene, before: WarmStart, controls: Controls, params: SolverNumbers) -> Joints:
    a, b = scene.joints.a, scene.joints.b
    is_held = scene.joints.active & (bodies.is_dynamic[a] | bodies.is_dynamic[b])
    pair = pair_up(bodies, a, b, is_held)
    is_fixed, is_prismatic = (scene.joints.is_kind(kind) for kind in (JointKind.FIXED, JointKind.PRISMATIC))
    is_velocity, is_servo = (scene.joints.is_drive(drive) for drive in (JointDrive.VELOCITY, JointDrive.SERVO))
    is_driven = scene.joints.motor_on & ~is_fixed & ((controls.motor != 0) | ~is_velocity)
    angular_impulse = jnp.where(is_driven | is_fixed, before.joints.angular_impulse, 0)
    base_speed = jnp.where(is_prismatic, params.base_slider_speed, params.base_motor_speed)
    speed, zero = scene.joints.motor_speed * base_speed, jnp.zeros_like(controls.motor)
    joints = Joints(
        is_held=is_held,
        is_fixed=is_fixed,
        is_softened=is_softened(scene),
        is_prismatic=is_prismatic,
        is_driven=is_driven,
        is_servo=is_servo,
        is_exact=~is_velocity,
        is_limited=scene.joints.has_limits,
        pair=pair,
        axis_angle=scene.joints.axis_angle,
        local_a=scene.joints.anchor_a,
        local_b=scene.joints.anchor_b,
        angle_a=bodies.angle[a],
        angle_b=bodies.angle[b],
        centre_gap=bodies.position[b] - bodies.position[a],
        start_angle=angles.wanted(counted_angle(bodies, scene), scene.joints),
        axial_mass=zero,
        control=controls.motor,
        motor_target=controls.motor * scene.joints.motor_speed * base_speed,
        max_motor_impulse=zero,
        motor_mass=zero,
        servo=Servo(zero, zero, zero),
        lower=scene.joints.lower_limit,
        upper=scene.joints.upper_limit,
        impulses=before.joints._replace(angular_impulse=angular_impulse),
        springs=springs_of.prepare(bodies, scene, before.springs),
    )
    rows = constraints(bodies, joints)
    axial_mass = vec2.inverse_or_zero(inverse_mass(pair, rows.axial, rows.axial))
    # The power is the acceleration that the motor can give to the pair of bodies alone.
    power = scene.joints.motor_power * jnp.where(is_prismatic, params.base_slider_power, params.base_motor_power)
    max_impulse = params.h * power * axial_mass
    driven = inverse_driven_mass(pair, rows)
    return joints._replace(
        axial_mass=axial_mass,
        max_motor_impulse=max_impulse,
        motor_mass=jnp.where(is_velocity, axial_mass, vec2.inverse_or_zero(driven)),
        servo=servo_of(controls.motor, speed, joints.lower, joints.upper, strength=max_impulse * driven / params.h),
    )


def counted_angle(bodies: Bodies, scene: Scene) -> jax.Array:
    """angle_b - angle_a - rest angle, [J] rad, turns counted as far as the bodies' angles count them."""
    return bodies.angle[scene.joints.b] - bodies.angle[scene.joints.a] - scene.joints.rest_angle


def store(bodies: Bodies, joints: Joints, state: State, rules: Rules) -> jax.Array:
    """Impulses as in `State.joint_impulse`; joints that hold nothing keep what they had."""
    i = joints.impulses
    solved = jnp.concatenate([i.point, i.angular_impulse[:, None], i.lower[:, None], i.upper[:, None]], axis=1)
    if rules.is_soft:
        solved = jnp.where(is_slowed(bodies, joints.pair)[:, None], 0, solved)
    return jnp.where(joints.is_held[:, None], solved, state.joint_impulse)


def current_angle(bodies: Bodies, joints: Joints) -> jax.Array:
    return joints.start_angle + pick(joints.pair.is_b, bodies.turn) - pick(joints.pair.is_a, bodies.turn)


def constraints(bodies: Bodies, joints: Joints) -> Constraints:
    arm_a, arm_b = arms(bodies, joints)
    gap, angle = current_gap(bodies, joints, arm_a, arm_b), current_angle(bodies, joints)
    local_axis = vec2.rotated(vec2.from_angle(joints.axis_angle), joints.angle_a)
    axis = vec2.rotated(local_axis, pick(joints.pair.is_a, bodies.turn))
    # Impulses act on both bodies at one point, or they would change what both have of angular momentum: of a slider at
    # the anchor of b, of others in the middle of the gap; what is fixed takes any.
    both_move = (joints.pair.mass_a > 0) & (joints.pair.mass_b > 0)
    half_gap = jnp.where(both_move[:, None], 0.5 * gap, 0)
    is_slider = joints.is_prismatic[:, None]
    common_a = arm_a + jnp.where(is_slider, gap, half_gap)
    common_b = arm_b - jnp.where(is_slider, 0, half_gap)

    def along(direction: jax.Array) -> Jacobian:
        return Jacobian(direction, vec2.cross(common_a, direction), vec2.cross(common_b, direction))

    one = jnp.ones_like(angle)
    turning = Jacobian(jnp.zeros_like(gap), one, one)
    x, y = (along(jnp.broadcast_to(unit, gap.shape)) for unit in jnp.eye(2, dtype=gap.dtype))

    def by_kind(prismatic: Any, other: Any) -> Any:
        return jax.tree.map(lambda p, o: jnp.where(like(joints.is_prismatic, p), p, o), prismatic, other)

    across = vec2.left(axis)
    return Constraints(
        axial=by_kind(along(axis), turning),
        first=by_kind(along(across), x),
        second=by_kind(turning, y),
        position=by_kind(vec2.dot(axis, gap), angle),
        error=by_kind(jnp.stack([vec2.dot(across, gap), angle], -1), gap),
    )


def like(mask: jax.Array, x: jax.Array) -> jax.Array:
    """The mask of the first axes of `x`, to select from it."""
    return mask.reshape(mask.shape + (1,) * (x.ndim - mask.ndim))


def warm_start(bodies: Bodies, joints: Joints) -> Bodies:
    bodies = springs_of.warm_start(bodies, joints.springs)
    rows, impulses = constraints(bodies, joints), joints.impulses
    before = pair_velocities(joints.pair, bodies.velocities)
    after = push(before, joints.pair, rows.first, impulses.point[:, 0])
    after = push(after, joints.pair, rows.second, impulses.point[:, 1])
    after = push(after, joints.pair, rows.axial, impulses.angular_impulse + impulses.lower - impulses.upper)
    return bodies._replace(velocities=scatter_velocities(bodies.velocities, joints.pair, before, after))


class Row(NamedTuple):
    """A joint as one pass needs it: nothing here changes while velocities are solved."""

    pair: Pair
    is_fixed: jax.Array
    is_driven: jax.Array
    is_limited: jax.Array
    is_prismatic: jax.Array
    axial: Jacobian
    first: Jacobian
    second: Jacobian
    axial_mass: jax.Array
    held_mass: jax.Array  # [2, 2], of the two rows that are held; of a weld with its angle held, too
    held_lever: jax.Array  # [2] speed along these rows after a unit of impulse about the axis of a weld; else 0
    soft: Softness
    motor_target: jax.Array
    motor_mass: jax.Array
    motor_answer: jax.Array  # [2], of what is held to a unit of a motor's impulse
    max_motor_impulse: jax.Array
    return_speed: jax.Array  # rad/s or m/s at which a weld's angle and what is beyond a limit is brought back
    angle: jax.Array  # rad
    lower_clearance: jax.Array  # rad or m left before the limit, negative beyond it
    upper_clearance: jax.Array
    correction: jax.Array  # [2] m/s and rad/s at which the errors of the two rows are undone
    bend_a: jax.Array  # [2] m s, times a spin squared: speed that keeps the anchor of a on its circle
    bend_b: jax.Array


def solve_soft(
    bodies: Bodies, joints: Joints, params: SolverNumbers, active: ActiveSet, *, use_bias: bool, motors: bool = True
) -> tuple[Bodies, Joints, jax.Array]:
    """One pass over springs and all joints: motor and limits, then what is held. No `motors` in a bounce: a force or
    torque does nothing in an instant. Also the bodies [n] that it moved in a repeated pass."""
    of_kinds = (params.joint, params.softened) if use_bias else (Softness(0.0, 1.0, 0.0),) * 2
    soft = Softness(*(jnp.where(joints.is_softened, softened, other) for other, softened in zip(*of_kinds)))
    bodies, springs, by_springs = springs_of.solve(
        bodies, joints.springs, params, active, use_bias=use_bias, forces=motors
    )
    now = constraints(bodies, joints)
    # Anchors go around their bodies: what that takes them off the tangent by the end of the sub-step counts too.
    bend_time = 0.5 * C.bend_share * params.h if use_bias else 0.0
    bend_a, bend_b = (jnp.where(joints.is_prismatic[:, None], 0, bend_time * arm) for arm in arms(bodies, joints))
    is_welded = joints.is_fixed & (joints.axial_mass > 0)
    rows = Row(
        pair=joints.pair,
        is_fixed=joints.is_fixed,
        is_driven=joints.is_driven & motors,
        is_limited=joints.is_limited & ~joints.is_fixed,
        is_prismatic=joints.is_prismatic,
        axial=now.axial,
        first=now.first,
        second=now.second,
        axial_mass=joints.axial_mass,
        held_mass=jnp.where(
            is_welded[:, None, None], welded_mass(joints.pair, joints.axial_mass, now), held_mass(joints.pair, now)
        ),
        held_lever=jnp.where(is_welded[:, None], wrong_of_drive(joints.pair, now), 0),
        soft=soft,
        motor_target=jnp.where(
            joints.is_servo,
            speed_towards(joints.servo, joints.servo.position - now.position, params.h),
            joints.motor_target,
        ),
        motor_mass=joints.motor_mass,
        motor_answer=-jnp.where(joints.is_exact[:, None], held_answer(joints.pair, now), 0),
        max_motor_impulse=joints.max_motor_impulse,
        return_speed=jnp.where(joints.is_prismatic, params.joint_pull_speed, params.joint_turn_speed),
        angle=current_angle(bodies, joints),
        lower_clearance=now.position - joints.lower,
        upper_clearance=joints.upper - now.position,
        correction=correction_speed(now.error * soft.bias_rate[:, None], joints.is_prismatic, params),
        bend_a=bend_a,
        bend_b=bend_b,
    )

    def solve(velocities: Velocities, row_and_impulses: tuple[Row, JointImpulses, jax.Array]) -> tuple:
        row, unsolved, included = row_and_impulses
        before = pair_velocities(row.pair, velocities)
        # In the relax pass a motor that is not at a limit has the last word: what holds the joint costs it no speed.
        motor_last = (not use_bias) & (unsolved.lower + unsolved.upper == 0)
        of, impulses = solve_motor(before, row._replace(is_driven=row.is_driven & ~motor_last), unsolved)
        of, impulses = solve_limits(of, row, impulses, params, use_bias=use_bias)
        of, impulses = solve_held(of, row, impulses, params.max_angular_speed)
        if not use_bias:
            of, impulses = solve_motor(of, row._replace(is_driven=row.is_driven & motor_last), impulses)
        of, impulses = choose(included, (of, impulses), (before, unsolved))
        return scatter_velocities(velocities, row.pair, before, of), (impulses, active.moves(before, of))

    included = active.includes(joints.pair)
    velocities, (impulses, moved) = jax.lax.scan(solve, bodies.velocities, (rows, joints.impulses, included))
    return (
        bodies._replace(velocities=velocities),
        joints._replace(impulses=impulses, springs=springs),
        by_springs | marked(bodies, joints.pair, moved),
    )


def correction_speed(wanted: jax.Array, is_prismatic: jax.Array, params: SolverNumbers) -> jax.Array:
    """[J, 2] speeds that undo errors, within their limits: of a point as a whole, of a slider each on its own."""
    point = jax.vmap(vec2.clamp_length, (0, None))(wanted, params.joint_pull_speed)
    max_speed = jnp.stack([jnp.asarray(params.joint_pull_speed), jnp.asarray(params.joint_turn_speed)])
    return jnp.where(is_prismatic[:, None], jnp.clip(wanted, -max_speed, max_speed), point)


def solve_motor(of: PairVelocities, row: Row, impulses: JointImpulses) -> tuple[PairVelocities, JointImpulses]:
    """A motor is a velocity constraint with a bounded impulse: dt changes neither its target nor its strength."""
    speed, before = speed_along(row.axial, of), impulses.angular_impulse
    driven = before - row.motor_mass * (speed - row.motor_target)
    driven = jnp.clip(driven, -row.max_motor_impulse, row.max_motor_impulse)
    total = jnp.where(row.is_driven, driven, before)
    of = push(of, row.pair, row.axial, total - before)
    # What is held answers a brake or servo at once, so that limits see the speed that stays.
    answer = jnp.where(row.is_driven, row.motor_answer * (total - before), 0)
    of = push(push(of, row.pair, row.first, answer[0]), row.pair, row.second, answer[1])
    return of, impulses._replace(angular_impulse=total, point=impulses.point + answer)


def solve_limits(
    of: PairVelocities, row: Row, impulses: JointImpulses, params: SolverNumbers, *, use_bias: bool
) -> tuple[PairVelocities, JointImpulses]:
    def total(clearance: jax.Array, speed: jax.Array, accumulated: jax.Array) -> jax.Array:
        """New total impulse of a one-sided limit; `speed` is that at which clearance grows."""
        # A hinge's is not softened when violated: a strong motor would lean into a limit that gives way.
        back = jnp.maximum(params.joint.bias_rate * clearance, -row.return_speed) if use_bias else 0
        impulse = -row.axial_mass * (speed + jnp.where(clearance > 0, clearance / params.h, back))
        slider = springs_of.limit_impulse(clearance, speed, row.axial_mass, accumulated, params, use_bias=use_bias)
        total = jnp.where(row.is_prismatic, slider, jnp.maximum(accumulated + impulse, 0))
        return jnp.where(row.is_limited, total, accumulated)

    lower = total(row.lower_clearance, speed_along(row.axial, of), impulses.lower)
    of = push(of, row.pair, row.axial, lower - impulses.lower)
    upper = total(row.upper_clearance, -speed_along(row.axial, of), impulses.upper)
    of = push(of, row.pair, row.axial, impulses.upper - upper)
    return of, impulses._replace(lower=lower, upper=upper)


def solve_held(
    of: PairVelocities, row: Row, impulses: JointImpulses, max_spin: Scalar
) -> tuple[PairVelocities, JointImpulses]:
    """The two rows of a point or slider; of a weld its angle with them: one after the other, each undoes most of the
    other where the arms are long beside what the bodies' inertia is like, and the impulses that are warm-started
    grow."""
    # Faster nothing turns in the end, however fast it does while velocities are solved.
    spin_a, spin_b = (jnp.minimum(jnp.abs(omega), max_spin) for omega in (of.omega_a, of.omega_b))
    bend = row.bend_a * spin_a**2 - row.bend_b * spin_b**2
    wrong = jnp.stack([speed_along(row.first, of), speed_along(row.second, of)]) + row.correction + bend
    turn_back = jnp.clip(row.soft.bias_rate * row.angle, -row.return_speed, row.return_speed)
    turn = row.axial_mass * (speed_along(row.axial, of) + turn_back)
    wrong = wrong - row.held_lever * turn
    needed = jnp.stack([vec2.dot(row.held_mass[0], wrong), vec2.dot(row.held_mass[1], wrong)])
    turn = turn - row.axial_mass * vec2.dot(row.held_lever, needed)
    angular = -turn * row.soft.mass_scale - impulses.angular_impulse * row.soft.impulse_scale
    angular = jnp.where(row.is_fixed, angular, 0)
    impulse = -needed * row.soft.mass_scale - impulses.point * row.soft.impulse_scale
    of = push(push(of, row.pair, row.first, impulse[0]), row.pair, row.second, impulse[1])
    of = push(of, row.pair, row.axial, angular)
    return of, impulses._replace(point=impulses.point + impulse, angular_impulse=impulses.angular_impulse + angular)


def motor_work(bodies: Bodies, joints: Joints) -> jax.Array:
    """[J] J, what motors have added to the bodies' energy in this sub-step."""
    speed = speed_along(constraints(bodies, joints).axial, pair_velocities(joints.pair, bodies.velocities))
    work = jnp.maximum(joints.impulses.angular_impulse * speed, 0)
    return jnp.where(joints.is_driven & joints.is_held, work, 0)


def kinematic_work(bodies: Bodies, joints: Joints) -> jax.Array:
    """[J] J, what kinematic bodies have done through joints in this sub-step."""
    rows, impulses, pair = constraints(bodies, joints), joints.impulses, joints.pair
    parts = (
        (rows.first, impulses.point[:, 0]),
        (rows.second, impulses.point[:, 1]),
        (rows.axial, impulses.angular_impulse + impulses.lower - impulses.upper),
    )
    on_b = sum(row.direction * impulse[:, None] for row, impulse in parts)
    angular_a = sum(row.lever_a * impulse for row, impulse in parts)
    angular_b = sum(row.lever_b * impulse for row, impulse in parts)
    return work_of_kinematic(bodies, pair, on_b, angular_a, angular_b)
