"""All promises, family by family."""

from __future__ import annotations

from tests.engine.promises import contact_mechanics, frame, mechanisms, neighbours, order, passivity
from tests.engine.promises.promise import Promise

FAMILIES = (mechanisms, passivity, frame, neighbours, order, contact_mechanics)


def all_promises() -> list[Promise]:
    return [promise for family in FAMILIES for promise in family.promises()]
