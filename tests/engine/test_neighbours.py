"""What another island does changes no bit of this one."""

from __future__ import annotations

import numpy as np
import pytest

from tests.engine.promises import neighbours
from tests.engine.promises.cases import assert_kept, cases
from tests.engine.promises.promise import Promise, Solver

OPTIMISED = True  # the reference steps by the hundred: see tests/conftest.py


@pytest.mark.parametrize(("promise", "preset", "backend"), cases(neighbours.promises(), []))
def test_neighbour_changes_nothing(promise: Promise, preset: str, backend: str):
    assert_kept(promise, preset, backend)


@pytest.mark.parametrize("island", ["stack", "bouncing disc", "pendulum", "car", "welded tree"])
def test_islands_move(island: str):
    """Islands at rest would show nothing."""
    motion, _ = neighbours.alone(island, Solver())
    assert np.abs(motion.velocity).max() > 0.1
