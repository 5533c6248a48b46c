"""A scene of the study: what moves, for how long, and how far a computed path is from the truth."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

from jax2d.builder import BuiltWorld, SceneBuilder
from jax2d.fidelity.path import Path
from jax2d.scene import Capacity

Error = Callable[[Path], float]


@dataclasses.dataclass(frozen=True, kw_only=True)
class StudyScene:
    """A world and its truth: a formula (`closed_forms`) or a reference solution (`references`)."""

    name: str
    metric: str  # what the error is and what it is divided by
    seconds: float  # how long the motion is followed
    capacity: Capacity
    gravity: float  # m/s^2 downwards
    control: float = 0.0  # of every motor and thruster
    needs_joint_force: bool = False  # not every engine tells
    uncertainty: float = 0.0  # of the truth, in the unit of the error; 0 for a formula
    build: Callable[[SceneBuilder], Error]

    def world(self) -> tuple[BuiltWorld, Error]:
        builder = SceneBuilder(self.capacity, gravity=(0.0, -self.gravity))
        error = self.build(builder)
        return builder.build(), error
