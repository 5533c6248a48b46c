"""The engine worker behind the server: answers, and what becomes of requests when it dies, hangs or is not wanted."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from kinetix_dist.studio.server import worker_client
from kinetix_dist.studio.server.level_pages import recording_files, recording_path
from kinetix_dist.studio.server.run_service import UnknownRunError
from kinetix_dist.studio.server.worker_client import GONE, HUNG, OFF, WorkerClient, WorkerError
from kinetix_dist.studio.worker.process import NICE
from tests.helpers import run_in_time
from tests.studio.runs_for_tests import write_run
from tests.studio.serving import Server, serving, wait_for


def a_worker_that(*lines: str) -> tuple[str, ...]:
    """A process that says hello as the engine worker does, then runs these lines with `read()` and `send(message)`."""
    head = """
import sys
from kinetix_dist.studio.worker import wire
def send(content, body=b""):
    sys.stdout.buffer.write(wire.encode(wire.Message(content, body))); sys.stdout.buffer.flush()
def read():
    return wire.read(sys.stdin.buffer)
send({"type": "hello", "version": wire.PROTOCOL_VERSION, "imports": {}, "palette": {}})
"""
    return (sys.executable, "-c", head + "\n".join(lines))


ECHO = (
    "while (m := read()) is not None:",
    "    send({'type': 'reply', 'id': m.content['id'], 'got': m.content['type']})",
)


def test_a_request_is_answered_by_its_reply() -> None:
    async def talk() -> None:
        worker = WorkerClient(command=a_worker_that(*ECHO))
        replies = await asyncio.gather(*(worker.request(f"kind {k}", {}) for k in range(20)))
        assert [reply.content["got"] for reply in replies] == [f"kind {k}" for k in range(20)]
        pid = worker.pid
        await worker.close()
        assert pid is not None and not psutil.pid_exists(pid) and worker.pid is None

    run_in_time(talk())


def test_a_worker_that_dies_fails_what_waits_and_the_next_request_starts_another() -> None:
    async def talk() -> None:
        lines = ("m = read()", "print('out of memory', file=sys.stderr)", "sys.exit(3)")
        worker = WorkerClient(command=a_worker_that(*lines))
        pids = []
        for _ in range(2):
            await worker.hello()
            pids.append(worker.pid)
            with pytest.raises(WorkerError, match=r"died \(exit status 3\): out of memory; try again") as error:
                await worker.request("anything", {})
            assert error.value.code == GONE
        assert pids[0] != pids[1]
        await worker.close()

    run_in_time(talk())


def test_a_worker_that_hangs_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker_client, "SILENT_SECONDS", 0.5)

    async def talk() -> None:
        worker = WorkerClient(command=a_worker_that("import time", "time.sleep(100)"))
        await worker.hello()
        pid = worker.pid
        with pytest.raises(WorkerError, match=r"was silent for 0\.5 s and was ended") as error:
            await worker.request("anything", {})
        assert error.value.code == HUNG and pid is not None
        while psutil.pid_exists(pid) and psutil.Process(pid).status() != psutil.STATUS_ZOMBIE:
            await asyncio.sleep(0.02)
        await worker.close()

    run_in_time(talk())


def test_a_cancelled_request_is_cancelled_in_the_worker() -> None:
    async def talk() -> None:
        lines = (
            "first, second, third = read(), read(), read()",
            "send({'type': 'reply', 'id': third.content['id'], 'was': second.content})",
        )
        worker = WorkerClient(command=a_worker_that(*lines))
        waiting = asyncio.create_task(worker.request("long", {}))
        await worker.hello()
        await asyncio.sleep(0.05)
        waiting.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await waiting
        reply = await worker.request("next", {})
        assert reply.content["was"] == {"type": "cancel", "id": 1}
        await worker.close()

    run_in_time(talk())


@pytest.mark.parametrize(
    ("line", "text"),
    [
        ("sys.stdout.buffer.write(b'\\xff' * 100); sys.stdout.buffer.flush(); read()", "no message"),
        ("sys.exit(0)", "since it had no requests"),
    ],
)
def test_other_ends_of_a_worker_are_one_line(line: str, text: str) -> None:
    async def talk() -> None:
        worker = WorkerClient(command=a_worker_that("read()", line))
        with pytest.raises(WorkerError, match=text):
            await worker.request("anything", {})
        await worker.close()

    run_in_time(talk())


def test_a_jax_that_the_worker_does_not_run_with_is_said_in_its_line(monkeypatch: pytest.MonkeyPatch) -> None:
    async def talk() -> None:
        with pytest.raises(WorkerError, match=r"died .*: JAX_NUMPY_RANK_PROMOTION is 'raise', .*; unset it"):
            await WorkerClient().hello()

    monkeypatch.setenv("JAX_NUMPY_RANK_PROMOTION", "raise")
    run_in_time(talk())


def test_one_of_another_version_is_refused() -> None:
    async def talk() -> None:
        command = (sys.executable, "-c", a_worker_that()[2].replace("wire.PROTOCOL_VERSION,", "99,"))
        with pytest.raises(WorkerError, match="speaks version 99"):
            await WorkerClient(command=command).hello()

    run_in_time(talk())


def test_one_that_imports_another_checkout_is_refused() -> None:
    async def talk() -> None:
        code = a_worker_that()[2].replace('"imports": {}', '"imports": {"kinetix_dist": "/other/kinetix_dist"}')
        with pytest.raises(WorkerError, match="imports kinetix_dist from /other/kinetix_dist instead of"):
            await WorkerClient(command=(sys.executable, "-c", code)).hello()

    run_in_time(talk())


def test_without_play_none_is_started() -> None:
    async def talk() -> None:
        worker = WorkerClient(is_allowed=False)
        with pytest.raises(WorkerError, match="--no-play") as error:
            await worker.hello()
        assert error.value.code == OFF and worker.pid is None

    run_in_time(talk())


def test_recordings_are_those_that_lie_in_the_run(tmp_path: Path) -> None:
    run = write_run(tmp_path / "a")
    (run / "recordings").mkdir()
    (run / "recordings" / "one.mcap").write_bytes(b"")
    (tmp_path / "secret.mcap").write_bytes(b"")
    (run / "recordings" / "link.mcap").symlink_to(tmp_path / "secret.mcap")
    assert [path.name for path in recording_files(run)] == ["one.mcap"]
    assert recording_path(run, "one.mcap").is_file()
    for name in ("link.mcap", "../../secret.mcap", "none.mcap", "..", "", "config.json"):
        with pytest.raises(UnknownRunError):
            recording_path(run, name)


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    run = write_run(tmp_path_factory.mktemp("runs") / "a")
    (run / "recordings").mkdir()
    (run / "recordings" / "garbage.mcap").write_bytes(b"garbage")
    with serving(run) as server:
        yield server


def worker_of(server: Server) -> psutil.Process:
    (child,) = psutil.Process(server.process.pid).children()
    return child


def test_the_real_worker_starts_when_it_is_needed_without_gpus(server: Server) -> None:
    assert not psutil.Process(server.process.pid).children()
    assert server.json("/api/palette")["role_palette"]
    worker = worker_of(server)
    assert worker.environ()["CUDA_VISIBLE_DEVICES"] == "" and worker.environ()["JAX_PLATFORMS"] == "cpu"
    assert worker.nice() == min(psutil.Process().nice() + NICE, 19)


def test_a_damaged_recording_is_a_line_beside_its_name(server: Server) -> None:
    (entry,) = server.json("/api/runs/a/recordings")["files"]
    assert entry["file"] == "garbage.mcap" and entry["rollouts"] == [] and "no MCAP file" in entry["problems"][0]


@pytest.mark.parametrize(
    ("path", "status", "text"),
    [
        ("/api/runs/a/recordings/none.mcap/0", 404, "there is no recording 'none.mcap'"),
        ("/api/runs/a/recordings/..%2Fconfig.json/0", 404, "there is no recording"),
        ("/api/runs/a/curriculum/refresh/0/levels", 404, "there is no refresh 0"),
        ("/api/runs/a/curriculum/refresh/0/thumbnails?indices=0", 404, "refresh_00000000.npz cannot be read"),
        ("/api/runs/a/curriculum/refresh/0/thumbnails?indices=x", 400, "indices is 'x'"),
    ],
)
def test_wrong_requests_get_one_line(server: Server, path: str, status: int, text: str) -> None:
    found = server.error(path)
    assert found[0] == status and text in found[1] and "\n" not in found[1]


def test_a_worker_that_is_killed_is_started_again(server: Server) -> None:
    server.json("/api/palette")
    first = worker_of(server)
    first.kill()

    def is_another() -> bool:
        # The server knows the palette, and may give it once more before it sees that the worker is gone.
        children = psutil.Process(server.process.pid).children()
        return server.request("/api/palette")[0] == 200 and any(child.pid != first.pid for child in children)

    wait_for(is_another)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_nothing_is_left_running_however_the_server_ends(tmp_path: Path, number: signal.Signals) -> None:
    write_run(tmp_path / "a")
    with serving(tmp_path) as server:
        server.json("/api/palette")
        worker = worker_of(server)
        os.kill(server.process.pid, number)
        server.process.wait(20)
        wait_for(lambda: not worker.is_running() or worker.status() == psutil.STATUS_ZOMBIE)
    assert isinstance(server.process, subprocess.Popen)
