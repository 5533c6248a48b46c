"""What nothing drives gains no energy, however long it is looked at: chains that limits lock, and levels with them."""

from __future__ import annotations

import pytest

from tests.engine.promises import passivity
from tests.engine.promises.cases import Broken, assert_kept, cases
from tests.engine.promises.promise import Promise

OPTIMISED = True  # the reference steps by the hundred: see tests/conftest.py

RATE = "judged energy may grow by 5 /s of it and 0.3 W/kg: a rate bounds nothing over time"
BROKEN = [
    Broken("passivity: chain with limits of 0 rad", ("draft", "standard", "fine"), RATE),
    Broken("passivity: chain with limits of 0.001 rad, last link at 6 rad/s", ("standard",), RATE),
    Broken("passivity: level pole_a", ("draft", "standard"), RATE),
    Broken("passivity: level pole_b", ("draft", "standard", "fine"), RATE),
]


@pytest.mark.parametrize(("promise", "preset", "backend"), cases(passivity.promises(), BROKEN))
def test_what_nothing_drives_gains_no_energy(promise: Promise, preset: str, backend: str):
    assert_kept(promise, preset, backend)
