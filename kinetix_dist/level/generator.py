"""Random levels, drawn on the device inside jit (paper, section 4, "Environment Generator").

    walls -> green and blue -> a forced control -> more shapes -> thrusters -> swap green and blue -> permute slots

A level grows one shape at a time: each addition draws several proposals (`proposals.py`) and keeps the one with the
fewest overlaps. Free and joined shapes are one code path and additions are steps of one `lax.scan`, so the program is
as small for L as for S and compiles in seconds. Everything is for one level; `generate_levels` is the batch.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.fields import Array
from jax2d.scene import Capacity, Thrusters
from kinetix_dist import prng
from kinetix_dist.level.derive import derive
from kinetix_dist.level.draft import (
    Draft,
    DrivenThrusters,
    draft_to_level,
    empty_draft,
    first_free,
    num_permutation_draws,
    permute_slots,
    read_slot,
    with_green_and_blue_exchanged,
    write_slot,
)
from kinetix_dist.level.fit import capacity_of_size
from kinetix_dist.level.generator_config import GeneratorConfig
from kinetix_dist.level.level import NUM_THRUSTER_COLOURS, NUM_WALLS, Level, Role
from kinetix_dist.level.mechanisms.mechanism_draft import mechanism_draft
from kinetix_dist.level.proposals import NUM_DRAWS, Request, add_best, pick, point_inside, propose, shape_mass
from kinetix_dist.level.variety import vary

__all__ = ["GeneratorConfig", "generate_level", "generate_levels"]

_NUM_FIRST = 3  # green, blue, and the shape that a forced motor needs
_NUM_THRUSTER_DRAWS = 9
_MECHANISM_STREAM = 0x4C4F  # "LO": folded into a level's key
_VARIETY_STREAM = 0x5641  # "VA"


def generate_level(key: Array, capacity: Capacity, config: GeneratorConfig) -> Level:
    """One random level. Exactly one green and one blue, at least one motor or thruster. Consumes `key`.

    Of the levels a share `config.mechanism_share` has one mechanism; a share `config.varied_share` has other physics.
    """
    draft, order = _draft(key, capacity, config)
    level = derive(*draft_to_level(permute_slots(order, draft, capacity.polygons), capacity))
    if config.varied_share == 0.0:
        return level
    return vary(prng.fold_in(key, _VARIETY_STREAM), level, config.varied_share)


def _draft(key: Array, capacity: Capacity, config: GeneratorConfig) -> tuple[Draft, Array]:
    """The draft of a level, and uniform numbers for `permute_slots`."""
    if config.mechanism_share == 0.0:
        return _random_draft(key, capacity, config)
    has_mechanism = prng.uniform(prng.fold_in(key, _MECHANISM_STREAM)) < config.mechanism_share
    with_mechanism = mechanism_draft(prng.fold_in(key, _MECHANISM_STREAM + 1), capacity, config)
    if config.mechanism_share == 1.0:
        return with_mechanism
    # Other levels are those of the key without mechanisms.
    either = (with_mechanism, _random_draft(key, capacity, config))
    return jax.tree.map(lambda *of: jnp.where(has_mechanism, *of), *either)


def _random_draft(key: Array, capacity: Capacity, config: GeneratorConfig) -> tuple[Draft, Array]:
    _check_capacity(capacity)
    draft = empty_draft(capacity)
    num_steps = capacity.shapes - NUM_WALLS
    shapes_key, rest_key = prng.split(key)
    # Everything but the proposals from one call: each call of the generator of random numbers is code to compile.
    sizes = (4, num_steps, capacity.thrusters * _NUM_THRUSTER_DRAWS, num_permutation_draws(draft))
    coins, kinds, thruster_draws, order_draws = jnp.split(prng.uniform(rest_key, (sum(sizes),)), np.cumsum(sizes)[:-1])
    control = 3.0 * coins[0]  # 0..1: motor, 1..2: thruster, 2..3: both
    force_motor, force_thruster = (control < 1.0) | (control >= 2.0), control >= 1.0

    draft = _paint_floor(coins[1], draft, config)
    draft = _add_shapes(shapes_key, kinds, coins[2], draft, force_motor, capacity, config)
    draft = _add_thrusters(thruster_draws.reshape(capacity.thrusters, -1), draft, force_thruster, config)
    return _swap_green_and_blue(coins[3], draft), order_draws


@functools.partial(jax.jit, static_argnames=("num_levels", "capacity", "config"))
def generate_levels(key: Array, num_levels: int, capacity: Capacity, config: GeneratorConfig) -> Level:
    """A batch, `[num_levels, ...]` on every field. Level i depends on `key` and i alone, not on `num_levels`."""
    return jax.vmap(lambda one: generate_level(one, capacity, config))(level_keys(key, num_levels))


def level_keys(key: Array, num_levels: int) -> Array:
    """[num_levels], of the levels of a batch. Consumes `key`."""
    return jax.vmap(functools.partial(prng.fold_in, key))(jnp.arange(num_levels))


class LevelGenerator(Protocol):
    """Pure; works inside jit."""

    def generate(self, key: Array, num_levels: int) -> Level:
        """[num_levels, ...] valid levels. Consumes `key`."""


@dataclasses.dataclass(frozen=True)
class RandomLevels:
    """The random levels of `generator.py`."""

    capacity: Capacity
    config: GeneratorConfig

    def generate(self, key: Array, num_levels: int) -> Level:
        return generate_levels(key, num_levels, self.capacity, self.config)


def _check_capacity(capacity: Capacity) -> None:
    free = capacity.shapes - NUM_WALLS
    if capacity.polygons <= NUM_WALLS or free < _NUM_FIRST or capacity.joints < 1 or capacity.thrusters < 1:
        raise ValueError(
            f"the generator needs room for {_NUM_FIRST} shapes besides the walls (one a polygon), 1 joint and 1 "
            f"thruster; capacity has {capacity.polygons} polygons with {NUM_WALLS} walls, {capacity.circles} circles, "
            f"{capacity.joints} joints and {capacity.thrusters} thrusters"
        )


def _paint_floor(draw: Array, draft: Draft, config: GeneratorConfig) -> Draft:
    is_blue = draw < config.floor_blue_chance
    is_red = ~is_blue & (draw < config.floor_blue_chance + config.floor_red_chance)
    role = jnp.where(is_blue, Role.BLUE, jnp.where(is_red, Role.RED, Role.NONE)).astype(jnp.int32)
    shapes = draft.shapes
    return dataclasses.replace(draft, shapes=dataclasses.replace(shapes, role=shapes.role.at[0].set(role)))


def _add_shapes(
    key: Array,
    kinds: Array,
    coin: Array,
    draft: Draft,
    force_motor: Array,
    capacity: Capacity,
    config: GeneratorConfig,
) -> Draft:
    """Green and blue, the forced motor's shape or a free one, then whatever chance says."""
    num_steps = capacity.shapes - NUM_WALLS
    is_small = num_steps <= _NUM_FIRST
    num_proposals = config.num_proposals_s if is_small else config.num_proposals
    allow_fixed = not is_small if config.allow_fixed is None else config.allow_fixed
    # One of green and blue can move, whatever happens: the first if the floor is the goal.
    first_moves = (coin < 0.5) | (draft.shapes.role[0] == Role.BLUE)

    def addition(draft: Draft, step_and_kind: tuple[Array, Array]) -> tuple[Draft, None]:
        step, kind = step_and_kind
        is_chance = step >= _NUM_FIRST
        wants_motor = (step == _NUM_FIRST - 1) & force_motor
        is_joined = wants_motor | (is_chance & (kind < config.joined_shape_chance))
        is_wanted = ~is_chance | (kind < config.joined_shape_chance + config.free_shape_chance)
        must_move = ((step == 0) & first_moves) | ((step == 1) & ~first_moves)
        request = Request(
            is_joined=is_joined, force_motor=wants_motor, may_be_fixed=allow_fixed & ~must_move, step=step
        )
        draws = prng.uniform(prng.fold_in(key, step), (num_proposals, NUM_DRAWS))
        proposals = jax.vmap(lambda draw: propose(draft, request, draw, capacity.polygons, config))(draws)
        return add_best(draft, proposals, is_joined, is_wanted), None

    steps = jnp.arange(num_steps, dtype=jnp.int32)
    draft, _ = jax.lax.scan(addition, draft, (steps, kinds))
    return draft


def _add_thrusters(draws: Array, draft: Draft, force_thruster: Array, config: GeneratorConfig) -> Draft:
    """The forced one on one of the first shapes, then one more at most for each slot but the first."""
    num_thrusters = draft.thrusters.active.shape[0]

    def addition(draft: Draft, step_and_draw: tuple[Array, Array]) -> tuple[Draft, None]:
        step, draw = step_and_draw
        is_wanted = jnp.where(step == 0, force_thruster, draw[0] < config.thruster_chance)
        shapes = draft.shapes
        may_carry = shapes.active & ~shapes.is_fixed & ((step > 0) | (shapes.added_at < _NUM_FIRST))
        body = pick(may_carry.astype(jnp.float32), draw[1])
        shape = read_slot(shapes, body)
        position = point_inside(shape, draw[2:4])
        outwards = jnp.arctan2(position[1], position[0]) + jnp.where(draw[4] < 0.5, math.pi, 0.0)
        angle = jnp.where(draw[5] < config.thruster_aligned_chance, outwards, 2.0 * math.pi * draw[6])
        thruster = Thrusters(
            active=jnp.array(True),
            body=body,
            position=position,
            angle=angle,
            power=shape_mass(shape) * config.thruster_power_factor * (0.5 + 1.5 * draw[7]),
        )
        colour = jnp.floor(draw[8] * NUM_THRUSTER_COLOURS).astype(jnp.int32)
        driven = DrivenThrusters(thrusters=thruster, colour=colour)
        slot = first_free(draft.thrusters.active)
        thrusters = write_slot(draft.driven_thrusters, slot, driven, is_wanted & may_carry.any())
        return dataclasses.replace(draft, driven_thrusters=thrusters), None

    draft, _ = jax.lax.scan(addition, draft, (jnp.arange(num_thrusters), draws))
    return draft


def _swap_green_and_blue(coin: Array, draft: Draft) -> Draft:
    """Removes the bias of green to the left and of green being added first, unless the floor plays a role."""
    return with_green_and_blue_exchanged(draft, (coin < 0.5) & (draft.shapes.role[0] == Role.NONE))


OVERSAMPLING = 2  # levels drawn for each one returned; about one in ten solves itself


def generate_filtered(
    key: Array,
    num_levels: int,
    size: str,
    config: GeneratorConfig,
    noop_outcome_fn: Callable[[Level], Array],
) -> Level:
    """`num_levels` random levels of a size, without levels that solve themselves (paper, section 4).

    Draws twice as many and returns the first ones that `noop_outcome_fn(levels) -> [W] bool` does not call solved, in
    the order drawn. If more than half of the draw is solved, the last ones are among the solved. Pure; works
    inside jit. Consumes `key`.
    """
    drawn = generate_levels(key, OVERSAMPLING * num_levels, capacity_of_size(size), config)
    return keep_unsolved(drawn, noop_outcome_fn(drawn), num_levels)


@functools.partial(jax.jit, static_argnames="num_levels")
def keep_unsolved(levels: Level, is_solved: Array, num_levels: int) -> Level:
    """The first `num_levels` of a batch that are not solved, then solved ones if there are not enough."""
    order = jnp.argsort(is_solved, stable=True)[:num_levels]
    return jax.tree.map(lambda x: x[order], levels)
