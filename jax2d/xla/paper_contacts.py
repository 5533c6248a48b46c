"""Hard contacts of preset paper: sequential impulses as in the appendix of the Kinetix paper, one after another or, as
there, in batches."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jax2d.solver_numbers import SolverNumbers
from jax2d.xla import vec2
from jax2d.xla.bodies import Bodies, Velocities, apply_impulse, pair_velocities, relative_velocity, scatter_velocities
from jax2d.xla.contact_solver import Row, rows_of, solve_friction, with_impulses
from jax2d.xla.contacts import Contacts
from jax2d.xla.rules import Rules


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
