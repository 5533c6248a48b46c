"""Slots of shapes and joints, ends of joints and first corners decide nothing; what is symmetric stays so."""

from __future__ import annotations

import pytest

from tests.engine.promises import order
from tests.engine.promises.cases import Broken, assert_kept, cases
from tests.engine.promises.promise import Promise

ALL = ("draft", "standard", "fine")
JOINTS = "joints are solved in the order of their slots"
CONTACTS = "contacts are solved in the order of the shapes' slots"
AXIS = "the axis of a slider turns with its body a, and its row acts at the anchor of b"
BROKEN = [
    Broken("order: slots of shapes, on a floor", ALL, CONTACTS),
    Broken("order: slots of joints", ALL, JOINTS),
    Broken("order: ends of sliders", ALL, AXIS),
    Broken("order: symmetric billiard break", ALL, CONTACTS),
    Broken("order: symmetric bridge", ALL, JOINTS),
    Broken("order: symmetric pile", ALL, CONTACTS),
    Broken("order: symmetric welded cross", ALL, JOINTS),
    Broken("order: speeds of the halves", ALL, CONTACTS),
]


@pytest.mark.parametrize(("promise", "preset", "backend"), cases(order.promises(), BROKEN))
def test_order_decides_nothing(promise: Promise, preset: str, backend: str):
    assert_kept(promise, preset, backend)
