"""Levels for the control of any body: it stands in the middle, and a goal that it cannot touch is above it.

Paper, section "Zero-shot Locomotion of an Arbitrary Morphology": the best a policy can do is to go below the goal, so
the correlation of the x of goal and green over many levels measures how well it steers. Morphologies are a `car`, a
`snake` of five links, a box with two `thrusters`, and `random` ones of three shapes joined at random. Pure; works
inside jit and vmap.
"""

from __future__ import annotations

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.fields import Array
from jax2d.scene import Capacity
from kinetix_dist import prng
from kinetix_dist.level.derive import derive
from kinetix_dist.level.draft import draft_to_level, empty_draft
from kinetix_dist.level.generator_config import GeneratorConfig
from kinetix_dist.level.level import NUM_WALLS, SIZES, WORLD_SIZE_M, Level, Role
from kinetix_dist.level.mechanisms import FAMILIES
from kinetix_dist.level.mechanisms.registry import Family
from kinetix_dist.level.mechanisms.table import choose, table_of, with_circle
from kinetix_dist.level.mechanisms.template import (
    CLEARANCE_M,
    GRAVITY_M_S2,
    NEWTON,
    Draws,
    Joint,
    Mechanism,
    Part,
    Thruster,
    draw_numbers,
    extent,
    given,
    moved,
)
from kinetix_dist.level.mechanisms.to_draft import with_table
from kinetix_dist.level.walls import FLOOR_TOP_M, PASSES_THROUGH

GOAL_HEIGHT_M = 4.5
GOAL_RADIUS_M = 0.25
GOAL_MARGIN_M = 0.5  # of its centre from the walls
_NUM_LINKS = 5


def generate_goal_following_level(key: Array, capacity: Capacity, morphology: str) -> Level:
    """One level with a body of that name. Consumes `key`. Raises ValueError for another name or too small a
    capacity."""
    if missing := _lacking(capacity, morphology):
        raise ValueError(f"{morphology!r} needs {missing}; use a larger size")
    needs = MORPHOLOGIES[morphology]
    draws = Draws(jax.lax.unstack(draw_numbers(key)))
    body = needs.build(draws, capacity)
    lowest, highest = extent(body.parts)
    middle = jnp.stack([0.5 * (WORLD_SIZE_M - lowest[0] - highest[0]), FLOOR_TOP_M + CLEARANCE_M - lowest[1]])
    body = moved(body, middle)
    goal_x = draws.between(GOAL_MARGIN_M, WORLD_SIZE_M - GOAL_MARGIN_M)
    goal = Part(
        position=jnp.stack([goal_x, jnp.asarray(GOAL_HEIGHT_M)]),
        radius=jnp.asarray(GOAL_RADIUS_M),
        role=Role.BLUE,
        is_fixed=True,
    )
    table = choose([table_of(body, draws.num_used, capacity, len(body.joints))], np.int32(0))
    draft = with_table(draws, empty_draft(capacity), with_circle(table, goal), capacity, GeneratorConfig())
    level, is_fixed = draft_to_level(draft, capacity)
    # Nothing but walls touches the goal.
    mode = jnp.where(level.shape_role == Role.BLUE, PASSES_THROUGH, level.collision_mode)
    return derive(dataclasses.replace(level, collision_mode=mode), is_fixed)


@dataclasses.dataclass(frozen=True)
class GoalFollowingLevels:
    """The levels of `goal_following.py`, with one kind of body."""

    capacity: Capacity
    morphology: str  # of MORPHOLOGIES

    def generate(self, key: Array, num_levels: int) -> Level:
        keys = prng.split(key, num_levels)
        return jax.vmap(lambda one: generate_goal_following_level(one, self.capacity, self.morphology))(keys)


def _snake(draws: Draws, capacity: Capacity) -> Mechanism:
    """Equal links in a row, the middle one green."""
    half = jnp.stack([draws.between(0.16, 0.24), draws.between(0.05, 0.08)])
    step = 1.7 * half[0]
    parts = [
        Part(
            position=jnp.stack([link * step, jnp.zeros((), jnp.float32)]),
            half=half,
            role=Role.GREEN if link == _NUM_LINKS // 2 else Role.NONE,
        )
        for link in range(_NUM_LINKS)
    ]
    joints = [
        Joint(
            a=link,
            b=link + 1,
            at=jnp.stack([(link + 0.5) * step, jnp.zeros((), jnp.float32)]),
            limit=given(jnp.asarray(1.2)),
        )
        for link in range(_NUM_LINKS - 1)
    ]
    return Mechanism(parts=parts, joints=joints)


def _box(draws: Draws, capacity: Capacity) -> Mechanism:
    """Two thrusters at the ends of a box, each pushing up and to the middle with nine tenths of the weight."""
    half = jnp.stack([draws.between(0.2, 0.35), draws.between(0.08, 0.14)])
    power = 0.9 * (4.0 * half[0] * half[1] * GRAVITY_M_S2) * NEWTON
    thrusters = [
        Thruster(
            part=0,
            at=jnp.stack([side * 0.8 * half[0], jnp.zeros((), jnp.float32)]),
            angle=jnp.asarray(0.5 * math.pi + 0.4 * side),
            power=power,
            colour=colour,
        )
        for colour, side in enumerate((-1.0, 1.0))
    ]
    return Mechanism(parts=[Part(position=jnp.zeros(2, jnp.float32), half=half, role=Role.GREEN)], thrusters=thrusters)


def _random(draws: Draws, capacity: Capacity) -> Mechanism:
    """A green box, a box or a wheel on it, and a wheel on one of the two."""
    half = jnp.stack([draws.between(0.15, 0.35), draws.between(0.08, 0.2)])
    at = jnp.stack([draws.between(-0.9, 0.9) * half[0], draws.between(-0.9, 0.9) * half[1]])
    angle = draws.between(0.0, 2.0 * math.pi)
    along = jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    link_half = jnp.stack([draws.between(0.14, 0.32), draws.between(0.05, 0.1)])
    has_link = draws.chance(0.5)
    link = Part(position=at + 0.85 * link_half[0] * along, angle=angle, half=link_half, active=has_link)
    wheel = Part(position=at, radius=draws.between(0.1, 0.22), active=~has_link)
    is_on_link = has_link & draws.chance(0.5)
    end = at + 1.7 * link_half[0] * along
    corner = jnp.stack([draws.between(-0.9, 0.9) * half[0], draws.between(-0.9, 0.9) * half[1]])
    last_at = jnp.where(is_on_link, end, corner)
    last = Part(position=last_at, radius=draws.between(0.1, 0.22))
    joints = [
        Joint(a=0, b=1, at=at, active=has_link),
        Joint(a=0, b=2, at=at, active=~has_link),
        Joint(a=0, b=3, at=last_at, active=~is_on_link),
        Joint(a=1, b=3, at=last_at, active=is_on_link),
    ]
    parts = [Part(position=jnp.zeros(2, jnp.float32), half=half, role=Role.GREEN), link, wheel, last]
    return Mechanism(parts=parts, joints=joints)


MORPHOLOGIES = {
    "car": FAMILIES["car"],
    "snake": Family(build=_snake, polygons=_NUM_LINKS, circles=1, joints=_NUM_LINKS - 1),
    "thrusters": Family(build=_box, polygons=1, circles=1, thrusters=2),
    "random": Family(build=_random, polygons=2, circles=3, joints=2),
}


def size_for(morphology: str) -> str:
    """The size of levels with such a body: "m", "l" where it has no room there. Raises ValueError for another name."""
    return next(name for name in ("m", "l") if not _lacking(SIZES[name], morphology))


def _lacking(capacity: Capacity, morphology: str) -> str:
    """Clause about what a body needs and a level of that capacity does not have; "": nothing."""
    if morphology not in MORPHOLOGIES:
        raise ValueError(f"unknown morphology {morphology!r}; there are {', '.join(MORPHOLOGIES)}")
    needs = MORPHOLOGIES[morphology]
    have = {name: getattr(capacity, name) for name in ("polygons", "circles", "joints", "thrusters")}
    have["polygons"] -= NUM_WALLS
    missing = [
        f"{getattr(needs, name)} {name}, there are {free}" for name, free in have.items() if free < getattr(needs, name)
    ]
    return missing[0] if missing else ""
