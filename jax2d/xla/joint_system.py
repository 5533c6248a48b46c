"""Joints of one world as one linear system: three rows a joint, solved at once.

    H x = r          impulses x of the held rows that leave none of the speeds r

H is J M^-1 J^T. Its diagonal is larger by a share of the inverse masses, so that rows that contradict each other have
bounded impulses. It follows from where the bodies stand, and from which rows are held.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_solve

ROWS = 3  # of a joint; rows of zeros where it has fewer


class JointSystem(NamedTuple):
    """Rows in the order row of the joint, joint. Velocities of the bodies are one vector [3n]."""

    rows: jax.Array  # [3J, 3n] Jacobian
    inverse_mass: jax.Array  # [3n], x and y of each body, and its inverse inertia
    yielding: jax.Array  # [3J] speed at which a row yields to a unit of its impulse
    matrix: jax.Array  # H [3J, 3J] of all rows


def build(rows: jax.Array, inverse_mass: jax.Array, yielding: jax.Array, rounding: jax.Array) -> JointSystem:
    """See `JointSystem`. yielding, rounding: [3J], added to the diagonal of H."""
    matrix = times(rows * inverse_mass, rows.T)
    # A row that nothing can move has no speed: any entry will do.
    more = jnp.where(jnp.diagonal(matrix) > 0, yielding + rounding, 1)
    return JointSystem(rows, inverse_mass, yielding, matrix + jnp.diag(more))


def times(a: jax.Array, b: jax.Array) -> jax.Array:
    return jnp.matmul(a, b, precision=jax.lax.Precision.HIGHEST)


def solve(system: JointSystem, is_held: jax.Array, right: jax.Array) -> jax.Array:
    """Impulses x [3J, ...], of the held rows alone; right: [3J, ...]."""
    both = is_held[:, None] & is_held
    matrix = jnp.where(both, system.matrix, jnp.eye(is_held.shape[0], dtype=system.matrix.dtype))
    masked = jnp.where(is_held.reshape(is_held.shape + (1,) * (right.ndim - 1)), right, 0)
    return cho_solve((jnp.linalg.cholesky(matrix), True), masked)


def axial_inverse_mass(system: JointSystem, is_held: jax.Array) -> jax.Array:
    """[J], what impulses along held axes change of their speeds, all that is held held."""
    num_joints = is_held.shape[0] // ROWS
    units = jnp.eye(is_held.shape[0], num_joints, k=-(ROWS - 1) * num_joints, dtype=system.matrix.dtype)
    own = jnp.diagonal(solve(system, is_held, units)[-num_joints:])
    return jnp.where(own > 0, 1 / jnp.where(own > 0, own, 1), 0)


def pushed(system: JointSystem, velocities: jax.Array, impulses: jax.Array) -> jax.Array:
    """Velocities [3n] after impulses [3J]."""
    return velocities + system.inverse_mass * times(system.rows.T, impulses)
