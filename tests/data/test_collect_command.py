"""`kinetix-dist collect`: what it says, that it goes on, and one line for each wrong option."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from kinetix_dist.cli.main import main
from kinetix_dist.data import open_dataset
from kinetix_dist.level.level_data import levels_root
from tests.data.small_collection import fill_disc_at

SMALL = ["--worlds", "2", "--shard-transitions", "512"]  # 256 steps of each world, the longest episode


def command(out: Path, transitions: str, *options: str) -> list[str]:
    words = ["--policy", "random", "--levels", "s/hop_home", "--out", str(out), "--transitions", transitions]
    return ["collect", *words, *SMALL, *options]


def test_a_collection_is_made_added_to_and_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "data"
    fill_disc_at(monkeypatch, "shard-000001")
    assert main(command(out, "1.5e3")) == 2
    said = capsys.readouterr()
    [line] = said.err.splitlines()
    assert "shard 1 of this command cannot be written (No space left on device); the 1 before it are whole" in line
    assert len(open_dataset(out)) == 512
    monkeypatch.undo()

    assert main(command(out, "1.5e3")) == 0  # 1,536 with whole shards
    said = capsys.readouterr().out
    assert f"collecting 1,536 transitions of s/hop_home into {out}: 3 shards of 2 worlds x 256 steps" in said
    assert f"{out}: 1,536 transitions in 3 shards, " in said and ", compiling included" in said
    data = open_dataset(out)
    assert len(data) == 1536 and data.manifest["policy"] == {
        "name": "random",
        "version": -1,
        "sha256": "",
        "greedy": False,
    }

    assert main(command(out, "1000")) == 0
    assert "nothing was missing" in capsys.readouterr().out
    assert main(command(out, "1000", "--noise", "0.1")) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert "holds another data set: noise 0.1 instead of 0.0; give --out another folder" in line


def test_the_same_levels_by_another_path_go_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "data"
    assert main(command(out, "512")) == 0
    (tmp_path / "mine").mkdir()
    shutil.copy(levels_root() / "s" / "hop_home.json", tmp_path / "mine")
    for path in ("mine", "mine/hop_home.json"):
        assert main([*command(out, "512"), "--levels", str(tmp_path / path)]) == 0
        assert "nothing was missing" in capsys.readouterr().out
    shutil.copy(levels_root() / "s" / "kick.json", tmp_path / "mine" / "hop_home.json")
    assert main([*command(out, "512"), "--levels", str(tmp_path / "mine")]) == 2
    assert "holds another data set: levels.fingerprint" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (["--noise", "1"], "--noise is 1.0; it is a probability, from 0 to below 1"),
        (["--sticky", "-0.1"], "--sticky is -0.1; it is a probability"),
        (["--transitions", "0"], "--transitions is 0; it must be 1 or more"),
        (["--transitions", "1e300"], "--transitions is 1e+300; give 1,000,000,000,000 or less"),
        (["--worlds", "1" * 400], "; give 1,073,741,824 or less"),
        (["--shard-transitions", str(1 << 31)], "--shard-transitions is 2147483648; give 1,073,741,824 or less"),
        (["--transitions", "nan"], "--transitions is nan; it must be a finite number"),
        (["--worlds", "0"], "--worlds is 0; it must be 1 or more"),
        (["--worlds", "3"], "--shard-transitions 512 is not a multiple of --worlds 3; change one"),
        (["--shard-transitions", "256"], "has 128 steps of each of 2 worlds, and an episode up to 256"),
        (["--greedy"], "--greedy is for trained policies, and --policy is random"),
        (["--levels", "s/hop_hom"], "unknown level set 's/hop_hom'; did you mean"),
        (["--policy", "generalistt"], "generalistt"),
        (["--policy", ""], "--policy is empty"),
        (["--env.preset", "exact"], "exact"),
    ],
)
def test_a_wrong_option_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], text: str
) -> None:
    assert main(command(tmp_path / "data", "512", *options)) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert text in line and not (tmp_path / "data").exists()


def test_a_folder_of_something_else_is_left_as_it_is(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "dataset.json").write_text(json.dumps({"format": "other", "version": 1}))
    assert main(command(tmp_path, "512")) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert "dataset.json is of format 'other', not 'kinetix-dist-dataset'" in line
    (tmp_path / "dataset.json").rename(tmp_path / "notes.json")
    assert main(command(tmp_path, "512")) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert f"{tmp_path} holds other files (notes.json) and no data set; give --out a directory of its own" in line
    assert [path.name for path in tmp_path.iterdir()] == ["notes.json"]
