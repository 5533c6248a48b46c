"""Bodies that a pass over joints and contacts is about: all of them, or those of islands that are solved again, or
those that an impact has moved. The last are passed over until nothing that holds or touches them changes any more: an
impact is shared out by all that it reaches, and costs nothing elsewhere."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jax2d.constants import CONSTANTS as C
from jax2d.xla import vec2
from jax2d.xla.bodies import Bodies, Pair, PairVelocities


class ActiveSet(NamedTuple):
    now: jax.Array  # [n] bool
    moved: jax.Array  # [n] bool, of these, by an impact in the pass before

    @classmethod
    def of(cls, only: jax.Array) -> ActiveSet:
        return cls(only, jnp.zeros_like(only))

    def includes(self, pair: Pair) -> jax.Array:
        """[...] bool, pairs that are solved."""
        return has_one_of(pair, self.now)

    def shares(self, pair: Pair) -> jax.Array:
        """[...] bool, pairs for which this is a repeated pass, of an impact."""
        return has_one_of(pair, self.moved)

    def includes_joined(self, pair: Pair, together: jax.Array) -> jax.Array:
        """[J] bool, joints that are solved: with any, all of its articulation (`together` [J, J] bool)."""
        return jnp.any(together & self.includes(pair), axis=1)

    def moves(self, before: PairVelocities, after: PairVelocities) -> jax.Array:
        """[...] bool, whether a joint or spring calls for another pass, if this is a repeated one."""
        change = (after.velocity_b - before.velocity_b) - (after.velocity_a - before.velocity_a)
        return vec2.dot(change, change) > C.settled_speed * C.settled_speed


def has_one_of(pair: Pair, these: jax.Array) -> jax.Array:
    """[...] bool, one of the pair's two is among these bodies [n] bool."""
    return jnp.any((pair.is_a | pair.is_b) & these, axis=-1)


def marked(bodies: Bodies, pair: Pair, changed: jax.Array) -> jax.Array:
    """[n] bool, movable bodies of the pairs that have changed, [...] bool."""
    return jnp.any((pair.is_a | pair.is_b) & changed[:, None], axis=0) & bodies.is_dynamic
