"""Saves at the same time, over HTTP, by pages of one server and of two servers of one folder: no text is lost."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Barrier

import pytest

from tests.studio.serving import Server, serving

WRITERS, ROUNDS = 16, 8


@pytest.fixture(scope="module")
def levels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("levels")


@pytest.fixture(scope="module")
def servers(levels: Path) -> Iterator[list[Server]]:
    with serving(levels, "--no-play", name="edit") as one, serving(levels, "--no-play", name="edit") as other:
        yield [one, other]


def save_all_at_once(servers: list[Server], name: str, header: tuple[str, str]) -> list[int]:
    """Send a PUT of each writer, at the same time. Return the status codes."""
    start = Barrier(WRITERS)

    def save(number: int) -> int:
        start.wait()
        body = json.dumps({"writer": number, "padding": "x" * 50_000}).encode()
        server = servers[number % len(servers)]
        return server.request(f"/api/files/{name}", method="PUT", headers=dict([header]), body=body)[0]

    with ThreadPoolExecutor(WRITERS) as pool:
        return list(pool.map(save, range(WRITERS)))


@pytest.mark.parametrize("num_servers", [1, 2])
@pytest.mark.parametrize("exists", [True, False])
def test_one_save_wins_and_the_others_are_told(
    num_servers: int, exists: bool, servers: list[Server], levels: Path
) -> None:
    for attempt in range(ROUNDS):
        name = f"{num_servers}_{exists}_{attempt}.json"
        header = ("If-None-Match", "*")
        if exists:
            (levels / name).write_text("{}")
            header = ("If-Match", f'"{servers[0].json(f"/api/files/{name}")["hash"]}"')
        statuses = save_all_at_once(servers[:num_servers], name, header)
        assert sorted(statuses) == [200] + [412] * (WRITERS - 1)
        assert json.loads((levels / name).read_text())["writer"] == statuses.index(200)
    assert not [path for path in levels.iterdir() if path.name.startswith(".")]


def test_a_save_follows_a_link_and_a_read_only_file_is_refused(servers: list[Server], levels: Path) -> None:
    (levels / "folder").mkdir()
    target, link = levels / "folder" / "target.json", levels / "link.json"
    target.write_text("{}")
    link.symlink_to(target)
    match = {"If-Match": f'"{servers[0].json("/api/files/link.json")["hash"]}"'}
    assert servers[0].request("/api/files/link.json", method="PUT", headers=match, body=b'{"a": 1}')[0] == 200
    assert link.is_symlink() and target.read_text() == '{"a": 1}'
    target.chmod(0o444)
    match = {"If-Match": f'"{servers[0].json("/api/files/link.json")["hash"]}"'}
    status, _, content = servers[0].request("/api/files/link.json", method="PUT", headers=match, body=b"{}")
    error = json.loads(content)["error"]
    assert status == 403 and "target.json: it is read-only; make it writable" in error and "\n" not in error
    assert target.read_text() == '{"a": 1}'


def test_a_link_that_a_person_named_may_lead_out_of_its_directory(tmp_path: Path) -> None:
    target, link = tmp_path / "target.json", tmp_path / "folder" / "link.json"
    target.write_text("{}")
    link.parent.mkdir()
    link.symlink_to(target)
    with serving(link, "--no-play", name="edit") as server:
        match = {"If-Match": f'"{server.json("/api/files/link.json")["hash"]}"'}
        assert server.request("/api/files/link.json", method="PUT", headers=match, body=b'{"a": 1}')[0] == 200
    assert link.is_symlink() and target.read_text() == '{"a": 1}'


def test_a_pipe_in_the_folder_is_refused_at_once(servers: list[Server], levels: Path) -> None:
    os.mkfifo(levels / "pipe.json")
    try:
        for method, header in (("GET", {}), ("PUT", {"If-None-Match": "*"})):
            status, _, body = servers[0].request("/api/files/pipe.json", method=method, headers=header, body=b"{}")
            assert status == 400 and "pipe.json is not a regular file" in body.decode()
    finally:
        (levels / "pipe.json").unlink()


def test_a_save_into_a_folder_that_is_missing_names_the_file_of_the_request(servers: list[Server]) -> None:
    status, _, body = servers[0].request(
        "/api/files/nowhere/a.json", method="PUT", headers={"If-None-Match": "*"}, body=b"{}"
    )
    assert status == 404 and "there is no file nowhere/a.json" in body.decode()
