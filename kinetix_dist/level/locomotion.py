"""Random cars, unicycles, walkers and arms with a goal: such wheels and legs are rare at random.

    build about the origin -> on the floor at one side -> goal at the other -> obstacle between -> permute slots

An arm hangs in the middle instead, with the goal above it within reach. Green is what is carried (chassis, torso) or
the last link of an arm; blue is a circle. Nothing overlaps at the start but what is joined: green's side and the goal's
are apart by construction. Everything is for one level, pure, and works inside jit and vmap; sizes are those at which a
motor of these powers moves the thing.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp

from jax2d.fields import Array
from jax2d.scene import Capacity
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
from kinetix_dist.level.things import Draws, Hinge, Part, Thing, extent, with_hinges, with_parts
from kinetix_dist.level.walls import FLOOR_TOP_M

CLEARANCE_M = 0.01  # above the floor, so that nothing touches it at the start
WALL_MARGIN_M = 0.1
GOAL_GAP_M = 0.3  # from the thing to the goal, at least
MAX_LEGS = 3
MAX_LINKS = 4


def generate_locomotion_level(key: Array, capacity: Capacity, config: GeneratorConfig) -> Level:
    """One level of a kind that `config.locomotion_kinds` names and the capacity has room for. Consumes `key`.

    Raises ValueError where there is room for none of them.
    """
    kinds = [kind for kind in config.locomotion_kinds if _KINDS[kind].fits(capacity)]
    if not kinds:
        raise ValueError(
            f"no kind of locomotion_kinds {config.locomotion_kinds} fits {capacity}; use a larger size or other kinds"
        )
    kind_key, *keys = jax.random.split(key, 1 + len(kinds))
    drafts = [_draw(kind_of, one, capacity, config) for kind_of, one in zip((_KINDS[k] for k in kinds), keys)]
    chosen = jax.random.randint(kind_key, (), 0, len(kinds))
    draft = jax.tree.map(lambda *columns: jnp.stack(columns)[chosen], *drafts)
    order = jax.random.uniform(jax.random.fold_in(kind_key, 1), (num_permutation_draws(draft),))
    return derive(*draft_to_level(permute_slots(order, draft, capacity.polygons), capacity))


def _draw(kind: _Kind, key: Array, capacity: Capacity, config: GeneratorConfig) -> Draft:
    draws = Draws(key)
    thing = kind.build(draws, capacity)
    radius = draws.between(0.12, 0.28)
    lowest, highest = extent(thing.parts)
    if thing.middle is None or thing.goal is None:
        # Stands at the left; all places are mirrored half of the time.
        width = highest[0] - lowest[0]
        left = WALL_MARGIN_M + draws.between(0.0, 0.5)
        nearest = left + width + GOAL_GAP_M
        goal_x = draws.between(nearest + radius, WORLD_SIZE_M - WALL_MARGIN_M - radius)
        goal_y = FLOOR_TOP_M + CLEARANCE_M + radius + draws.between(0.0, 1.0) * 0.5 * (highest[1] - lowest[1])
        obstacle_half = jnp.stack([draws.between(0.03, 0.1), draws.between(0.02, 0.08)])
        obstacle_x = draws.between(left + width + obstacle_half[0] + 0.03, goal_x - radius - obstacle_half[0] - 0.03)
        has_obstacle = draws.chance(0.4)
        is_mirrored = draws.chance(0.5)
        middle_x = left - lowest[0]
        middle_x = jnp.where(is_mirrored, WORLD_SIZE_M - left - highest[0], middle_x)
        goal_x = jnp.where(is_mirrored, WORLD_SIZE_M - goal_x, goal_x)
        obstacle_x = jnp.where(is_mirrored, WORLD_SIZE_M - obstacle_x, obstacle_x)
        middle = jnp.stack([middle_x, FLOOR_TOP_M + CLEARANCE_M - lowest[1]])
        goal = jnp.stack([goal_x, goal_y])
        obstacle = Part(
            position=jnp.stack([obstacle_x, FLOOR_TOP_M + obstacle_half[1]]),
            half=obstacle_half,
            is_fixed=True,
            active=has_obstacle,
        )
        extra = [obstacle] if _count(thing.parts, is_box=True) < capacity.polygons - NUM_WALLS else []
        blue_is_fixed = draws.chance(0.7)
    else:
        middle, goal, extra, blue_is_fixed = thing.middle, thing.middle + thing.goal, [], True
    blue = Part(position=goal, radius=radius, role=Role.BLUE, is_fixed=blue_is_fixed)
    moved = [dataclasses.replace(part, position=part.position + middle) for part in thing.parts]
    hinges = [dataclasses.replace(hinge, at=hinge.at + middle) for hinge in thing.hinges]
    draft = empty_draft(capacity)
    floor_role = jnp.where(draws.chance(config.floor_red_chance), Role.RED, Role.NONE).astype(jnp.int32)
    shapes = dataclasses.replace(draft.shapes, role=draft.shapes.role.at[0].set(floor_role))
    draft, slots = with_parts(dataclasses.replace(draft, shapes=shapes), [*moved, *extra, blue], capacity)
    return with_hinges(draws, draft, hinges, slots, capacity, config)


def _count(parts: list[Part], *, is_box: bool) -> int:
    return sum((part.half is not None) == is_box for part in parts)


def _unicycle(draws: Draws, capacity: Capacity) -> Thing:
    """A box above a wheel."""
    radius = draws.between(0.14, 0.28)
    # Tall enough that it stands out above the wheel: green is what must touch blue.
    half = jnp.stack([draws.between(0.1, 0.3), draws.between(0.8 * radius, 0.35)])
    height = half[1] * draws.between(0.75, 0.95)
    wheel = Part(position=jnp.zeros(2), radius=radius)
    body = Part(position=jnp.stack([jnp.zeros(()), height]), half=half, role=Role.GREEN)
    return Thing(parts=[body, wheel], hinges=[Hinge(a=0, b=1, at=jnp.zeros(2))])


def build_car(draws: Draws, capacity: Capacity) -> Thing:
    """A chassis on two wheels of different sizes, both on the floor."""
    radii = [draws.between(0.14, 0.28) for _ in range(2)]
    along = draws.between(0.3, 0.55)  # half the distance of the axles, level
    axles = [jnp.stack([-along, radii[0]]), jnp.stack([along, radii[1]])]
    slope = jnp.arctan2(radii[1] - radii[0], 2.0 * along)
    wheelbase = jnp.hypot(2.0 * along, radii[1] - radii[0])
    half = jnp.stack([0.5 * wheelbase * draws.between(1.02, 1.3), draws.between(0.07, 0.16)])
    up = jnp.stack([-jnp.sin(slope), jnp.cos(slope)])
    centre = 0.5 * (axles[0] + axles[1]) + 0.5 * half[1] * up
    chassis = Part(position=centre, angle=slope, half=half, role=Role.GREEN)
    wheels = [Part(position=axle, radius=radius) for axle, radius in zip(axles, radii, strict=True)]
    return Thing(parts=[chassis, *wheels], hinges=[Hinge(a=0, b=1 + k, at=axle) for k, axle in enumerate(axles)])


def _walker(draws: Draws, capacity: Capacity) -> Thing:
    """A torso on legs of one or two links: as many as there is room for, 2 at least where there is."""
    room = min(capacity.polygons - NUM_WALLS - 1, capacity.joints)
    max_legs = min(room, MAX_LEGS)
    has_shins = room >= 2 * max_legs
    torso_half = jnp.stack([draws.between(0.2, 0.5), draws.between(0.08, 0.16)])
    parts = [Part(position=jnp.zeros(2), half=torso_half, role=Role.GREEN)]
    hinges: list[Hinge] = []
    num_legs, with_shins = draws.number(min(2, max_legs), max_legs), draws.chance(0.6)
    thigh, shin = (jnp.stack([draws.between(0.04, 0.08), draws.between(0.14, 0.28)]) for _ in range(2))
    for leg in range(max_legs):
        # Hips are spread evenly under the torso, whatever the number of legs.
        share = (leg + 0.5) / jnp.maximum(num_legs, 1) * 2.0 - 1.0
        hip = jnp.stack([0.85 * share * torso_half[0], -0.7 * torso_half[1]])
        active = leg < num_legs
        knee = _add_link(draws, parts, hinges, 0, hip, thigh, active)
        if has_shins:
            _add_link(draws, parts, hinges, len(parts) - 1, knee, shin, active & with_shins)
    return Thing(parts=parts, hinges=hinges)


def _add_link(
    draws: Draws, parts: list[Part], hinges: list[Hinge], of: int, at: Array, half: Array, active: Array
) -> Array:
    """Hangs a box with its upper end at a point of part `of`; where its other end is."""
    angle = draws.between(-0.45, 0.45)
    down = jnp.stack([jnp.sin(angle), -jnp.cos(angle)])
    inside = 0.85 * half[1]
    parts.append(Part(position=at + inside * down, angle=angle, half=half, active=active))
    hinges.append(Hinge(a=of, b=len(parts) - 1, at=at, limit=draws.between(0.5, 1.2), active=active))
    return at + 2.0 * inside * down


def _arm(draws: Draws, capacity: Capacity) -> Thing:
    """Links on a fixed disc, all to one side of it; the goal is to the other side, within reach."""
    num_links = min(capacity.polygons - NUM_WALLS, capacity.joints, MAX_LINKS)
    count = draws.number(min(2, num_links), num_links)
    reach = draws.between(0.8, 1.4)
    towards = -0.5 * math.pi + draws.between(-1.0, 1.0)  # hangs, so that few fall onto their goal
    parts = [Part(position=jnp.zeros(2), radius=draws.between(0.1, 0.18), is_fixed=True)]
    hinges, at = [], jnp.zeros(2)
    length = reach / count
    width = draws.between(0.04, 0.08)
    for link in range(num_links):
        angle = towards + draws.between(-0.6, 0.6)
        along = jnp.stack([jnp.cos(angle), jnp.sin(angle)])
        active = link < count
        role = jnp.where(link == count - 1, Role.GREEN, Role.NONE)
        half = jnp.stack([0.5 * length + 0.5 * width, width])
        parts.append(Part(position=at + 0.5 * length * along, angle=angle, half=half, role=role, active=active))
        hinges.append(Hinge(a=link, b=link + 1, at=at, active=active))
        at = at + length * along
    # Links keep within 0.6 rad of one direction: what is more than 1.9 rad from it is behind all of them.
    goal_angle = towards + math.pi + draws.between(-1.0, 1.0)
    distance = jnp.maximum(0.6, draws.between(0.5, 0.9) * reach)
    goal = distance * jnp.stack([jnp.cos(goal_angle), jnp.sin(goal_angle)])
    middle = jnp.stack([draws.between(1.8, WORLD_SIZE_M - 1.8), draws.between(FLOOR_TOP_M + 1.7, 3.2)])
    return Thing(parts=parts, hinges=hinges, middle=middle, goal=goal)


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Kind:
    """How a thing is built, and what there must be room for besides the walls, the goal included."""

    build: Callable[[Draws, Capacity], Thing]
    polygons: int
    circles: int
    joints: int

    def fits(self, capacity: Capacity) -> bool:
        polygons = capacity.polygons - NUM_WALLS
        return polygons >= self.polygons and capacity.circles >= self.circles and capacity.joints >= self.joints


_KINDS = {
    "car": _Kind(build=build_car, polygons=1, circles=3, joints=2),
    "unicycle": _Kind(build=_unicycle, polygons=1, circles=2, joints=1),
    "walker": _Kind(build=_walker, polygons=2, circles=1, joints=1),
    "arm": _Kind(build=_arm, polygons=1, circles=2, joints=1),
}
