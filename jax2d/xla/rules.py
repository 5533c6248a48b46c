"""Choices of the settings that are compiled into the reference's programs."""

from __future__ import annotations

from typing import NamedTuple

from jax2d.settings import Settings


class Rules(NamedTuple):
    """Compiled choices of the settings."""

    solver: str
    friction_mixing: str
    substeps: int
    bounce_rounds: int
    impact_passes: int
    line_search: bool
    solver_batch_size: int
    report_contacts: bool = False

    @property
    def is_soft(self) -> bool:
        return self.solver == "soft_step"


def rules_of(settings: Settings, *, report_contacts: bool = False) -> Rules:
    return Rules(
        settings.solver,
        settings.friction_mixing,
        settings.substeps,
        settings.bounce_rounds,
        settings.impact_passes,
        settings.line_search,
        settings.solver_batch_size,
        report_contacts,
    )
