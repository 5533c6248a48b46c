"""The public Kinetix files: all 74 come in with their meaning, and go out again."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import jax
import numpy as np
import pytest

from jax2d.checks import check_scene
from jax2d.engine import Engine
from jax2d.scene import Controls, JointKind
from kinetix_dist.level.fit import capacity_of, smallest_size, usage
from kinetix_dist.level.kinetix_format import export_kinetix, import_kinetix, load_kinetix
from kinetix_dist.level.level import SIZES, Level
from kinetix_dist.level.schema import level_from_json, level_to_json
from kinetix_dist.level.validate import LevelFormatError
from tests.env.worlds import MOTOR_JOINT, small_level
from tests.level.documents import cart_document


def assert_same_levels(level: object, other: object) -> None:
    for leaf, again in zip(jax.tree.leaves(level), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(leaf, again, rtol=1e-5, atol=2e-6)  # float32, centroids computed again


def test_a_joint_names_motor_auto_only_where_it_is_so() -> None:
    """kinetix-env 3.0.2 refuses files whose joints have the key."""
    level = small_level(joint=MOTOR_JOINT)
    (joint,) = export_kinetix(level)["env_state"]["joint"]
    assert "motor_auto" not in joint
    (joint,) = export_kinetix(dataclasses.replace(level, motor_auto=np.array([True])))["env_state"]["joint"]
    assert joint["motor_auto"] is True


@pytest.mark.parametrize(("size", "count"), [("s", 10), ("m", 24), ("l", 40)])
def test_public_files_come_in_with_their_size_and_contacts_and_go_out_again(
    public_levels: Path, size: str, count: int
) -> None:
    files = sorted((public_levels / size).glob("*.json"))
    assert len(files) == count
    for file in files:
        document = json.loads(file.read_text())
        level = import_kinetix(document)
        assert capacity_of(level) == SIZES[size]
        check_scene(level.scene, capacity_of(level), np.dtype(np.float32), batch=())
        state = document["env_state"]
        shapes = state["polygon"] + state["circle"]
        for slot, shape in enumerate(shapes):
            assert level.scene.shapes.active[slot] == shape["active"]
            if shape["active"]:
                assert (level.scene.shapes.inverse_mass[slot] == 0.0) == (shape["inverse_mass"] == 0.0)
                assert level.shape_role[slot] == shape["role"]
        exported = json.loads(json.dumps(export_kinetix(level)))
        # The file's own matrix is the witness that shapes joined through others do not collide.
        assert exported["env_state"]["collision_matrix"] == state["collision_matrix"]
        assert exported["static_env_params"] == document["static_env_params"]
        assert exported["env_params"] == document["env_params"]
        for key, rows in state.items():
            assert len(exported["env_state"][key]) == len(rows)
        assert_same_levels(level, import_kinetix(exported))


def test_public_polygons_become_counter_clockwise_about_their_centroid_in_the_same_place(public_levels: Path) -> None:
    document = json.loads((public_levels / "l" / "h2_car_ramp.json").read_text())
    level = import_kinetix(document)
    for slot, shape in enumerate(document["env_state"]["polygon"]):
        if not shape["active"]:
            continue
        count = shape["n_vertices"]
        corners = level.scene.shapes.vertices[slot, :count]
        following = np.roll(corners, -1, axis=0)
        assert np.sum(corners[:, 0] * following[:, 1] - corners[:, 1] * following[:, 0]) > 0
        public = np.array([[shape["vertices"][str(i)][axis] for axis in ("0", "1")] for i in range(count)])
        angle = shape["rotation"]
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        before = public @ turn.T + [shape["position"]["0"], shape["position"]["1"]]
        after = corners @ turn.T + level.position[slot]
        gaps = np.linalg.norm(before[:, None] - after[None], axis=-1)
        assert gaps.min(axis=1).max() < 1e-5


def test_discs_get_their_full_inertia_whatever_the_file_says(public_levels: Path) -> None:
    level = load_kinetix(public_levels / "s" / "h2_one_wheel_car.json")
    moving = np.flatnonzero(level.scene.shapes.active[5:] & (level.scene.shapes.inverse_mass[5:] > 0))
    assert len(moving) > 0
    for circle in moving:
        mass, radius = 1 / level.scene.shapes.inverse_mass[5 + circle], level.scene.shapes.radius[circle]
        np.testing.assert_allclose(
            1 / level.scene.shapes.inverse_inertia[5 + circle], 0.5 * mass * radius**2, rtol=1e-5
        )


def test_a_motor_run_forward_turns_b_counter_clockwise_against_a_as_in_the_public_package() -> None:
    """Published engine, bar and disc, speed 1, no gravity: (w_b - w_a) tends to +6 rad/s."""
    document = cart_document()
    document["gravity"] = [0.0, 0.0]
    document["shapes"][0]["position"] = [2.0, 2.6]
    document["shapes"][2]["position"] = [2.0, 2.6]
    document["joints"][0] |= {"anchor": [2.0, 2.6], "motor": {"speed": 1.0, "power": 1.0}}
    level = import_kinetix(export_kinetix(level_from_json(document)))
    engine = Engine(capacity_of(level))
    state = engine.initial_state(level.scene, level.position, level.angle)
    controls = Controls(motor=np.array([1.0, 0.0], np.float32), thruster=np.zeros(2, np.float32))
    state, _ = engine.step(level.scene, state, controls, num_steps=60)
    speed = state.angular_velocity[6] - state.angular_velocity[4]  # wheel minus chassis
    np.testing.assert_allclose(speed, 6.0, atol=0.5)


def test_our_levels_go_out_and_come_back() -> None:
    level = level_from_json(cart_document())
    again = import_kinetix(export_kinetix(level))
    assert usage(again) == usage(level) and smallest_size(again) == "m"
    assert_same_levels(level, again)


def compacted(level: Level) -> dict[str, np.ndarray]:
    """The part of a level that an importer must preserve: active shapes, joints and thrusters, slots counted among
    them."""
    scene = level.scene
    polygons, active = len(scene.shapes.num_vertices), scene.shapes.active
    rank = np.cumsum(active) - 1
    is_polygon, is_circle = active[:polygons], active[polygons:]
    held, pushes = scene.joints.active, scene.thrusters.active
    preserved = {
        f"shape {name}": getattr(scene.shapes, name)[active] for name in ("density", "friction", "restitution")
    }
    preserved |= {
        f"shape {name}": getattr(level, name)[active]
        for name in ("position", "angle", "velocity", "angular_velocity", "shape_role", "collision_mode")
    }
    preserved |= {f"shape {name}": getattr(scene.shapes, name)[active] for name in ("inverse_mass", "inverse_inertia")}
    preserved |= {"vertices": scene.shapes.vertices[is_polygon], "num_vertices": scene.shapes.num_vertices[is_polygon]}
    preserved |= {"radius": scene.shapes.radius[is_circle], "gravity": scene.gravity}
    preserved["can_touch"] = scene.shapes.can_touch[np.ix_(active, active)]
    for end in ("a", "b"):
        preserved[f"joint {end}"] = rank[getattr(scene.joints, end)[held]]
    is_hinge = scene.joints.is_kind(JointKind.REVOLUTE)
    for name in ("kind", "anchor_a", "anchor_b", "rest_angle", "motor_on", "motor_speed", "motor_power"):
        preserved[f"joint {name}"] = getattr(scene.joints, name)[held]
    has_limits = held & is_hinge & scene.joints.has_limits
    preserved |= {f"joint {name}": getattr(scene.joints, name)[has_limits] for name in ("lower_limit", "upper_limit")}
    preserved |= {"motor colour": level.motor_colour[held], "motor auto": level.motor_auto[held]}
    preserved["thruster body"] = rank[scene.thrusters.body[pushes]]
    for name in ("position", "angle", "power"):
        preserved[f"thruster {name}"] = getattr(scene.thrusters, name)[pushes]
    return preserved | {"thruster colour": level.thruster_colour[pushes]}


def test_public_levels_lose_nothing_on_the_way_into_our_files_and_out_again(public_levels: Path) -> None:
    for file in sorted(public_levels.glob("*/*.json")):
        level = load_kinetix(file)
        again = import_kinetix(json.loads(json.dumps(export_kinetix(level_from_json(level_to_json(level))))))
        preserved, found = compacted(level), compacted(again)
        for name, values in preserved.items():
            np.testing.assert_allclose(found[name], values, rtol=1e-5, atol=3e-6, err_msg=f"{file}: {name}")


def edited(*path: object, value: object = None, remove: bool = False) -> dict:
    """A public document of the cart with one entry set or removed."""
    document = json.loads(json.dumps(export_kinetix(level_from_json(cart_document()))))
    holder = document
    for key in path[:-1]:
        holder = holder[key]
    if remove:
        del holder[path[-1]]
    else:
        holder[path[-1]] = value
    return document


@pytest.mark.parametrize(
    ("document", "says"),
    [
        ({}, r"^env_state: is missing; this is no level file"),
        (
            edited("env_state", "circle", 0, "radius", remove=True),
            r"^env_state\.circle\[0\]\.radius: is missing; .*version",
        ),
        (edited("env_state", "joint", 0, "motor_binding", remove=True), r"joint\[0\]\.motor_binding: is missing"),
        (edited("env_state", "thruster", remove=True), r"^env_state\.thruster: is missing"),
        (edited("env_state", "gravity", remove=True), r"^env_state\.gravity: is missing"),
        (edited("env_state", "polygon", 4, "position", "0", value=math.nan), r"polygon\[4\]\.position\.0: is nan"),
        (
            edited("env_state", "polygon", 4, "vertices", "1", "1", value=math.inf),
            r"polygon\[4\]\.vertices\.1\.1: is inf",
        ),
        (
            edited("env_state", "circle", 0, "density", value="heavy"),
            r"circle\[0\]\.density: is 'heavy'; give a number",
        ),
        (edited("env_state", "joint", 0, "b_index", value=99), r"joint\[0\]\.b_index: there is no shape 99; active"),
        (edited("env_state", "joint", 0, "a_index", value=8), r"joint\[0\]\.a_index: there is no shape 8"),
        (edited("env_state", "thruster", 0, "object_index", value=-1), r"object_index: there is no shape -1"),
        (edited("env_state", "thruster", 0, "thruster_binding", value=2), r"thruster_binding: is 2; use 0 to 1"),
        (edited("env_state", "circle", 0, "role", value=7), r"circle\[0\]\.role: is 7; use 0 to 3"),
        (
            edited("env_state", "polygon", 0, "position", "1", value=-4.0),
            r"polygon\[0\]: is not the floor of the usual",
        ),
        (edited("env_state", "polygon", 3, "active", value=False), r"polygon\[3\]: is not active, but is the ceiling"),
        (
            edited("env_state", "polygon", 4, "n_vertices", value=2),
            r"n_vertices: is 2; a polygon has 3 corners or more",
        ),
        (
            edited("env_params", "base_motor_power", value=450.0),
            r"^env_params\.base_motor_power: is 450\.0; .* with 900",
        ),
        (edited("env_state", "circle", 0, "active", value=[1, 2]), r"active: is \[1, 2\]; use true or false"),
        (edited("env_state", "joint", 0, "motor_on", value="no"), r"motor_on: is 'no'; use true or false"),
        (edited("env_state", "joint", 0, "motor_auto", value=None), r"motor_auto: is None; use true or false"),
        (edited("env_params", "dt", value="1/60"), r"^env_params\.dt: is '1/60'; give a number"),
        (edited("env_params", "dt", value=float("nan")), r"^env_params\.dt: is nan; give a finite number"),
        (edited("env_params", value=None), r"^env_params: is NoneType; this file is of another version"),
    ],
)
def test_a_public_file_that_cannot_be_read_says_where_and_why(document: dict, says: str) -> None:
    with pytest.raises(LevelFormatError, match=says) as error:
        import_kinetix(document)
    assert "\n" not in str(error.value)


def test_what_is_wrong_in_slots_that_are_not_active_does_not_matter() -> None:
    document = edited("env_state", "circle", 2, "position", value={"0": math.nan})
    assert not document["env_state"]["circle"][2]["active"]
    assert usage(import_kinetix(document)) == usage(level_from_json(cart_document()))
