"""Declaration of scenes with a formula, their common capacity, and their errors.

    FORMS = ClosedForms()

    @FORMS.add("free_fall", metric="height error / height fallen", seconds=1.5)
    def free_fall(b: SceneBuilder) -> Error: ...

Each function adds its bodies to a builder of CAPACITY and returns the error as a function of a `Trajectory`. Errors
have no unit and no sign: each is divided by the size of what it measures, so that 0.01 is one per cent everywhere;
angles are in rad. A coefficient of friction mu is that between two shapes which both carry it
(`units.with_plain_friction`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from jax2d.builder import SceneBuilder
from jax2d.fidelity.study_scene import Error, StudyScene
from jax2d.fidelity.units import G
from jax2d.scene import Capacity

# One capacity for all scenes, so that one compiled engine runs them all.
CAPACITY = Capacity(polygons=7, circles=3, joints=3, thrusters=2)

Build = Callable[[SceneBuilder], Error]


@dataclasses.dataclass
class ClosedForms:
    """The scenes of one subject."""

    scenes: list[StudyScene] = dataclasses.field(default_factory=list)

    def add(
        self,
        name: str,
        *,
        metric: str,
        seconds: float,
        gravity: float = G,
        control: float = 0.0,
        needs_joint_force: bool = False,
    ) -> Callable[[Build], Build]:
        """Declares the decorated function's scene; arguments are fields of `StudyScene`."""

        def declare(build: Build) -> Build:
            self.scenes.append(
                StudyScene(
                    name=name,
                    metric=metric,
                    seconds=seconds,
                    capacity=CAPACITY,
                    gravity=gravity,
                    control=control,
                    needs_joint_force=needs_joint_force,
                    build=build,
                )
            )
            return build

        return declare


def relative_error(value: float, expected: float) -> float:
    return abs(value - expected) / abs(expected)


def distance(value: np.ndarray, expected: Sequence[float] | np.ndarray) -> float:
    return float(np.linalg.norm(np.asarray(value) - np.asarray(expected)))
