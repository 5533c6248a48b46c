"""Angles of many turns: the level that they make is that of the same directions within a turn."""

from __future__ import annotations

import copy
import math
from typing import Any

import jax
import numpy as np
import pytest

from jax2d.builder import SceneBuilder
from jax2d.builder_checks import reduced
from jax2d.scene import Capacity
from kinetix_dist.level.kinetix_format import export_kinetix, import_kinetix
from kinetix_dist.level.schema import level_from_json
from tests.level.documents import cart_document

TURNS = 100_000  # in float32 the angle of so many is a multiple of 1/16 rad
TOLERANCE_RAD = 1e-6  # of the remainder in float64 at 6e5 rad: 1e-10; float32 at 3 rad: 2e-7


def turned(document: dict[str, Any], turns: float) -> dict[str, Any]:
    """Return a document with more full turns in each angle: of shapes, of thrusters, and of axes of sliders."""
    document = copy.deepcopy(document)
    for element in [*document["shapes"], *document["thrusters"]]:
        element["angle"] = element.get("angle", 0.0) + math.tau * turns
    return document


def document_with_angles() -> dict[str, Any]:
    document = cart_document()
    document["shapes"][0]["angle"] = 0.3
    document["shapes"][2]["angle"] = -1.1
    document["joints"][0] = document["joints"][0] | {"rest_angle": -1.4, "limits": [-1.0, 2.0]}
    return document


@pytest.mark.parametrize("turns", [TURNS, -TURNS, 1.0e4, 2])
def test_turns_change_no_level(turns: float) -> None:
    plain, many = (level_from_json(turned(document_with_angles(), k)) for k in (0, turns))
    for ours, expected in zip(jax.tree.leaves(many), jax.tree.leaves(plain), strict=True):
        np.testing.assert_allclose(ours, expected, rtol=0, atol=TOLERANCE_RAD)


def test_an_angle_within_a_turn_stays_bit_for_bit() -> None:
    for angle in (0.0, -0.0, 3.0, 6.0, -6.28, math.tau, -math.tau):
        assert math.copysign(1, reduced(angle)) == math.copysign(1, angle) and reduced(angle) == angle
    assert abs(reduced(6.3)) <= math.pi


@pytest.mark.parametrize("kind", ["revolute", "fixed"])
def test_a_joint_stands_as_before(kind: str) -> None:
    """The bend angle_b - angle_a - rest_angle of a joint whose end b was turned often, with the rest angle."""
    document = document_with_angles()
    joint = document["joints"][0]
    if kind == "fixed":
        document["joints"][0] = joint = {k: v for k, v in joint.items() if k not in ("limits", "motor")}
        joint["type"] = kind
    before = level_from_json(document)
    by_name = {shape["id"]: shape for shape in document["shapes"]}
    by_name[joint["b"]]["angle"] = by_name[joint["b"]].get("angle", 0.0) + math.tau * TURNS
    joint["rest_angle"] += math.tau * TURNS
    after = level_from_json(document)
    for name in ("rest_angle", "lower_limit", "upper_limit"):
        np.testing.assert_allclose(
            getattr(after.scene.joints, name), getattr(before.scene.joints, name), rtol=0, atol=TOLERANCE_RAD
        )


def test_limits_keep_the_number_of_turns() -> None:
    """A joint that starts three turns away from its zero, with limits that let it: a reduced rest angle would not."""
    document = document_with_angles()
    document["joints"][0] |= {"rest_angle": -1.4 - 3 * math.tau, "limits": [0.0, 8 * math.tau]}
    joints = level_from_json(document).scene.joints
    assert abs(joints.rest_angle[0]) == pytest.approx(1.4 + 3 * math.tau, abs=1e-5)


def test_public_files_are_read_alike() -> None:
    document = export_kinetix(level_from_json(document_with_angles()))
    many = copy.deepcopy(document)
    state = many["env_state"]
    for row in [*state["polygon"], *state["circle"], *state["thruster"]]:
        row["rotation"] += math.tau * TURNS
    for ours, expected in zip(*(jax.tree.leaves(import_kinetix(one)) for one in (many, document)), strict=True):
        np.testing.assert_allclose(ours, expected, rtol=0, atol=TOLERANCE_RAD)


@pytest.mark.parametrize("turns", [TURNS, -3])
def test_a_scene_is_built_alike(turns: float) -> None:
    def built(more: float) -> Any:
        builder = SceneBuilder(Capacity(polygons=2, circles=0, joints=1, thrusters=1))
        a = builder.add_box(width=1.0, height=0.2, position=(1.0, 1.0), angle=0.3 + more)
        b = builder.add_box(width=1.0, height=0.2, position=(2.0, 1.0), angle=-2.0)
        builder.add_prismatic_joint(a, b, at=(1.5, 1.0), axis_angle=0.7 + more)
        builder.add_thruster(b, at=(2.0, 1.0), angle=1.0 + more)
        return builder.build()

    for ours, expected in zip(jax.tree.leaves(built(math.tau * turns)), jax.tree.leaves(built(0.0)), strict=True):
        np.testing.assert_allclose(ours, expected, rtol=0, atol=TOLERANCE_RAD)
