"""Effective masses of joints, along the rows of their Jacobians."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jax2d.xla import vec2
from jax2d.xla.bodies import Pair
from jax2d.xla.rows import Jacobian, inverse_mass


class Constraints(NamedTuple):
    """Rows of all joints, [J], as the bodies stand now."""

    axial: Jacobian  # what motors drive and limits bound
    first: Jacobian  # what is held
    second: Jacobian
    position: jax.Array  # [J] rad or m, along the axial row
    error: jax.Array  # [J, 2], of the two that are held


def inverse_driven_mass(pair: Pair, rows: Constraints) -> jax.Array:
    """[J] 1/(kg m^2), of a slider 1/kg: how fast the bodies go along the axial row after a unit of impulse along it,
    with what the joint holds against it. Brakes and servos aim with this mass: an arm hung up beside its centre would
    take hundreds of passes to follow one that knows the axis alone."""
    held = vec2.dot(wrong_of_drive(pair, rows), held_answer(pair, rows))
    return jnp.maximum(inverse_mass(pair, rows.axial, rows.axial) - held, 0)


def wrong_of_drive(pair: Pair, rows: Constraints) -> jax.Array:
    """[J, 2] speeds along what is held that a unit of impulse along the axial row makes."""
    return jnp.stack([inverse_mass(pair, rows.axial, row) for row in (rows.first, rows.second)], -1)


def held_answer(pair: Pair, rows: Constraints) -> jax.Array:
    """[J, 2] impulses along what is held that undo those speeds if taken away."""
    wrong, mass = wrong_of_drive(pair, rows), held_mass(pair, rows)
    return jnp.stack([vec2.dot(mass[:, 0], wrong), vec2.dot(mass[:, 1], wrong)], -1)


def held_mass(pair: Pair, rows: Constraints) -> jax.Array:
    """Inverse of K, the 2 x 2 inverse effective mass of the two rows that are held, [J, 2, 2]."""
    k11 = inverse_mass(pair, rows.first, rows.first)
    k12 = inverse_mass(pair, rows.first, rows.second)
    k22 = inverse_mass(pair, rows.second, rows.second)
    return inverse_of_symmetric(k11, k12, jnp.where(k22 > 0, k22, 1))  # what cannot turn keeps its angle anyway


def welded_mass(pair: Pair, axial_mass: jax.Array, rows: Constraints) -> jax.Array:
    """The same where the angle is held, too: K less what a turn of both would take, without a difference of the two."""
    first, second = rows.first, rows.second
    mass, inertia = pair.mass_a + pair.mass_b, pair.inertia_a * pair.inertia_b * axial_mass
    x, y = first.lever_a - first.lever_b, second.lever_a - second.lever_b
    return inverse_of_symmetric(mass + inertia * x * x, inertia * x * y, mass + inertia * y * y)


def inverse_of_symmetric(k11: jax.Array, k12: jax.Array, k22: jax.Array) -> jax.Array:
    """[J, 2, 2]; 0 where there is none."""
    determinant = k11 * k22 - k12 * k12
    is_regular = determinant != 0
    inverse = jnp.where(is_regular, 1 / jnp.where(is_regular, determinant, 1), 0)
    rows = jnp.stack([jnp.stack([k22, -k12], -1), jnp.stack([-k12, k11], -1)], -2)
    return inverse[:, None, None] * rows
