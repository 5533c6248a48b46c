"""`kinetix-dist levels`: what it prints, what it writes, and one line with exit status 2 for what is wrong."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from kinetix_dist.cli.main import main
from kinetix_dist.level.paths import levels_root
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


def test_render_writes_a_picture(tmp_path: Path) -> None:
    assert main(["levels", "render", "l/walker", str(tmp_path / "walker.png")]) == 0
    assert (tmp_path / "walker.png").read_bytes().startswith(b"\x89PNG")


def test_a_level_goes_out_to_a_public_file_and_comes_back(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    public, ours = str(tmp_path / "public.json"), str(tmp_path / "ours.json")
    assert main(["levels", "export", "m/seesaw", public]) == 0
    assert main(["levels", "import", public, ours, "--name", "seesaw"]) == 0
    capsys.readouterr()
    assert main(["levels", "validate", ours, public]) == 0
    assert "2 of 2 files are valid" in capsys.readouterr().out
    assert json.loads(Path(ours).read_text())["name"] == "seesaw"


def test_validate_names_each_wrong_file_and_fails(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    document = cart_document()
    document["joints"][0]["a"] = "nobody"
    (tmp_path / "bad.json").write_text(json.dumps(document))
    (tmp_path / "good.json").write_text(json.dumps(cart_document()))
    assert main(["levels", "validate", str(tmp_path)]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2 and "bad.json: joints[0].a: there is no shape 'nobody'" in lines[0]
    assert lines[1] == "1 of 2 files are valid"


def test_all_shipped_levels_are_valid(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["levels", "validate", str(levels_root())]) == 0
    capsys.readouterr()


def test_what_is_wrong_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "unknown level set 'nope'" in failure(capsys, "show", "nope")
    assert "is a set of 5 levels; name one level" in failure(capsys, "show", "designed_s")
    assert "drawn when it is used" in failure(capsys, "list", "random_s")
    assert "No such file or directory" in failure(capsys, "render", "s/kick", str(tmp_path / "no" / "x.png"))
    (tmp_path / "ours.json").write_text(json.dumps(cart_document()))
    assert "env_state: is missing" in failure(capsys, "import", str(tmp_path / "ours.json"), str(tmp_path / "x.json"))
    assert not (tmp_path / "x.json").exists()
