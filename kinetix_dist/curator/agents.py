"""Agents that learn next to the policy of a run: another student, a teacher. They learn by the PPO of the
run, on its devices; their states are part of the state of the curriculum.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Protocol

from jax2d.scene import Array
from kinetix_dist.level.level import Level
from kinetix_dist.messages import StaticInput, Trajectory


class Agent(Protocol):
    """Something that learns by PPO."""

    def init(self) -> Any:
        """Its first state, a pytree of arrays with `params` among its attributes."""

    def learn(
        self, state: Any, static: StaticInput, trajectory: Trajectory, last_value: Array
    ) -> tuple[Any, dict[str, Array]]:
        """(next state, metrics by the names of the learner's) from T steps of worlds, each once and by groups.

        static [W, ...], trajectory [T, W, ...], last_value [W]; W: as many worlds as the policy learns from.
        Called where the curriculum observes, inside jit: the work is divided over the devices.
        """


@dataclasses.dataclass(frozen=True, kw_only=True)
class AgentPpo:
    """Settings of PPO in which an agent differs from the run, as in `PpoConfig`."""

    learning_rate: float
    epochs: int
    clip: float
    entropy_coefficient: float
    minibatches: int
    discount: float
    trace: float
    value_clip: bool


class Agents(Protocol):
    """Factory of agents, with the settings of the run."""

    def student(self) -> Agent:
        """One with the network, the observation and the PPO settings of the run's policy, and parameters of its own."""

    def teacher(self, policy: Any, distribution: Any, obs: Any, ppo: AgentPpo) -> Agent:
        """Agent that acts in no environment. policy: a flax module; distribution: an `ActionDistribution`; obs: shapes
        of the policy's input, [1, ...], which trajectories store in `dynamic_obs`."""

    def static_input(self, levels: Level) -> StaticInput:
        """Static part of a student's input on levels [W, ...]."""
