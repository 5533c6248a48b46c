"""`kinetix-dist levels`: what it prints, what it writes, and one line with exit status 2 for what is wrong."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from jax2d.scene import Capacity
from kinetix_dist.cli.main import main
from kinetix_dist.level.kinetix_format import export_kinetix
from kinetix_dist.level.level_data import levels_root
from kinetix_dist.level.schema import level_from_json
from kinetix_dist.level.sets import files_of_set, load_level_set
from tests.helpers import REPOSITORY
from tests.level.documents import cart_document


def failure(capsys: pytest.CaptureFixture[str], *argv: str) -> str:
    """stderr of a command that must end with status 2 and one line."""
    assert main(["levels", *argv]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    return error


def test_list_names_the_sets_and_the_levels_of_one(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["levels", "list"]) == 0
    assert {"designed_s", "designed_m", "designed_l", "random_s"} <= set(capsys.readouterr().out.split())
    assert main(["levels", "list", "designed_s", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert "hop_home" in [row["level"] for row in rows] and all(row["polygons"] <= 5 for row in rows)


def test_show_describes_shapes_joints_and_motors(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["levels", "show", "m/ramp_car"]) == 0
    shown = capsys.readouterr().out
    assert "chassis" in shown and "role green" in shown and "motor speed -1.5" in shown


def cart_as_public_file(path: Path, capacity: Capacity | None = None) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(export_kinetix(level_from_json(cart_document(), capacity))))
    return path


def test_a_directory_of_public_files_comes_in_but_for_the_wrong_ones(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    public, ours = tmp_path / "public", tmp_path / "ours"
    good = cart_as_public_file(public / "m" / "good.json")
    (public / "cut.json").write_text(good.read_text()[:1000])
    document = json.loads(good.read_text())
    document["env_state"]["joint"][0]["b_index"] = 99
    (public / "loose.json").write_text(json.dumps(document))
    document = json.loads(good.read_text())
    document["env_state"]["circle"][0]["role"] = 2  # a second blue one
    (public / "goals.json").write_text(json.dumps(document))
    (public / "ours.json").write_text(json.dumps(cart_document()))
    assert main(["levels", "import", str(public), str(ours)]) == 1
    found = capsys.readouterr()
    assert found.out == f"imported 1 of 5 files into {ours} (1 of size m)\n"
    cut, goals, loose, other = found.err.splitlines()
    assert cut.startswith(f"{public / 'cut.json'}: is not JSON")
    assert goals == f"{public / 'goals.json'}: shapes: 2 shapes are blue; make exactly one shape blue"
    assert loose.startswith(f"{public / 'loose.json'}: env_state.joint[0].b_index: there is no shape 99; active shapes")
    assert other.startswith(f"{public / 'ours.json'}: env_state: is missing")
    assert [file.relative_to(ours) for file in ours.glob("**/*.json")] == [Path("m/good.json")]


def test_a_level_in_larger_arrays_comes_in_with_the_size_that_it_needs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    large = cart_as_public_file(tmp_path / "large.json", Capacity(polygons=20, circles=9, joints=12, thrusters=8))
    assert main(["levels", "import", str(large), str(tmp_path / "cart.json")]) == 0
    assert "(size m)" in capsys.readouterr().out
    assert main(["levels", "export", str(tmp_path / "cart.json"), str(tmp_path / "l.json"), "--size", "l"]) == 0
    assert json.loads((tmp_path / "l.json").read_text())["static_env_params"]["num_polygons"] == 12


def test_a_level_that_no_size_holds_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    document = cart_document()
    ball = {"type": "circle", "radius": 0.1}
    document["shapes"] += [{"id": f"ball_{i}", "position": [0.5 + 0.4 * i, 3.0], **ball} for i in range(6)]
    capacity = Capacity(polygons=12, circles=9, joints=6, thrusters=2)
    file = tmp_path / "full.json"
    file.write_text(json.dumps(export_kinetix(level_from_json(document, capacity))))
    error = failure(capsys, "import", str(file), str(tmp_path / "x.json"))
    assert error.endswith(f"{file}: level has 8 circles (size l has 4); remove some\n")
    assert "level has 8 circles" in failure(capsys, "show", str(file))


def test_a_set_goes_out_and_comes_back(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["levels", "export", "designed_m", str(tmp_path / "public")]) == 0
    assert "exported 5 of 5 files" in capsys.readouterr().out
    assert main(["levels", "import", str(tmp_path / "public"), str(tmp_path / "ours")]) == 0
    assert main(["levels", "validate", "--no-play", str(tmp_path / "ours")]) == 0
    capsys.readouterr()
    assert main(["levels", "export", "sliders", str(tmp_path / "x.json")]) == 2  # it has one level
    assert "is prismatic, which public files cannot hold" in capsys.readouterr().err
    assert "--name is for one file" in failure(capsys, "import", str(tmp_path), str(tmp_path / "y"), "--name", "x")
    (tmp_path / "empty").mkdir()
    assert "no .json files in" in failure(capsys, "import", str(tmp_path / "empty"), str(tmp_path / "y"))
    file = tmp_path / "public" / "seesaw.json"
    assert "would be written over" in failure(capsys, "import", str(file), str(file))


def test_validate_names_each_wrong_file_and_fails(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    document = cart_document()
    document["joints"][0]["a"] = "nobody"
    (tmp_path / "bad.json").write_text(json.dumps(document))
    (tmp_path / "good.json").write_text(json.dumps(cart_document()))
    assert main(["levels", "validate", "--no-play", str(tmp_path)]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2 and "bad.json: joints[0].a: there is no shape 'nobody'" in lines[0]
    assert lines[1] == "1 of 2 files are valid"


def test_validate_warns_of_what_the_editor_warns_of_and_strict_fails(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    document = cart_document()
    document["joints"][0]["motor"]["speed"] = 0.0
    file = tmp_path / "odd.json"
    file.write_text(json.dumps(document))
    says = "joints[0] has a motor of speed 0: actions can make it brake, and never move"
    assert main(["levels", "validate", "--no-play", str(file)]) == 0
    found = capsys.readouterr().out.splitlines()
    assert found == [f"{file}: warning: {says}", "1 of 1 files are valid, 1 with warnings"]
    assert main(["levels", "validate", "--no-play", "--strict", str(file)]) == 1
    assert capsys.readouterr().out.splitlines() == [f"{file}: {says}", "0 of 1 files are valid"]


def test_validate_plays_a_level_to_see_whether_it_solves_itself(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    document = cart_document()
    document["shapes"][3] |= {"position": [1.0, 0.5], "radius": 0.1}  # the goal is where the chassis falls
    document["shapes"][2]["position"] = document["joints"][0]["anchor"] = [0.6, 1.2]
    file = tmp_path / "itself.json"
    file.write_text(json.dumps(document))
    assert main(["levels", "validate", str(file)]) == 0
    assert f"{file}: warning: is solved by doing nothing, after " in capsys.readouterr().out


def test_proofs_and_the_schema_beside_level_files_are_no_levels(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copy(levels_root() / "s" / "hop_home.json", tmp_path / "mine.json")
    shutil.copy(levels_root() / "proofs" / "s" / "hop_home.json", tmp_path / "mine.proof.json")
    shutil.copy(levels_root() / "schema.json", tmp_path)
    assert files_of_set(str(tmp_path)) == [tmp_path / "mine.json"]
    assert len(files_of_set(str(levels_root()))) == 74
    assert main(["levels", "export", str(tmp_path), str(tmp_path / "public")]) == 0
    shutil.copy(tmp_path / "mine.proof.json", tmp_path / "public")
    assert main(["levels", "import", str(tmp_path / "public"), str(tmp_path / "again")]) == 0
    assert "imported 1 of 1 files" in capsys.readouterr().out


def test_all_shipped_levels_are_valid(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["levels", "validate", "--strict", "--no-play", str(levels_root())]) == 0
    assert capsys.readouterr().out == "148 of 148 files are valid\n"


def test_what_is_wrong_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "unknown level set 'nope'" in failure(capsys, "show", "nope")
    assert "is a set of 5 levels; name one level" in failure(capsys, "show", "designed_s")
    assert "is a set of 5 levels; name one level" in failure(capsys, "play", "designed_s")
    assert "there are keys, random, noop, generalist" in failure(capsys, "play", "s/hop_home", "--policy", "qqq")
    assert "starts no engine, which playing needs" in failure(capsys, "play", "s/hop_home", "--no-play")
    for drawn in ("random_s", "dev_designed_s"):
        assert "drawn when it is used" in failure(capsys, "list", drawn)
        assert "drawn when it is used" in failure(capsys, "show", drawn)
        assert "drawn when it is used" in failure(capsys, "export", drawn, str(tmp_path / "out"))
    for command, given in (("import", str(tmp_path / "public.json")), ("export", "s/hop_home")):
        for out in (tmp_path, tmp_path / "no" / "x.json"):
            assert f"cannot write {out}; name a file in" in failure(capsys, command, given, str(out))
    sling = failure(capsys, "export", "m/sling", str(tmp_path / "x.json"), "--size", "s")
    assert "sling.json: level has 6 polygons" in sling
    assert f"there is no {tmp_path / 'none'}; give files" in failure(capsys, "validate", str(tmp_path / "none"))
    (tmp_path / "cut.json").write_text(json.dumps(cart_document())[:99])
    assert "cut.json" in failure(capsys, "play", str(tmp_path / "cut.json"))
    (tmp_path / "ours.json").write_text(json.dumps(cart_document()))
    assert "env_state: is missing" in failure(capsys, "import", str(tmp_path / "ours.json"), str(tmp_path / "x.json"))
    assert not (tmp_path / "x.json").exists()


@pytest.fixture
def two_of_one_stem(tmp_path: Path) -> Path:
    """A folder with kick.json and two files same.json, whose own names are others."""
    folder = tmp_path / "mine"
    for place, level in (("s", "hop_home"), ("m", "kick"), ("m", "trapdoor")):
        (folder / place).mkdir(parents=True, exist_ok=True)
        name = "kick" if level == "kick" else "same"
        shutil.copy(levels_root() / "s" / f"{level}.json", folder / place / f"{name}.json")
    return folder


def test_levels_of_one_stem_have_the_same_unique_names_in_every_command(
    two_of_one_stem: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names = ["kick", "m/same", "s/same"]
    assert load_level_set(str(two_of_one_stem))[1] == names
    assert main(["levels", "list", str(two_of_one_stem), "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert [row["level"] for row in rows] == names
    for row in rows:
        assert main(["levels", "show", row["file"]]) == 0, "commands accept the listed file"
    results = tmp_path / "results.json"
    capsys.readouterr()
    command = ("--policy", "noop", "--attempts", "1", "--no-baselines")
    assert main(["eval", "--levels", str(two_of_one_stem), "--json", str(results), *command]) == 0
    levels = json.loads(results.read_text())["solve_rate"]["noop"]["levels"]
    assert [level["name"] for level in levels] == names


def test_levels_of_one_stem_are_exported_and_solved_to_files_of_their_own(
    two_of_one_stem: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["levels", "export", str(two_of_one_stem), str(tmp_path / "public")]) == 0
    assert "exported 3 of 3 files" in capsys.readouterr().out
    files = [path.relative_to(tmp_path / "public") for path in files_below(tmp_path / "public")]
    assert [str(file) for file in files] == ["kick.json", "m/same.json", "s/same.json"]
    for name, level in (("kick", "kick"), ("m/same", "trapdoor"), ("s/same", "hop_home")):
        (tmp_path / "proofs" / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(levels_root() / "proofs" / "s" / f"{level}.json", tmp_path / "proofs" / f"{name}.json")
    options = ("--check", "--worlds", "32", "--proofs", str(tmp_path / "proofs"))
    assert main(["levels", "solve", str(two_of_one_stem), *options]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in lines[:3]] == ["kick", "m/same", "s/same"]


def files_below(folder: Path) -> list[Path]:
    return sorted(path for path in folder.glob("**/*") if path.is_file())


KILLED = """
import os, signal
from kinetix_dist.cli import convert_levels
from kinetix_dist.cli.main import main

def kill(file, out, size, export=convert_levels._export_file):
    if file.stem == "kick":
        os.kill(os.getpid(), signal.SIGKILL)
    return export(file, out, size)

convert_levels._export_file = kill
main(["levels", "export", "designed_s", {out!r}])
"""


def test_a_killed_export_leaves_no_directory_and_the_same_command_succeeds(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "public"
    code = KILLED.format(out=str(out))
    killed = subprocess.run([sys.executable, "-c", code], cwd=REPOSITORY, timeout=300, check=False)
    assert killed.returncode == -signal.SIGKILL
    assert files_below(tmp_path), "levels were on the disk"
    assert not out.exists()
    assert main(["levels", "export", "designed_s", str(out)]) == 0
    assert "exported 5 of 5 files" in capsys.readouterr().out
    assert len(files_below(tmp_path)) == 5 and list(tmp_path.iterdir()) == [out]
    (out / "notes.txt").write_text("mine")
    assert main(["levels", "export", "designed_s", str(out)]) == 0, "files are added to a directory that exists"
    assert len(files_below(tmp_path)) == 6 and (out / "notes.txt").read_text() == "mine"
