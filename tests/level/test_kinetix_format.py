"""The public Kinetix files: all 74 come in with their meaning, and go out again."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import jax
import numpy as np
import pytest

from jax2d.checks import check_scene
from jax2d.engine import Engine
from jax2d.scene import Controls
from kinetix_dist.level.fit import capacity_of, smallest_size, usage
from kinetix_dist.level.kinetix_format import export_kinetix, import_kinetix, load_kinetix
from kinetix_dist.level.level import SIZES
from kinetix_dist.level.schema import level_from_json
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


def test_a_file_that_is_no_kinetix_level_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "other.json"
    path.write_text("{}")
    with pytest.raises(LevelFormatError, match=r"other\.json: env_state: is missing"):
        load_kinetix(path)
    document = export_kinetix(level_from_json(cart_document()))
    del document["env_state"]["circle"][0]["radius"]
    with pytest.raises(LevelFormatError, match=r"^env_state\.radius: is missing"):
        import_kinetix(document)
