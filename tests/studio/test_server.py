"""The server over real run directories: what it answers, what it refuses, and that it leaves runs as they are."""

from __future__ import annotations

import asyncio
import gzip
import hashlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import aiohttp
import numpy as np
import pytest

from kinetix_dist.telemetry.curriculum_log import DIRECTORY, OUTCOMES
from kinetix_dist.telemetry.json_lines import append_line
from tests.helpers import PATIENCE_S, python_path
from tests.studio.runs_for_tests import solve_rate, write_config, write_rows, write_run
from tests.studio.serving import Server, command, environment, serving, wait_for
from tests.studio.test_refreshes import window, write_refresh


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    runs = tmp_path_factory.mktemp("runs")
    write_run(runs / "a", 30)
    write_run(runs / "b", 3000, run={"seed": 7})
    write_config(runs / "young")
    return runs


@pytest.fixture(scope="module")
def server(runs: Path) -> Iterator[Server]:
    with serving(runs) as server:
        yield server


def test_runs_are_listed_with_their_state_and_last_row(server: Server) -> None:
    rows = {row["id"]: row for row in server.json("/api/runs")["runs"]}
    assert set(rows) == {"a", "b", "young"}
    assert rows["a"]["last"]["update"] == 30 and rows["a"]["name"] == "tiny"
    assert rows["young"]["status"]["state"] == "not started" and rows["young"]["last"] is None


def test_curves_have_few_points_and_keep_their_extremes(server: Server) -> None:
    found = server.json("/api/runs/b/series?names=train/solve_rate,learner/approx_kl&x=updates&points=100")
    assert found["rows"] == 3000 and len(found["x"]) == 100 and found["missing"] == ["learner/approx_kl"]
    curve = found["series"]["train/solve_rate"]
    assert curve["min"][0] == solve_rate(1) and curve["max"][1] == max(solve_rate(u) for u in range(31, 61))
    zoomed = server.json("/api/runs/b/series?names=train/solve_rate&x=updates&from=100&to=120")
    assert zoomed["x"] == [float(u) for u in range(99, 122)]
    assert zoomed["series"]["train/solve_rate"]["mean"] == [solve_rate(u) for u in range(99, 122)]


def test_a_run_is_described_with_units(server: Server) -> None:
    found = server.json("/api/runs/a")
    assert found["metrics"]["progress/env_steps"]["unit"] == "env steps"
    assert found["config"]["config"]["env"]["size"] == "s" and found["report"] is None


def test_runs_are_compared_by_a_field(server: Server) -> None:
    found = server.json("/api/compare?runs=a,b&metric=train/solve_rate&x=updates&group=run.seed&points=50")
    assert found["differences"] == {"run.seed": {"a": 0, "b": 7}}
    assert [(group["value"], group["runs"]) for group in found["curves"]["train/solve_rate"]["groups"]] == [
        ("0", ["a"]),
        ("7", ["b"]),
    ]


@pytest.mark.parametrize(
    ("path", "status", "text"),
    [
        ("/api/runs/none", 404, "there is no run 'none'"),
        ("/api/runs/..%2Fa", 404, "there is no run"),
        ("/api/runs/a/series?x=weeks", 400, "none of env_steps"),
        ("/api/runs/a/series?points=many", 400, "points is 'many'; it must be a number"),
        ("/api/runs/a/series?points=1e9", 400, "must be between 1 and 20000"),
        ("/api/runs/a/series?from=nan", 400, "from is nan"),
        ("/api/compare?runs=", 400, "0 runs are named"),
        ("/api/compare?runs=a&statistic=median", 400, "none of mean, iqm"),
    ],
)
def test_wrong_requests_get_one_line(server: Server, path: str, status: int, text: str) -> None:
    found = server.error(path)
    assert found[0] == status and text in found[1] and "\n" not in found[1]


@pytest.mark.parametrize(
    "path", ["/static/../app.py", "/static/..%2fapp.py", "/static/%2e%2e/app.py", "/static//etc/passwd", "/../x"]
)
def test_no_file_is_served_but_those_of_the_pages(server: Server, path: str) -> None:
    assert server.request(path)[0] == 404


def test_files_are_compressed_and_asked_for_once(server: Server) -> None:
    status, headers, content = server.request("/static/app.js", headers={"Accept-Encoding": "gzip"})
    plain = server.request("/static/app.js")[2]
    assert status == 200 and headers["Content-Encoding"] == "gzip" and gzip.decompress(content) == plain
    assert server.request("/static/app.js", headers={"If-None-Match": headers["ETag"]})[0] == 304
    _, headers, _ = server.request("/api/runs", headers={"Accept-Encoding": "gzip"})
    assert headers["Content-Encoding"] == "gzip"


def test_scripts_and_styles_are_requested_once_per_version(server: Server) -> None:
    page = server.request("/")[2].decode()
    paths = re.findall(r'(?:src|href)="(static/[^"]+\.(?:js|css))"', page)
    assert len(paths) == 4 and all(re.match(r"static/[0-9a-f]{20}/", path) for path in paths)
    for path in paths:
        status, headers, content = server.request(f"/{path}")
        assert status == 200 and "immutable" in headers["Cache-Control"], path
        plain = server.request("/static/" + path.split("/", 2)[2])
        assert plain[2] == content and plain[1]["Cache-Control"] == "no-cache"
    version = paths[0].split("/")[1]
    assert server.request(f"/static/{version}/../../x")[0] == 404
    status, headers, _ = server.request(f"/static/{version}/none.js")
    assert status == 404 and "immutable" not in headers["Cache-Control"]


async def messages_of(server: Server, watch: dict, act, until) -> list[dict]:
    """Messages of the channel after `watch`, until one is as wanted; `act` is called when the first rows are there."""
    messages: list[dict] = []
    headers = {"Cookie": server.cookie, "Origin": f"http://127.0.0.1:{server.port}"}
    async with aiohttp.ClientSession() as session:
        async with session.ws_connect(f"http://127.0.0.1:{server.port}/channel", headers=headers) as channel:
            await channel.send_json({"type": "hello", "version": 1})
            await channel.send_json({"type": "watch", **watch})
            while not messages or not until(messages[-1]):
                messages.append(await asyncio.wait_for(channel.receive_json(), PATIENCE_S))
                if messages[-1]["type"] == "rows" and act is not None:
                    act()
                    act = None
    return messages


def test_a_page_hears_of_new_rows_events_and_of_a_run_that_goes_back(tmp_path: Path) -> None:
    run = write_run(tmp_path / "a", 5)
    with serving(run) as server:

        def go_on() -> None:
            write_rows(run, 6, 6)
            append_line(run / "events.jsonl", {"time": "2026-01-31T12:01:00Z", "event": "recovered", "update": 6})

        messages = asyncio.run(
            messages_of(server, {"run": "a", "since": 3, "revision": 0}, go_on, lambda m: m["type"] == "events")
        )
        rows = [message for message in messages if message["type"] == "rows"]
        assert [(m["first"], m["columns"]["update"]) for m in rows] == [(3, [4.0, 5.0]), (5, [6.0])]
        assert messages[-1]["events"][0]["event"] == "recovered"

        def go_back() -> None:
            write_rows(run, 3, 4, resume_at=2, **{"learner/approx_kl": 0.5})

        messages = asyncio.run(
            messages_of(server, {"run": "a", "since": 0}, go_back, lambda m: m["type"] == "rows" and m["revision"] == 1)
        )
        (rewound,) = [message for message in messages if message["type"] == "rewound"]
        assert rewound["to_update"] == 2
        assert messages[-1]["columns"]["update"] == [3.0, 4.0]
        # A page that was away has rows of the former state: `rewound` drops them.
        messages = asyncio.run(
            messages_of(server, {"run": "a", "since": 6, "revision": 0}, None, lambda m: m["type"] == "rows")
        )
        assert [m["type"] for m in messages[1:]] == ["rewound", "rows"] and messages[-1]["first"] == 0


def test_a_page_that_has_nothing_hears_of_new_rows_alone(tmp_path: Path) -> None:
    """Rows of before come as curves; a run of 200,000 must not be sent row by row."""
    run = write_run(tmp_path / "a", 5)
    with serving(run) as server:
        server.json("/api/runs/a")  # the run is read
        write_rows(run, 6, 6)
        messages = asyncio.run(messages_of(server, {"run": "a", "since": None}, None, lambda m: m["type"] == "rows"))
        assert messages[-1]["first"] == 5 and messages[-1]["columns"]["update"] == [6.0]


@pytest.mark.parametrize(
    "message", ["no json", "[]", "{}", '{"type": "watch"}', '{"type": "fly"}', '{"type": "watch", "run": "none"}']
)
def test_a_message_that_is_wrong_gets_a_line_and_the_channel_stays(server: Server, message: str) -> None:
    async def talk() -> list[dict]:
        async with aiohttp.ClientSession() as session:
            address = f"http://127.0.0.1:{server.port}/channel"
            async with session.ws_connect(address, headers={"Cookie": server.cookie}) as channel:
                await channel.send_str(message)
                await channel.send_json({"type": "hello", "version": 1})
                return [await asyncio.wait_for(channel.receive_json(), PATIENCE_S) for _ in range(2)]

    error, hello = asyncio.run(talk())
    assert error["type"] == "error" and "\n" not in error["text"] and hello["type"] == "hello"


def snapshot(root: Path) -> dict[str, tuple]:
    """Content, times and rights of everything below a directory; reading a file changes its access time alone."""
    found = {}
    for path in sorted([root, *root.rglob("*")]):
        status = path.stat()
        content = hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else None
        found[str(path)] = (content, status.st_mtime_ns, status.st_ctime_ns, status.st_mode, status.st_size)
    return found


def browse(server: Server) -> None:
    for run in [row["id"] for row in server.json("/api/runs")["runs"]]:
        for page in ("", "/series?names=train/solve_rate", "/events", "/evaluations", "/verdict"):
            server.json(f"/api/runs/{run}{page}")


def test_a_run_is_left_as_it_is_and_can_be_a_copy_without_write_permission(tmp_path: Path, runs: Path) -> None:
    shutil.copytree(runs, tmp_path / "copy")
    for path in (tmp_path / "copy").rglob("*"):
        path.chmod(0o555 if path.is_dir() else 0o444)
    before = snapshot(tmp_path / "copy")
    with serving(tmp_path / "copy") as server:
        browse(server)
    assert snapshot(tmp_path / "copy") == before


def test_the_lock_of_a_driver_is_never_touched(tmp_path: Path) -> None:
    """A driver can take its lock while pages are read, and no file of the name is opened."""
    from kinetix_dist.runtime.driver.run_directory import RunDirectory

    run = write_run(tmp_path / "a")
    with serving(tmp_path) as server:
        for _ in range(5):
            browse(server)
            RunDirectory.open_existing(run).close()
        opened = [os.readlink(link) for link in Path(f"/proc/{server.process.pid}/fd").iterdir()]
        assert not [name for name in opened if name.endswith("/lock")]


def test_a_run_that_vanishes_is_an_answer_and_no_end(tmp_path: Path) -> None:
    write_run(tmp_path / "a")
    write_run(tmp_path / "b")
    with serving(tmp_path) as server:
        browse(server)
        shutil.rmtree(tmp_path / "a")
        found = server.json("/api/runs/a")
        assert found["config"] is None
        wait_for(lambda: [row["id"] for row in server.json("/api/runs")["runs"]] == ["b"])


@pytest.mark.parametrize("path", ["", "/series", "/evaluations", "/curriculum", "/recordings", "/verdict"])
def test_a_run_that_has_just_begun_is_found_by_any_page(tmp_path: Path, path: str) -> None:
    with serving(tmp_path, "--no-play") as server:
        server.json("/api/runs")  # the list was looked at a moment ago
        write_run(tmp_path / "new")
        status, _, content = server.request(f"/api/runs/new{path}")
        assert b"there is no run" not in content and status in (200, 503), content


def test_the_curriculum_of_a_run_has_attempts(tmp_path: Path) -> None:
    run = write_run(tmp_path / "new", 1)
    write_refresh(run, 0, np.random.default_rng(0))
    append_line(run / DIRECTORY / OUTCOMES, window(0, 0, 16, [2] * 8, [4] * 8))
    with serving(tmp_path, "--no-play") as server:
        found = server.json("/api/runs/new/curriculum")
        (shown,) = found["windows"]
        assert shown["sources"]["buffer"]["episodes"] == 32 and not found["problems"]
        base = "/api/runs/new/curriculum/refresh/0/levels"
        assert server.json(f"{base}?sort=attempts_training")["levels"][0]["training"]["rate"] == 0.5
        (trained,) = server.json(f"{base}/3/history")["windows"]
        assert (trained["solved"], trained["episodes"]) == (2, 4)


def test_the_server_imports_no_jax() -> None:
    code = (
        "import sys, kinetix_dist.cli.dashboard, kinetix_dist.studio.server.app\n"
        "print([m for m in ('jax', 'jaxlib', 'warp', 'ray', 'orbax', 'flax') if m in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=environment(), check=True, timeout=PATIENCE_S
    )
    assert done.stdout.strip() == "[]" and python_path() in environment()["PYTHONPATH"]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_it_in_order(tmp_path: Path, number: signal.Signals) -> None:
    write_run(tmp_path / "a")
    with serving(tmp_path) as server:
        browse(server)
        server.process.send_signal(number)
        assert server.process.wait(10) == 0


def test_a_busy_port_gives_the_next(tmp_path: Path) -> None:
    write_run(tmp_path / "a")
    with serving(tmp_path) as first:
        with serving(tmp_path, "--port", str(first.port)) as second:
            assert second.port > first.port and f"port {first.port} is busy" in "".join(second.lines)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["{tmp}/nothing"], "does not exist; name a run directory"),
        (["{tmp}/file"], "is no directory"),
        (["{tmp}/other"], "is no run (it has no config.json)"),
        (["{tmp}", "--port", "70000"], "--port is 70000; it must be 0 to 65535"),
        (["{tmp}/a", "--host", "192.0.2.1"], "--host 192.0.2.1 cannot be listened on"),
        ([], "there is no directory runs/ here"),
    ],
)
def test_wrong_arguments_are_one_line_and_status_2(tmp_path: Path, arguments: list[str], text: str) -> None:
    write_run(tmp_path / "a")
    (tmp_path / "file").write_text("")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "x").write_text("")
    (tmp_path / "here").mkdir()
    done = subprocess.run(
        command(*(argument.format(tmp=tmp_path) for argument in arguments)),
        capture_output=True, text=True, env=environment(), cwd=tmp_path / "here", timeout=PATIENCE_S, check=False,
    )  # fmt: skip
    assert done.returncode == 2 and done.stdout == "", done
    assert done.stderr.startswith("kinetix-dist: ") and done.stderr.count("\n") == 1 and text in done.stderr


def test_answers_are_json_without_nan(server: Server) -> None:
    content = server.request("/api/runs/b/series?names=train/solve_rate,learner/entropy&points=10")[2]
    json.loads(content, parse_constant=lambda name: pytest.fail(name))
