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
from jax2d.xla.pairs import bounds_overlap


class TravelPrediction(NamedTuple):
    """Largest travel of each surface at the speed that its body has when contacts are found."""

    distance: jax.Array  # [n] m
    core: jax.Array  # [n] m
    arm: jax.Array  # [n] m, of what swings: a disc's surface does not leave its place by turning
    lower: jax.Array  # [n, 2] m, bounds
    upper: jax.Array


def predict_travel(bodies: Bodies, geometry: Geometry, seconds: Scalar) -> TravelPrediction:
    arm = geometry.extent - geometry.core
    distance = travel(bodies, arm, seconds)
    return TravelPrediction(distance, geometry.core, arm, geometry.lower, geometry.upper)


def travel(bodies: Bodies, arm: jax.Array, left: Scalar) -> jax.Array:
    """Largest travel of each surface by the end of the step, [n] m."""
    velocity, omega = bodies.velocities
    gone = vec2.length(bodies.delta) + arm * jnp.abs(bodies.turn)
    there = gone + (vec2.length(velocity) + arm * jnp.abs(omega)) * left
    return jnp.where(bodies.moves, there, 0)


def margins(predicted: TravelPrediction, reach: Scalar, *, ahead: bool) -> jax.Array:
    """Distance at which a contact of each pair is prepared, [n, n] m.

    `ahead`: within what both move in a step if that is more than `reach`, so that no step ends inside; and within both
    where a body could step over what is in its way.
    """
    n, dtype = predicted.distance.shape[0], predicted.distance.dtype
    if not ahead:
        return jnp.full((n, n), reach, dtype)
    both = predicted.distance[:, None] + predicted.distance[None]
    safe = C.safe_core_share * jnp.minimum(predicted.core[:, None], predicted.core[None])
    return jnp.where(both > safe, reach + both, jnp.maximum(reach, both)).astype(dtype)


def outruns_contacts(
    bodies: Bodies, predicted: TravelPrediction, pair: Pair, can_touch: jax.Array, reach: Scalar, left: Scalar
) -> jax.Array:
    """Returns True if two bodies that move on for the `left` seconds of the step could meet without a contact, since
    they go farther than was predicted: every margin has `reach` to spare. can_touch [n, n], at [lower, higher]."""
    distance = travel(bodies, predicted.arm, left)
    farther = distance - predicted.distance
    a, b = np.triu_indices(farther.shape[0], 1)
    d = bodies.position[b] - bodies.position[a]
    near = bounds_overlap(predicted, a, b, d, distance[a] + distance[b])
    has_contact = jnp.any(pair.is_a[:, a] & pair.is_b[:, b], axis=0)
    return jnp.any(can_touch[a, b] & near & ~has_contact & (farther[a] + farther[b] > reach))
