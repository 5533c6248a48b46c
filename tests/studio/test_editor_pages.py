"""`kinetix-dist edit`: its files over HTTP, what it refuses, and where the printed address leads."""

from __future__ import annotations

import base64
import json
import subprocess
import zlib
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.helpers import PATIENCE_S, REPOSITORY, next_line
from tests.studio.serving import Server, command, end, environment, serving

LEVEL = (REPOSITORY / "levels" / "s" / "hop_home.json").read_bytes()


@pytest.fixture(scope="module")
def levels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("levels")
    (directory / "mine.json").write_bytes(LEVEL)
    (directory / "broken.json").write_bytes(b"\xff{")
    return directory


@pytest.fixture(scope="module")
def server(levels: Path) -> Iterator[Server]:
    with serving(levels, "--no-play", name="edit") as server:
        yield server


def save(server: Server, name: str, body: bytes, **headers: str) -> tuple[int, dict]:
    named = {key.replace("_", "-"): value for key, value in headers.items()}
    status, _, content = server.request(f"/api/files/{name}", method="PUT", headers=named, body=body)
    return status, json.loads(content)


def test_the_address_leads_to_the_editor(server: Server) -> None:
    assert b'url=./#/edit"' in server.request(f"/?token={server.token}")[2]
    about = server.json("/api/levels")
    assert about["opens"] is None and about["files"]["only"] is None
    assert {"designed_s", "all_designed_l"} <= {entry["name"] for entry in about["sets"]}


def test_sets_and_files_are_sent_as_they_are(server: Server) -> None:
    sent = server.json("/api/levels/sets/designed_s")["levels"]
    assert sent[0] == {"name": "s/hop_home", "text": LEVEL.decode()} and len(sent) == 5
    files = {entry["name"]: entry for entry in server.json("/api/files")["files"]}
    assert files["mine.json"]["text"] == LEVEL.decode() and "is no text" in files["broken.json"]["problem"]


def test_a_file_is_saved_unless_it_changed_elsewhere(server: Server, levels: Path) -> None:
    read = server.json("/api/files/mine.json")
    new = LEVEL + b"\n"
    status, content = save(server, "mine.json", new, If_Match=f'"{read["hash"]}"')
    assert status == 200 and (levels / "mine.json").read_bytes() == new
    status, conflict = save(server, "mine.json", LEVEL, If_Match=f'"{read["hash"]}"')
    assert status == 412 and "changed elsewhere; nothing was saved" in conflict["error"]
    assert conflict["hash"] == content["hash"] and (levels / "mine.json").read_bytes() == new
    assert save(server, "mine.json", LEVEL, If_Match=f'"{conflict["hash"]}"')[0] == 200
    assert save(server, "made.json", LEVEL, If_None_Match="*")[0] == 200
    assert (levels / "made.json").read_bytes() == LEVEL


@pytest.mark.parametrize(
    ("name", "body", "status", "text"),
    [
        ("a.json", b"{", 400, "is not JSON"),
        ("a.json", b"[]", 400, "is no JSON object"),
        ("../a.json", b"{}", 400, "no level file that can be named here"),
        ("%2e%2e%2fa.json", b"{}", 400, "no level file that can be named here"),
        ("nowhere/a.json", b"{}", 404, "there is no file"),
    ],
)
def test_what_cannot_be_saved_is_one_line(server: Server, name: str, body: bytes, status: int, text: str) -> None:
    found, content = save(server, name, body, If_None_Match="*")
    assert found == status and text in content["error"]
    assert save(server, "a.json", b"{}")[0] == 400  # without saying what is there


def test_results_of_searches_alone_in_runs_do_not_keep_the_editor_from_starting(tmp_path: Path) -> None:
    (tmp_path / "runs" / "taught").mkdir(parents=True)
    (tmp_path / "runs" / "taught" / "mine-20261129-120000.json").write_bytes(LEVEL)
    server = subprocess.Popen(
        command("--port", "0", "--no-play", name="edit"),
        stdout=subprocess.PIPE,
        text=True,
        env=environment(),
        cwd=tmp_path,
    )
    assert "http://127.0.0.1" in next_line(server)
    end(server)


def test_without_a_file_on_the_command_line_nothing_is_saved() -> None:
    with serving("--no-play", "s/hop_home", name="edit") as server:
        assert server.json("/api/levels")["opens"] == "designed/s/hop_home"
        assert server.error("/api/files")[0] == 400
        assert save(server, "a.json", b"{}", If_None_Match="*")[0] == 400
        assert "--no-play" in server.error("/api/engine")[1]


@pytest.mark.parametrize("player", ["keys", "generalist", "a run"])
def test_levels_play_names_the_level_and_who_plays_it(tmp_path: Path, levels: Path, player: str) -> None:
    run = tmp_path / "mine"
    run.mkdir()
    (run / "config.json").write_text("{}")
    policy = str(run) if player == "a run" else player
    with serving(levels / "mine.json", "--policy", policy, name="levels play") as server:
        about = server.json("/api/levels")
        assert about["opens"] == "file/mine.json" and about["files"]["only"] == "mine.json"
        assert about["plays"] == {"keys": "keys", "generalist": "checkpoint:generalist", "a run": "run:mine"}[player]
        assert [found["id"] for found in server.json("/api/runs")["runs"]] == (["mine"] if player == "a run" else [])


def test_edit_and_play_open_the_level_of_a_link(levels: Path) -> None:
    part = "1." + base64.urlsafe_b64encode(zlib.compress((levels / "mine.json").read_bytes())).decode().rstrip("=")
    link = f"https://gpu.example/#/edit?level={part}"
    for name, plays in (("edit", None), ("levels play", "keys")):
        with serving(link, name=name) as server:
            about = server.json("/api/levels")
            assert about["opens"] == f"link/{part}" and about["plays"] == plays and about["files"] is None


def test_what_is_no_level_is_one_line_and_status_2(tmp_path: Path) -> None:
    (tmp_path / "picture.png").write_text("")
    for given, text in (("nothing", "level file, directory of them or link"), ("picture.png", "end in .json")):
        done = subprocess.run(
            command(given, name="edit"),
            capture_output=True, text=True, env=environment(), cwd=tmp_path, timeout=PATIENCE_S, check=False,
        )  # fmt: skip
        assert done.returncode == 2 and done.stderr.count("\n") == 1 and text in done.stderr, done
