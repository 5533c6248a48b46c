"""What nothing drives gains no energy, however long it is looked at: chains that limits lock, and levels with them."""

from __future__ import annotations

import pytest

from tests.engine.promises import passivity
from tests.engine.promises.cases import assert_kept, cases
from tests.engine.promises.promise import Promise

OPTIMISED = True  # the reference steps by the hundred: see tests/conftest.py


@pytest.mark.parametrize(("promise", "preset", "backend"), cases(passivity.promises(), []))
def test_what_nothing_drives_gains_no_energy(promise: Promise, preset: str, backend: str):
    assert_kept(promise, preset, backend)
