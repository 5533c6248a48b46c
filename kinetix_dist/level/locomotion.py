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
from kinetix_dist.level import bodies
from kinetix_dist.level.bodies import CLEARANCE_M, WALL_MARGIN_M
from kinetix_dist.level.derive import derive
from kinetix_dist.level.draft import (
    Draft,
    draft_to_level,
    empty_draft,
)
from kinetix_dist.level.generator_config import GeneratorConfig
from kinetix_dist.level.level import NUM_WALLS, WORLD_SIZE_M, Level
from kinetix_dist.level.permute import num_permutation_draws, permute_slots
from kinetix_dist.level.roles import Role
from kinetix_dist.level.things import (
    Draws,
    Part,
    Thing,
    extent,
    mirrored,
    moved,
    with_hinges,
    with_jets,
    with_parts,
)
from kinetix_dist.level.walls import FLOOR_TOP_M

GOAL_GAP_M = 0.3  # from the thing to the goal, at least


def generate_locomotion_level(key: Array, capacity: Capacity, config: GeneratorConfig) -> Level:
    """One level of a kind that `config.locomotion_kinds` names and the capacity has room for. Consumes `key`.

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
    kind_key, *keys = jax.random.split(key, 1 + len(kinds))
    drafts = [_draw(kind_of, one, capacity, config) for kind_of, one in zip((_KINDS[k] for k in kinds), keys)]
    chosen = _choose(kind_key, weights)
    draft = jax.tree.map(lambda *columns: jnp.stack(columns)[chosen], *drafts)
    order = jax.random.uniform(jax.random.fold_in(kind_key, 1), (num_permutation_draws(draft),))
    return derive(*draft_to_level(permute_slots(order, draft, capacity.polygons), capacity))


def _choose(key: Array, weights: Sequence[float]) -> Array:
    """int32, one of as many as there are weights. Consumes `key`."""
    if len(set(weights)) == 1:
        return jax.random.randint(key, (), 0, len(weights))
    ends = np.cumsum(np.asarray(weights, np.float32))
    return jnp.searchsorted(ends[:-1], jax.random.uniform(key) * ends[-1], side="right").astype(jnp.int32)


def fitting_kinds(kinds: Sequence[str], capacity: Capacity) -> list[str]:
    """Those for which there is room."""
    return [kind for kind in kinds if _KINDS[kind].fits(capacity)]


def _draw(kind: _Kind, key: Array, capacity: Capacity, config: GeneratorConfig) -> Draft:
    draws = Draws(key)
    thing = kind.build(draws, capacity)
    radius = draws.between(0.12, 0.28)
    if thing.middle is None or thing.goal is None:
        thing, goal, extra = _beside_its_goal(draws, thing, radius, capacity)
        blue_is_fixed = draws.chance(0.7)
    else:
        radius = radius if thing.goal_radius is None else thing.goal_radius
        thing, goal, extra = moved(thing, thing.middle), thing.middle + thing.goal, []
        blue_is_fixed = jnp.array(True)
    blue = [Part(position=goal, radius=radius, role=Role.BLUE, is_fixed=blue_is_fixed)]
    if thing.slab is not None:
        is_slab = jnp.asarray(thing.goal_is_slab)
        # A disc in its place hangs: one that fell is behind the wall of what carries the load.
        disc = dataclasses.replace(blue[0], active=~is_slab, is_fixed=True)
        blue = [disc] if thing.goal_is_slab is not True else []
        blue.append(Part(position=goal, half=thing.slab, role=Role.BLUE, is_fixed=blue_is_fixed, active=is_slab))
    draft = empty_draft(capacity)
    floor_is_red = draws.chance(config.floor_red_chance)
    floor_is_red = floor_is_red if thing.floor_is_red is None else thing.floor_is_red
    floor_role = jnp.where(floor_is_red, Role.RED, Role.NONE).astype(jnp.int32)
    shapes = dataclasses.replace(draft.shapes, role=draft.shapes.role.at[0].set(floor_role))
    draft, slots = with_parts(dataclasses.replace(draft, shapes=shapes), [*thing.parts, *extra, *blue], capacity)
    draft = with_jets(draft, thing.jets, slots)
    return with_hinges(draws, draft, thing, slots, capacity, config)


def _beside_its_goal(draws: Draws, thing: Thing, radius: Array, capacity: Capacity) -> tuple[Thing, Array, list[Part]]:
    """The thing at the left, the centre of its goal to the right of it ([2] m) and what is between them; all of it
    mirrored half of the time."""
    lowest, highest = extent(thing.parts)
    width = highest[0] - lowest[0]
    left = WALL_MARGIN_M + draws.between(0.0, 0.5)
    nearest = left + width + GOAL_GAP_M
    if thing.slab is not None:
        radius = jnp.where(thing.goal_is_slab, thing.slab[0], radius)
    share = draws.between(0.0, 1.0) ** thing.goal_nearness
    goal_x = nearest + radius + share * (WORLD_SIZE_M - WALL_MARGIN_M - radius - (nearest + radius))
    low, high = thing.goal_rise
    goal_y = FLOOR_TOP_M + CLEARANCE_M + radius + draws.between(low, high) * (highest[1] - lowest[1])
    goal_y = goal_y if thing.goal_height is None else thing.goal_height
    if thing.slab is not None:
        goal_y = jnp.where(thing.goal_is_slab, FLOOR_TOP_M + CLEARANCE_M + thing.slab[1], goal_y)
    bump_half = jnp.stack([draws.between(0.03, 0.1), draws.between(0.02, 0.08)])
    obstacle_ends = jnp.stack([left + width, goal_x - radius]) + jnp.array([1.0, -1.0]) * (bump_half[0] + 0.03)
    obstacle_x = draws.between(obstacle_ends[0], obstacle_ends[1])
    has_obstacle = draws.chance(0.4)
    is_mirrored = draws.chance(0.5)
    if thing.is_handed:
        thing = mirrored(thing, is_mirrored)
        lowest, highest = extent(thing.parts)
    middle_x = jnp.where(is_mirrored, WORLD_SIZE_M - left - highest[0], left - lowest[0])
    goal_x = jnp.where(is_mirrored, WORLD_SIZE_M - goal_x, goal_x)
    obstacle_x = jnp.where(is_mirrored, WORLD_SIZE_M - obstacle_x, obstacle_x)
    obstacle_ends = jnp.where(is_mirrored, WORLD_SIZE_M - obstacle_ends[::-1], obstacle_ends)
    thing = moved(thing, jnp.stack([middle_x, FLOOR_TOP_M + CLEARANCE_M + thing.height - lowest[1]]))
    room = capacity.polygons - NUM_WALLS - sum(part.half is not None for part in thing.parts)
    extra = []
    if thing.gap is not None:
        ends = jnp.sort(jnp.stack([middle_x + 0.5 * (lowest[0] + highest[0]), goal_x]))
        within = ends + jnp.stack([1.0, -1.0]) * (jnp.maximum(radius, 0.5 * width) + CLEARANCE_M)
        pillars = _pillars(draws, thing.gap, obstacle_x, obstacle_ends, bump_half[0])
        extra = _either(draws.chance(0.5), pillars, [_block(draws, within) for _ in range(thing.num_blocks)])
    elif thing.has_bump:
        position = jnp.stack([obstacle_x, FLOOR_TOP_M + bump_half[1]])
        extra = [Part(position=position, half=bump_half, is_fixed=True, active=has_obstacle)]
    return thing, jnp.stack([goal_x, goal_y]), extra[:room]


def _either(is_first: Array, first: list[Part], second: list[Part]) -> list[Part]:
    """The fixed boxes of one of two lists, of which the second is the longer one."""

    def one_of(a: Part, b: Part) -> Part:
        fields = ("position", "half", "role", "active")
        return dataclasses.replace(
            a, **{name: jnp.where(is_first, getattr(a, name), getattr(b, name)) for name in fields}
        )

    rest = [dataclasses.replace(part, active=part.active & ~is_first) for part in second[len(first) :]]
    return [one_of(a, b) for a, b in zip(first, second, strict=False)] + rest


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
    """One that stands and one that hangs, a gap (its half, m) between them; half of the time both are red.

    In two fifths the second is at an x of its own between `ends` ([2] m). Where that leaves as much room, each may
    reach beyond the other's end: the way is over the one and below the other.
    """
    is_red, is_first_below = draws.chance(0.5), draws.chance(0.5)
    gap_y = draws.between(FLOOR_TOP_M + gap + 0.1, WORLD_SIZE_M - gap - 0.1)
    own_x = jnp.where(draws.chance(0.4), draws.between(ends[0], ends[1]), x)
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
    return pillars


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
    "runner": _Kind(build=bodies.build_runner, polygons=4, circles=1, joints=3),
    "sprinter": _Kind(build=bodies.build_sprinter, polygons=8, circles=1, joints=6),
    "snake": _Kind(build=bodies.build_snake, polygons=2, circles=1, joints=1),
    "cartpole": _Kind(build=bodies.build_cartpole, polygons=2, circles=1, joints=1, thrusters=2),
    "flyer": _Kind(build=bodies.build_flyer, polygons=1, circles=1, thrusters=2),
    "pusher": _Kind(build=bodies.build_pusher, polygons=2, circles=3, joints=2),
    "beam": _Kind(build=bodies.build_beam, polygons=1, circles=3, joints=1),
    "lander": _Kind(build=bodies.build_lander, polygons=2, circles=0, thrusters=2),
    "carrier": _Kind(build=bodies.build_carrier, polygons=5, circles=4, joints=4),
    "jumper": _Kind(build=bodies.build_jumper, polygons=3, circles=3, joints=2),
}
