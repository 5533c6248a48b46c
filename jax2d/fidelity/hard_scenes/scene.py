"""Builder of hard scenes, and the checks that a scene passes or fails.

    def single_box() -> HardScene:
        b = HardSceneBuilder()
        box = b.box(0, 1.5)
        return b.scene("single box", lambda trajectory: [Check("moves at, m/s", trajectory.speed()[-1], 1e-3)])

Bodies are 1 m large, of density 1 and friction coefficient 0.6 unless given.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Sequence
from typing import NamedTuple, Unpack

import numpy as np

from jax2d.builder import BuiltWorld, SceneBuilder
from jax2d.builder_checks import Point, Points
from jax2d.builder_options import BodyKeywords, PrismaticKeywords, RevoluteKeywords
from jax2d.fidelity.trajectory import Trajectory
from jax2d.scene import Capacity
from jax2d.settings import preset

# One capacity for all scenes, so that they run as one batch.
CAPACITY = Capacity(polygons=64, circles=64, joints=112, thrusters=0)
MU = 0.6 / preset("standard").base_friction  # friction that two such bodies mix to 0.6
SLOP_M = 0.005  # Box2D's linear slop: what counts as touching


class Check(NamedTuple):
    """One figure of a scene; it holds when the value is at most the limit (NaN never is)."""

    figure: str
    value: float
    limit: float

    @property
    def holds(self) -> bool:
        return self.value <= self.limit


@dataclasses.dataclass(frozen=True, kw_only=True)
class HardScene:
    name: str
    world: BuiltWorld
    checks: Callable[[Trajectory], list[Check]]
    seconds: float = 10.0


class HardSceneBuilder:
    """A scene under construction, around the point `at`, m; with a floor whose top is at its height."""

    def __init__(self, *, at: Point = (0.0, 0.0), gravity: float = 9.81, floor: bool = True, mu: float = MU):
        self.builder = SceneBuilder(CAPACITY, gravity=(0.0, -gravity))
        self.at = np.asarray(at, np.float64)
        self.mu = mu
        if floor:
            self.box(0, -0.5, width=200, fixed=True)

    def box(
        self, x: float, y: float, *, width: float = 1.0, height: float = 1.0, **options: Unpack[BodyKeywords]
    ) -> int:
        """Adds a box; `options` as for `SceneBuilder.add_polygon`; so below."""
        options.setdefault("friction", self.mu)
        return self.builder.add_box(width=width, height=height, position=self.point(x, y), **options)

    def circle(self, x: float, y: float, *, radius: float = 0.5, **options: Unpack[BodyKeywords]) -> int:
        options.setdefault("friction", self.mu)
        return self.builder.add_circle(radius=radius, position=self.point(x, y), **options)

    def polygon(self, points: Points, **options: Unpack[BodyKeywords]) -> int:
        options.setdefault("friction", self.mu)
        return self.builder.add_polygon(points, position=self.point(0, 0), **options)

    def revolute(self, a: int, b: int, x: float, y: float, **motor: Unpack[RevoluteKeywords]) -> int:
        return self.builder.add_revolute_joint(a, b, at=self.point(x, y), **motor)

    def prismatic(
        self, a: int, b: int, x: float, y: float, *, axis_angle: float = 0.0, **motor: Unpack[PrismaticKeywords]
    ) -> int:
        return self.builder.add_prismatic_joint(a, b, at=self.point(x, y), axis_angle=axis_angle, **motor)

    def fixed_joint(self, a: int, b: int, x: float, y: float) -> int:
        return self.builder.add_fixed_joint(a, b, at=self.point(x, y))

    def keep_all_apart(self, bodies: Sequence[int]) -> None:
        """Lets all of these bodies pass through each other."""
        for a, b in itertools.combinations(bodies, 2):
            self.builder.keep_apart(a, b)

    def point(self, x: float, y: float) -> np.ndarray:
        """[2] m, world frame."""
        return self.at + np.array([x, y])

    def scene(self, name: str, checks: Callable[[Trajectory], list[Check]], *, seconds: float = 10.0) -> HardScene:
        return HardScene(name=name, world=self.builder.build(), checks=checks, seconds=seconds)


def drop(trajectory: Trajectory, body: int) -> float:
    """m, how much lower a body ends than it started."""
    height = trajectory.position[:, body, 1]
    return height[0] - height[-1]


def widest_gap(trajectory: Trajectory, limit: float, *, after: float = 0.0) -> Check:
    """Check of the widest gap of any joint, from `after` seconds on."""
    return Check("joint gap, m", trajectory.joint_gaps()[trajectory.index_at(after) :].max(), limit)
