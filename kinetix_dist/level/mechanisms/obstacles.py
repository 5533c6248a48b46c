"""Obstacles on the way of a mechanism to its goal: pillars with a gap between them, or blocks in the air."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp

from jax2d.fields import Array
from kinetix_dist.level.level import WORLD_SIZE_M, Role
from kinetix_dist.level.mechanisms.template import Draws, Part
from kinetix_dist.level.walls import FLOOR_TOP_M

_NUM_PILLAR_DRAWS, _NUM_BLOCK_DRAWS = 11, 8


def num_obstacle_draws(num_blocks: int) -> int:
    """Uniform numbers that pillars and so many blocks use."""
    return _NUM_PILLAR_DRAWS + num_blocks * _NUM_BLOCK_DRAWS


def either(is_first: Array, first: list[Part], second: list[Part]) -> list[Part]:
    """The fixed boxes of one of two lists."""

    def one_of(a: Part, b: Part) -> Part:
        fields = ("position", "half", "role", "active")
        return dataclasses.replace(
            a, **{name: jnp.where(is_first, getattr(a, name), getattr(b, name)) for name in fields}
        )

    rest_of_first = [dataclasses.replace(part, active=part.active & is_first) for part in first[len(second) :]]
    rest_of_second = [dataclasses.replace(part, active=part.active & ~is_first) for part in second[len(first) :]]
    return [one_of(a, b) for a, b in zip(first, second, strict=False)] + rest_of_first + rest_of_second


def block(draws: Draws, within: Array) -> Part:
    """A box in the air between two x ([2] m), mostly red, sometimes tall, and not always active."""
    height = jnp.where(draws.chance(0.3), draws.between(0.3, 0.9), draws.between(0.08, 0.3))
    half = jnp.stack([draws.between(0.08, 0.3), height])
    x = draws.between(within[0], within[1])
    y = draws.between(FLOOR_TOP_M + half[1], WORLD_SIZE_M - half[1])
    widest = jnp.minimum(x - within[0], within[1] - x)
    role = jnp.where(draws.chance(0.7), Role.RED, Role.NONE)
    half = half.at[0].min(widest)
    return Part(
        position=jnp.stack([x, y]), half=half, role=role, is_fixed=True, active=draws.chance(0.7) & (widest > 0.04)
    )


def pillars(draws: Draws, gap: Array, x: Array, ends: Array, half_width: Array) -> list[Part]:
    """A pillar that stands and one that hangs, a gap (its half, m) between them; in six tenths all are red.

    In two thirds the second is at an x of its own between `ends` ([2] m). Where that leaves as much room, each may
    reach beyond the other's end: the way is over the one and below the other. A third may stand or hang elsewhere.
    """
    is_red, is_first_below = draws.chance(0.6), draws.chance(0.5)
    gap_y = draws.between(FLOOR_TOP_M + gap + 0.1, WORLD_SIZE_M - gap - 0.1)
    own_x = jnp.where(draws.chance(0.67), draws.between(ends[0], ends[1]), x)
    has_room = jnp.abs(own_x - x) > 2.0 * (gap + half_width)
    beyond = gap * jnp.where(has_room, draws.between(1.0, 2.0), 0.0)
    below = FLOOR_TOP_M, jnp.minimum(gap_y - gap + beyond, WORLD_SIZE_M - 2.0 * gap)
    above = jnp.maximum(gap_y + gap - beyond, FLOOR_TOP_M + 2.0 * gap), WORLD_SIZE_M
    role = jnp.where(is_red, Role.RED, Role.NONE)
    two = []
    # Where there is room for one alone, it is either.
    for pillar_x, is_below in ((x, is_first_below), (own_x, ~is_first_below)):
        bottom, top = (jnp.where(is_below, *ends) for ends in zip(below, above, strict=True))
        position, half = jnp.stack([pillar_x, 0.5 * (bottom + top)]), jnp.stack([half_width, 0.5 * (top - bottom)])
        two.append(Part(position=position, half=half, role=role, is_fixed=True))
    third_x, third_is_below = draws.between(ends[0], ends[1]), draws.chance(0.5)
    away = jnp.minimum(jnp.abs(third_x - x), jnp.abs(third_x - own_x))
    length = draws.between(0.1, 0.7) * (WORLD_SIZE_M - FLOOR_TOP_M)
    length = jnp.minimum(length, WORLD_SIZE_M - FLOOR_TOP_M - 2.0 * gap)
    middle = jnp.where(third_is_below, FLOOR_TOP_M + 0.5 * length, WORLD_SIZE_M - 0.5 * length)
    has_third = draws.chance(0.5) & (away > 2.0 * (gap + half_width))
    position, half = jnp.stack([third_x, middle]), jnp.stack([half_width, 0.5 * length])
    return [*two, Part(position=position, half=half, role=role, is_fixed=True, active=has_third)]
