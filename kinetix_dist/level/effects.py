"""What levels can call for of the engine. Engines made for it have none of the code of the rest."""

from __future__ import annotations

from jax2d import Capacity, Effects, Settings

BEYOND_LEVELS = ("kinematic_bodies", "brakes_and_servos", "springs")  # no level format has them


def level_effects(capacity: Capacity, settings: Settings) -> Effects:
    return Effects.full(capacity).without(*BEYOND_LEVELS).known_to(settings.solver)
