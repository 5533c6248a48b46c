"""Registry of mechanism families: how each is built, and the room that its levels need."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

from jax2d.scene import Capacity
from kinetix_dist.level.level import NUM_WALLS
from kinetix_dist.level.mechanisms.template import Draws, Mechanism

Build = Callable[[Draws, Capacity], Mechanism]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Family:
    """Mechanisms of one kind. Counts are the fewest slots besides the walls that its levels need, goal included."""

    build: Build
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


FAMILIES: dict[str, Family] = {}


def family(name: str, *, polygons: int, circles: int, joints: int = 0, thrusters: int = 0) -> Callable[[Build], Build]:
    """Registers a function that builds mechanisms; counts are those of `Family`."""

    def register(build: Build) -> Build:
        if name in FAMILIES:
            raise ValueError(f"there are two mechanism families {name!r}; give one another name")
        FAMILIES[name] = Family(build=build, polygons=polygons, circles=circles, joints=joints, thrusters=thrusters)
        return build

    return register


def fitting_families(names: Sequence[str], capacity: Capacity) -> list[str]:
    """Families of these that the capacity has room for."""
    return [name for name in names if FAMILIES[name].fits(capacity)]
