"""PAIRED (Dennis et al. 2020, "Emergent Complexity and Zero-shot Transfer via Unsupervised Environment Design").

A teacher builds all levels, action by action. Two students play each: the protagonist, which is the policy of the run,
and an antagonist with a network and a learner of its own. The teacher is rewarded with the regret of a level, what the
antagonist got there more than the protagonist: so it looks for levels that can be solved and are not solved yet.

    regret = mean return of the antagonist (or that of its best episode) - mean return of the protagonist

    propose     levels of the teacher; of each group the first half of the worlds is the protagonist's, the second half
                holds the same levels for the antagonist. Tags: how the levels were built, [W / 2, ...]
    players     who acts where
    summarise   what the antagonist learns from, [W / 2, ...], and returns [W]
    observe     the teacher learns from the regret, the antagonist from what it played

Both learn from what the update played, as the protagonist does. State: the learners of both, and what was last seen.

Departures from the paper: the antagonist counts by its mean. Its best episode would be one of as many as end within an
update, and a teacher that is paid for it finds levels of many short episodes that end either way (docs/lab_log.md). A
level is played by one world of each student. The teacher has no memory, since it sees all of the level that it builds.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from jax2d.scene import Array
from kinetix_dist import prng
from kinetix_dist.curator.config import CurriculumConfig
from kinetix_dist.curator.curriculum import Curriculum, CurriculumTools, Proposal
from kinetix_dist.curator.scores import highest_return, solve_rate
from kinetix_dist.curator.teacher import Teacher
from kinetix_dist.messages import LevelOutcome, Trajectory
from kinetix_dist.models.several_policies import SeveralPolicies, joined_shares, share_of

PROTAGONIST, ANTAGONIST = STUDENTS = range(2)
METRICS = (
    "regret",
    "protagonist_return",
    "antagonist_return",
    "protagonist_solve_rate",
    "antagonist_solve_rate",
    "teacher_entropy",
    "skipped_steps",
)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class PairedState:
    """Between two updates."""

    teacher: Any  # state of its learner
    antagonist: Any  # state of its learner
    seen: dict[str, Array]  # METRICS of the last update, float32, NaN before the first


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class PairedSummary:
    """Summary of a trajectory for `observe`."""

    max_return: Array  # [W] float32, of an episode that ended
    trajectory: Trajectory  # [W / 2, T, ...], the antagonist's
    last_value: Array  # [W / 2]


class Paired(Curriculum):
    """See the module docstring."""

    observes = True
    sections = ("paired",)
    sources = ("protagonist", "antagonist")  # who plays: levels all come from the teacher
    needs_whole_episodes = True
    draws_levels = False

    def __init__(self, tools: CurriculumTools) -> None:
        super().__init__(tools)
        self._teacher = Teacher(tools.capacity, tools.config.generator, tools.config.paired, tools.agents)
        self._antagonist = tools.agents.student()

    @classmethod
    def check(cls, config: CurriculumConfig, worlds_per_group: int) -> None:
        if worlds_per_group % 2:
            raise ValueError(
                f"{config.name!r} shares the worlds of a group between two students, but a group has "
                f"{worlds_per_group}; change rollout.num_envs or rollout.num_groups so that it is even"
            )

    @classmethod
    def num_trained(cls, config: CurriculumConfig, worlds_per_group: int) -> int:
        return worlds_per_group // 2

    def init(self) -> PairedState:
        unknown = {name: jnp.full((), jnp.nan, jnp.float32) for name in METRICS}
        return PairedState(teacher=self._teacher.init(), antagonist=self._antagonist.init(), seen=unknown)

    def players(self, policy: Any, params: Any, state: PairedState) -> tuple[SeveralPolicies, Any]:
        both = SeveralPolicies(policy, len(STUDENTS), self.tools.worlds_per_group)
        return both, (params, state.antagonist.params)

    def propose(self, state: PairedState, group_keys: Array, groups: Array) -> Proposal:
        del groups
        half = self.tools.worlds_per_group // 2
        keys = jax.vmap(lambda key: prng.split(key, half))(group_keys).reshape(-1)
        levels, trajectory = self._teacher.build(state.teacher.params, keys)
        size = self.tools.worlds_per_group
        players = [jnp.full(keys.size, student, jnp.int32) for student in STUDENTS]
        return Proposal(
            levels=joined_shares([levels] * len(STUDENTS), size),
            tags=_swap_time_and_worlds(trajectory),
            source=joined_shares(players, size),
        )

    def summarise(self, trajectory: Trajectory, last_value: Array) -> PairedSummary:
        return PairedSummary(
            max_return=highest_return(trajectory),
            trajectory=self._of(ANTAGONIST, _swap_time_and_worlds(trajectory)),
            last_value=self._of(ANTAGONIST, last_value),
        )

    def observe(self, state: PairedState, proposal: Proposal, outcome: LevelOutcome) -> PairedState:
        # One ended in every world: `needs_whole_episodes`. Means over the episodes of one world have no bias then.
        mean_return = outcome.return_sum / outcome.num_finished
        is_best = self.tools.config.paired.antagonist_return == "max"
        protagonist = self._of(PROTAGONIST, mean_return)
        antagonist = self._of(ANTAGONIST, outcome.summary.max_return if is_best else mean_return)
        regret = antagonist - protagonist
        teacher, of_teacher = self._teacher.learn(state.teacher, _swap_time_and_worlds(proposal.tags), regret)
        student, of_student = self._antagonist.learn(
            state.antagonist,
            self.tools.agents.static_input(self._of(ANTAGONIST, proposal.levels)),
            _swap_time_and_worlds(outcome.summary.trajectory),
            outcome.summary.last_value,
        )
        solved = solve_rate(outcome.num_solved, outcome.num_finished)
        seen = {
            "regret": regret.mean(),
            "protagonist_return": protagonist.mean(),
            "antagonist_return": antagonist.mean(),
            "protagonist_solve_rate": self._of(PROTAGONIST, solved).mean(),
            "antagonist_solve_rate": self._of(ANTAGONIST, solved).mean(),
            "teacher_entropy": of_teacher["entropy"],
            "skipped_steps": of_teacher["skipped_steps"] + of_student["skipped_steps"],
        }
        return PairedState(teacher=teacher, antagonist=student, seen=seen)

    def metrics(self, state: PairedState, num_updates: int) -> dict[str, Any]:
        del num_updates
        return {f"curriculum/{name}": state.seen[name] for name in METRICS}

    def _of(self, student: int, tree: Any) -> Any:
        return share_of(tree, student, len(STUDENTS), self.tools.worlds_per_group)


def _swap_time_and_worlds(tree: Any) -> Any:
    """[T, W, ...] <-> [W, T, ...]: what curricula observe has its worlds first."""
    return jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), tree)
