"""Bodies that an impact has moved. Passes over joints and contacts are repeated for what holds or touches them until
none of these changes any more: an impact is shared out by all that it reaches, and costs nothing elsewhere."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jax2d.constants import CONSTANTS as C
from jax2d.xla import vec2
from jax2d.xla.bodies import Bodies, Pair, PairVelocities


class ActiveSet(NamedTuple):
    now: jax.Array  # [n] bool
    again: jax.Array  # [] bool, in a repeated pass: only what holds or touches these is solved
    only: jax.Array  # [n] bool, bodies that all passes are about

    @classmethod
    def everything(cls, bodies: Bodies) -> ActiveSet:
        return cls.of(jnp.ones(bodies.inverse_mass.shape, bool))

    @classmethod
    def of(cls, only: jax.Array) -> ActiveSet:
        return cls(only, jnp.array(False), only)

    def includes(self, pair: Pair) -> jax.Array:
        """[...] bool, pairs that are solved."""
        has_only, has_now = (jnp.any((pair.is_a | pair.is_b) & these, axis=-1) for these in (self.only, self.now))
        return has_only & (~self.again | has_now)

    def moves(self, before: PairVelocities, after: PairVelocities) -> jax.Array:
        """[] bool, whether a joint or spring calls for another pass: only one that a repeated pass changes does."""
        change = (after.velocity_b - before.velocity_b) - (after.velocity_a - before.velocity_a)
        return self.again & (vec2.dot(change, change) > C.settled_speed * C.settled_speed)


def marked(bodies: Bodies, pair: Pair, changed: jax.Array) -> jax.Array:
    """[n] bool, movable bodies of the pairs that have changed, [...] bool."""
    return jnp.any((pair.is_a | pair.is_b) & changed[:, None], axis=0) & bodies.is_dynamic
