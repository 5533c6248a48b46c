"""Random levels with one mechanism: a car, a walker, a cart with a pole. Such levels are rare at random.

    build about the origin -> on the floor at one side -> goal at the other -> obstacle between -> permute slots

Arms and beams hang in the middle instead, with the goal within reach, and flyers begin in the air. Green is the carried
part (chassis, torso), the load, the balanced part, or the last link of an arm; blue is a circle. Only joined shapes
overlap at the start: green's side and the goal's are apart by construction. Everything is for one level, pure, and
works inside jit and vmap; sizes are those at which motors and thrusters of these powers move the mechanism.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.fields import Array
from jax2d.scene import Capacity
from kinetix_dist import prng
from kinetix_dist.level.draft import Draft, empty_draft, num_permutation_draws, with_green_and_blue_exchanged
from kinetix_dist.level.generator_config import GeneratorConfig
from kinetix_dist.level.level import WORLD_SIZE_M, Role
from kinetix_dist.level.mechanisms import FAMILIES, fitting_families
from kinetix_dist.level.mechanisms.obstacles import block, either, num_obstacle_draws, pillars
from kinetix_dist.level.mechanisms.registry import Family
from kinetix_dist.level.mechanisms.table import Table, choose, table_of, with_boxes, with_circle
from kinetix_dist.level.mechanisms.template import CLEARANCE_M, WALL_MARGIN_M, Draws, Part, Task, draw_numbers
from kinetix_dist.level.mechanisms.to_draft import with_table
from kinetix_dist.level.walls import FLOOR_TOP_M

GOAL_GAP_M = 0.3  # from the mechanism to the goal, at least
# Numbers drawn after those that a mechanism is built of; those of pillars and blocks are between the two.
_NUM_GOAL_DRAWS = 9  # the radius of the goal, its place and that of an obstacle
_NUM_LAST_DRAWS = 4  # besides three for each joint


def mechanism_draft(key: Array, capacity: Capacity, config: GeneratorConfig) -> tuple[Draft, Array]:
    """The draft of a level of one of `config.mechanism_families` that fit the capacity, and uniform numbers for
    `permute_slots`. Consumes `key`.

    Raises ValueError where none of them fits.
    """
    names = fitting_families(config.mechanism_families, capacity)
    weights = [weight for family, weight in config.weight_of_family.items() if family in names]
    if not names:
        of = f"{capacity.polygons} polygons, {capacity.circles} circles, {capacity.joints} joints"
        raise ValueError(
            f"no family of mechanism_families {', '.join(config.mechanism_families)} has room in {of} and "
            f"{capacity.thrusters} thrusters; use a larger size or other families"
        )
    keys = prng.split(key, 1 + len(names))
    chosen = _choose(keys[0], weights)
    # All families are built, of the numbers of the chosen one.
    numbers = draw_numbers(keys[1 + chosen])
    tables, num_blocks = _tables([FAMILIES[name] for name in names], numbers, capacity)
    draft = _draft(choose(tables, chosen), num_blocks, numbers, capacity, config)
    return draft, prng.uniform(prng.fold_in(keys[0], 1), (num_permutation_draws(draft),))


def _choose(key: Array, weights: Sequence[float]) -> Array:
    """int32, one of as many as there are weights. Consumes `key`."""
    if len(set(weights)) == 1:
        return prng.randint(key, (), 0, len(weights))
    ends = np.cumsum(np.asarray(weights) / max(weights)).astype(np.float32)  # any floats: float32 may not hold them
    return jnp.searchsorted(ends[:-1], prng.uniform(key) * ends[-1], side="right").astype(jnp.int32)


def _tables(families: Sequence[Family], numbers: Array, capacity: Capacity) -> tuple[list[Table], int | None]:
    """A table of each family, built of the first of the numbers ([80]), and how many blocks those with a gap may have
    (None: none has a gap)."""
    each, mechanisms, num_draws = jax.lax.unstack(numbers), [], []
    for family in families:
        draws = Draws(each)
        mechanisms.append(family.build(draws, capacity))
        num_draws.append(draws.num_used)
    num_joints = max(len(mechanism.joints) for mechanism in mechanisms)
    num_blocks = {mechanism.num_blocks for mechanism in mechanisms if mechanism.task.gap.is_given}
    assert len(num_blocks) <= 1
    for mechanism, num in zip(mechanisms, num_draws, strict=True):
        task = mechanism.task
        num_way = num_obstacle_draws(mechanism.num_blocks) if task.gap.is_given else 0
        assert num + _NUM_GOAL_DRAWS + num_way + _NUM_LAST_DRAWS + 3 * len(mechanism.joints) <= len(each)
        assert not task.slab.is_given or not (task.has_bump or task.gap.is_given)  # both would be in the next row
    tables = [table_of(mechanism, num, capacity, num_joints) for mechanism, num in zip(mechanisms, num_draws)]
    return tables, max(num_blocks, default=None)


def _draft(table: Table, num_blocks: int | None, numbers: Array, capacity: Capacity, config: GeneratorConfig) -> Draft:
    """The mechanism, its goal and obstacles between, from the numbers ([80]) after those that it was built of."""
    padded = jnp.pad(numbers, (0, len(numbers)))  # beyond the last one: for families that do not use it
    task = table.task

    def draws_after(num_before: Array | int, number: int) -> Draws:
        some = jax.lax.dynamic_slice_in_dim(padded, table.num_draws + num_before, number)
        return Draws(jax.lax.unstack(some))

    num_way_draws = 0 if num_blocks is None else num_obstacle_draws(num_blocks)
    of_goal, of_way = draws_after(0, _NUM_GOAL_DRAWS), draws_after(_NUM_GOAL_DRAWS, num_way_draws)
    # Of a mechanism that stays in its place only the radius is drawn before the last ones.
    num_before = _NUM_GOAL_DRAWS + jnp.where(task.gap.is_given, num_way_draws, 0)
    last = draws_after(
        jnp.where(task.middle.is_given, 0, num_before), _NUM_LAST_DRAWS + 3 * np.shape(table.joints.a)[0]
    )
    radius = task.goal_radius.or_else(of_goal.between(0.12, 0.28))
    table, goal = _with_goal(of_goal, of_way, table, num_blocks, radius)
    blue_is_fixed = last.chance(0.7) | task.middle.is_given
    blue = Part(position=goal, half=task.slab.filled, radius=radius, role=Role.BLUE, is_fixed=blue_is_fixed)
    slab = dataclasses.replace(blue, active=task.goal_is_slab)
    # A disc in place of a slab is fixed in the air: one that fell would be behind the wall of a carrier.
    disc = dataclasses.replace(blue, active=~task.goal_is_slab, is_fixed=blue_is_fixed | task.slab.is_given)
    table = with_circle(with_boxes(table, [slab]), disc)
    floor_is_red = task.floor_is_red.or_else(last.chance(config.floor_red_chance))
    draft = empty_draft(capacity)
    role = draft.shapes.role.at[0].set(jnp.where(floor_is_red, Role.RED, Role.NONE))
    draft = dataclasses.replace(draft, shapes=dataclasses.replace(draft.shapes, role=role))
    draft = with_table(last, draft, table, capacity, config)
    return with_green_and_blue_exchanged(draft, task.goal_is_green)


def _with_goal(draws: Draws, way: Draws, table: Table, num_blocks: int | None, radius: Array) -> tuple[Table, Array]:
    """The mechanism at the left with obstacles between it and its goal, and the centre of the goal to the right of it
    ([2] m); all of it mirrored half of the time. A mechanism that stays in its place is at `task.middle` instead."""
    task, is_placed = table.task, table.task.middle.is_given
    lowest, highest = table.extent()
    width = highest[0] - lowest[0]
    left = WALL_MARGIN_M + draws.between(0.0, 0.5)
    nearest = left + width + GOAL_GAP_M
    radius = jnp.where(task.goal_is_slab, task.slab.filled[0], radius)
    share = _to_power(draws.between(0.0, 1.0), task)
    goal_x = nearest + radius + share * (WORLD_SIZE_M - WALL_MARGIN_M - radius - (nearest + radius))
    rise = task.goal_rise_low + draws.between(0.0, 1.0) * task.goal_rise_span
    goal_y = FLOOR_TOP_M + CLEARANCE_M + radius + rise * (highest[1] - lowest[1])
    goal_y = task.goal_height.or_else(goal_y)
    goal_y = jnp.where(task.goal_is_slab, FLOOR_TOP_M + CLEARANCE_M + task.slab.filled[1], goal_y)
    bump_half = jnp.stack([draws.between(0.03, 0.1), draws.between(0.02, 0.08)])
    obstacle_ends = jnp.stack([left + width, goal_x - radius]) + np.array([1.0, -1.0], np.float32) * (
        bump_half[0] + 0.03
    )
    obstacle_x = draws.between(obstacle_ends[0], obstacle_ends[1])
    has_obstacle = draws.chance(0.4)
    is_mirrored = draws.chance(0.5)
    is_turned = is_mirrored & task.is_handed & ~is_placed
    table = table.mirrored(is_turned)
    ends = jnp.where(is_turned, jnp.stack([-highest[0], -lowest[0]]), jnp.stack([lowest[0], highest[0]]))
    middle_x = jnp.where(is_mirrored, WORLD_SIZE_M - left - ends[1], left - ends[0])
    goal_x = jnp.where(is_mirrored, WORLD_SIZE_M - goal_x, goal_x)
    obstacle_x = jnp.where(is_mirrored, WORLD_SIZE_M - obstacle_x, obstacle_x)
    obstacle_ends = jnp.where(is_mirrored, WORLD_SIZE_M - obstacle_ends[::-1], obstacle_ends)
    on_floor = jnp.stack([middle_x, FLOOR_TOP_M + CLEARANCE_M + task.height - lowest[1]])
    table = table.moved(jnp.where(is_placed, task.middle.filled, on_floor))
    goal = jnp.where(is_placed, task.middle.filled + task.goal, jnp.stack([goal_x, goal_y]))
    bump = Part(
        position=jnp.stack([obstacle_x, FLOOR_TOP_M + bump_half[1]]),
        half=bump_half,
        is_fixed=True,
        active=has_obstacle & task.has_bump & ~is_placed,
    )
    if num_blocks is None:
        return with_boxes(table, [bump]), goal
    has_way = task.gap.is_given & ~is_placed
    between = jnp.sort(jnp.stack([middle_x + 0.5 * (ends[0] + ends[1]), goal_x]))
    within = between + np.array([1.0, -1.0]) * (jnp.maximum(radius, 0.5 * width) + CLEARANCE_M)
    some_pillars = pillars(way, task.gap.filled, obstacle_x, obstacle_ends, bump_half[0])
    is_pillars = way.chance(0.65)
    blocks = [block(way, within) for _ in range(num_blocks)]
    obstacles = either(has_way, either(is_pillars, some_pillars, blocks), [bump])
    return with_boxes(table, obstacles), goal


def _to_power(share: Array, task: Task) -> Array:
    """share ** goal_nearness; a power that is not drawn is multiplied out."""
    known = jax.lax.select_n(jnp.asarray(task.goal_nearness), jnp.ones((), jnp.float32), share, share**2, share**3)
    return jnp.where(task.drawn_nearness.is_given, share**task.drawn_nearness.filled, known)
