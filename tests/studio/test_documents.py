"""Checks of a document for an editor: all problems, warnings about the start, facts."""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from kinetix_dist.level.kinetix_format import export_kinetix, import_kinetix
from kinetix_dist.level.level_data import levels_root
from kinetix_dist.level.schema import level_from_json
from kinetix_dist.level.start_warnings import noop_warning, start_warnings
from kinetix_dist.studio.worker.document_check import check_document

DESIGNED = sorted(levels_root().glob("[sml]/*.json"))


def level_document() -> dict[str, Any]:
    """A box with a thruster, an arm on a joint and a ball, nothing odd."""
    return {
        "format": "kinetix-dist-level",
        "version": 1,
        "name": "plain",
        "size": "m",
        "shapes": [
            {"id": "box", "type": "box", "width": 1.0, "height": 0.5, "position": [1.0, 2.0], "role": "green"},
            {"id": "ball", "type": "circle", "radius": 0.3, "position": [4.0, 1.0], "role": "blue"},
            {"id": "arm", "type": "box", "width": 0.6, "height": 0.1, "position": [1.8, 2.0], "density": 2.0},
        ],
        "joints": [
            {
                "type": "revolute",
                "a": "box",
                "b": "arm",
                "anchor": [1.5, 2.0],
                "limits": [-0.5, 0.5],
                "motor": {"colour": 2},
            }
        ],
        "thrusters": [{"shape": "box", "anchor": [1.0, 1.75], "angle": math.pi / 2, "colour": 1}],
    }


def warnings_of(change: Callable[[dict[str, Any]], None]) -> list[tuple[str, tuple[str, ...]]]:
    document = level_document()
    change(document)
    checked = check_document(document)
    assert not checked.problems, checked.problems
    assert all("\n" not in warning.text for warning in checked.warnings)
    return [(warning.kind, warning.paths) for warning in checked.warnings]


def test_nothing_is_odd_about_a_plain_level() -> None:
    assert warnings_of(lambda document: None) == []


def test_shapes_that_lie_in_each_other_are_named_with_the_depth() -> None:
    document = level_document()
    document["shapes"][1]["position"] = [4.8, 1.0]  # 0.1 m into the right wall
    (warning,) = check_document(document).warnings
    assert (warning.kind, warning.paths) == ("overlap", ("walls.right_wall", "shapes[1]"))
    assert "0.1 m" in warning.text


def test_joined_shapes_may_overlap() -> None:
    # The arm reaches into the box: shapes of one body never touch.
    assert warnings_of(lambda document: document["shapes"][2].update(width=0.9)) == []


def test_green_that_touches_blue_or_red_at_the_start() -> None:
    def onto_blue(document: dict[str, Any]) -> None:
        document["shapes"][1]["position"] = [0.3, 2.0]

    assert {kind for kind, _ in warnings_of(onto_blue)} == {"already_solved", "overlap"}

    def onto_red(document: dict[str, Any]) -> None:
        document["walls"] = {"floor": {"role": "red"}}
        for shape in (document["shapes"][0], document["shapes"][2]):
            shape["position"][1] = 0.63  # the box reaches 0.02 m into the floor

        document["joints"][0]["anchor"] = [1.5, 0.63]
        document["thrusters"][0]["anchor"] = [1.0, 0.5]

    kinds = [kind for kind, _ in warnings_of(onto_red)]
    assert kinds == ["already_failed", "overlap"]


@pytest.mark.parametrize("motor", [None, {"on": False}, {"auto": True}, {"speed": 0.0}, {"power": 0.0}])
def test_a_level_that_nobody_can_control(motor: Any) -> None:
    def change(document: dict[str, Any]) -> None:
        document["thrusters"] = []
        if motor is None:
            del document["joints"][0]["motor"]
        else:
            document["joints"][0]["motor"] = motor

    assert [kind for kind, _ in warnings_of(change) if kind != "idle"] == ["uncontrollable"]


def test_a_thruster_on_what_is_fixed_controls_nothing() -> None:
    def change(document: dict[str, Any]) -> None:
        document["joints"], document["shapes"][0]["fixed"] = [], True

    assert ("uncontrollable", ()) in warnings_of(change)


def test_limits_that_are_not_met_at_the_start() -> None:
    assert warnings_of(lambda d: d["joints"][0].update(limits=[0.2, 0.5])) == [("limits", ("joints[0]",))]
    assert warnings_of(lambda d: d["joints"][0].update(limits=[0.2, 0.5], rest_angle=-0.3)) == []

    def slider(document: dict[str, Any]) -> None:
        del document["joints"][0]["anchor"]
        # 0.3 m along the axis from the one anchor to the other.
        document["joints"][0] |= {"type": "prismatic", "axis": 0.0, "anchor_a": [0.5, 0.0], "anchor_b": [0.0, 0.0]}
        document["joints"][0]["limits"] = [-0.1, 0.29]

    assert warnings_of(slider) == [("limits", ("joints[0]",))]

    def within(document: dict[str, Any]) -> None:
        slider(document)
        document["joints"][0]["limits"] = [-0.1, 0.31]

    assert warnings_of(within) == []


@pytest.mark.parametrize(
    ("motor", "says"),
    [
        ({"speed": 0.0}, "motor of speed 0: actions can make it brake"),
        ({"power": 0.0}, "motor of power 0: it does nothing"),
    ],
)
def test_a_motor_that_drives_nothing(motor: dict[str, float], says: str) -> None:
    document = level_document()
    document["joints"][0]["motor"] = motor
    (warning,) = check_document(document).warnings
    assert (warning.kind, warning.paths) == ("idle", ("joints[0]",)) and says in warning.text


def test_a_joint_between_two_fixed_shapes_and_a_thruster_that_pushes_nothing() -> None:
    def change(document: dict[str, Any]) -> None:
        document["shapes"][0] |= {"fixed": True}
        document["shapes"][2] |= {"fixed": True}

    assert warnings_of(change) == [("uncontrollable", ()), ("idle", ("joints[0]",)), ("idle", ("thrusters[0]",))]

    def to_a_wall(document: dict[str, Any]) -> None:
        document["shapes"][2] |= {"fixed": True}
        document["joints"][0]["a"] = "left_wall"

    assert warnings_of(to_a_wall)[0] == ("idle", ("joints[0]",))
    assert warnings_of(lambda d: d["thrusters"][0].update(power=0.0)) == [("idle", ("thrusters[0]",))]


def test_an_anchor_far_from_both_shapes() -> None:
    assert warnings_of(lambda d: d["joints"][0].update(anchor=[1.5, 4.9])) == [("anchor", ("joints[0]",))]
    # 0.2 m off, as axles that are not drawn are, and far from one of the two alone.
    assert warnings_of(lambda d: d["joints"][0].update(anchor=[1.5, 2.4])) == []
    assert warnings_of(lambda d: d["shapes"][2].update(position=[3.5, 2.0], width=0.2)) == []


def test_ends_of_a_joint_that_are_apart() -> None:
    def change(document: dict[str, Any]) -> None:
        del document["joints"][0]["anchor"]
        document["joints"][0] |= {"anchor_a": [0.5, 0.0], "anchor_b": [-0.3, 0.15]}

    document = level_document()
    change(document)
    (warning,) = check_document(document).warnings
    assert (warning.kind, warning.paths) == ("anchor", ("joints[0]",)) and "0.15 m apart" in warning.text


def test_the_same_joint_twice() -> None:
    def change(document: dict[str, Any]) -> None:
        document["joints"].append(document["joints"][0] | {"a": "arm", "b": "box"})

    assert warnings_of(change) == [("twice", ("joints[0]", "joints[1]"))]

    def elsewhere(document: dict[str, Any]) -> None:
        document["joints"].append(document["joints"][0] | {"anchor": [1.52, 2.05]})

    assert warnings_of(elsewhere) == []


def test_a_fixed_shape_may_reach_into_a_wall() -> None:
    """A ramp that is half in the floor, as people draw them; one that is all in it is a mistake."""
    assert warnings_of(lambda d: d["shapes"][1].update(position=[4.0, 0.3], fixed=True)) == []
    assert warnings_of(lambda d: d["shapes"][1].update(position=[4.0, 0.05], fixed=True)) == [
        ("outside", ("shapes[1]",))
    ]


def test_public_files_name_their_own_parts() -> None:
    document = level_document()
    document["joints"][0]["motor"] = {"speed": 0.0}
    document["shapes"][1]["position"] = [4.8, 1.0]
    public = export_kinetix(level_from_json(document))
    found = start_warnings(import_kinetix(public), public)
    assert [(warning.kind, warning.paths) for warning in found] == [
        ("overlap", ("env_state.polygon[2]", "env_state.circle[0]")),
        ("idle", ("env_state.joint[0]",)),
    ]


def test_a_shape_outside_of_the_box() -> None:
    assert ("outside", ("shapes[1]",)) in warnings_of(lambda d: d["shapes"][1].update(position=[7.0, 1.0]))
    assert ("outside", ("shapes[1]",)) in warnings_of(lambda d: d["shapes"][1].update(position=[2.0, 0.3]))


def test_solved_by_doing_nothing() -> None:
    assert noop_warning(None) == []
    (warning,) = noop_warning(17)
    assert warning.kind == "noop" and "17 steps" in warning.text


def test_facts_are_those_of_formulas() -> None:
    facts = check_document(level_document()).facts
    assert facts["counts"] == {"polygons": 2, "circles": 1, "joints": 1, "thrusters": 1}
    assert facts["free"] == {"polygons": 0, "circles": 2, "joints": 1, "thrusters": 1}
    assert facts["masses"]["shapes[0]"] == pytest.approx(0.5)
    assert facts["masses"]["shapes[1]"] == pytest.approx(math.pi * 0.09)
    assert facts["masses"]["shapes[2]"] == pytest.approx(0.12)
    assert facts["motor_colours"] == [2] and facts["thruster_colours"] == [1]
    fixed = level_document()
    fixed["shapes"][1]["fixed"] = True
    assert check_document(fixed).facts["masses"]["shapes[1]"] is None


@pytest.mark.parametrize("file", DESIGNED, ids=lambda file: f"{file.parent.name}/{file.stem}")
def test_designed_levels_have_no_problems_and_can_be_controlled(file: Any) -> None:
    checked = check_document(json.loads(file.read_text()))
    assert not checked.problems and checked.level is not None
    kinds = {warning.kind for warning in checked.warnings}
    assert not kinds & {"uncontrollable", "already_solved", "already_failed", "outside"}


def test_a_document_with_a_thousand_things_is_refused_at_once() -> None:
    document = level_document()
    document["shapes"] = [copy.deepcopy(document["shapes"][0]) for _ in range(10_000)]
    (problem,) = check_document(document).problems
    assert str(problem) == "shapes: has 10,000 entries; give at most 1,000"


def test_random_damage_never_breaks_the_check() -> None:
    """Documents without problems can be read, others cannot, with any value in any field."""
    draws = np.random.default_rng(0)
    values = [None, True, -1, 0, 1e300, math.nan, "", "box", "floor", [], [1], [0.0, 0.0], {}, {"a": 1}, [[0, 0]] * 5]
    for _ in range(300):
        document = level_document()
        for _ in range(int(draws.integers(1, 4))):
            place: Any = document
            while True:
                keys = list(place) if isinstance(place, dict) else range(len(place))
                if not keys:
                    break
                key = keys[int(draws.integers(len(keys)))]
                if isinstance(place[key], dict | list) and place[key] and draws.uniform() < 0.8:
                    place = place[key]
                    continue
                place[key] = copy.deepcopy(values[int(draws.integers(len(values)))])
                break
        checked = check_document(document)
        if checked.problems:
            with pytest.raises(ValueError):
                level_from_json(document)
            with pytest.raises(ValueError) as error:
                level_from_json(document)
            if document.get("size") in ("s", "m", "l"):
                assert str(error.value) == str(checked.problems[0])
        else:
            level_from_json(document)
