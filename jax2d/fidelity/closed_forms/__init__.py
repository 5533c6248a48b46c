"""Scenes with a formula, a file a subject: the scene, what the formula says, and how far a trajectory is from it."""

from __future__ import annotations

from jax2d.fidelity.closed_forms import contact_groups, free_motion, friction, impacts, joints
from jax2d.fidelity.closed_forms.form import CAPACITY
from jax2d.fidelity.study_scene import by_name

__all__ = ["CAPACITY", "CLOSED_FORMS"]

SUBJECTS = (free_motion, friction, impacts, joints, contact_groups)
CLOSED_FORMS = by_name([scene for subject in SUBJECTS for scene in subject.FORMS.scenes])
