"""Joints of one world: what they hold, their motors and limits; ropes and rods, and springs with them.

Body b is held to body a. Angles are angle_b - angle_a - rest angle. Every constraint is a row of a Jacobian, three a
joint, and all rows are one system (joint_system.py):

                 first and second row           third row
    revolute     x and y of the common point    the angle, where a motor or a limit holds it
    fixed        x and y of the common point    the angle
    prismatic    across the axis, the angle     along the axis, where a motor or a limit holds it
    rope, rod    none                           the length, where a bound holds it
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jax2d.constants import CONSTANTS as C
from jax2d.scene import Controls, JointDrive, JointKind, Scene, State
from jax2d.solver_numbers import SolverNumbers
from jax2d.xla import angles, axial_rows, joint_system, vec2
from jax2d.xla import springs as springs_of
from jax2d.xla.active_set import ActiveSet, has_one_of, marked
from jax2d.xla.axial_rows import AxialRows
from jax2d.xla.bodies import (
    Bodies,
    Pair,
    PairVelocities,
    Velocities,
    is_slowed,
    pair_up,
    pair_velocities,
    pick,
)
from jax2d.xla.branching import choose, in_any_world
from jax2d.xla.drives import Servo, servo_of, speed_towards
from jax2d.xla.joint_system import JointSystem
from jax2d.xla.rods import ROD, Lengths, across_line, bend_of_line, hold_lengths, joints_with_rods, line_of
from jax2d.xla.rows import (
    Constraints,
    Jacobian,
    arms,
    current_gap,
    inverse_mass,
    speed_along,
    work_of_kinematic,
)
from jax2d.xla.springs import Springs


class JointImpulses(NamedTuple):
    """Accumulated over steps."""

    point: jax.Array  # [J, 2] N s; of a slider across its axis (N s) and about it (N m s)
    angular_impulse: jax.Array  # [J] N m s, of the motor (of a slider N s), or of a fixed joint's angle
    lower: jax.Array  # [J] N m s, of a slider N s
    upper: jax.Array


class WarmStart(NamedTuple):
    """Impulses of joints and springs that a step starts with, those of the step before."""

    joints: JointImpulses
    springs: jax.Array  # [S] N s


class Joints(NamedTuple):
    """`J` joints in one step, those of the scene and then its ropes and rods (rods.py), and the springs; what holds
    nothing (`is_held` False) is masked out."""

    is_held: jax.Array  # [J] bool, active and with a body that can move
    is_fixed: jax.Array  # [J] bool
    is_prismatic: jax.Array  # [J] bool
    is_rod: jax.Array  # [J] bool
    is_driven: jax.Array  # [J] bool, a motor with a control, a brake or a servo
    is_servo: jax.Array  # [J] bool
    is_limited: jax.Array  # [J] bool
    pair: Pair  # of [J]
    together: jax.Array  # [J, J] bool, joints of one articulation: connected through bodies that can be pushed
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
    servo: Servo
    lower: jax.Array  # [J] rad, of a slider m
    upper: jax.Array
    axes: AxialRows
    impulses: JointImpulses
    springs: Springs

    @property
    def has_rods(self) -> bool:
        """True where there is room for springs; known when a step is compiled."""
        return self.springs.rest_length.shape[0] > 0

    def warm_start_impulses(self) -> WarmStart:
        return WarmStart(self.impulses, self.springs.impulse)


def load(state: State, params: SolverNumbers) -> WarmStart:
    impulse, of_springs = (jnp.where(params.warm_start, x, 0) for x in (state.joint_impulse, state.spring_impulse))
    bounds = jnp.pad(of_springs[:, 1:], ((0, 0), (3, 0)))
    both = jnp.concatenate([impulse, bounds]) if len(bounds) else impulse
    return WarmStart(JointImpulses(both[:, :2], both[:, 2], both[:, 3], both[:, 4]), of_springs[:, 0])


def prepare(bodies: Bodies, scene: Scene, before: WarmStart, controls: Controls, params: SolverNumbers) -> Joints:
    of = joints_with_rods(scene)
    a, b = of.a, of.b
    is_held = of.active & (bodies.is_dynamic[a] | bodies.is_dynamic[b])
    pair = pair_up(bodies, a, b, is_held)
    is_fixed, is_prismatic = (of.is_kind(kind) for kind in (JointKind.FIXED, JointKind.PRISMATIC))
    is_velocity, is_servo = (of.is_drive(drive) for drive in (JointDrive.VELOCITY, JointDrive.SERVO))
    control = jnp.pad(controls.motor, (0, a.shape[0] - controls.motor.shape[0]))
    is_driven = of.motor_on & ~is_fixed & ((control != 0) | ~is_velocity)
    angular_impulse = jnp.where(is_driven | is_fixed, before.joints.angular_impulse, 0)
    base_speed = jnp.where(is_prismatic, params.base_slider_speed, params.base_motor_speed)
    speed, zero = of.motor_speed * base_speed, jnp.zeros_like(control)
    joints = Joints(
        is_held=is_held,
        is_fixed=is_fixed,
        is_prismatic=is_prismatic,
        is_rod=of.kind == ROD,
        is_driven=is_driven,
        is_servo=is_servo,
        is_limited=of.has_limits,
        pair=pair,
        together=articulations(bodies, pair),
        axis_angle=of.axis_angle,
        local_a=of.anchor_a,
        local_b=of.anchor_b,
        angle_a=bodies.angle[a],
        angle_b=bodies.angle[b],
        centre_gap=bodies.position[b] - bodies.position[a],
        start_angle=angles.wanted(counted_angle(bodies, scene), of),
        axial_mass=zero,
        control=control,
        motor_target=control * of.motor_speed * base_speed,
        max_motor_impulse=zero,
        servo=servo_of(control, speed, of.lower_limit, of.upper_limit),
        lower=of.lower_limit,
        upper=of.upper_limit,
        axes=AxialRows.of(jnp.zeros(a.shape, jnp.int32), zero),
        impulses=before.joints._replace(angular_impulse=angular_impulse),
        springs=springs_of.prepare(bodies, scene, before.springs),
    )
    rows = constraints(bodies, joints)
    axial_mass = vec2.inverse_or_zero(inverse_mass(pair, rows.axial, rows.axial))
    # The power is the acceleration that the motor can give to the pair of bodies alone.
    power = of.motor_power * jnp.where(is_prismatic, params.base_slider_power, params.base_motor_power)
    joints = joints._replace(axial_mass=axial_mass, max_motor_impulse=params.h * power * axial_mass)
    holds = held_before(joints, speed_along(rows.axial, pair_velocities(pair, bodies.velocities)))
    return joints._replace(axes=joints.axes._replace(holds=holds))


def held_before(joints: Joints, speed: jax.Array) -> jax.Array:
    """[J] what holds the speed along the axes, by the impulses that they have and the speed of the motor."""
    impulses = joints.impulses
    more = jnp.where(joints.is_servo, 0, joints.motor_target - speed)
    needed = jnp.abs(impulses.angular_impulse + more * joints.axial_mass)
    is_motor = joints.is_driven & (needed < joints.max_motor_impulse)
    holds = jnp.where(is_motor, axial_rows.MOTOR, axial_rows.NOTHING)
    holds = jnp.where(joints.is_limited & (impulses.upper > 0), axial_rows.UPPER, holds)
    holds = jnp.where(joints.is_limited & (impulses.lower > 0), axial_rows.LOWER, holds)
    is_tight = impulses.lower != impulses.upper
    return jnp.where(joints.is_rod, jnp.where(is_tight, axial_rows.MOTOR, axial_rows.NOTHING), holds)


def replace_found(old: Joints, new: Joints, which: jax.Array) -> Joints:
    """Joints and springs of the bodies of `which` [n] bool, which can be pushed, as they were prepared; others stay."""
    springs = springs_of.replace_found(old.springs, new.springs, which)
    is_of = has_one_of(old.pair, which)

    def prepared(of_new: jax.Array, of_old: jax.Array) -> jax.Array:
        return jnp.where(like(is_of, of_new), of_new, of_old)

    return new._replace(
        springs=springs,
        angle_a=prepared(new.angle_a, old.angle_a),
        angle_b=prepared(new.angle_b, old.angle_b),
        centre_gap=prepared(new.centre_gap, old.centre_gap),
        start_angle=prepared(new.start_angle, old.start_angle),
        axial_mass=prepared(new.axial_mass, old.axial_mass),
        max_motor_impulse=prepared(new.max_motor_impulse, old.max_motor_impulse),
        axes=choose(is_of, new.axes, old.axes),
    )


def articulations(bodies: Bodies, pair: Pair) -> jax.Array:
    """[J, J] bool, see `Joints.together`."""
    ends = (pair.is_a | pair.is_b) & bodies.is_dynamic
    together = jnp.any(ends[:, None] & ends, axis=-1)
    for _ in range(math.ceil(math.log2(max(2, ends.shape[0])))):  # twice as far each time
        together = together.astype(jnp.float32) @ together.astype(jnp.float32) > 0
    return together


def counted_angle(bodies: Bodies, scene: Scene) -> jax.Array:
    """angle_b - angle_a - rest angle, [J] rad, turns counted as far as the bodies' angles count them."""
    of = joints_with_rods(scene)
    return bodies.angle[of.b] - bodies.angle[of.a] - of.rest_angle


def store(joints: Joints, state: State) -> jax.Array:
    """Impulses as in `State.joint_impulse`; joints that hold nothing keep what they had."""
    i, before = joints.impulses, state.joint_impulse
    solved = jnp.concatenate([i.point, i.angular_impulse[:, None], i.lower[:, None], i.upper[:, None]], axis=1)
    return jnp.where(joints.is_held[: len(before), None], solved[: len(before)], before)


def store_springs(bodies: Bodies, joints: Joints, state: State) -> jax.Array:
    """Impulses as in `State.spring_impulse`, of springs and of the bounds of their lengths; the same."""
    springs, before, num_joints = joints.springs, state.spring_impulse, state.joint_impulse.shape[0]
    force = jnp.where(is_slowed(bodies, springs.pair), 0, springs.impulse)
    bounds = jnp.stack([joints.impulses.lower, joints.impulses.upper], -1)[num_joints:]
    return jnp.concatenate(
        [
            jnp.where(springs.is_held, force, before[:, 0])[:, None],
            jnp.where(joints.is_held[num_joints:, None], bounds, before[:, 1:]),
        ],
        axis=1,
    )


def current_angle(bodies: Bodies, joints: Joints) -> jax.Array:
    return joints.start_angle + pick(joints.pair.is_b, bodies.turn) - pick(joints.pair.is_a, bodies.turn)


def constraints(bodies: Bodies, joints: Joints) -> Constraints:
    arm_a, arm_b = arms(bodies, joints)
    gap, angle = current_gap(bodies, joints, arm_a, arm_b), current_angle(bodies, joints)
    local_axis = vec2.rotated(vec2.from_angle(joints.axis_angle), joints.angle_a)
    axis = vec2.rotated(local_axis, pick(joints.pair.is_a, bodies.turn))
    common_a, common_b = common_arms(joints, gap, arm_a, arm_b)

    def along(direction: jax.Array) -> Jacobian:
        return Jacobian(direction, vec2.cross(common_a, direction), vec2.cross(common_b, direction))

    one = jnp.ones_like(angle)
    turning = Jacobian(jnp.zeros_like(gap), one, one)
    x, y = (along(jnp.broadcast_to(unit, gap.shape)) for unit in jnp.eye(2, dtype=gap.dtype))

    def by_kind(prismatic: Any, other: Any) -> Any:
        return jax.tree.map(lambda p, o: jnp.where(like(joints.is_prismatic, p), p, o), prismatic, other)

    across = vec2.left(axis)
    rows = Constraints(
        axial=by_kind(along(axis), turning),
        first=by_kind(along(across), x),
        second=by_kind(turning, y),
        position=by_kind(vec2.dot(axis, gap), angle),
        error=by_kind(jnp.stack([vec2.dot(across, gap), angle], -1), gap),
    )
    if not joints.has_rods:
        return rows
    line, length = line_of(gap, arm_a, arm_b)
    none = jax.tree.map(jnp.zeros_like, line)
    of_rods = Constraints(axial=line, first=none, second=none, position=length, error=jnp.zeros_like(gap))
    return jax.tree.map(lambda r, o: jnp.where(like(joints.is_rod, r), r, o), of_rods, rows)


def common_arms(joints: Joints, gap: jax.Array, arm_a: jax.Array, arm_b: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Arms [J, 2] m to the points where impulses act. It is one point for both bodies, or they would change what both
    have of angular momentum: of a slider the anchor of b, of others the middle of the gap; what is fixed takes any."""
    both_move = (joints.pair.mass_a > 0) & (joints.pair.mass_b > 0)
    half_gap = jnp.where(both_move[:, None], 0.5 * gap, 0)
    is_slider = joints.is_prismatic[:, None]
    return arm_a + jnp.where(is_slider, gap, half_gap), arm_b - jnp.where(is_slider, 0, half_gap)


def like(mask: jax.Array, x: jax.Array) -> jax.Array:
    """The mask of the first axes of `x`, to select from it."""
    return mask.reshape(mask.shape + (1,) * (x.ndim - mask.ndim))


def without_impulses(joints: Joints) -> Joints:
    """Joints as a sub-step begins with them. They need no warm start, since they are solved directly."""
    return joints._replace(impulses=jax.tree.map(jnp.zeros_like, joints.impulses))


def stretched(bodies: Bodies, joints: Joints, h: jax.Array) -> jax.Array:
    """[n] inverse inertias by which spins change in a sub-step of h.

    A joint that pulls along the arm it has holds its body against turning, by what it exerted in the sub-step before.
    Where a sub-step is too long for the swing that comes of it, the body has stiffness x h^2 as its inertia (geometric
    stiffness: Tournier et al. 2015, Andrews et al. 2017). What turns is the body and, as far as the other's anchor
    holds still, its mass at the arm: a bob on a pivot swings as slowly as its arm is long.
    """
    arm_a, arm_b = arms(bodies, joints)
    impulse = jnp.where(joints.is_prismatic[:, None], 0, joints.impulses.point)
    if joints.has_rods:
        line = vec2.unit_or_zero(current_gap(bodies, joints, arm_a, arm_b))
        along = (joints.impulses.lower - joints.impulses.upper)[:, None] * line
        impulse = jnp.where(joints.is_rod[:, None], along, impulse)
    pair = joints.pair
    moves_a = pair.mass_a + pair.inertia_a * vec2.dot(arm_a, arm_a)
    moves_b = pair.mass_b + pair.inertia_b * vec2.dot(arm_b, arm_b)

    def of_side(
        is_it: jax.Array, pull: jax.Array, arm: jax.Array, mass: jax.Array, other: jax.Array, inertia: jax.Array
    ) -> jax.Array:
        """[J, n] kg m^2, stiffness x h^2 where it is too much."""
        still = vec2.inverse_or_zero(mass + other)
        is_stiff = pull * inertia > 1 + vec2.dot(arm, arm) * mass * still * still * inertia
        return jnp.where(is_it & is_stiff[:, None], pull[:, None], 0)

    a = of_side(pair.is_a, -h * vec2.dot(arm_a, impulse), arm_a, pair.mass_a, moves_b, pair.inertia_a)
    b = of_side(pair.is_b, h * vec2.dot(arm_b, impulse), arm_b, pair.mass_b, moves_a, pair.inertia_b)
    inertia = jnp.max(jnp.maximum(a, b), axis=0, initial=0)
    is_stiff = inertia * bodies.inverse_inertia > 1
    return jnp.where(is_stiff, 1 / jnp.where(is_stiff, inertia, 1), bodies.inverse_inertia)


class PlacedJoints(NamedTuple):
    """Rows of the joints and their system, as the bodies stood when it was made."""

    rows: Constraints
    system: JointSystem


def place(bodies: Bodies, joints: Joints) -> PlacedJoints:
    rows = constraints(bodies, joints)
    has_third = joints.is_fixed | has_axis(joints)
    third = jnp.where(has_third[:, None], _dense(joints.pair, rows.axial), 0)
    dense = jnp.concatenate([_dense(joints.pair, rows.first), _dense(joints.pair, rows.second), third])
    inverse = _inverse_masses(bodies)
    own = jnp.sum(dense * inverse * dense, axis=1).reshape(3, -1)
    mass, turning = joints.pair.mass_a + joints.pair.mass_b, joints.pair.inertia_a + joints.pair.inertia_b
    is_slider = joints.is_prismatic
    # An axis does not yield: under a load a motor would creep.
    yielding = (mass, jnp.where(is_slider, turning, mass), jnp.where(joints.is_fixed, turning, 0))
    point = own[0] + jnp.where(is_slider, 0, own[1])
    rounding = C.joint_rounding * jnp.concatenate([point, jnp.where(is_slider, own[1], point), own[2]])
    if joints.has_rods:  # of two rounds the second makes good what this leaves
        rounding = rounding.at[-len(mass) :].add(jnp.where(joints.is_rod, C.joint_compliance * mass, 0))
    system = joint_system.build(dense, inverse, C.joint_compliance * jnp.concatenate(yielding), rounding)
    return PlacedJoints(rows, system)


def has_axis(joints: Joints) -> jax.Array:
    """[J] bool, a motor or limits may act along its axis."""
    return (joints.is_driven | joints.is_limited) & ~joints.is_fixed


def _dense(pair: Pair, row: Jacobian) -> jax.Array:
    """[J, 3n], x, y and angle of each body."""
    linear = (pair.is_b.astype(row.direction.dtype) - pair.is_a)[..., None] * row.direction[:, None]
    angular = jnp.where(pair.is_b, row.lever_b[:, None], 0) - jnp.where(pair.is_a, row.lever_a[:, None], 0)
    return jnp.concatenate([linear, angular[..., None]], axis=-1).reshape(len(linear), 3 * linear.shape[1])


def _inverse_masses(bodies: Bodies) -> jax.Array:
    """[3n], in the order of `_dense`."""
    linear = jnp.broadcast_to(bodies.inverse_mass[:, None], bodies.position.shape)
    return jnp.concatenate([linear, bodies.inverse_inertia[:, None]], axis=-1).ravel()


def _flat(velocities: Velocities) -> jax.Array:
    """[3n], in the order of `_dense`."""
    return jnp.concatenate([velocities.velocity, velocities.omega[:, None]], axis=-1).ravel()


def _unflat(flat: jax.Array) -> Velocities:
    by_body = flat.reshape(-1, 3)
    return Velocities(by_body[:, :2], by_body[:, 2])


class _Attempt(NamedTuple):
    velocities: jax.Array  # [3n]
    impulses: jax.Array  # [3J]
    axes: AxialRows
    included: jax.Array  # [J] bool, joints that it is about, whole articulations


def solve_soft(
    bodies: Bodies,
    joints: Joints,
    placed: PlacedJoints,
    params: SolverNumbers,
    active: ActiveSet,
    *,
    use_bias: bool,
    after: Velocities | None = None,
) -> tuple[Bodies, Joints, jax.Array]:
    """The first of two rounds of a pass with bias, over springs and all joints; or the second, for what contacts and
    changed spins have made wrong since, `after` the velocities that contacts left; or a bounce, without springs and
    motors: a force or torque does nothing in an instant. Also the bodies [n] that it moved in a repeated pass.

    A round is solved with what motors and limits held at last. Where that cannot be at the speeds that come out, their
    articulation is solved again with what they would hold. Where they do not agree with each other in the end, limits
    hold still, which takes energy and gives none."""
    by_springs, is_first = jnp.zeros_like(active.now), after is None
    if is_first and use_bias:
        bodies, springs, by_springs = springs_of.solve(bodies, joints.springs, params, active, use_bias=True)
        joints = joints._replace(springs=springs)
    num_joints = joints.is_held.shape[0]
    if num_joints == 0:
        return bodies, joints, by_springs
    now, system = placed
    included = active.includes_joined(joints.pair, joints.together)
    before, start = pair_velocities(joints.pair, bodies.velocities), _flat(bodies.velocities)
    if is_first:
        begun = begin_axes(bodies, joints, placed, params, use_bias=use_bias)
        joints = joints._replace(axes=choose(included, begun, joints.axes))

    def push_unheld(at: _Attempt) -> _Attempt:
        has_none = has_axis(joints) & ~at.axes.is_held & at.included
        free = jnp.where(has_none, at.axes.impulse - at.impulses[-num_joints:], 0)
        free = jnp.concatenate([jnp.zeros((2 * num_joints,), free.dtype), free])
        return at._replace(velocities=joint_system.pushed(system, at.velocities, free), impulses=at.impulses + free)

    first = _Attempt(start, row_impulses(joints), joints.axes, included)
    bias = jnp.zeros_like(system.yielding)
    if use_bias:
        # No motor of this round has acted yet: a strong one spins a light body far beyond what is solved.
        foreseen = before if after is None else pair_velocities(joints.pair, after)
        bias = bend_speed(bodies, joints, foreseen, now, params) + correction_speed(now, joints, params)

    def solve(before_it: _Attempt) -> _Attempt:
        at = push_unheld(before_it)
        wrong = joint_system.times(system.rows, at.velocities) + bias
        wrong = wrong.at[-num_joints:].add(jnp.where(has_axis(joints), -at.axes.speed, 0))
        if use_bias:
            wrong += system.yielding * at.impulses
        change = -joint_system.solve(system, held_rows(joints, at.axes) & jnp.tile(at.included, 3), wrong)
        return at._replace(velocities=joint_system.pushed(system, at.velocities, change), impulses=at.impulses + change)

    def attempt(at: _Attempt, index: jax.Array) -> tuple[_Attempt, None]:
        def chosen() -> _Attempt:
            done = solve(at)
            total, speed = done.impulses[-num_joints:], joint_system.times(system.rows, done.velocities)[-num_joints:]
            if joints.has_rods:
                speed += jnp.where(joints.is_rod, bias[-num_joints:], 0)
            axes, changes = axial_rows.choose(done.axes, speed, total)
            changes &= has_axis(joints) & done.included
            again = done.included & jnp.any(joints.together & changes, axis=1)
            is_last = index + 1 == C.axial_changes
            axes = choose(again & is_last, axial_rows.settle(axes, total), axes)
            return done._replace(axes=choose(again, axes, done.axes), included=again)

        return jax.lax.cond(in_any_world(jnp.any(at.included)), chosen, lambda: at), None

    last, _ = jax.lax.scan(attempt, first, jnp.arange(C.axial_changes))
    last = jax.lax.cond(in_any_world(jnp.any(last.included)), lambda: solve(last), lambda: last)
    held = with_row_impulses(joints._replace(axes=last.axes), last.impulses)
    solved = jax.tree.map(lambda x, y: jnp.where(like(included, x), x, y), held.impulses, joints.impulses)
    solved_velocities = _unflat(last.velocities)
    moved = active.moves(before, pair_velocities(joints.pair, solved_velocities)) & included
    return (
        bodies._replace(velocities=solved_velocities),
        joints._replace(impulses=solved, axes=last.axes),
        by_springs | marked(bodies, joints.pair, moved),
    )


def row_impulses(joints: Joints) -> jax.Array:
    """[3J] N s or N m s, of each row."""
    i = joints.impulses
    third = jnp.where(joints.is_fixed, i.angular_impulse, i.angular_impulse + i.lower - i.upper)
    return jnp.concatenate([i.point.T.ravel(), third])


def with_row_impulses(joints: Joints, impulses: jax.Array) -> Joints:
    """Joints with impulses [3J] of their rows: along an axis, a motor's and beyond it a limit's."""
    i, axes, num_joints = joints.impulses, joints.axes, joints.is_held.shape[0]
    total = impulses[-num_joints:]
    motor = jnp.where(joints.is_rod, 0, jnp.where(axes.is_limit, axes.pushing, total))
    solved = JointImpulses(
        point=impulses[: 2 * num_joints].reshape(2, -1).T,
        angular_impulse=jnp.where(has_axis(joints), motor, jnp.where(joints.is_fixed, total, i.angular_impulse)),
        lower=jnp.where(has_axis(joints), jnp.maximum(total - motor, 0), i.lower),
        upper=jnp.where(has_axis(joints), jnp.maximum(motor - total, 0), i.upper),
    )
    return joints._replace(impulses=solved)


def with_changed_impulses(joints: Joints, impulses: jax.Array) -> Joints:
    """The same where a row of a joint has another impulse than before; others keep theirs to the bit."""
    changed = jnp.any((impulses != row_impulses(joints)).reshape(3, -1), axis=0)
    after = with_row_impulses(joints, impulses).impulses
    return joints._replace(
        impulses=jax.tree.map(lambda x, y: jnp.where(like(changed, x), x, y), after, joints.impulses)
    )


class Answers(NamedTuple):
    """Answers of joints to changes of their bodies' velocities, so that their rows keep their speeds."""

    impulses: jax.Array  # [3J, 3n] of rows, for a change of one
    moved: jax.Array  # [3n, 3n] changes of velocities by them


def answers(bodies: Bodies, joints: Joints, placed: PlacedJoints, pushed: jax.Array) -> Answers:
    """Answers of the joints of bodies of `pushed` [n] bool, motors left out; zeros in a world without such."""
    system, dtype, n = placed.system, bodies.angle.dtype, bodies.angle.shape[0]
    none = Answers(jnp.zeros((system.rows.shape[0], 3 * n), dtype), jnp.zeros((3 * n, 3 * n), dtype))
    if joints.is_held.shape[0] == 0:
        return none
    is_needed = jnp.any(has_one_of(joints.pair, pushed))

    # A motor gives nothing in an instant: with bias the second round has what it makes of it, else the next sub-step.
    holds = joints.axes.holds
    is_motor = (holds == axial_rows.MOTOR) & ~joints.is_rod
    released = joints.axes._replace(holds=jnp.where(is_motor, axial_rows.NOTHING, holds))

    def solved() -> Answers:
        impulses = -joint_system.solve(system, held_rows(joints, released), system.rows)
        moved = system.inverse_mass[:, None] * joint_system.times(system.rows.T, impulses)
        return Answers(impulses, moved)

    return jax.lax.cond(in_any_world(is_needed), lambda: choose(is_needed, solved(), none), lambda: none)


def answers_of_pairs(answers: Answers, pair: Pair) -> jax.Array:
    """[K, 6, 6] changes of the velocities of two bodies by what joints answer to changes of them (`as_vector`)."""
    n = answers.moved.shape[0] // 3
    both = jnp.stack([pair.is_a, pair.is_b], axis=1).astype(answers.moved.dtype)
    by_body = answers.moved.reshape(n, 3, n, 3)
    precise = jax.lax.Precision.HIGHEST
    of_both = jnp.einsum("kpi,iajb,kqj->kpaqb", both, by_body, both, precision=precise)
    return of_both.reshape(both.shape[0], 6, 6)


def answer(
    answers: Answers, velocities: Velocities, impulses: jax.Array, pair: Pair, pushed: jax.Array
) -> tuple[Velocities, jax.Array]:
    """Velocities of all but the two bodies of a pair, and impulses [3J], after the answer to a change of those two,
    [6]."""
    change = (pair.is_a[:, None] * pushed[:3] + pair.is_b[:, None] * pushed[3:]).ravel()
    moved = joint_system.times(answers.moved, change).reshape(-1, 3)
    moved = jnp.where((pair.is_a | pair.is_b)[:, None], 0, moved)
    after = Velocities(velocities.velocity + moved[:, :2], velocities.omega + moved[:, 2])
    return after, impulses + joint_system.times(answers.impulses, change)


def as_vector(of: PairVelocities) -> jax.Array:
    """[6] of one pair: x, y and angle of a, then of b."""
    return jnp.concatenate([of.velocity_a, of.omega_a[None], of.velocity_b, of.omega_b[None]])


def as_velocities(vector: jax.Array) -> PairVelocities:
    return PairVelocities(vector[:2], vector[3:5], vector[2], vector[5])


def held_rows(joints: Joints, axes: AxialRows) -> jax.Array:
    """[3J] bool."""
    is_held = jnp.ones_like(joints.is_fixed)
    return jnp.concatenate([is_held, is_held, joints.is_fixed | (has_axis(joints) & axes.is_held)])


def correction_speed(now: Constraints, joints: Joints, params: SolverNumbers) -> jax.Array:
    """[3J] speeds that undo errors, within their limits: of a point as a whole, of a slider each on its own."""
    rate = params.joint_correction / params.h
    wanted, angle = rate * now.error, jnp.clip(rate * now.position, -params.joint_turn_speed, params.joint_turn_speed)
    point = jax.vmap(vec2.clamp_length, (0, None))(wanted, params.joint_pull_speed)
    max_speed = jnp.stack([jnp.asarray(params.joint_pull_speed), jnp.asarray(params.joint_turn_speed)])
    both = jnp.where(joints.is_prismatic[:, None], jnp.clip(wanted, -max_speed, max_speed), point)
    return jnp.concatenate([both[:, 0], both[:, 1], jnp.where(joints.is_fixed, angle, 0)])


def bend_speed(
    bodies: Bodies, joints: Joints, of: PairVelocities, now: Constraints, params: SolverNumbers
) -> jax.Array:
    """[3J] m/s at which held rows go wrong even where their speeds are zero, since anchors and axes go around their
    bodies: change of the errors in the next h seconds, over h, less the speeds of the rows."""
    arm_a, arm_b = arms(bodies, joints)
    gap = current_gap(bodies, joints, arm_a, arm_b)
    # Faster nothing turns in the end, however fast it does while velocities are solved.
    turn_a, turn_b = (
        params.h * jnp.clip(omega, -params.max_angular_speed, params.max_angular_speed)
        for omega in (of.omega_a, of.omega_b)
    )
    drift = of.velocity_b - of.velocity_a
    moved = drift + (chord(arm_b, turn_b) - chord(arm_a, turn_a)) / params.h
    at_a, at_b = common_arms(joints, gap, arm_a, arm_b)
    speed = drift + vec2.left(at_b) * of.omega_b[:, None] - vec2.left(at_a) * of.omega_a[:, None]
    across = now.first.direction
    swing = chord(across, turn_a)
    of_slider = vec2.dot(across + swing, moved) + vec2.dot(swing, gap) / params.h - speed_along(now.first, of)
    none = jnp.zeros_like(of_slider)
    x, y = jnp.moveaxis(moved - speed, -1, 0)
    is_slider = joints.is_prismatic
    speeds = jnp.concatenate([jnp.where(is_slider, of_slider, x), jnp.where(is_slider, none, y), none])
    if not joints.has_rods:
        return speeds
    of_rods = jnp.concatenate([none, none, bend_of_line(gap, moved, now.axial, of, params.h)])
    return jnp.where(jnp.tile(joints.is_rod, 3), of_rods, speeds)


def chord(arm: jax.Array, turn: jax.Array) -> jax.Array:
    """From the end of an arm to where it is after a turn."""
    half = jnp.sin(0.5 * turn)[..., None]
    return vec2.left(arm) * jnp.sin(turn)[..., None] - arm * (2 * half * half)


def begin_axes(
    bodies: Bodies, joints: Joints, placed: PlacedJoints, params: SolverNumbers, *, use_bias: bool
) -> AxialRows:
    """Motors and limits of the joints in this sub-step, with what they held at last."""
    now, system = placed
    return_speed = jnp.where(joints.is_prismatic | joints.is_rod, params.joint_pull_speed, params.joint_turn_speed)

    def approach(clearance: jax.Array) -> jax.Array:
        """Speed at which a joint may go towards its limit; from beyond the limit it comes back."""
        back = jnp.maximum(params.joint_correction / params.h * clearance, -return_speed) if use_bias else 0
        return jnp.where(joints.is_limited, jnp.where(clearance > 0, clearance / params.h, back), C.far_distance)

    lowest, highest = -approach(now.position - joints.lower), approach(joints.upper - now.position)
    drives = joints.is_driven & use_bias
    motor = joints.impulses.angular_impulse
    rows = joints.axes._replace(
        lowest=lowest,
        highest=jnp.maximum(lowest, highest),
        target=joints.motor_target,
        least=jnp.where(drives, -joints.max_motor_impulse, motor),
        most=jnp.where(drives, joints.max_motor_impulse, motor),
    )
    speed = speed_along(now.axial, pair_velocities(joints.pair, bodies.velocities))
    if joints.has_rods:
        aside = across_line(now.axial, *arms(bodies, joints))
        across_mass = vec2.inverse_or_zero(inverse_mass(joints.pair, aside, aside))
        lengths = Lengths(now.position, joints.lower, joints.upper, C.rod_strength * across_mass / params.h)
        rows = choose(joints.is_rod, hold_lengths(rows, lengths, approach, speed), rows)
    begun = axial_rows.begin(rows, speed)
    is_servo = joints.is_servo & drives

    def aimed() -> AxialRows:
        driving = rows._replace(holds=jnp.where(is_servo, axial_rows.MOTOR, begun.holds))
        moves = joint_system.axial_inverse_mass(system, held_rows(joints, driving))
        way = joints.servo.position - now.position
        target = speed_towards(joints.servo, way, rows.most * moves / params.h, params.h)
        return choose(is_servo, axial_rows.begin(driving._replace(target=target), speed), begun)

    return jax.lax.cond(in_any_world(jnp.any(is_servo)), aimed, lambda: begun)


def motor_work(bodies: Bodies, joints: Joints, rows: Constraints) -> jax.Array:
    """[J] J, what motors have added to the bodies' energy in this sub-step, along the rows that were solved."""
    speed = speed_along(rows.axial, pair_velocities(joints.pair, bodies.velocities))
    work = jnp.maximum(joints.impulses.angular_impulse * speed, 0)
    return jnp.where(joints.is_driven & joints.is_held, work, 0)


def kinematic_work(bodies: Bodies, joints: Joints, rows: Constraints) -> jax.Array:
    """[J] J, what kinematic bodies have done through joints in this sub-step, along the rows that were solved."""
    impulses, pair = joints.impulses, joints.pair
    parts = (
        (rows.first, impulses.point[:, 0]),
        (rows.second, impulses.point[:, 1]),
        (rows.axial, impulses.angular_impulse + impulses.lower - impulses.upper),
    )
    on_b = jnp.asarray(sum(row.direction * impulse[:, None] for row, impulse in parts))
    angular_a = jnp.asarray(sum(row.lever_a * impulse for row, impulse in parts))
    angular_b = jnp.asarray(sum(row.lever_b * impulse for row, impulse in parts))
    return work_of_kinematic(bodies, pair, on_b, angular_a, angular_b)
