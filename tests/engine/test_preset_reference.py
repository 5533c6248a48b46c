"""The preset `reference`, by which others are judged: it is converged, and stored solutions are what it computes."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from jax2d import preset
from jax2d.fidelity.reference_scenes import REFERENCE_SCENES
from jax2d.fidelity.references import SAMPLES_PER_SECOND, solve
from tests.engine.test_references import stored_positions

pytestmark = pytest.mark.long

OPTIMISED = True  # steps by the ten thousand: see tests/conftest.py

SCENE, SECONDS = "double_pendulum_path", 0.2  # tenths: it is sampled ten times a second
DIVISIONS = (256, 1024)  # of 1/60 s, the second that of the preset


@functools.cache
def solution(division: int) -> np.ndarray:
    """[samples, movable, 2] m, of as many steps whatever the division: one program. So a coarser one goes on longer."""
    seconds = SECONDS * DIVISIONS[1] / division
    (positions,) = solve(REFERENCE_SCENES[SCENE], divisions=(division,), seconds=seconds)
    return positions[: round(SECONDS * SAMPLES_PER_SECOND)]


def test_preset_reference_is_converged() -> None:
    """Errors are of first order in the step: that of the preset is a third of what four times the step changes."""
    assert preset("reference").dt == pytest.approx(1 / 60 / DIVISIONS[1])
    coarse, fine = map(solution, DIVISIONS)
    error = np.linalg.norm(coarse - fine, axis=-1).max() / 3
    assert 0 < error < 1e-4  # m


def test_stored_solution_is_what_the_command_computes() -> None:
    computed = solution(DIVISIONS[1])
    assert len(computed) == round(SECONDS * SAMPLES_PER_SECOND)
    stored = stored_positions(SCENE)[: len(computed)]
    assert computed == pytest.approx(stored, abs=1e-8)  # stored to 1e-9 m
