"""Mechanisms: cars, arms, flyers and the like, one of which a level may be built around.

    families/ -> registry.py: FAMILIES -> mechanism_draft.py: template -> table -> draft of a level

A new family is one function in a file of `families/`, with the decorator `registry.family`. It can then be drawn by its
name; recipes draw it where they give it a weight.
"""

import kinetix_dist.level.mechanisms.families  # noqa: F401, registers all of them
from kinetix_dist.level.mechanisms.registry import FAMILIES, fitting_families

__all__ = ["FAMILIES", "fitting_families"]
