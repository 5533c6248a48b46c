"""Curricula whose tools are those that a test needs: any other that is called fails it."""

from __future__ import annotations

from typing import Any

from jax2d import Capacity
from kinetix_dist.curator.config import CurriculumConfig
from kinetix_dist.curator.curricula import curriculum_class
from kinetix_dist.curator.curriculum import Curriculum, CurriculumTools


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

    functions = dict.fromkeys(("solves_itself", "play", "load_levels", "advantages"), unused) | given
    made = tools(config=config, capacity=capacity, worlds_per_group=worlds_per_group, **functions)  # type: ignore[arg-type]
    return curriculum_class(config, worlds_per_group)(made)
