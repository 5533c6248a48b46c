"""Hard contacts of preset paper: sequential impulses as in the appendix of the Kinetix paper, one after another or, as
there, in batches."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jax2d.scene import Capacity
from jax2d.solver_numbers import SolverNumbers
from jax2d.xla import published, published_order, vec2
from jax2d.xla.bodies import Bodies, Velocities, apply_impulse, pair_velocities, relative_velocity, scatter_velocities
from jax2d.xla.contact_solver import rows_of, solve_friction, with_impulses
from jax2d.xla.contacts import Contacts
from jax2d.xla.rules import Rules


def solve_hard(
    bodies: Bodies, contacts: Contacts, params: SolverNumbers, rules: Rules, capacity: Capacity
) -> tuple[Bodies, Contacts]:
    """One iteration of sequential impulses (paper, appendix Collision Resolution): restitution target and penetration
    bias in the numerator, accumulated impulse never negative, friction by Coulomb's law."""
    bias = params.collision_correction / params.dt * jnp.maximum(-contacts.separation - params.slop, 0)
    wanted = bias - contacts.restitution * contacts.approach  # m/s, separating
    details, batch_size = rules.published_details, rules.solver_batch_size
    rows = rows_of(contacts)
    if "arms_follow_joints" in details:
        rows = published.arms_from_here(bodies, rows)

    def solve(velocities: Velocities, row: tuple) -> tuple[Velocities, tuple]:
        c, wanted = row
        before = of = pair_velocities(c.pair, velocities)
        vn = vec2.dot(c.normal, relative_velocity(of, c.arm_a, c.arm_b))
        normal_total = jnp.maximum(c.impulse_normal + c.mass_normal * (wanted - vn), 0)
        of = apply_impulse(of, c.pair, c.arm_a, c.arm_b, c.normal * (normal_total - c.impulse_normal)[..., None])
        of, tangent_total = solve_friction(of, c, normal_total)
        return scatter_velocities(velocities, c.pair, before, of), (normal_total, tangent_total)

    if "solve_order" in details:
        velocities, (normal, tangent) = published_order.in_turn(
            solve, bodies.velocities, rows, wanted, contacts.solve_order, published_order.num_batches(capacity, rules)
        )
    elif batch_size == 1:
        velocities, (normal, tangent) = jax.lax.scan(solve, bodies.velocities, (rows, wanted))
    else:
        velocities, (normal, tangent) = _in_batches(solve, bodies.velocities, (rows, wanted), batch_size)
    contacts = with_impulses(contacts, normal, tangent)
    if "last_pair" in details:
        assert contacts.solve_order is not None
        is_warm = ~contacts.solve_order.is_dropped
        contacts = contacts._replace(
            impulse_normal=jnp.where(is_warm, normal, 0), impulse_tangent=jnp.where(is_warm, tangent, 0)
        )
    return bodies._replace(velocities=velocities), contacts


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
