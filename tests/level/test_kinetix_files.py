"""Public level files that people have: walls that are mended and written back, parameters that are not read, and files
of other kinds, which are named and never loaded."""

from __future__ import annotations

import copy
import json
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from kinetix_dist.cli.main import main
from kinetix_dist.level.kinetix_format import export_kinetix, import_kinetix, read_kinetix
from kinetix_dist.level.kinetix_walls import USUAL_WALLS, PublicWalls
from kinetix_dist.level.schema import level_from_json
from kinetix_dist.level.sets import files_of_set, load_level_set
from kinetix_dist.level.structure import LevelFormatError, LevelNote
from tests.helpers import REPOSITORY
from tests.level.documents import cart_document

CASES = REPOSITORY.parent / "shared" / "cases" / "levels"
MISPLACED = PublicWalls(left_wall_x=-0.05)
SOFT = PublicWalls(collision_modes=(1, 1, 1, 1))


def public_cart(walls: PublicWalls = USUAL_WALLS) -> dict[str, Any]:
    return json.loads(json.dumps(export_kinetix(level_from_json(cart_document()), walls)))


def assert_same(level: Any, other: Any) -> None:
    for leaf, again in zip(jax.tree.leaves(level), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(leaf, again, rtol=1e-5, atol=2e-6)


def right_side_of_left_wall(document: dict[str, Any]) -> float:
    wall = document["env_state"]["polygon"][1]
    return wall["position"]["0"] + max(corner["0"] for corner in wall["vertices"].values())


@pytest.mark.parametrize("walls", [MISPLACED, SOFT, PublicWalls(left_wall_x=-0.0499, collision_modes=(2, 1, 2, 1))])
def test_walls_of_two_kinds_of_files_become_the_usual_box_and_go_out_as_they_were(walls: PublicWalls) -> None:
    document = public_cart(walls)
    assert right_side_of_left_wall(document) == pytest.approx(walls.left_wall_x, abs=1e-6)
    assert [wall["collision_mode"] for wall in document["env_state"]["polygon"][:4]] == list(walls.collision_modes)
    before = copy.deepcopy(document)
    found = read_kinetix(document)
    assert document == before  # what was read is not changed
    assert_same(found.level, import_kinetix(public_cart()))
    assert found.walls.left_wall_x == pytest.approx(walls.left_wall_x) and found.notes
    again = json.loads(json.dumps(export_kinetix(found.level, found.walls)))
    for wall, was in zip(again["env_state"]["polygon"][:4], before["env_state"]["polygon"][:4]):
        assert wall["collision_mode"] == was["collision_mode"]
        for i, corner in was["vertices"].items():
            np.testing.assert_allclose(list(wall["vertices"][i].values()), list(corner.values()), atol=1e-6)
    assert_same(import_kinetix(again), found.level)


def test_the_usual_box_is_nothing_to_note() -> None:
    found = read_kinetix(public_cart())
    assert found.notes == () and found.walls == USUAL_WALLS


def test_an_anchor_on_a_misplaced_wall_stays_where_it_is() -> None:
    document = public_cart()
    joint = document["env_state"]["joint"][0]
    joint["a_index"], joint["a_relative_pos"] = 1, {"0": 0.0, "1": 0.3}
    wall = document["env_state"]["polygon"][1]
    wall["position"] = {"0": -2.5, "1": 2.5}
    usual = import_kinetix(copy.deepcopy(document))
    for corner in wall["vertices"].values():
        corner["0"] -= 0.05 * (corner["0"] > 0)
    found = read_kinetix(document)
    assert found.walls.left_wall_x == pytest.approx(-0.05)
    assert_same(found.level, usual)


def test_a_shape_that_walls_of_the_file_let_through_is_refused() -> None:
    """Mode 0 passes through mode 1 there: the wheel would fall out of the box, and here it would not."""
    document = public_cart(SOFT)
    document["env_state"]["circle"][0]["collision_mode"] = 0
    with pytest.raises(LevelFormatError, match=r"circle\[0\]\.collision_mode: is 0, which passes through the floor"):
        import_kinetix(document)
    document = public_cart()
    document["env_state"]["circle"][0]["collision_mode"] = 0
    import_kinetix(document)


@pytest.mark.parametrize(("wall", "by"), [(1, -0.2), (1, 0.05), (2, 0.05), (0, -0.05), (3, 0.05)])
def test_walls_elsewhere_are_refused(wall: int, by: float) -> None:
    document = public_cart()
    document["env_state"]["polygon"][wall]["position"]["0" if wall in (1, 2) else "1"] += by
    with pytest.raises(LevelFormatError, match=rf"polygon\[{wall}\]: is not the \w+ of the usual box"):
        import_kinetix(document)


def test_what_is_not_read_of_the_parameters_is_noted_and_other_units_are_refused() -> None:
    document = public_cart()
    document["static_env_params"] |= {"frame_skip": 1, "downscale": 1}
    document["env_params"] |= {"joint_stiffness": 0.3, "dense_reward_scale": 1.0}
    skip, solver = read_kinetix(document).notes
    assert skip == "frame_skip 1 is not read (here 2, or --env.frame_skip)"
    assert solver == "solver settings of the package are not read: joint_stiffness 0.3"
    document["static_env_params"]["num_static_fixated_polys"] = 5
    with pytest.raises(LevelFormatError, match=r"num_static_fixated_polys: is 5; levels here have 4 walls"):
        import_kinetix(document)


def test_parameters_as_the_gallery_of_the_web_editor_writes_them() -> None:
    document = public_cart(SOFT)
    size = {"type": "size", "size": "m", "params": None}
    assert read_kinetix(document | {"env_params": size, "static_env_params": size}).notes == tuple(SOFT.notes)
    full = {"type": "full", "size": None, "params": document["env_params"] | {"base_friction": 1.0}}
    with pytest.raises(LevelFormatError, match=r"env_params\.base_friction: is 1\.0"):
        import_kinetix(document | {"env_params": full})


def test_a_level_with_more_shapes_than_any_size_holds_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    document = public_cart()
    file = tmp_path / "many.json"
    balls = document["env_state"]["circle"]
    document["env_state"]["circle"] = balls + [dict(balls[1], role=0) for _ in range(6)]
    file.write_text(json.dumps(document))
    assert main(["levels", "import", str(file), str(tmp_path / "out.json")]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and str(file) in error and "circles" in error


def test_import_says_what_was_mended_and_export_writes_it_back(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    public, ours, back, again = (tmp_path / f"{name}.json" for name in ("public", "ours", "back", "again"))
    public.write_text(json.dumps(public_cart(MISPLACED)))
    assert main(["levels", "import", str(public), str(ours), "--name", "cart"]) == 0
    (note,) = capsys.readouterr().err.splitlines()
    assert note == (
        f"kinetix-dist: {public}: left wall 5 cm too far left (an erratum of the public package): moved to x = 0"
    )
    assert json.loads(ours.read_text())["public_walls"] == {"left_wall_x": pytest.approx(-0.05)}
    assert main(["levels", "export", str(ours), str(back)]) == 0
    assert capsys.readouterr().err == ""  # our file is of the usual box
    assert right_side_of_left_wall(json.loads(back.read_text())) == pytest.approx(-0.05)
    assert main(["levels", "import", str(back), str(again), "--name", "cart"]) == 0
    assert "left wall 5 cm" in capsys.readouterr().err
    assert again.read_text() == ours.read_text()


@pytest.mark.skipif(not CASES.is_dir(), reason="level files of real-time chunking not found beside the checkout")
@pytest.mark.parametrize("name", ["car_launch", "h17_unicycle", "cartpole_thrust", "catcher_v3"])
def test_level_files_of_real_time_chunking_are_read_and_go_out_as_they_were(name: str, tmp_path: Path) -> None:
    document = json.loads((CASES / f"{name}.json").read_text())
    found = read_kinetix(document)
    (note,) = found.notes
    assert ("collision_mode 1" if name == "catcher_v3" else "left wall 5 cm") in note
    again = export_kinetix(found.level, found.walls)
    assert right_side_of_left_wall(again) == pytest.approx(right_side_of_left_wall(document), abs=1e-6)
    for wall, was in zip(again["env_state"]["polygon"][:4], document["env_state"]["polygon"][:4]):
        assert wall["collision_mode"] == was["collision_mode"]
    assert main(["levels", "import", str(CASES / f"{name}.json"), str(tmp_path / "ours.json")]) == 0


def test_programs_that_read_a_level_are_warned_of_what_was_mended(tmp_path: Path) -> None:
    (tmp_path / "cart.json").write_text(json.dumps(public_cart(MISPLACED)))
    with pytest.warns(LevelNote, match=r"cart\.json: left wall 5 cm too far left"):
        load_level_set(str(tmp_path))


def write_pickle(path: Path) -> None:
    path.write_bytes(pickle.dumps({"levels": np.zeros(3)}))


def write_npz(path: Path) -> None:
    with path.open("wb") as file:
        np.savez(file, levels=np.zeros(3))


def write_bzip2(path: Path) -> None:
    import bz2

    path.write_bytes(bz2.compress(pickle.dumps(0)))


@pytest.mark.parametrize(
    ("write", "says"),
    [
        (write_pickle, "is a Python pickle, which is never loaded because that would run the code in it"),
        (write_npz, "is a zip archive"),
        (write_bzip2, "is a bzip2 archive"),
    ],
)
def test_files_of_other_kinds_are_named_and_not_loaded(
    write: Callable[[Path], None], says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "level.pcg.pkl"
    write(file)
    assert main(["levels", "import", str(file), str(tmp_path / "out.json")]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and f"{file}: {says}" in error and "export_env_state_to_json" in error
    assert main(["levels", "validate", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "no level files to check" in error and "1 .pkl cannot be read here" in error


def test_a_zarr_store_is_no_directory_of_levels(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "zarr.json").write_text('{"zarr_format": 3, "node_type": "group"}')
    for command in (("validate", str(tmp_path)), ("import", str(tmp_path), str(tmp_path / "out"))):
        assert main(["levels", *command]) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1 and f"{tmp_path}: is a zarr store of arrays" in error
    with pytest.raises(LevelFormatError, match="zarr"):
        files_of_set(str(tmp_path))
