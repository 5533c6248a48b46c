"""Ropes and rods: springs with a shortest or a longest length, as joints that hold along the line of their anchors.

They follow the joints of a scene and are solved with them as one system. Nothing but the length is held, at its bounds;
the spring's force is not theirs (springs.py). What they pull holds their ends against going aside, as a string is held.
Where that would swing faster than a sub-step can follow they give way instead: their impulses are bounded.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jax2d.constants import CONSTANTS as C
from jax2d.fields import fields_of
from jax2d.scene import Joints, Scene
from jax2d.xla import vec2
from jax2d.xla.axial_rows import MOTOR, NOTHING, AxialRows
from jax2d.xla.bodies import PairVelocities
from jax2d.xla.rows import Jacobian, speed_along

ROD = 3  # kind of joint, after those of `JointKind`


def joints_with_rods(scene: Scene) -> Joints:
    """Joints [J + S]: those of the scene, then its springs, active where they have a bound."""
    of, num = scene.springs, scene.springs.rest_length.shape[0]
    if num == 0:
        return scene.joints
    has_shortest, has_longest = of.min_length > 0, of.max_length < C.no_maximum
    own = {
        "active": of.active & (has_shortest | has_longest),
        "kind": jnp.full(num, ROD),
        "a": of.a,
        "b": of.b,
        "anchor_a": of.anchor_a,
        "anchor_b": of.anchor_b,
        "has_limits": jnp.ones(num, bool),
        "lower_limit": jnp.where(has_shortest, of.min_length, -C.far_distance),
        "upper_limit": jnp.where(has_longest, of.max_length, C.far_distance),
    }
    both = {}
    for field in fields_of(Joints):
        values = getattr(scene.joints, field.name)
        more = own.get(field.name, jnp.zeros(num))
        both[field.name] = jnp.concatenate([values, jnp.asarray(more, values.dtype)])
    return Joints(**both)


def line_of(gap: jax.Array, arm_a: jax.Array, arm_b: jax.Array) -> tuple[Jacobian, jax.Array]:
    """(rows [k] along the lines of anchors, lengths [k] m), by arms and gaps [k, 2] m."""
    length = vec2.length(gap)
    # Anchors in one place are pushed apart upwards, as circles in one place are.
    apart = (length > C.coincident_distance)[:, None]
    axis = jnp.where(apart, vec2.unit_or_zero(gap), jnp.array([0.0, 1.0], gap.dtype))
    return Jacobian(axis, vec2.cross(arm_a, axis), vec2.cross(arm_b, axis)), length


def across_line(line: Jacobian, arm_a: jax.Array, arm_b: jax.Array) -> Jacobian:
    """Rows [k] of the speeds of anchors b across their lines, seen from anchors a."""
    across = vec2.left(line.direction)
    return Jacobian(across, vec2.cross(arm_a, across), vec2.cross(arm_b, across))


class Lengths(NamedTuple):
    """Bounds of lengths, [k] m, and the lengths themselves."""

    now: jax.Array
    shortest: jax.Array
    longest: jax.Array
    strength: jax.Array  # [k] N s/m, the largest impulse over the length


def hold_lengths(
    rows: AxialRows, of: Lengths, approach: Callable[[jax.Array], jax.Array], speed: jax.Array
) -> AxialRows:
    """Rows [k] that hold lengths at the nearer bound, as a motor does its speed, with bounded impulses; the other bound
    is a limit in this sub-step. approach: speed at which a length may go towards a bound, by what is left before it.
    speed: [k] m/s, at which lengths grow."""
    left, above = of.longest - of.now, of.now - of.shortest
    is_long, is_rigid = left < above, of.shortest == of.longest
    target = jnp.where(is_long, approach(left), -approach(above))
    most = of.strength * jnp.maximum(of.now, jnp.where(is_long, of.longest, of.shortest))
    # What is at its bound holds at first: to let go takes one attempt, to be pulled tight one after the other many.
    is_met = jnp.where(is_long, speed > target, speed < target) | (jnp.minimum(left, above) < C.touching_distance)
    return rows._replace(
        lowest=jnp.where(is_long & ~is_rigid, -approach(above), -C.far_distance),
        highest=jnp.where(is_long | is_rigid, C.far_distance, approach(left)),
        target=target,
        least=jnp.where(is_long | is_rigid, -most, 0),
        most=jnp.where(is_long & ~is_rigid, 0, most),
        holds=jnp.where(is_met, MOTOR, jnp.where(rows.is_limit, NOTHING, rows.holds)),
    )


def bend_of_line(gap: jax.Array, moved: jax.Array, row: Jacobian, of: PairVelocities, h: jax.Array) -> jax.Array:
    """[k] m/s at which lengths grow beside their rows' speeds, since lines turn: change of the length in the next h
    seconds, over h, less the speed. moved: [k, 2] m/s, of anchor b from anchor a in that time."""
    after = gap + h * moved
    lengths = jnp.maximum(vec2.length(gap) + vec2.length(after), C.coincident_distance)
    return vec2.dot(moved, gap + after) / lengths - speed_along(row, of)
