"""A world that drifts, is turned, mirrored or shifted moves as it did, to rounding."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from tests.engine.promises import frame
from tests.engine.promises.cases import Broken, assert_kept, cases
from tests.engine.promises.frame import FLYING, GROUNDED, drawn_world, frame_error
from tests.engine.promises.plan import Plan, adrift, mirrored, shifted, turned
from tests.engine.promises.promise import Promise, Solver

ROUNDING = "joints are eliminated by x and y of the world: what that rounds off is not the same once turned"
BROKEN = [Broken("frame: turn, on a floor", ("fine",), ROUNDING)]


@pytest.mark.parametrize(("promise", "preset", "backend"), cases(frame.promises(), BROKEN))
def test_frame_changes_nothing(promise: Promise, preset: str, backend: str):
    assert_kept(promise, preset, backend)


def test_a_drift_that_is_off_by_a_thousandth_is_seen():
    right = frame.drift(20.0)
    off = right._replace(change=frame.drift(20.02).change)
    assert frame_error(right, FLYING, Solver()) < 1 < frame_error(off, FLYING, Solver())


# The worlds that are looked at


def test_what_is_moved_and_moved_back_is_the_same_world():
    plan = drawn_world(0, GROUNDED)
    assert mirrored(mirrored(plan))._replace(joints=()) == plan._replace(joints=())
    for joint, again in zip(plan.joints, mirrored(mirrored(plan)).joints, strict=True):
        assert dataclasses.replace(again, axis_angle=joint.axis_angle) == joint
        assert np.isclose(again.axis_angle, joint.axis_angle)
    for changed in (turned(turned(plan, 0.7), -0.7), shifted(shifted(plan, (3, 4)), (-3, -4))):
        assert_alike(changed, plan)
    assert_alike(adrift(adrift(drawn_world(0, FLYING), (3, 4)), (-3, -4)), drawn_world(0, FLYING))


def test_drawn_worlds_touch_and_are_joined_in_every_way():
    plans = frame.worlds(FLYING)
    kinds = {(joint.kind, joint.limits is not None, joint.speed is not None) for p in plans for joint in p.joints}
    assert kinds >= {
        ("hinge", False, False),
        ("hinge", True, False),
        ("hinge", False, True),
        ("weld", False, False),
        ("slider", True, False),
        ("slider", False, True),
    }


def assert_alike(one: Plan, other: Plan) -> None:
    for a, b in zip(one.build(frame.CAPACITY)[1:], other.build(frame.CAPACITY)[1:], strict=True):
        np.testing.assert_allclose(a, b, atol=2e-6)
    for name in ("anchor_a", "anchor_b", "axis_angle", "rest_angle"):
        a, b = (getattr(plan.build(frame.CAPACITY).scene.joints, name) for plan in (one, other))
        np.testing.assert_allclose(a, b, atol=2e-6)
