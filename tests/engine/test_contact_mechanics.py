"""Impacts, friction and rolling follow their closed forms. The reference follows the kernel (test_reference.py)."""

from __future__ import annotations

import numpy as np
import pytest

from tests.engine.promises import contact_mechanics
from tests.engine.promises.cases import Broken, assert_kept, cases
from tests.engine.promises.contact_mechanics import MU, TARGETS, Impact, Throw, coulomb_impact
from tests.engine.promises.promise import PRESETS, Promise

COARSE = ("draft", "standard")
POINTS = "points of an impact are solved one after another, each at where it was found"
WELDED = "one throw of 64 is off by 5.04 %"
SEAMS = "a disc falls for up to a sub-step onto the next facet"
SLIPS = "links and contacts are solved in turn, and friction holds less than it should"
BROKEN = [
    Broken("contact: face of a box on a rough corner: closed form", PRESETS, POINTS),
    Broken("contact: corner of a box on a rough floor: closed form", ("standard", "fine"), POINTS),
    Broken("contact: corner of a box on a rough floor: welded halves", ("standard",), WELDED),
    Broken("contact: disc in a bowl", COARSE, SEAMS),
    Broken("contact: chain over a drum", ("draft",), SLIPS),
    Broken("contact: rolling hexagon", PRESETS, POINTS),
]


@pytest.mark.parametrize(("promise", "preset", "backend"), cases(contact_mechanics.promises(), BROKEN, reference=False))
def test_contact_follows_its_closed_form(promise: Promise, preset: str, backend: str):
    assert_kept(promise, preset, backend)


# The closed form of impacts


@pytest.mark.parametrize("target", sorted(TARGETS))
def test_impacts_of_the_closed_form_lose_energy_and_do_not_close(target: str):
    kinds = set()
    for throw, impact, _ in contact_mechanics.throws(target):
        velocity, spin = coulomb_impact(throw, impact)
        arm = impact.point - (np.array(throw.position) + impact.seconds * np.array(throw.velocity))
        point = velocity + spin * np.array([-arm[1], arm[0]])
        push = velocity - throw.velocity
        tangent = np.array([impact.normal[1], -impact.normal[0]])
        assert point @ impact.normal == pytest.approx(0, abs=1e-9)
        share = abs(push @ tangent) / (push @ impact.normal)
        sticks = abs(point @ tangent) < 1e-9
        assert share <= MU + 1e-9 and (sticks or share == pytest.approx(MU))
        kinds.add(sticks)
        assert energy(throw, velocity, spin) <= energy(throw, np.array(throw.velocity), throw.spin)
    assert kinds == {True, False}  # some stick and some slide


def test_square_that_falls_upright_on_its_middle_stops():
    throw = Throw(1.0, 1.0, 0.0, (0.0, 0.5), (0.0, -2.0), 0.0)
    velocity, spin = coulomb_impact(throw, Impact(0.0, np.zeros(2), np.array([0.0, 1.0])))
    np.testing.assert_allclose((*velocity, spin), 0, atol=1e-12)


def energy(throw: Throw, velocity: np.ndarray, spin: float) -> float:
    """J/kg."""
    return 0.5 * float(velocity @ velocity + throw.squared_radius * spin**2)
