"""Motors and limits along the axes of joints.

The impulse along an axis is one number: a motor's, bounded, and beyond that what limits need so that the speed is
between their bounds. So a joint has one of three speeds, and is held at it, or one of two impulses.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

NOTHING, MOTOR, LOWER, UPPER = range(4)  # what holds the speed along an axis


class AxialRows(NamedTuple):
    """Axial rows of J joints in one sub-step; holds, impulse, gain and is_still change while they are solved."""

    lowest: jax.Array  # [J] speeds that the limits allow
    highest: jax.Array
    target: jax.Array  # [J] speed of the motor
    least: jax.Array  # [J] impulses of the motor
    most: jax.Array
    holds: jax.Array  # [J] int
    impulse: jax.Array  # [J] to have where nothing is held
    before: jax.Array  # [J] speed that a round began with
    gain: jax.Array  # [J] what the round changed of it while nothing was held
    is_still: jax.Array  # [J] bool, a limit that holds still may pull

    @classmethod
    def of(cls, holds: jax.Array, like: jax.Array) -> AxialRows:
        """Rows of which only is known what they held before; like: [J] of the type of the other values."""
        zero = jnp.zeros_like(like)
        return cls(zero, zero, zero, zero, zero, holds, zero, zero, zero, jnp.zeros_like(holds, dtype=bool))

    @property
    def is_held(self) -> jax.Array:
        return self.holds != NOTHING

    @property
    def is_limit(self) -> jax.Array:
        return (self.holds == LOWER) | (self.holds == UPPER)

    @property
    def speed(self) -> jax.Array:
        """[J] at which they are held."""
        held = jnp.where(self.holds == LOWER, self.lowest, jnp.where(self.holds == UPPER, self.highest, self.target))
        return jnp.where(self.is_still & self.is_limit, jnp.clip(0, self.lowest, self.highest), held)

    @property
    def pushing(self) -> jax.Array:
        """[J] impulse of the motor while a limit holds."""
        upper = jnp.where(self.target < self.highest, self.least, self.most)
        return jnp.where(self.holds == LOWER, jnp.where(self.target > self.lowest, self.most, self.least), upper)


def begin(rows: AxialRows, speed: jax.Array, change: jax.Array) -> AxialRows:
    """Rows with what they held before, as far as that can be.

    change: [J] what a round is expected to change of the speed while nothing is held, as that of the sub-step before
    did. What is out of bounds then is held from the start.
    """
    can_drive = (rows.target > rows.lowest) & (rows.target < rows.highest) & (rows.least < rows.most)
    impulse = jnp.where(speed < rows.target, rows.most, rows.least)
    impulse = jnp.where(rows.target <= rows.lowest, rows.least, impulse)
    begun = rows._replace(
        holds=jnp.where((rows.holds == MOTOR) & ~can_drive, NOTHING, rows.holds),
        impulse=jnp.where(rows.target >= rows.highest, rows.most, impulse),
        before=speed,
        is_still=jnp.zeros_like(rows.is_still),
    )
    guessed, _ = choose(begun, speed + change, begun.impulse)
    return jax.tree.map(lambda held, guess: jnp.where(begun.is_held, held, guess), begun, guessed)


def choose(rows: AxialRows, speed: jax.Array, total: jax.Array) -> tuple[AxialRows, jax.Array]:
    """(rows, [J] bool which of them change). Each goes on to what is next to what it holds, if that cannot be with its
    speed and total impulse."""
    is_motor = rows.least < rows.most
    pushing = rows.pushing
    pulls = jnp.where(rows.holds == LOWER, total < pushing, total > pushing) & (rows.lowest != rows.highest)
    lets_go = jnp.where(rows.is_limit, pulls, (rows.holds == MOTOR) & ((total > rows.most) | (total < rows.least)))
    left = jnp.where(rows.is_limit, pushing, jnp.where(total > rows.most, rows.most, rows.least))
    pushes_up, pushes_down = (is_motor & (rows.impulse == bound) for bound in (rows.most, rows.least))
    above = jnp.where(pushes_up, jnp.minimum(rows.target, rows.highest), rows.highest)
    below = jnp.where(pushes_down, jnp.maximum(rows.target, rows.lowest), rows.lowest)
    met = jnp.where(speed < below, jnp.where(below == rows.lowest, LOWER, MOTOR), NOTHING)
    met = jnp.where(speed > above, jnp.where(above == rows.highest, UPPER, MOTOR), met)
    holds = jnp.where(rows.is_held, jnp.where(lets_go, NOTHING, rows.holds), met)
    chosen = rows._replace(
        holds=holds,
        impulse=jnp.where(lets_go, left, rows.impulse),
        gain=jnp.where(rows.is_held, rows.gain, speed - rows.before),
    )
    return chosen, holds != rows.holds


def settle(rows: AxialRows, total: jax.Array) -> AxialRows:
    """Rows that do not agree: a limit may pull for once, since nothing moves by it, and a motor has no more than it
    has."""
    drives = rows.holds == MOTOR
    return rows._replace(
        holds=jnp.where(drives, NOTHING, rows.holds),
        impulse=jnp.where(drives, jnp.clip(total, rows.least, rows.most), rows.impulse),
        is_still=jnp.ones_like(rows.is_still),
    )
