"""Springs, dampers, ropes and rods: forces and limits along the line between an anchor on a and one on b.

    impulse = -h (k (C + theta h v) + c v), C = length - rest length at the start of the sub-step, v the speed after it

With q = k h^2 / mass, theta = q + (theta_max - q_max) (q / q_max)^2: a spring that is slow against the sub-step is
solved as free motion is (semi-implicit, which keeps its energy), a fast one implicitly. q_max and theta_max are those
of the stiffest that can be solved. The line is where both anchors are now, so that the impulse acts on both bodies
along one line and changes no momentum of the two.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jax2d.constants import CONSTANTS as C
from jax2d.scene import Scene, State
from jax2d.solver_numbers import Softness, SolverNumbers
from jax2d.xla import vec2
from jax2d.xla.active_set import ActiveSet, has_one_of, marked
from jax2d.xla.bodies import Bodies, Pair, Velocities, is_slowed, pair_up, pair_velocities, scatter_velocities
from jax2d.xla.branching import choose
from jax2d.xla.rows import Jacobian, arms, current_gap, inverse_mass, push, speed_along, work_of_kinematic


class SpringImpulses(NamedTuple):
    """Accumulated over steps, [S] N s."""

    force: jax.Array  # positive where it pushes apart
    shortest: jax.Array
    longest: jax.Array

    @property
    def total(self) -> jax.Array:
        return self.force + self.shortest - self.longest


class Springs(NamedTuple):
    """`S` elements in one step; what holds nothing is masked out of its pair."""

    is_held: jax.Array  # [S] bool, active and with a body that can move
    pair: Pair  # of [S]
    local_a: jax.Array  # [S, 2] m, anchors in the bodies' frames
    local_b: jax.Array
    angle_a: jax.Array  # [S] rad, of the bodies at the start of the step
    angle_b: jax.Array
    centre_gap: jax.Array  # [S, 2] m, centre of b from centre of a at the start of the step
    rest_length: jax.Array  # [S] m
    stiffness: jax.Array  # [S] N/m
    damping: jax.Array  # [S] N s/m
    min_length: jax.Array  # [S] m
    max_length: jax.Array
    stretch: jax.Array  # [S] m, at the start of the sub-step
    impulses: SpringImpulses


def load(state: State, params: SolverNumbers) -> SpringImpulses:
    impulse = jnp.where(params.warm_start, state.spring_impulse, 0)
    return SpringImpulses(impulse[:, 0], impulse[:, 1], impulse[:, 2])


def prepare(bodies: Bodies, scene: Scene, impulses: SpringImpulses) -> Springs:
    of = scene.springs
    is_held = of.active & (bodies.is_dynamic[of.a] | bodies.is_dynamic[of.b])
    return Springs(
        is_held=is_held,
        pair=pair_up(bodies, of.a, of.b, is_held),
        local_a=of.anchor_a,
        local_b=of.anchor_b,
        angle_a=bodies.angle[of.a],
        angle_b=bodies.angle[of.b],
        centre_gap=bodies.position[of.b] - bodies.position[of.a],
        rest_length=of.rest_length,
        stiffness=of.stiffness,
        damping=of.damping,
        min_length=of.min_length,
        max_length=of.max_length,
        stretch=jnp.zeros_like(of.rest_length),
        impulses=impulses,
    )


def replace_found(old: Springs, new: Springs, which: jax.Array) -> Springs:
    """Springs of the bodies of `which` [n] bool, which can be pushed, as they were prepared; others stay."""
    is_of = has_one_of(old.pair, which)
    return new._replace(
        angle_a=jnp.where(is_of, new.angle_a, old.angle_a),
        angle_b=jnp.where(is_of, new.angle_b, old.angle_b),
        centre_gap=jnp.where(is_of[:, None], new.centre_gap, old.centre_gap),
    )


def store(bodies: Bodies, springs: Springs, state: State) -> jax.Array:
    """Impulses as in `State.spring_impulse`; those that hold nothing keep what they had."""
    solved = jnp.where(is_slowed(bodies, springs.pair)[:, None], 0, jnp.stack(springs.impulses, -1))
    return jnp.where(springs.is_held[:, None], solved, state.spring_impulse)


def line(bodies: Bodies, springs: Springs) -> tuple[Jacobian, jax.Array]:
    """(rows [S] along the lines, lengths [S] m) as the bodies stand now."""
    arm_a, arm_b = arms(bodies, springs)
    gap = current_gap(bodies, springs, arm_a, arm_b)
    length = vec2.length(gap)
    # Anchors in one place are pushed apart upwards, as circles in one place are.
    apart = (length > C.coincident_distance)[:, None]
    axis = jnp.where(apart, vec2.unit_or_zero(gap), jnp.array([0.0, 1.0], gap.dtype))
    return Jacobian(axis, vec2.cross(arm_a, axis), vec2.cross(arm_b, axis)), length


def warm_start(bodies: Bodies, springs: Springs) -> Bodies:
    if springs.rest_length.shape[0] == 0:
        return bodies
    rows, _ = line(bodies, springs)
    before = pair_velocities(springs.pair, bodies.velocities)
    after = push(before, springs.pair, rows, springs.impulses.total)
    return bodies._replace(velocities=scatter_velocities(bodies.velocities, springs.pair, before, after))


class Row(NamedTuple):
    """An element as one pass needs it: nothing here changes while velocities are solved."""

    pair: Pair
    line: Jacobian
    inverse_mass: jax.Array  # 1/kg along the line
    has_force: jax.Array  # bool
    pull: jax.Array  # N s, of the stretch
    resistance: jax.Array  # N s/m
    shortest_room: jax.Array  # m left before the limit, negative beyond it
    longest_room: jax.Array
    has_shortest: jax.Array  # bool
    has_longest: jax.Array


def solve(
    bodies: Bodies, springs: Springs, params: SolverNumbers, active: ActiveSet, *, use_bias: bool, forces: bool
) -> tuple[Bodies, Springs, jax.Array]:
    """Passes over all elements. No `forces` in a bounce: they do nothing in an instant. Also the bodies [n] that they
    moved in a repeated pass."""
    if springs.rest_length.shape[0] == 0:
        return bodies, springs, jnp.zeros_like(active.now)
    rows, length = line(bodies, springs)
    if use_bias:
        springs = springs._replace(stretch=length - springs.rest_length)
    h, inverse = params.h, inverse_mass(springs.pair, rows, rows)
    stiffness, theta = solvable(springs.stiffness, h * h * inverse, params)
    row = Row(
        pair=springs.pair,
        line=rows,
        inverse_mass=inverse,
        has_force=((springs.stiffness > 0) | (springs.damping > 0)) & forces,
        pull=h * stiffness * springs.stretch,
        resistance=springs.damping + theta * h * stiffness,
        shortest_room=length - springs.min_length,
        longest_room=springs.max_length - length,
        has_shortest=springs.min_length > 0,
        has_longest=springs.max_length < C.no_maximum,
    )

    def solve_one(velocities: Velocities, now: tuple[Row, SpringImpulses, jax.Array]) -> tuple:
        row, impulses, included = now
        before = of = pair_velocities(row.pair, velocities)
        free_speed = speed_along(row.line, of) - row.inverse_mass * impulses.force
        slowed = 1 + h * row.resistance * row.inverse_mass
        force = -(row.pull + h * row.resistance * free_speed) / slowed
        force = jnp.where(row.has_force, force, impulses.force)
        of = push(of, row.pair, row.line, force - impulses.force)
        mass = vec2.inverse_or_zero(row.inverse_mass)

        def limit(clearance: jax.Array, speed: jax.Array, accumulated: jax.Array, exists: jax.Array) -> jax.Array:
            total = limit_impulse(clearance, speed, mass, accumulated, params, use_bias=use_bias)
            return jnp.where(exists, total, accumulated)

        shortest = limit(row.shortest_room, speed_along(row.line, of), impulses.shortest, row.has_shortest)
        of = push(of, row.pair, row.line, shortest - impulses.shortest)
        longest = limit(row.longest_room, -speed_along(row.line, of), impulses.longest, row.has_longest)
        of = push(of, row.pair, row.line, impulses.longest - longest)
        solved = SpringImpulses(force, shortest, longest)
        of, solved = choose(included, (of, solved), (before, impulses))
        return scatter_velocities(velocities, row.pair, before, of), (solved, active.moves(before, of))

    included = active.includes(springs.pair)

    def one_pass(now: tuple[Velocities, SpringImpulses], _: None) -> tuple:
        velocities, (impulses, moved) = jax.lax.scan(solve_one, now[0], (row, now[1], included))
        return (velocities, impulses), moved

    passes = C.spring_passes if use_bias else 1
    (velocities, impulses), moved = jax.lax.scan(one_pass, (bodies.velocities, springs.impulses), length=passes)
    return (
        bodies._replace(velocities=velocities),
        springs._replace(impulses=impulses),
        marked(bodies, springs.pair, jnp.any(moved, axis=0)),
    )


def solvable(stiffness: jax.Array, inverse: jax.Array, params: SolverNumbers) -> tuple[jax.Array, jax.Array]:
    """(stiffness, of what can be solved; theta: how far ahead it looks, in sub-steps), [S]. `inverse`: h^2 / mass."""
    bias_rate, mass_scale, impulse_scale = params.spring
    is_soft = impulse_scale > 0
    max_q = jnp.where(is_soft, mass_scale / jnp.where(is_soft, impulse_scale, 1) * bias_rate * params.h, C.far_distance)
    max_theta = jnp.where(is_soft, 1 / jnp.where(is_soft, bias_rate * params.h, 1), 0)
    has_mass = inverse > 0
    stiffness = jnp.minimum(stiffness, max_q / jnp.where(has_mass, inverse, 1))
    q = stiffness * inverse
    return stiffness, q + jnp.maximum(max_theta - max_q, 0) * (q / max_q) ** 2


def limit_impulse(
    clearance: jax.Array,
    speed: jax.Array,
    mass: jax.Array,
    accumulated: jax.Array,
    params: SolverNumbers,
    *,
    use_bias: bool,
) -> jax.Array:
    """New total of a one-sided limit. clearance: what is left before it; speed: that at which it grows. It is softened
    as the stiffest spring is: rows of rods that are not would gain energy."""
    soft = params.spring if use_bias else Softness(0.0, 1.0, 0.0)
    back = jnp.maximum(soft.bias_rate * clearance, -params.joint_pull_speed)
    hard = -mass * (speed + clearance / params.h)
    softened = -mass * soft.mass_scale * (speed + back) - soft.impulse_scale * accumulated
    return jnp.maximum(accumulated + jnp.where(clearance > 0, hard, softened), 0)


def work(bodies: Bodies, springs: Springs) -> jax.Array:
    """[S] J, what they have added to the bodies' energy in this sub-step."""
    speed = speed_along(line(bodies, springs)[0], pair_velocities(springs.pair, bodies.velocities))
    return jnp.maximum(springs.impulses.force * speed, 0)


def kinematic_work(bodies: Bodies, springs: Springs) -> jax.Array:
    """[S] J, what kinematic bodies have done through them in this sub-step."""
    if springs.rest_length.shape[0] == 0:
        return jnp.zeros(0, bodies.velocities.velocity.dtype)
    rows, impulse = line(bodies, springs)[0], springs.impulses.total
    return work_of_kinematic(
        bodies, springs.pair, rows.direction * impulse[:, None], rows.lever_a * impulse, rows.lever_b * impulse
    )
