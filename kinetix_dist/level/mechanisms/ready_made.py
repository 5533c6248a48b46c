"""Ready-made mechanisms that a level drawn by hand may begin with: typical ones of the families, and a cannon.

    READY_MADE[name].build(capacity) -> table.py -> to_draft.py -> a level of walls and this mechanism

Numbers that a family draws are in the middle of their ranges here, so that a name always gives the same mechanism.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.fields import Array
from jax2d.scene import Capacity
from kinetix_dist import prng
from kinetix_dist.level.derive import derive
from kinetix_dist.level.draft import draft_to_level, empty_draft
from kinetix_dist.level.fit import capacity_of_size
from kinetix_dist.level.generator_config import GeneratorConfig
from kinetix_dist.level.level import SIZES, WORLD_SIZE_M, Level, Role
from kinetix_dist.level.mechanisms import FAMILIES
from kinetix_dist.level.mechanisms.table import choose, table_of
from kinetix_dist.level.mechanisms.template import (
    CLEARANCE_M,
    GRAVITY_M_S2,
    NEWTON,
    Draws,
    Mechanism,
    Part,
    Thruster,
    draw_numbers,
)
from kinetix_dist.level.mechanisms.to_draft import with_table
from kinetix_dist.level.walls import FLOOR_TOP_M

MIDDLE = 0.5  # of the range of a number that is drawn
LARGEST = capacity_of_size(list(SIZES)[-1])
NUM_DRAWS = jax.eval_shape(draw_numbers, prng.key(0)).shape[0]


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReadyMade:
    """A mechanism as people choose it. build: of a capacity, to which the number of its links may adapt."""

    help: str  # one line
    build: Callable[[Capacity], Mechanism]


def _of_family(name: str, drawn: Mapping[int, float] | None = None, **task: Any) -> Callable[[Capacity], Mechanism]:
    """The typical mechanism of a family. drawn: numbers that are not in the middle, by their place; task: requests that
    differ from those of the family."""

    def build(capacity: Capacity) -> Mechanism:
        family, numbers = FAMILIES[name], _middle_numbers()
        for place, number in (drawn or {}).items():
            numbers[place] = jnp.float32(number)
        # A mechanism that the size is too small for is that of the largest one: the caller says what it lacks.
        mechanism = family.build(Draws(numbers), capacity if family.fits(capacity) else LARGEST)
        return dataclasses.replace(mechanism, task=dataclasses.replace(mechanism.task, **task))

    return build


def _middle_numbers() -> list[Array]:
    return [jnp.float32(MIDDLE)] * NUM_DRAWS


SHELL_HALF_M = np.array([0.12, 0.08], np.float32)
BARREL_HALF_M = np.array([0.45, 0.03], np.float32)
ELEVATION_RAD = math.radians(45.0)
SHELL_THRUST = 6.0  # times its weight


def _cannon(capacity: Capacity) -> Mechanism:
    """A green shell in a barrel that is closed behind and fixed; its thruster pushes it out."""
    along = np.array([math.cos(ELEVATION_RAD), math.sin(ELEVATION_RAD)], np.float32)
    across = np.array([-along[1], along[0]], np.float32)
    beside = SHELL_HALF_M[1] + CLEARANCE_M + BARREL_HALF_M[1]
    breech_half = np.array([0.03, beside + BARREL_HALF_M[1]], np.float32)
    behind = BARREL_HALF_M[0] + breech_half[0]
    inside = BARREL_HALF_M[0] - SHELL_HALF_M[0] - CLEARANCE_M
    places = [(beside * across, BARREL_HALF_M), (-beside * across, BARREL_HALF_M), (-behind * along, breech_half)]
    shell = Part(position=jnp.asarray(-inside * along), angle=ELEVATION_RAD, half=SHELL_HALF_M, role=Role.GREEN)
    walls = [Part(position=jnp.asarray(at), angle=ELEVATION_RAD, half=half, is_fixed=True) for at, half in places]
    weight = 4.0 * float(np.prod(SHELL_HALF_M)) * GRAVITY_M_S2  # N, of density 1
    at = jnp.array([-SHELL_HALF_M[0], 0.0], jnp.float32)
    push = Thruster(part=0, at=at, angle=0.0, power=jnp.float32(SHELL_THRUST * weight * NEWTON), colour=0)
    return Mechanism(parts=[shell, *walls], thrusters=[push])


READY_MADE: dict[str, ReadyMade] = {
    "car": ReadyMade(help="a chassis on two wheels with motors", build=_of_family("car")),
    "arm": ReadyMade(
        help="links on a fixed disc, a motor in each joint", build=_of_family("arm", colours_in_turn=True)
    ),
    # The first number of a runner chooses between one leg and two.
    "hopper": ReadyMade(
        help="a torso on one leg of thigh, shin and foot, a motor in each joint",
        build=_of_family("runner", {0: 1.0 - 2.0**-24}, colours_in_turn=True),
    ),
    "lander": ReadyMade(help="a box with two thrusters, in the air", build=_of_family("lander")),
    "cannon": ReadyMade(help="a shell with a thruster in a fixed barrel", build=_cannon),
}


def ready_made_level(name: str, size: str) -> Level:
    """A level (numpy) of the largest size with walls and the mechanism: on the floor, in the air or where it hangs.

    size: that of the level it is meant for. All motors are of colour 0, or each of the next.
    """
    return jax.device_get(_level(name, capacity_of_size(size)))


@functools.partial(jax.jit, static_argnames=("name", "capacity"))  # operation by operation it takes ten times as long
def _level(name: str, capacity: Capacity) -> Level:
    mechanism = READY_MADE[name].build(capacity)
    table = choose([table_of(mechanism, 0, LARGEST, max(len(mechanism.joints), 1))], jnp.int32(0))
    lowest, highest = table.extent()
    in_the_middle = 0.5 * (WORLD_SIZE_M - lowest[0] - highest[0])
    on_floor = jnp.stack([in_the_middle, FLOOR_TOP_M + CLEARANCE_M + table.task.height - lowest[1]])
    table = table.moved(table.task.middle.or_else(on_floor))
    # The first two numbers: whether motors have one colour, and which is the first.
    numbers = [jnp.float32(0.0)] * 2 + _middle_numbers()
    draft = with_table(Draws(numbers), empty_draft(LARGEST), table, LARGEST, GeneratorConfig())
    return derive(*draft_to_level(draft, LARGEST))
