"""Prediction of how far bodies move in a step: contacts are prepared within it, and found again beyond it."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.constants import CONSTANTS as C
from jax2d.solver_numbers import Scalar
from jax2d.xla import vec2
from jax2d.xla.bodies import Bodies, Pair
from jax2d.xla.geometry import Geometry
from jax2d.xla.pairs import least_distance


class Found(NamedTuple):
    """Which contacts hold until when, and of whom; bodies [n] bool."""

    last: jax.Array  # their contacts were found last, with each other's
    every: jax.Array  # their contacts are found in each sub-step
    waiting: jax.Array  # they have not moved yet in this sub-step
    left: Scalar  # s, of the step
    h: Scalar  # s, of the sub-step


class TravelPrediction(NamedTuple):
    """Motion of bodies as they have it when contacts are found, which go on so for `seconds`."""

    velocity: jax.Array  # [n, 2] m/s
    swing: jax.Array  # [n] m, how far each surface goes by turning, at most
    seconds: jax.Array  # [n]
    core: jax.Array  # [n] m
    arm: jax.Array  # [n] m, of what swings: a disc's surface does not leave its place by turning
    apart: jax.Array  # [n, n] m, surfaces of each pair at least


def predict_travel(bodies: Bodies, geometry: Geometry, seconds: Scalar) -> TravelPrediction:
    velocity, omega = bodies.velocities
    arm = geometry.extent - geometry.core
    swing = jnp.where(bodies.moves, arm * jnp.abs(omega) * seconds, 0)
    apart = least_distance(bodies, geometry)
    return TravelPrediction(velocity, swing, jnp.full_like(swing, seconds), geometry.core, arm, apart)


def predicted_travel(predicted: TravelPrediction) -> jax.Array:
    """Largest travel of the surfaces of each pair against each other, [n, n] m, of those found together."""
    v, swing = predicted.velocity, predicted.swing
    seconds = jnp.minimum(predicted.seconds[:, None], predicted.seconds[None])  # of what is fixed: the whole step
    return vec2.length(v[None] - v[:, None]) * seconds + swing[:, None] + swing[None]


def travel(bodies: Bodies, arm: jax.Array, seconds: jax.Array, a: np.ndarray, b: np.ndarray) -> jax.Array:
    """Largest travel of the surfaces of a[k] and b[k] against each other since contacts were found, [K] m, by the time
    when each has gone on as it does for its own `seconds` [2, K]."""
    velocity, omega = bodies.velocities
    of_a, of_b = seconds
    way = (velocity[b] - velocity[a]) * of_b[:, None] + velocity[a] * (of_b - of_a)[:, None]
    gone = vec2.length(bodies.delta[b] - bodies.delta[a]) + vec2.length(way)
    for i, left in ((a, of_a), (b, of_b)):
        gone += jnp.where(bodies.moves[i], arm[i] * (jnp.abs(bodies.turn[i]) + jnp.abs(omega[i]) * left), 0)
    return gone


def margins(predicted: TravelPrediction, reach: Scalar, *, ahead: bool) -> jax.Array:
    """Distance at which a contact of each pair is prepared, [n, n] m.

    `ahead`: within what both move against each other in a step if that is more than `reach`, so that no step ends
    inside; and within both where a body could step over what is in its way.
    """
    n, dtype = predicted.swing.shape[0], predicted.swing.dtype
    if not ahead:
        return jnp.full((n, n), reach, dtype)
    both = predicted_travel(predicted)
    safe = C.safe_core_share * jnp.minimum(predicted.core[:, None], predicted.core[None])
    return jnp.where(both > safe, reach + both, jnp.maximum(reach, both)).astype(dtype)


def outruns_contacts(
    bodies: Bodies,
    predicted: TravelPrediction,
    pair: Pair,
    can_touch: jax.Array,
    reach: Scalar,
    found: Found,
) -> jax.Array:
    """Bodies [n] bool that could meet without a contact, since they move on farther than was predicted: every margin
    has `reach` to spare. Where contacts of the two were not found together, those that could meet in this sub-step.
    can_touch [n, n], at [lower, higher]."""
    moves, (last, every, waiting, left, h) = bodies.moves, found
    a, b = np.triu_indices(moves.shape[0], 1)
    together = ~(moves[a] & moves[b]) | (last[a] == last[b])
    is_soon = ~together | (every & moves)[a] | (every & moves)[b]
    moved = jnp.where(waiting | ~moves, 0, h)
    seconds = jnp.where(is_soon, h, left) - jnp.stack([moved[a], moved[b]])
    distance = travel(bodies, predicted.arm, seconds, a, b)
    outruns = ~together | (distance - predicted_travel(predicted)[a, b] > reach)
    near = predicted.apart[a, b] <= distance
    has_contact = jnp.any(pair.is_a[:, a] & pair.is_b[:, b], axis=0)
    is_waiting = (waiting & moves)[a] | (waiting & moves)[b]
    marked = can_touch[a, b] & near & ~has_contact & outruns & is_waiting
    return jnp.zeros_like(moves).at[a].max(marked).at[b].max(marked) & moves
