"""Scenes on which solvers fail, a file a subject, each with the limits that it must keep.

All scenes fit one capacity, so that they run as one batch; `hard_table` runs and checks them. Scenes with more phases
than time (tunnelling, a thousand bounces) stand in tests/engine.
"""

from __future__ import annotations

from jax2d.fidelity.hard_scenes import chains, extremes, machines, sliding, stacks
from jax2d.fidelity.hard_scenes.scene import CAPACITY, Check, HardScene, HardSceneBuilder
from jax2d.fidelity.study_scene import by_name

__all__ = ["CAPACITY", "Check", "HardScene", "HardSceneBuilder", "hard_scenes"]

SUBJECTS = (stacks, sliding, extremes, chains, machines)


def hard_scenes() -> list[HardScene]:
    """Returns all hard scenes, built, in the order of the published table."""
    return list(by_name([scene for subject in SUBJECTS for scene in subject.scenes()]).values())
