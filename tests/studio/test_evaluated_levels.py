"""Levels of evaluation sets, built again: by the engine worker, and over HTTP; commands that train on them."""

from __future__ import annotations

import io
import json
import os
import shlex
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlencode

import numpy as np
import pytest

from bench.worker_client import Client
from kinetix_dist.cli import finetune
from kinetix_dist.level.frontier import frontier_sets
from kinetix_dist.level.level_data import levels_root
from kinetix_dist.level.schema import load_level
from kinetix_dist.level.sets import load_level_set
from kinetix_dist.studio.runs.finetune_command import archive_stem, file_names, finetune_lines
from kinetix_dist.studio.worker.wire import RequestError
from tests.helpers import python_path
from tests.studio.runs_for_tests import write_config, write_evaluations
from tests.studio.serving import Server, serving

LEVELS = ("swing_up", "kick", "hop_home", "aim_rocket")
ORDERED = sorted(LEVELS)  # as a directory lists them
DRAWN = "frontier_s"  # a set that is drawn in seconds


def write_evaluated(folder: Path) -> Path:
    """A run that is evaluated on a directory of levels, which it names by its path, and on frontier_s."""
    own = folder / "own levels"
    own.mkdir()
    for name in LEVELS:
        shutil.copy(levels_root() / "s" / f"{name}.json", own)
    run = write_config(folder / "runs" / "run", evaluation={"sets": [str(own), DRAWN, "missing/levels"]})
    drawn = [f"{DRAWN}_{index}" for index in frontier_sets()[DRAWN].indices]
    count = len(drawn)
    sets = {
        str(own): (ORDERED, 4, [[0, 0, 0, 0], [1, 4, 1, 0], [2, 0, 2, 4]]),
        DRAWN: (drawn, 1, [[0] * count, [0] * count, [k % 2 for k in range(count)]]),
    }
    write_evaluations(run, sets)
    return run


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_evaluated(tmp_path_factory.mktemp("evaluated"))


@pytest.fixture(scope="module")
def own(run: Path) -> str:
    return str(run.parent.parent / "own levels")


# The engine worker


def test_a_set_of_files_is_read_again_with_the_documents_of_its_files(worker: Client, run: Path, own: str) -> None:
    found = worker.request("evaluation_set", run=str(run), set=own)
    assert (found["names"], found["size"]) == (ORDERED, "s")
    assert found["features"]["thrusters"] == [1, 1, 0, 0] and found["features"]["joints"] == [0, 0, 1, 1]
    level = {"run": str(run), "set": own, "index": 3, "name": "swing_up"}
    document = json.loads((levels_root() / "s" / "swing_up.json").read_text())
    assert worker.request("document", level=level)["document"] == document
    session = worker.request("play.open", level=level, policy="noop", env={"run": str(run)})
    assert (session["name"], session["size"], session["exact"]) == ("swing_up", "s", True)
    worker.others.clear()


def test_distance_is_that_of_green_and_blue_at_the_start(worker: Client, run: Path, own: str) -> None:
    found = worker.request("evaluation_set", run=str(run), set=own)
    level, _ = load_level(levels_root() / "s" / "hop_home.json")
    green, blue = (level.position[np.asarray(level.shape_role) == role] for role in (1, 2))
    assert found["features"]["distance"][1] == pytest.approx(np.linalg.norm(green[0] - blue[0]), abs=1e-3)


def test_a_drawn_set_is_drawn_again_level_for_level(worker: Client, run: Path) -> None:
    levels, names = load_level_set(DRAWN)
    found = worker.request("evaluation_set", run=str(run), set=DRAWN)
    assert found["names"] == names
    message = worker.wait(worker.send("thumbnails", run=str(run), set=DRAWN, indices=[7]))
    [picture] = json.loads(message.body)
    expected = np.concatenate([levels.position[7], levels.angle[7][:, None]], axis=-1)
    np.testing.assert_array_equal(np.array(picture["poses"], np.float32), expected)


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        ({"set": "designed_s"}, "names no evaluation set 'designed_s'"),  # only what the run names is read
        ({"set": "missing/levels"}, "there is no level file or directory missing/levels|unknown level set"),
        ({"set": None}, "names no evaluation set None"),
        ({"run": "/nowhere"}, "cannot be read"),
    ],
)
def test_sets_that_cannot_be_built_are_refused_with_one_line(
    worker: Client, run: Path, fields: dict, text: str
) -> None:
    with pytest.raises(RequestError, match=text) as error:
        worker.request("evaluation_set", **{"run": str(run), "set": DRAWN, **fields})
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"name": "kick"}, "has other levels now"),
        ({"index": 4, "name": None}, "no 4"),
        ({"index": "0"}, "whole number"),
    ],
)
def test_a_level_that_is_not_there_any_more_is_refused(
    worker: Client, run: Path, own: str, changes: dict, text: str
) -> None:
    with pytest.raises(RequestError, match=text):
        worker.request("display", level={"run": str(run), "set": own, "index": 1, "name": "hop_home"} | changes)


def test_a_level_file_that_changes_is_read_again(worker: Client, tmp_path: Path) -> None:
    run = write_evaluated(tmp_path)
    own = tmp_path / "own levels"
    level = {"run": str(run), "set": str(own), "index": 1}
    before = worker.request("display", level=level)
    shutil.copy(own / "kick.json", own / "hop_home.json")
    os.utime(own / "hop_home.json", ns=(1, 1))
    assert worker.request("display", level=level)["poses"] != before["poses"]


# Over HTTP


@pytest.fixture(scope="module")
def server(run: Path) -> Iterator[Server]:
    with serving(run.parent) as server:
        yield server


def test_features_come_with_groups_of_the_newest_evaluation(server: Server, own: str) -> None:
    found = server.json(f"/api/runs/run/evaluations/features?{urlencode({'set': own})}")
    assert found["names"] == ORDERED
    [joints] = [one for one in found["groupings"] if "joints" in (one["feature"], *one["same"])]
    assert "thrusters" in (joints["feature"], *joints["same"])  # these levels have one or the other
    counts = {tuple(group["levels"]): (group["solved"], group["attempts"]) for group in joints["groups"]}
    assert counts == {(0, 1): (2, 8), (2, 3): (6, 8)}


def test_an_archive_has_the_chosen_levels_as_files_that_are_level_sets(
    server: Server, own: str, tmp_path: Path
) -> None:
    chosen = urlencode({"set": own, "indices": "3,1"})
    status, headers, content = server.request(f"/api/runs/run/evaluations/archive?{chosen}")
    assert status == 200 and 'filename="run_own_levels_2_levels.zip"' in headers["Content-Disposition"]
    again = server.request(f"/api/runs/run/evaluations/archive?{chosen}")[2]
    assert again == content  # the same levels are the same bytes
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        archive.extractall(tmp_path / "unpacked")
    _, names = load_level_set(str(tmp_path / "unpacked"))
    assert names == ["hop_home", "swing_up"]


def test_a_level_of_a_drawn_set_comes_as_a_file_with_the_same_numbers(server: Server, tmp_path: Path) -> None:
    levels, names = load_level_set(DRAWN)
    query = urlencode({"set": DRAWN, "index": 3, "name": names[3]})
    status, headers, content = server.request(f"/api/runs/run/evaluations/document?{query}")
    assert status == 200 and f'filename="{names[3]}.json"' in headers["Content-Disposition"]
    (tmp_path / "one.json").write_bytes(content)
    level, info = load_level(tmp_path / "one.json")
    np.testing.assert_allclose(level.position, levels.position[3], atol=1e-6)  # m; numbers of a file are rounded
    assert info.name == names[3]


@pytest.mark.parametrize(
    ("path", "text"),
    [
        ("features", "set is missing"),
        ("features?set=nothing", "no evaluation of single levels of 'nothing'"),
        ("finetune?set=frontier_s&indices=512", "indices has 512; the set has levels 0 to 511"),
        ("thumbnails?set=frontier_s&indices=x", "indices is 'x'"),
    ],
)
def test_malformed_requests_say_what_is_wrong(server: Server, path: str, text: str) -> None:
    status, error = server.error(f"/api/runs/run/evaluations/{path}")
    assert status == 400 and text in error


def test_without_the_worker_the_table_and_the_command_are_there(run: Path, own: str) -> None:
    with serving(run.parent, "--no-play") as server:
        found = server.json("/api/runs/run/evaluations/levels")
        assert found["sets"][own]["changes"]["first"]["value"] == [0.25, -1.0, 0.25, 1.0]
        assert server.json("/api/runs/run/evaluations/finetune?set=frontier_s&indices=1")["archive"]
        found = server.json(f"/api/runs/run/evaluations/features?{urlencode({'set': own})}")
        assert set(found) == {"problem"} and "--no-play" in found["problem"]


def test_levels_of_another_number_than_when_they_were_evaluated_are_not_mixed_up(tmp_path: Path) -> None:
    run = write_evaluated(tmp_path)
    own = tmp_path / "own levels"
    (own / "kick.json").unlink()
    with serving(run.parent) as server:
        status, error = server.error(f"/api/runs/run/evaluations/features?{urlencode({'set': str(own)})}")
        assert status == 400 and "has other levels now than when the run was evaluated" in error


# Commands


def test_a_whole_set_is_named_and_some_levels_are_unpacked(tmp_path: Path) -> None:
    run = write_config(tmp_path / "a run")
    assert finetune_lines(run, "random_s", archive=None) == [
        "kinetix-dist finetune --levels random_s --run runs/finetune-random_s"
    ]
    (run / "checkpoints" / "00000008").mkdir(parents=True)
    unpack, train = finetune_lines(run, "two_levels", archive="two_levels.zip")
    assert shlex.split(unpack) == ["python3", "-m", "zipfile", "-e", "two_levels.zip", "two_levels"]
    assert shlex.split(train)[2:4] == ["--from", str(run)]  # its name has a space, so it is quoted


def test_names_of_archives_and_files_are_plain_and_different() -> None:
    assert archive_stem("my run", "/data/some levels/", 3) == "my_run_some_levels_3_levels"
    assert file_names(["a/b", "a_b", "über", "../x"]) == ["a_b.json", "a_b_2.json", "ber.json", "x.json"]


def test_the_command_of_the_page_parses(
    server: Server, own: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    answer = server.json(f"/api/runs/run/evaluations/finetune?{urlencode({'set': own, 'indices': '0,2'})}")
    program, name, *words = shlex.split(answer["lines"][-1])
    assert (program, name) == ("kinetix-dist", "finetune")
    args = finetune.parse(words)
    assert args.train is not None
    assert args.train.config.curriculum.levels == "run_own_levels_2_levels"
    assert str(args.train.run) == "runs/finetune-run_own_levels_2_levels"


@pytest.mark.long
def test_the_handed_out_commands_train_on_the_levels(tmp_path: Path) -> None:
    """From a run of a minute: its failing levels are downloaded, unpacked and trained on, from its checkpoint."""
    run_command = [sys.executable, "-m", "kinetix_dist.cli.main"]
    environment = os.environ | {"PYTHONPATH": python_path()}

    def done(command: list[str]) -> None:
        ended = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=900)
        assert ended.returncode == 0, ended.stderr

    done([*run_command, "train", "--recipe", "tiny", "--run", "trained/tiny", "--recording.make_pictures", "False"])
    with serving(tmp_path / "trained") as server:
        query = urlencode({"set": "random_s", "indices": "3,5,8"})
        answer = server.json(f"/api/runs/tiny/evaluations/finetune?{query}")
        assert answer["has_checkpoint"]
        (tmp_path / answer["archive"]).write_bytes(server.request(f"/api/runs/tiny/evaluations/archive?{query}")[2])
    unpack, train = (shlex.split(line) for line in answer["lines"])
    done([sys.executable, *unpack[1:]])
    small = ["--run.total_env_steps", "256", "--rollout.num_envs", "8", "--rollout.num_steps", "16"]
    done([*run_command, *train[1:], *small, "--recording.make_pictures", "False"])
    lines = (tmp_path / "runs" / "finetune-tiny_random_s_3_levels" / "evaluations.jsonl").read_text().splitlines()
    [evaluated] = json.loads(lines[-1])["sets"].values()
    assert evaluated["names"] == ["random_s_3", "random_s_5", "random_s_8"]
