"""Springs and dampers: forces along the line between an anchor on a and one on b.

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
from jax2d.scene import Scene
from jax2d.solver_numbers import SolverNumbers
from jax2d.xla.active_set import ActiveSet, has_one_of, marked
from jax2d.xla.bodies import Bodies, Pair, Velocities, pair_up, pair_velocities, scatter_velocities
from jax2d.xla.branching import choose
from jax2d.xla.rods import line_of
from jax2d.xla.rows import Jacobian, arms, current_gap, inverse_mass, push, speed_along, work_of_kinematic


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
    stretch: jax.Array  # [S] m, at the start of the sub-step
    impulse: jax.Array  # [S] N s, accumulated over steps, positive where it pushes apart


def prepare(bodies: Bodies, scene: Scene, impulse: jax.Array) -> Springs:
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
        stretch=jnp.zeros_like(of.rest_length),
        impulse=impulse,
    )


def replace_found(old: Springs, new: Springs, which: jax.Array) -> Springs:
    """Springs of the bodies of `which` [n] bool, which can be pushed, as they were prepared; others stay."""
    is_of = has_one_of(old.pair, which)
    return new._replace(
        angle_a=jnp.where(is_of, new.angle_a, old.angle_a),
        angle_b=jnp.where(is_of, new.angle_b, old.angle_b),
        centre_gap=jnp.where(is_of[:, None], new.centre_gap, old.centre_gap),
    )


def line(bodies: Bodies, springs: Springs) -> tuple[Jacobian, jax.Array]:
    """(rows [S] along the lines, lengths [S] m) as the bodies stand now."""
    arm_a, arm_b = arms(bodies, springs)
    return line_of(current_gap(bodies, springs, arm_a, arm_b), arm_a, arm_b)


def warm_start(bodies: Bodies, springs: Springs) -> Bodies:
    if springs.rest_length.shape[0] == 0:
        return bodies
    rows, _ = line(bodies, springs)
    before = pair_velocities(springs.pair, bodies.velocities)
    after = push(before, springs.pair, rows, springs.impulse)
    return bodies._replace(velocities=scatter_velocities(bodies.velocities, springs.pair, before, after))


class Row(NamedTuple):
    """An element as one pass needs it: nothing here changes while velocities are solved."""

    pair: Pair
    line: Jacobian
    inverse_mass: jax.Array  # 1/kg along the line
    has_force: jax.Array  # bool
    pull: jax.Array  # N s, of the stretch
    resistance: jax.Array  # N s/m


def solve(
    bodies: Bodies, springs: Springs, params: SolverNumbers, active: ActiveSet, *, use_bias: bool
) -> tuple[Bodies, Springs, jax.Array]:
    """Passes over all elements. Also the bodies [n] that they moved in a repeated pass."""
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
        has_force=(springs.stiffness > 0) | (springs.damping > 0),
        pull=h * stiffness * springs.stretch,
        resistance=springs.damping + theta * h * stiffness,
    )

    def solve_one(velocities: Velocities, now: tuple[Row, jax.Array, jax.Array]) -> tuple:
        row, impulse, included = now
        before = pair_velocities(row.pair, velocities)
        free_speed = speed_along(row.line, before) - row.inverse_mass * impulse
        slowed = 1 + h * row.resistance * row.inverse_mass
        total = -(row.pull + h * row.resistance * free_speed) / slowed
        total = jnp.where(row.has_force & included, total, impulse)
        of = choose(included, push(before, row.pair, row.line, total - impulse), before)
        return scatter_velocities(velocities, row.pair, before, of), (total, active.moves(before, of))

    included = active.includes(springs.pair)

    def one_pass(now: tuple[Velocities, jax.Array], _: None) -> tuple:
        velocities, (impulse, moved) = jax.lax.scan(solve_one, now[0], (row, now[1], included))
        return (velocities, impulse), moved

    passes = C.spring_passes if use_bias else 1
    (velocities, impulse), moved = jax.lax.scan(one_pass, (bodies.velocities, springs.impulse), length=passes)
    return (
        bodies._replace(velocities=velocities),
        springs._replace(impulse=impulse),
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


def work(bodies: Bodies, springs: Springs) -> jax.Array:
    """[S] J, what they have added to the bodies' energy in this sub-step."""
    speed = speed_along(line(bodies, springs)[0], pair_velocities(springs.pair, bodies.velocities))
    return jnp.maximum(springs.impulse * speed, 0)


def kinematic_work(bodies: Bodies, springs: Springs) -> jax.Array:
    """[S] J, what kinematic bodies have done through them in this sub-step."""
    if springs.rest_length.shape[0] == 0:
        return jnp.zeros(0, bodies.velocities.velocity.dtype)
    rows, impulse = line(bodies, springs)[0], springs.impulse
    return work_of_kinematic(
        bodies, springs.pair, rows.direction * impulse[:, None], rows.lever_a * impulse, rows.lever_b * impulse
    )
