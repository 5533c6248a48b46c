"""Curricula whose tools are those that a test needs: any other that is called fails it."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from jax2d import Capacity
from kinetix_dist.actors.outcomes import no_outcomes
from kinetix_dist.curator.config import CurriculumConfig
from kinetix_dist.curator.curricula import curriculum_class
from kinetix_dist.curator.curriculum import Curriculum, CurriculumTools
from kinetix_dist.curator.scores import ValueSummary
from kinetix_dist.messages import LevelOutcome


def curriculum_of(
    config: CurriculumConfig,
    worlds_per_group: int,
    tools: type[CurriculumTools] = CurriculumTools,
    *,
    capacity: Capacity | None = None,
    **given: Any,
) -> Curriculum:
    """`given`: tools by name."""

    def unused(*arguments: Any) -> Any:
        raise AssertionError(f"this curriculum was to do without: {arguments}")

    functions = dict.fromkeys(("solves_itself", "play", "load_levels", "advantages", "agents"), unused) | given
    made = tools(config=config, capacity=capacity, worlds_per_group=worlds_per_group, max_steps=256, **functions)  # type: ignore[arg-type]
    return curriculum_class(config, worlds_per_group)(made)


def stand_in(numbers: Any) -> Any:
    """Return numbers that stand for levels: what is tested here never looks inside one."""
    return numbers


def played(levels: jax.Array, key: jax.Array, num_episodes: int) -> LevelOutcome:
    """Outcome of levels that are the chances with which the policy solves them, as its value function says."""
    solved = jax.random.uniform(key, (num_episodes, levels.size)) < levels
    none = no_outcomes(levels.size)
    return dataclasses.replace(
        none,
        num_finished=none.num_finished + num_episodes,
        num_solved=solved.sum(0, dtype=jnp.int32),
        first_solved=solved[0].astype(jnp.int32),
        summary=ValueSummary(
            mean_value=levels, max_return=solved.any(0) * 1.0, positive_value_loss=levels, l1_value_loss=levels
        ),
    )
