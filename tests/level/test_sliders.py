"""Prismatic joints in levels: the format, what it refuses, and a designed level that needs one."""

from __future__ import annotations

import math

import numpy as np
import pytest

from jax2d.scene import JointKind
from kinetix_dist.env.environment import EnvConfig, Environment
from kinetix_dist.level.document import level_to_json
from kinetix_dist.level.kinetix_format import export_kinetix
from kinetix_dist.level.schema import LevelFormatError, level_from_json
from kinetix_dist.level.sets import load_level_set
from tests.level.documents import cart_document


def slider_document(**changes: object) -> dict:
    """The cart with a slider from its chassis to the wedge, turned by 0.3 rad; `changes` to the joint."""
    document = cart_document()
    document["shapes"][0]["angle"] = 0.3
    document["joints"] = [
        {"type": "prismatic", "a": "chassis", "b": "wedge", "axis": 0.2, "anchor": [2.0, 0.8], "limits": [-0.4, 1.0]}
        | changes
    ]
    return document


def test_a_slider_reads_and_writes_its_axis_and_limits() -> None:
    level = level_from_json(slider_document())
    joints = level.scene.joints
    assert joints.kind[0] == JointKind.PRISMATIC
    np.testing.assert_allclose([joints.axis_angle[0], joints.rest_angle[0]], [0.2, 0.2], atol=1e-6)
    np.testing.assert_allclose([joints.lower_limit[0], joints.upper_limit[0]], [-0.4, 1.0])
    written = level_to_json(level)["joints"][0]
    assert (written["type"], written["axis"], written["limits"]) == ("prismatic", 0.2, [-0.4, 1.0])
    again = level_from_json(level_to_json(level))
    np.testing.assert_array_equal(again.scene.joints.axis_angle, joints.axis_angle)


def test_the_axis_of_a_slider_is_kept_between_minus_and_plus_half_a_turn() -> None:
    axis = level_from_json(slider_document()).scene.joints.axis_angle
    a_turn_more = level_from_json(slider_document(axis=0.2 + 2 * math.pi)).scene.joints.axis_angle
    # The wedge is turned by 0.2 rad more than the chassis: in its frame the axis points along 0, and back along pi.
    from_the_other_end = level_from_json(slider_document(a="wedge", b="chassis", axis=math.pi)).scene.joints.axis_angle
    np.testing.assert_allclose(a_turn_more, axis, atol=1e-6)
    np.testing.assert_allclose(from_the_other_end, axis, atol=1e-6)


def test_anchors_of_a_slider_may_be_apart_along_its_axis_only() -> None:
    along = {"anchor": None, "anchor_a": [0.3, 0.0], "anchor_b": [0.0, 0.0]}  # wedge at (3, 0.4), chassis at (1, 1)
    start = np.array([1.0, 1.0]) + 0.3 * np.array([np.cos(0.3), np.sin(0.3)])
    to_wedge = np.array([3.0, 0.4]) - start
    axis = float(np.arctan2(to_wedge[1], to_wedge[0])) - 0.3
    document = slider_document(**along, axis=axis)
    del document["joints"][0]["anchor"]
    level_from_json(document)
    document["joints"][0]["axis"] = axis + 0.25
    with pytest.raises(LevelFormatError, match=r"joints\[0\]: its anchors are 0\.\d+ m apart across its axis"):
        level_from_json(document)


@pytest.mark.parametrize(
    ("joint", "message"),
    [
        ({"type": "revolute"}, r"joints\[0\].axis: a revolute joint has no axis; remove it or use type 'prismatic'"),
        ({"axis": "up"}, r"joints\[0\].axis: is 'up'; give a value of type number"),
    ],
)
def test_a_wrong_slider_is_refused_by_name(joint: dict, message: str) -> None:
    with pytest.raises(LevelFormatError, match=message):
        level_from_json(slider_document(**joint))


def test_a_slider_without_axis_is_refused() -> None:
    document = slider_document()
    del document["joints"][0]["axis"]
    with pytest.raises(LevelFormatError, match=r"joints\[0\].axis: is missing; give the angle"):
        level_from_json(document)


def test_public_files_cannot_hold_a_slider() -> None:
    with pytest.raises(LevelFormatError, match=r"joints\[0\]: is prismatic, which public files cannot hold"):
        export_kinetix(level_from_json(slider_document()))


def test_the_lift_is_solved_by_its_motor_and_not_by_nobody() -> None:
    env = Environment(EnvConfig(size="m"))
    levels, _ = load_level_set("sliders")
    prepared = env.prepare(levels)
    solved = []
    for choice in (0, 1):  # off, forward
        state, _ = env.reset(prepared)
        actions = np.zeros((len(levels.position), 6), np.int32)
        actions[:, 0] = choice
        for _ in range(90):  # 3 s
            state, _, _, done, info = env.step(prepared, state, actions)
            if done.all():
                break
        solved.append(bool(info.solved.all()))
    assert solved == [False, True]
