"""The level format: what a document means, that writing and reading agree, and that each mistake is named."""

from __future__ import annotations

import copy
import json
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from kinetix_dist.level.document import LevelInfo, level_to_json
from kinetix_dist.level.fit import usage
from kinetix_dist.level.level import SIZES, Role
from kinetix_dist.level.schema import LevelFormatError, level_from_json, load_level, save_level
from kinetix_dist.level.validate import problems_of
from tests.level.documents import cart_document


def test_a_box_has_the_mass_and_inertia_of_its_formula() -> None:
    scene = level_from_json(cart_document()).scene
    mass = 1.0 * 0.2  # density 1 kg/m^2
    np.testing.assert_allclose(1 / scene.shapes.inverse_mass[4], mass, rtol=1e-6)
    np.testing.assert_allclose(1 / scene.shapes.inverse_inertia[4], mass * (1.0**2 + 0.2**2) / 12, rtol=1e-5)


def test_a_disc_has_the_inertia_half_m_r_squared_and_a_fixed_one_never_moves() -> None:
    scene = level_from_json(cart_document()).scene
    mass = math.pi * 0.2**2
    np.testing.assert_allclose(1 / scene.shapes.inverse_inertia[6], 0.5 * mass * 0.2**2, rtol=1e-5)
    assert scene.shapes.inverse_mass[7] == 0.0 and scene.shapes.inverse_inertia[7] == 0.0


def test_a_triangle_is_moved_onto_its_centroid_and_stays_where_it_was() -> None:
    level = level_from_json(cart_document())
    corners = level.scene.shapes.vertices[5, :3]
    np.testing.assert_allclose(corners.mean(axis=0), 0.0, atol=1e-6)  # a triangle's centroid is its vertex mean
    cos, sin = math.cos(0.5), math.sin(0.5)
    world = level.position[5] + corners @ np.array([[cos, sin], [-sin, cos]])
    to_origin = np.linalg.norm(world - [3.0, 0.4], axis=-1)  # where the document puts the origin, one of its corners
    np.testing.assert_allclose(to_origin.min(), 0.0, atol=1e-6)
    np.testing.assert_allclose(1 / level.scene.shapes.inverse_mass[5], 2.0 * 0.5 * 0.6 * 0.3, rtol=1e-6)
    np.testing.assert_allclose(level.scene.shapes.vertices[5, 3], corners[2])  # padding repeats the last corner


def test_anchors_of_joints_and_thrusters_stay_where_they_were_in_the_world() -> None:
    level = level_from_json(cart_document())
    scene = level.scene
    for body, local, expected in (
        (scene.joints.a[0], scene.joints.anchor_a[0], [0.6, 0.9]),
        (scene.joints.b[0], scene.joints.anchor_b[0], [0.6, 0.9]),
        (scene.thrusters.body[0], scene.thrusters.position[0], [3.0, 0.4]),
    ):
        cos, sin = math.cos(level.angle[body]), math.sin(level.angle[body])
        world = level.position[body] + np.array([[cos, -sin], [sin, cos]]) @ local
        np.testing.assert_allclose(world, expected, atol=1e-6)


def test_roles_motors_and_colours_are_read() -> None:
    level = level_from_json(cart_document())
    assert level.shape_role[4] == Role.GREEN and level.shape_role[7] == Role.BLUE
    assert level.scene.joints.motor_on[0] and level.motor_colour[0] == 3 and level.thruster_colour[0] == 1
    assert (level.scene.joints.motor_speed[0], level.scene.joints.motor_power[0]) == (2.0, 1.5)


def test_writing_and_reading_again_gives_the_same_level(tmp_path: Path) -> None:
    document = cart_document()
    document["walls"] = {"floor": {"role": "red", "friction": 0.5}}
    document["joints"][0]["limits"] = [-1.0, 0.5]
    document["shapes"][0] |= {"velocity": [1.0, -2.0], "angular_velocity": 3.0, "collision": "ghost"}
    level = level_from_json(document)
    path = tmp_path / "cart.json"
    save_level(level, path, LevelInfo(name="cart", size="m", description="rolls"))
    again, info = load_level(path)
    assert info == LevelInfo(name="cart", size="m", description="rolls")
    for leaf, other in zip(jax.tree.leaves(level), jax.tree.leaves(again)):
        np.testing.assert_allclose(leaf, other, rtol=1e-5, atol=1e-6)  # the centroid is computed again in float32


def test_a_written_level_has_one_line_a_shape(tmp_path: Path) -> None:
    path = tmp_path / "cart.json"
    save_level(level_from_json(cart_document()), path, LevelInfo(name="cart", size="m"))
    lines = path.read_text().splitlines()
    assert sum('"type": "circle"' in line for line in lines) == 2
    assert json.loads(path.read_text())["shapes"][0]["role"] == "green"


def test_a_level_can_be_read_into_a_larger_size_but_not_a_smaller_one() -> None:
    assert usage(level_from_json(cart_document(), "l")) == usage(level_from_json(cart_document()))
    with pytest.raises(LevelFormatError, match="shapes: 2 boxes and polygons, size s has room for 1; use a larger"):
        level_from_json(cart_document(), "s")


def test_a_level_becomes_the_document_it_came_from_in_meaning() -> None:
    document = level_to_json(level_from_json(cart_document()), LevelInfo(name="cart", size="m"))
    again = level_to_json(level_from_json(document), LevelInfo(name="cart", size="m"))
    assert [shape["type"] for shape in again["shapes"]] == ["polygon", "polygon", "circle", "circle"]
    assert again["joints"][0]["a"] == "polygon_4" and again["thrusters"][0]["shape"] == "polygon_5"


def edit(path: str, value: Any) -> Callable[[dict], None]:
    """A change of one place: "shapes.0.radius"; `...` as value removes the field."""

    def change(document: dict) -> None:
        *parents, last = [int(part) if part.isdigit() else part for part in path.split(".")]
        place: Any = document
        for part in parents:
            place = place[part]
        if value is ...:
            del place[last]
        else:
            place[last] = value

    return change


MISTAKES = {
    "missing field": (edit("shapes.2.radius", ...), r"^shapes\[2\]\.radius: is missing; add 'radius'$"),
    "missing name": (edit("name", ...), "^name: is missing; add 'name'$"),
    "unknown field": (
        edit("shapes.0.mass", 1),
        r"^shapes\[0\]\.mass: is not a field of the format; fields here: angle",
    ),
    "wrong type": (
        edit("shapes.0.position", "here"),
        r"^shapes\[0\]\.position: is 'here'; give a value of type array$",
    ),
    "short point": (edit("shapes.0.position", [1.0]), r"^shapes\[0\]\.position: has 1 entries; give at least 2$"),
    "unknown role": (
        edit("shapes.0.role", "pink"),
        r"^shapes\[0\]\.role: is 'pink'; use 'none', 'green', 'blue', 'red'",
    ),
    "unknown size": (edit("size", "xl"), "^size: unknown size 'xl'; use one of s, m, l$"),
    "unknown version": (edit("version", 2), "^version: is 2; use 1$"),
    "other format": (edit("format", "svg"), "^format: is 'svg'; use 'kinetix-dist-level'$"),
    "negative radius": (edit("shapes.2.radius", -0.1), r"^shapes\[2\]\.radius: is -0.1; give at least 0.001$"),
    "nan": (
        edit("shapes.1.vertices.2.0", math.nan),
        r"^shapes\[1\]\.vertices\[2\]\[0\]: is nan; give a finite number$",
    ),
    "too large": (
        edit("shapes.1.position.0", 1e39),
        r"^shapes\[1\]\.position\[0\]: is 1e\+39; give a number between -1e\+06 and 1e\+06$",
    ),
    "inf": (edit("joints.0.motor.speed", math.inf), r"^joints\[0\]\.motor\.speed: is inf; give a finite number$"),
    "clockwise": (
        edit("shapes.1.vertices", [[0, 0], [0, 0.3], [0.6, 0]]),
        r"^shapes\[1\]\.vertices: corners run clockwise; list them counter-clockwise",
    ),
    "not convex": (
        edit("shapes.1.vertices", [[0, 0], [1, 0], [0.2, 0.2], [0, 1]]),
        r"^shapes\[1\]\.vertices: polygon is not convex at corner 2; split it",
    ),
    "crossing": (
        edit("shapes.1.vertices", [[0, 0], [1, 0], [0.2, 1], [0.9, 1]]),
        r"^shapes\[1\]\.vertices: polygon is not convex",
    ),
    "no area": (
        edit("shapes.1.vertices", [[0, 0], [0.3, 0], [0.6, 0]]),
        r"^shapes\[1\]\.vertices: polygon has an area of 0.0e\+00 m\^2",
    ),
    "repeated corner": (
        edit("shapes.1.vertices", [[0, 0], [0, 0], [0.6, 0], [0, 1]]),
        r"^shapes\[1\]\.vertices\[0\]: is the same point as the next corner; remove",
    ),
    "too many corners": (
        edit("shapes.1.vertices", [[0, 0], [1, 0], [1.2, 1], [0.5, 2], [0, 1]]),
        r"^shapes\[1\]\.vertices: has 5 entries; give at most 4$",
    ),
    "joint to a missing shape": (
        edit("joints.0.b", "wheels"),
        r"^joints\[0\]\.b: there is no shape 'wheels'; shapes are chassis, wedge, wheel, goal, floor",
    ),
    "thruster on a missing shape": (edit("thrusters.0.shape", "x"), r"^thrusters\[0\]\.shape: there is no shape 'x'"),
    "joint to itself": (edit("joints.0.b", "chassis"), r"^joints\[0\]\.b: joins 'chassis' to itself"),
    "no anchor": (edit("joints.0.anchor", ...), r"^joints\[0\]: has no anchor; give 'anchor'"),
    "one local anchor": (edit("joints.0.anchor_a", [0, 0]), r"^joints\[0\]: has anchor and anchor_a; give"),
    "limits crossed": (edit("joints.0.limits", [1, -1]), r"^joints\[0\]\.limits: lower 1 is above upper -1; swap them"),
    "same name twice": (edit("shapes.1.id", "chassis"), r"^shapes\[1\]\.id: 'chassis' is used twice"),
    "wall's name": (edit("shapes.1.id", "floor"), r"^shapes\[1\]\.id: 'floor' is the name of a wall"),
    "no green": (edit("shapes.0.role", "none"), "^shapes: 0 shapes are green; make exactly one shape green$"),
    "two blue": (edit("shapes.1.role", "blue"), "^shapes: 2 shapes are blue; make exactly one shape blue$"),
    "no list": (edit("shapes", {}), "^shapes: is {}; give a value of type array$"),
}


# What else is wrong after one of them, for the same reason: the wedge has another name, and a thruster refers to it.
CONSEQUENCES = dict.fromkeys(
    ("same name twice", "wall's name"), (r"^thrusters\[0\]\.shape: there is no shape 'wedge'",)
)


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_named_with_its_field_and_remedy_in_one_line(mistake: str) -> None:
    change, message = MISTAKES[mistake]
    document = copy.deepcopy(cart_document())
    change(document)
    with pytest.raises(LevelFormatError, match=message) as error:
        level_from_json(document)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("mistake", MISTAKES)
def test_an_editor_hears_of_the_mistake_too_and_of_nothing_that_is_none(mistake: str) -> None:
    change, message = MISTAKES[mistake]
    document = copy.deepcopy(cart_document())
    change(document)
    problems = [str(problem) for problem in problems_of(document, SIZES["m"], "m")]
    assert [text for text in problems if re.search(message, text)]
    assert len(problems) == 1 + len(CONSEQUENCES.get(mistake, ())), problems
    for text in CONSEQUENCES.get(mistake, ()):
        assert any(re.search(text, problem) for problem in problems)


def test_an_editor_hears_of_many_mistakes_at_once() -> None:
    document = copy.deepcopy(cart_document())
    mistakes = (
        "missing name",
        "unknown field",
        "clockwise",
        "limits crossed",
        "negative radius",
        "thruster on a missing shape",
    )
    for mistake in mistakes:
        MISTAKES[mistake][0](document)
    problems = [str(problem) for problem in problems_of(document, SIZES["m"], "m")]
    assert len(problems) == len(mistakes)
    for mistake in mistakes:
        assert sum(bool(re.search(MISTAKES[mistake][1], problem)) for problem in problems) == 1


@pytest.mark.parametrize("document", [None, 3, [], {"shapes": 3}, {"shapes": [3, None]}, {"shapes": [], "joints": 3}])
def test_what_is_no_level_at_all_has_problems_and_nothing_breaks(document: Any) -> None:
    assert list(problems_of(document, SIZES["m"], "m"))


def test_local_anchors_far_apart_are_refused() -> None:
    document = cart_document()
    joint = document["joints"][0]
    del joint["anchor"]
    joint |= {"anchor_a": [-0.4, -0.1], "anchor_b": [0.0, 0.5]}
    with pytest.raises(LevelFormatError, match=r"^joints\[0\]: its anchors are 0.5 m apart"):
        level_from_json(document)


def test_a_document_that_is_no_object_is_refused() -> None:
    with pytest.raises(LevelFormatError, match="size"):
        level_from_json([1, 2])
    with pytest.raises(LevelFormatError, match="type object"):
        level_from_json([1, 2], "s")


def test_a_bad_file_is_named(tmp_path: Path) -> None:
    path = tmp_path / "bad.json"
    path.write_text('{"format": ')
    with pytest.raises(LevelFormatError, match=r"bad\.json: is not JSON"):
        load_level(path)
    document = cart_document()
    document["shapes"][2]["radius"] = math.nan
    path.write_text(json.dumps(document))
    with pytest.raises(LevelFormatError, match=r"bad\.json: is not JSON \(shapes\[2\]\.radius is nan"):
        load_level(path)
