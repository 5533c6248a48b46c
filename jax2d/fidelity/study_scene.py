"""A scene of the study: what moves, for how long, and how far a trajectory is from the truth."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Protocol, TypeVar

from jax2d.builder import BuiltWorld, SceneBuilder
from jax2d.fidelity.trajectory import Trajectory
from jax2d.scene import Capacity

Error = Callable[[Trajectory], float]


@dataclasses.dataclass(frozen=True, kw_only=True)
class StudyScene:
    """A world and its truth: a formula (`closed_forms`) or a reference solution (`references`)."""

    name: str
    metric: str  # what the error is and what it is divided by
    seconds: float  # how long it is followed
    capacity: Capacity
    gravity: float  # m/s^2 downwards
    control: float = 0.0  # of every motor and thruster
    needs_joint_force: bool = False  # not every engine records it
    uncertainty: float = 0.0  # of the truth, in the unit of the error; 0 for a formula
    build: Callable[[SceneBuilder], Error]

    def world(self) -> tuple[BuiltWorld, Error]:
        builder = SceneBuilder(self.capacity, gravity=(0.0, -self.gravity))
        error = self.build(builder)
        return builder.build(), error


class Named(Protocol):
    @property
    def name(self) -> str: ...


AnyScene = TypeVar("AnyScene", bound=Named)


def by_name(scenes: Sequence[AnyScene]) -> dict[str, AnyScene]:
    """A table of scenes, in their order. Raises ValueError for a name that two of them have."""
    table: dict[str, AnyScene] = {}
    for scene in scenes:
        if scene.name in table:
            raise ValueError(f"two scenes are called {scene.name!r}; give each a name of its own")
        table[scene.name] = scene
    return table
