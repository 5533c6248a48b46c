"""End of a worker: with its pipe, its parent, or after a while without work; killed and hung ones are noticed."""

from __future__ import annotations

import os
import queue
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from bench.worker_client import WORKER, Client
from kinetix_dist.child_python import command_of
from kinetix_dist.studio.worker.process import IDLE_VARIABLE, NICE
from tests.helpers import PATIENCE_S, REPOSITORY, next_line, python_path, wait_until
from tests.studio.test_worker import LONG, document


def wait_for_end(pid: int, seconds: float) -> None:
    end = time.monotonic() + seconds
    while psutil.pid_exists(pid) and psutil.Process(pid).status() != psutil.STATUS_ZOMBIE:
        assert time.monotonic() < end, f"process {pid} goes on"
        time.sleep(0.05)


def test_it_ends_with_its_pipe_also_in_the_middle_of_work(tmp_path: Path) -> None:
    client = Client(log=tmp_path / "log")
    process = psutil.Process(client.process.pid)
    assert process.nice() == min(psutil.Process().nice() + NICE, 19)
    request = client.send("attempts", **LONG)
    while not any(p["stage"] == "playing" for p in client.progress.get(request, ())):
        client.take()
    begin = time.monotonic()
    assert client.close() == 0
    assert time.monotonic() - begin < 5
    assert "Traceback" not in (tmp_path / "log").read_text()


def test_it_ends_when_its_parent_is_killed_though_the_pipe_stays_open(tmp_path: Path) -> None:
    reading, writing = os.pipe()
    code = (
        f"import subprocess; out = open({str(tmp_path / 'out')!r}, 'wb'); "
        f"p = subprocess.Popen({command_of(WORKER)!r}, stdin={reading}, stdout=out); print(p.pid, flush=True); p.wait()"
    )
    parent = subprocess.Popen(
        [sys.executable, "-c", code],
        pass_fds=[reading],
        stdout=subprocess.PIPE,
        stderr=(tmp_path / "log").open("wb"),
        cwd=REPOSITORY,
        env=os.environ | {"PYTHONPATH": python_path()},
    )
    worker = int(next_line(parent))
    wait_until(
        lambda: b"hello" in (tmp_path / "out").read_bytes() or parent.poll() is not None, "the worker begins", every=0.1
    )
    assert parent.poll() is None, (tmp_path / "log").read_text()  # it ends with the worker
    parent.kill()
    parent.wait()
    wait_for_end(worker, PATIENCE_S)
    os.close(writing)
    os.close(reading)


def test_it_ends_after_a_while_without_work_but_not_while_a_session_runs(tmp_path: Path) -> None:
    client = Client(log=tmp_path / "log", environment={IDLE_VARIABLE: "1.5"})
    session = client.request("play.open", level=LONG["level"], env=LONG["env"], running=True)
    time.sleep(3.0)
    client.request("play.control", session=session["session"], do="pause")
    assert client.other("bye", seconds=PATIENCE_S).content["reason"] == "idle"
    assert client.process.wait(timeout=PATIENCE_S) == 0


def test_a_hung_worker_is_silent_and_a_killed_one_is_the_end_of_the_pipe(tmp_path: Path) -> None:
    client = Client(log=tmp_path / "log")
    client.process.send_signal(signal.SIGSTOP)
    request = client.send("check", document=document())
    with pytest.raises(queue.Empty):
        client.wait(request, seconds=1)
    client.process.kill()
    with pytest.raises(AssertionError, match="the worker ended"):
        client.wait(request)
    assert client.process.wait(timeout=PATIENCE_S) == -signal.SIGKILL


def test_ctrl_c_is_left_to_the_server(worker: Client) -> None:
    worker.process.send_signal(signal.SIGINT)
    assert worker.request("check", document=document(), play=False)["problems"] == []


def test_it_sees_no_gpu_and_computes_on_the_cpu(tmp_path: Path) -> None:
    code = (
        "from kinetix_dist.studio.worker.process import _prepare_process; _prepare_process(); import os, jax; "
        "assert os.environ['CUDA_VISIBLE_DEVICES'] == ''; assert jax.default_backend() == 'cpu'; print('ok')"
    )
    environment = os.environ | {"PYTHONPATH": python_path(), "JAX_PLATFORMS": "", "CUDA_VISIBLE_DEVICES": "0"}
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=REPOSITORY,
        env=environment,
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
    )
    assert done.stdout.strip() == "ok", done.stderr
