"""What another island does changes no bit of this one."""

from __future__ import annotations

import numpy as np
import pytest

from tests.engine.promises import neighbours
from tests.engine.promises.cases import Broken, assert_kept, cases
from tests.engine.promises.promise import PRESETS, Promise, Solver

OPTIMISED = True  # the reference steps by the hundred: see tests/conftest.py

FOUND_AGAIN = "contacts are found again, and impacts begun, for a whole world where one body asks for it"
BOUNCES = "restitution is solved, and its energy judged, for a whole world"
BROKEN = [
    *(
        Broken(f"neighbours: {island} beside {neighbour}", PRESETS, FOUND_AGAIN)
        for island in ("stack", "bouncing disc", "pendulum", "car", "welded tree")
        for neighbour in ("spinner", "stirrer")
    ),
    *(
        Broken(f"neighbours: {island} beside bouncing disc", PRESETS, BOUNCES)
        for island in ("stack", "pendulum", "car", "welded tree")
    ),
    Broken("neighbours: height of a disc", ("draft", "standard"), FOUND_AGAIN),
]


@pytest.mark.parametrize(("promise", "preset", "backend"), cases(neighbours.promises(), BROKEN))
def test_neighbour_changes_nothing(promise: Promise, preset: str, backend: str):
    assert_kept(promise, preset, backend)


@pytest.mark.parametrize("island", ["stack", "bouncing disc", "pendulum", "car", "welded tree"])
def test_islands_move(island: str):
    """Islands at rest would show nothing."""
    motion, _ = neighbours.alone(island, Solver())
    assert np.abs(motion.velocity).max() > 0.1
