"""Random levels with one thing that can do something: a car, a walker, a cart with a pole. Such are rare at random.

    build about the origin -> on the floor at one side -> goal at the other -> obstacle between -> permute slots

Arms and beams hang in the middle instead, with the goal within reach, and flyers begin in the air. Green is what is
carried (chassis, torso), pushed or balanced, or the last link of an arm; blue is a circle. Nothing overlaps at the
start but what is joined: green's side and the goal's are apart by construction. Everything is for one level, pure, and
works inside jit and vmap; sizes are those at which motors and jets of these powers move the thing.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.fields import Array
from jax2d.scene import Capacity
from kinetix_dist import prng
from kinetix_dist.level import bodies
from kinetix_dist.level.bodies import CLEARANCE_M, WALL_MARGIN_M
from kinetix_dist.level.draft import (
    Draft,
    empty_draft,
    with_green_and_blue_exchanged,
)
from kinetix_dist.level.generator_config import GeneratorConfig
from kinetix_dist.level.level import NUM_WALLS, WORLD_SIZE_M
from kinetix_dist.level.permute import num_permutation_draws
from kinetix_dist.level.roles import Role
from kinetix_dist.level.thing_tables import Table, choose, table_of, with_boxes, with_circle, with_table
from kinetix_dist.level.things import Draws, Part, Thing, draw_numbers
from kinetix_dist.level.walls import FLOOR_TOP_M

GOAL_GAP_M = 0.3  # from the thing to the goal, at least
# Numbers that are drawn after those that a thing is built of, in this order
_NUM_BESIDE_DRAWS = 9  # the radius of the goal, where it is and whether there is an obstacle
_NUM_PILLAR_DRAWS, _NUM_BLOCK_DRAWS = 11, 8  # where there is a gap
_NUM_LAST_DRAWS = 4  # besides three for each hinge


def locomotion_draft(key: Array, capacity: Capacity, config: GeneratorConfig) -> tuple[Draft, Array]:
    """What is in a level of a kind that `config.locomotion_kinds` names and the capacity has room for, and uniform
    numbers for `permute_slots`. Consumes `key`.

    Raises ValueError where there is room for none of them.
    """
    kinds = fitting_kinds(config.locomotion_kinds, capacity)
    weights = [weight for kind, weight in config.weight_of_kind.items() if kind in kinds]
    if not kinds:
        of = f"{capacity.polygons} polygons, {capacity.circles} circles, {capacity.joints} joints"
        raise ValueError(
            f"no kind of locomotion_kinds {', '.join(config.locomotion_kinds)} has room in {of} and "
            f"{capacity.thrusters} thrusters; use a larger size or other kinds"
        )
    keys = prng.split(key, 1 + len(kinds))
    chosen = _choose(keys[0], weights)
    # All kinds are built, of the numbers of the chosen one.
    numbers = draw_numbers(keys[1 + chosen])
    tables, num_blocks = _tables([_KINDS[kind] for kind in kinds], numbers, capacity)
    draft = _draft(choose(tables, chosen), num_blocks, numbers, capacity, config)
    return draft, prng.uniform(prng.fold_in(keys[0], 1), (num_permutation_draws(draft),))


def _choose(key: Array, weights: Sequence[float]) -> Array:
    """int32, one of as many as there are weights. Consumes `key`."""
    if len(set(weights)) == 1:
        return prng.randint(key, (), 0, len(weights))
    ends = np.cumsum(np.asarray(weights) / max(weights)).astype(np.float32)  # any floats: float32 may not hold them
    return jnp.searchsorted(ends[:-1], prng.uniform(key) * ends[-1], side="right").astype(jnp.int32)


def fitting_kinds(kinds: Sequence[str], capacity: Capacity) -> list[str]:
    """Those for which there is room."""
    return [kind for kind in kinds if _KINDS[kind].fits(capacity)]


def _tables(kinds: Sequence[_Kind], numbers: Array, capacity: Capacity) -> tuple[list[Table], int | None]:
    """A table of each kind, built of the first of the numbers ([80]), and how many blocks those with a gap may have
    (None: none has a gap)."""
    each, things, num_draws = jax.lax.unstack(numbers), [], []
    for kind in kinds:
        draws = Draws(each)
        things.append(kind.build(draws, capacity))
        num_draws.append(draws.num_used)
    num_hinges = max(len(thing.hinges) for thing in things)
    num_blocks = {thing.num_blocks for thing in things if thing.gap is not None}
    assert len(num_blocks) <= 1
    for thing, num in zip(things, num_draws, strict=True):
        num_way = 0 if thing.gap is None else _NUM_PILLAR_DRAWS + thing.num_blocks * _NUM_BLOCK_DRAWS
        assert num + _NUM_BESIDE_DRAWS + num_way + _NUM_LAST_DRAWS + 3 * len(thing.hinges) <= len(each)
        assert thing.slab is None or not (thing.has_bump or thing.gap is not None)  # both would be in the next row
    tables = [table_of(thing, num, capacity, num_hinges) for thing, num in zip(things, num_draws, strict=True)]
    return tables, max(num_blocks, default=None)


def _draft(table: Table, num_blocks: int | None, numbers: Array, capacity: Capacity, config: GeneratorConfig) -> Draft:
    """The thing, its goal and what is between them, from the numbers ([80]) after those that it was built of."""
    padded = jnp.pad(numbers, (0, len(numbers)))  # what is beyond the last one is for kinds that do not use it

    def draws_after(num_before: Array | int, number: int) -> Draws:
        some = jax.lax.dynamic_slice_in_dim(padded, table.num_draws + num_before, number)
        return Draws(jax.lax.unstack(some))

    num_way_draws = 0 if num_blocks is None else _NUM_PILLAR_DRAWS + num_blocks * _NUM_BLOCK_DRAWS
    beside, way = draws_after(0, _NUM_BESIDE_DRAWS), draws_after(_NUM_BESIDE_DRAWS, num_way_draws)
    # Of what cannot go anywhere only the radius is drawn before the last ones.
    num_before = _NUM_BESIDE_DRAWS + jnp.where(table.gap.is_given, num_way_draws, 0)
    last = draws_after(jnp.where(table.is_placed, 0, num_before), _NUM_LAST_DRAWS + 3 * len(table.hinges.a))
    radius = table.goal_radius.otherwise(beside.between(0.12, 0.28))
    table, goal = _beside_its_goal(beside, way, table, num_blocks, radius)
    blue_is_fixed = last.chance(0.7) | table.is_placed
    blue = Part(position=goal, half=table.slab.value, radius=radius, role=Role.BLUE, is_fixed=blue_is_fixed)
    slab = dataclasses.replace(blue, active=table.goal_is_slab)
    # A disc in place of a slab hangs: one that fell is behind the wall of what carries the load.
    disc = dataclasses.replace(blue, active=~table.goal_is_slab, is_fixed=blue_is_fixed | table.slab.is_given)
    table = with_circle(with_boxes(table, [slab]), disc)
    floor_is_red = table.floor_is_red.otherwise(last.chance(config.floor_red_chance))
    draft = empty_draft(capacity)
    role = draft.shapes.role.at[0].set(jnp.where(floor_is_red, Role.RED, Role.NONE))
    draft = dataclasses.replace(draft, shapes=dataclasses.replace(draft.shapes, role=role))
    draft = with_table(last, draft, table, capacity, config)
    return with_green_and_blue_exchanged(draft, table.goal_is_green)


def _beside_its_goal(
    draws: Draws, way: Draws, table: Table, num_blocks: int | None, radius: Array
) -> tuple[Table, Array]:
    """The thing at the left with what is between it and its goal, and the centre of the goal to the right of it ([2]
    m); all of it mirrored half of the time. What cannot go anywhere is where it says instead."""
    lowest, highest = table.extent()
    width = highest[0] - lowest[0]
    left = WALL_MARGIN_M + draws.between(0.0, 0.5)
    nearest = left + width + GOAL_GAP_M
    radius = jnp.where(table.goal_is_slab, table.slab.value[0], radius)
    share = _to_power(draws.between(0.0, 1.0), table)
    goal_x = nearest + radius + share * (WORLD_SIZE_M - WALL_MARGIN_M - radius - (nearest + radius))
    rise = table.goal_rise_low + draws.between(0.0, 1.0) * table.goal_rise_span
    goal_y = FLOOR_TOP_M + CLEARANCE_M + radius + rise * (highest[1] - lowest[1])
    goal_y = table.goal_height.otherwise(goal_y)
    goal_y = jnp.where(table.goal_is_slab, FLOOR_TOP_M + CLEARANCE_M + table.slab.value[1], goal_y)
    bump_half = jnp.stack([draws.between(0.03, 0.1), draws.between(0.02, 0.08)])
    obstacle_ends = jnp.stack([left + width, goal_x - radius]) + np.array([1.0, -1.0], np.float32) * (
        bump_half[0] + 0.03
    )
    obstacle_x = draws.between(obstacle_ends[0], obstacle_ends[1])
    has_obstacle = draws.chance(0.4)
    is_mirrored = draws.chance(0.5)
    is_turned = is_mirrored & table.is_handed & ~table.is_placed
    table = table.mirrored(is_turned)
    ends = jnp.where(is_turned, jnp.stack([-highest[0], -lowest[0]]), jnp.stack([lowest[0], highest[0]]))
    middle_x = jnp.where(is_mirrored, WORLD_SIZE_M - left - ends[1], left - ends[0])
    goal_x = jnp.where(is_mirrored, WORLD_SIZE_M - goal_x, goal_x)
    obstacle_x = jnp.where(is_mirrored, WORLD_SIZE_M - obstacle_x, obstacle_x)
    obstacle_ends = jnp.where(is_mirrored, WORLD_SIZE_M - obstacle_ends[::-1], obstacle_ends)
    beside = jnp.stack([middle_x, FLOOR_TOP_M + CLEARANCE_M + table.height - lowest[1]])
    table = table.moved(jnp.where(table.is_placed, table.middle, beside))
    goal = jnp.where(table.is_placed, table.middle + table.goal, jnp.stack([goal_x, goal_y]))
    bump = Part(
        position=jnp.stack([obstacle_x, FLOOR_TOP_M + bump_half[1]]),
        half=bump_half,
        is_fixed=True,
        active=has_obstacle & table.has_bump & ~table.is_placed,
    )
    if num_blocks is None:
        return with_boxes(table, [bump]), goal
    has_way = table.gap.is_given & ~table.is_placed
    between = jnp.sort(jnp.stack([middle_x + 0.5 * (ends[0] + ends[1]), goal_x]))
    within = between + np.array([1.0, -1.0]) * (jnp.maximum(radius, 0.5 * width) + CLEARANCE_M)
    pillars = _pillars(way, table.gap.value, obstacle_x, obstacle_ends, bump_half[0])
    is_pillars = way.chance(0.65)
    blocks = [_block(way, within) for _ in range(num_blocks)]
    obstacles = _either(has_way, _either(is_pillars, pillars, blocks), [bump])
    return with_boxes(table, obstacles), goal


def _to_power(share: Array, table: Table) -> Array:
    """share ** goal_nearness. Where the power is known, multiplied out: levels of a key stay what they are."""
    known = jax.lax.select_n(jnp.asarray(table.goal_nearness), jnp.ones((), jnp.float32), share, share**2, share**3)
    return jnp.where(table.is_nearness_known, known, share**table.goal_nearness)


def _either(is_first: Array, first: list[Part], second: list[Part]) -> list[Part]:
    """The fixed boxes of one of two lists."""

    def one_of(a: Part, b: Part) -> Part:
        fields = ("position", "half", "role", "active")
        return dataclasses.replace(
            a, **{name: jnp.where(is_first, getattr(a, name), getattr(b, name)) for name in fields}
        )

    rest_of_first = [dataclasses.replace(part, active=part.active & is_first) for part in first[len(second) :]]
    rest_of_second = [dataclasses.replace(part, active=part.active & ~is_first) for part in second[len(first) :]]
    return [one_of(a, b) for a, b in zip(first, second, strict=False)] + rest_of_first + rest_of_second


def _block(draws: Draws, within: Array) -> Part:
    """A box in the air between two x ([2] m), mostly red, sometimes tall; not always there."""
    height = jnp.where(draws.chance(0.3), draws.between(0.3, 0.9), draws.between(0.08, 0.3))
    half = jnp.stack([draws.between(0.08, 0.3), height])
    x = draws.between(within[0], within[1])
    y = draws.between(FLOOR_TOP_M + half[1], WORLD_SIZE_M - half[1])
    room = jnp.minimum(x - within[0], within[1] - x)
    role = jnp.where(draws.chance(0.7), Role.RED, Role.NONE)
    half = half.at[0].min(room)
    return Part(
        position=jnp.stack([x, y]), half=half, role=role, is_fixed=True, active=draws.chance(0.7) & (room > 0.04)
    )


def _pillars(draws: Draws, gap: Array, x: Array, ends: Array, half_width: Array) -> list[Part]:
    """One that stands and one that hangs, a gap (its half, m) between them; in six tenths all are red.

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
    pillars = []
    # Where there is room for one alone, it is either.
    for pillar_x, is_below in ((x, is_first_below), (own_x, ~is_first_below)):
        bottom, top = (jnp.where(is_below, *ends) for ends in zip(below, above, strict=True))
        position, half = jnp.stack([pillar_x, 0.5 * (bottom + top)]), jnp.stack([half_width, 0.5 * (top - bottom)])
        pillars.append(Part(position=position, half=half, role=role, is_fixed=True))
    third_x, third_is_below = draws.between(ends[0], ends[1]), draws.chance(0.5)
    away = jnp.minimum(jnp.abs(third_x - x), jnp.abs(third_x - own_x))
    length = draws.between(0.1, 0.7) * (WORLD_SIZE_M - FLOOR_TOP_M)
    length = jnp.minimum(length, WORLD_SIZE_M - FLOOR_TOP_M - 2.0 * gap)
    middle = jnp.where(third_is_below, FLOOR_TOP_M + 0.5 * length, WORLD_SIZE_M - 0.5 * length)
    has_third = draws.chance(0.5) & (away > 2.0 * (gap + half_width))
    position, half = jnp.stack([third_x, middle]), jnp.stack([half_width, 0.5 * length])
    return [*pillars, Part(position=position, half=half, role=role, is_fixed=True, active=has_third)]


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Kind:
    """How a thing is built, and what there must be room for besides the walls, the goal included."""

    build: Callable[[Draws, Capacity], Thing]
    polygons: int
    circles: int
    joints: int = 0
    thrusters: int = 0

    def fits(self, capacity: Capacity) -> bool:
        return (
            capacity.polygons - NUM_WALLS >= self.polygons
            and capacity.circles >= self.circles
            and capacity.joints >= self.joints
            and capacity.thrusters >= self.thrusters
        )


_KINDS = {
    "car": _Kind(build=bodies.build_car, polygons=1, circles=3, joints=2),
    "unicycle": _Kind(build=bodies.build_unicycle, polygons=1, circles=2, joints=1),
    "walker": _Kind(build=bodies.build_walker, polygons=2, circles=1, joints=1),
    "arm": _Kind(build=bodies.build_arm, polygons=1, circles=2, joints=1),
    "reacher": _Kind(build=bodies.build_reacher, polygons=2, circles=2, joints=2),
    "runner": _Kind(build=bodies.build_runner, polygons=4, circles=1, joints=3),
    "sprinter": _Kind(build=bodies.build_sprinter, polygons=8, circles=1, joints=6),
    "snake": _Kind(build=bodies.build_snake, polygons=2, circles=1, joints=1),
    "cartpole": _Kind(build=bodies.build_cartpole, polygons=2, circles=1, joints=1, thrusters=2),
    "flyer": _Kind(build=bodies.build_flyer, polygons=1, circles=1, thrusters=2),
    "climber": _Kind(build=bodies.build_climber, polygons=4, circles=2, thrusters=2),
    "pusher": _Kind(build=bodies.build_pusher, polygons=2, circles=3, joints=2),
    "beam": _Kind(build=bodies.build_beam, polygons=1, circles=3, joints=1),
    "lander": _Kind(build=bodies.build_lander, polygons=2, circles=0, thrusters=2),
    "carrier": _Kind(build=bodies.build_carrier, polygons=5, circles=4, joints=4),
    "jumper": _Kind(build=bodies.build_jumper, polygons=4, circles=3, joints=3),
    "thrower": _Kind(build=bodies.build_thrower, polygons=1, circles=3, joints=1),
    "turner": _Kind(build=bodies.build_turner, polygons=1, circles=2, joints=1),
    "flipper": _Kind(build=bodies.build_flipper, polygons=2, circles=2, joints=2, thrusters=2),
    "grasper": _Kind(build=bodies.build_grasper, polygons=7, circles=1, joints=5),
    "pendulum": _Kind(build=bodies.build_pendulum, polygons=1, circles=2, joints=1),
    "ramp": _Kind(build=bodies.build_ramp, polygons=4, circles=3, joints=2),
    "gripper": _Kind(build=bodies.build_gripper, polygons=8, circles=3, joints=6),
    "pinball": _Kind(build=bodies.build_pinball, polygons=4, circles=4, joints=2),
}
