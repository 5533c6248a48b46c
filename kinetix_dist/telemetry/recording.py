"""Rollout: one attempt at one level, as numpy. What is recorded, replayed, drawn.

A rollout of `T` steps has `T + 1` states. Step `k` (0-based) leads from state `k` to state `k + 1`: it has
`actions[k]`, the motor and thruster commands they turned into, and `reward[k]`. This file knows no level
format: a rollout carries the level's JSON text, and whatever decoded it (see evaluation/recordings.py).
"""

from __future__ import annotations

import dataclasses
from typing import Any, Protocol

import numpy as np

from jax2d.scene import Scene

OUTCOMES = ("solved", "failed", "unstable", "out of time", "cut")


class RecordedLevel(Protocol):
    """Level as a replay needs it: bodies, where they start, and who plays which role."""

    @property
    def scene(self) -> Scene: ...

    @property
    def shape_role(self) -> Any:  # [n] int
        ...

    @property
    def position(self) -> Any:  # [n, 2] m, at the start
        ...

    @property
    def angle(self) -> Any:  # [n] rad
        ...


@dataclasses.dataclass(frozen=True)
class ActionName:
    """Name of one number of an action, and those of its values from 0 on; no values: a number in a range."""

    name: str
    values: tuple[str, ...] = ()

    @property
    def legend(self) -> str:
        """The name with its values: "motor colour 0: 0 off, 1 forward, 2 backward"."""
        values = ", ".join(f"{number} {value}" for number, value in enumerate(self.values))
        return f"{self.name}: {values}" if values else self.name

    def words(self, value: float) -> str:
        """An action in words: "motor colour 0: forward"."""
        is_named = value == int(value) and 0 <= value < len(self.values)
        return f"{self.name}: {self.values[int(value)] if is_named else f'{value:g}'}"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Rollout:
    """One attempt of `T` steps at a level of `n` shapes, `J` joints, `K` thrusters, `A` action dimensions."""

    level: RecordedLevel
    level_json: str  # the level in the level file format: a recording needs no other file
    level_name: str
    position: np.ndarray  # [T + 1, n, 2] float32 m, centre of mass
    angle: np.ndarray  # [T + 1, n] float32 rad
    velocity: np.ndarray  # [T + 1, n, 2] float32 m/s
    angular_velocity: np.ndarray  # [T + 1, n] float32 rad/s
    actions: np.ndarray  # [T, A] float32, as the policy chose them
    motor: np.ndarray  # [T, J] float32, -1..1, share of each motor's target speed
    thruster: np.ndarray  # [T, K] float32, 0..1, share of each thruster's power
    reward: np.ndarray  # [T] float32
    solved: bool
    failed: bool  # green touched red
    unstable: bool = False  # the physics gave a number that is not finite; none of the three: out of time
    policy_version: int  # policy updates before this rollout; -1 for no policy (random actions)
    seed: int
    step_seconds: float  # simulated time of one step
    action_names: tuple[ActionName, ...] = ()  # of each action dimension; none: an older recording
    is_complete: bool = True  # False: the end is missing, because the file it was read from is cut or damaged

    def __post_init__(self) -> None:
        steps, shapes = self.num_steps, self.num_shapes
        expected = {
            "position": (steps + 1, shapes, 2),
            "angle": (steps + 1, shapes),
            "velocity": (steps + 1, shapes, 2),
            "angular_velocity": (steps + 1, shapes),
            "actions": (steps, *self.actions.shape[1:2]),
            "motor": (steps, *np.shape(self.level.scene.joints.active)),
            "thruster": (steps, *np.shape(self.level.scene.thrusters.active)),
            "reward": (steps,),
        }
        for name, shape in expected.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"Rollout.{name} has shape {getattr(self, name).shape}; this level needs {shape}")

        if self.action_names and len(self.action_names) != self.actions.shape[1]:
            raise ValueError(f"{len(self.action_names)} names for {self.actions.shape[1]} action dimensions")

    @property
    def names_of_actions(self) -> tuple[ActionName, ...]:
        """Name of each action dimension; its number where the recording has no names."""
        return self.action_names or tuple(ActionName(f"action {k}") for k in range(self.actions.shape[1]))

    @property
    def num_steps(self) -> int:
        return self.reward.shape[0]

    @property
    def num_shapes(self) -> int:
        return np.shape(self.level.scene.shapes.active)[0]

    @property
    def outcome(self) -> str:
        """One of OUTCOMES: how it ended, or "cut" when the end was not recorded."""
        if not self.is_complete:
            return "cut"
        ended = [name for name in ("solved", "failed", "unstable") if getattr(self, name)]
        return ended[0] if ended else "out of time"

    @property
    def seconds(self) -> np.ndarray:
        """[T + 1] simulated time of each state, s."""
        return np.arange(self.num_steps + 1) * self.step_seconds


@dataclasses.dataclass(frozen=True, kw_only=True)
class Recording:
    """Content of one file: its rollouts, and its faults, one line each."""

    path: str
    rollouts: tuple[Rollout, ...]
    problems: tuple[str, ...] = ()


class RecordingError(ValueError):
    """A file that is no recording, or one that cannot be read at all."""
