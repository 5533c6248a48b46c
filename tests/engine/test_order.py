"""Slots of shapes and joints, ends of joints and first corners decide nothing; what is symmetric stays so."""

from __future__ import annotations

import pytest

from tests.engine.promises import order
from tests.engine.promises.cases import Broken, assert_kept, cases
from tests.engine.promises.promise import PRESETS, Promise

CONTACTS = "contacts are solved in the order of the shapes' slots"
AXIS = "the axis of a slider turns with its body a, and its row acts at the anchor of b"
BROKEN = [
    Broken("order: slots of shapes, on a floor", PRESETS, CONTACTS),
    Broken("order: ends of sliders", PRESETS, AXIS),
    Broken("order: symmetric billiard break", PRESETS, CONTACTS),
    Broken("order: symmetric bridge", ("draft",), CONTACTS),
    Broken("order: symmetric pile", PRESETS, CONTACTS),
    Broken("order: symmetric welded cross", ("draft", "standard"), CONTACTS),
]


@pytest.mark.parametrize(("promise", "preset", "backend"), cases(order.promises(), BROKEN))
def test_order_decides_nothing(promise: Promise, preset: str, backend: str):
    assert_kept(promise, preset, backend)
