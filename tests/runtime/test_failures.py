"""`kinetix-dist train` where a process of it fails: one line that says which and why, exit status 1, nothing lost."""

import json
import shutil

import pytest

from kinetix_dist.level.level_data import levels_root
from kinetix_dist.models.kernels import support
from tests.helpers import next_line
from tests.runtime.sockets import listening, places_of
from tests.runtime.train_process import TINY, kill_newest, rows, start, wait_for

COLOCATED = [*TINY, "--run.placement", "colocated"]


def _the_line(process, status: int = 1) -> str:
    """Last line of a command; fails where there is more than one, or another exit status."""
    output, errors = process.communicate(timeout=300)
    assert process.returncode == status, errors
    assert "raylet" not in output  # Ray's own advice on lost processes
    assert "Traceback" not in errors
    line = errors.strip().splitlines()[-1]
    assert line.startswith("kinetix-dist: "), errors
    return line


@pytest.mark.long
def test_a_level_set_that_is_gone_when_a_worker_loads_it(tmp_path):
    levels = tmp_path / "levels"
    levels.mkdir()
    shutil.copy(levels_root() / "s" / "kick.json", levels)
    fixed = ["--curriculum.name", "fixed", "--curriculum.levels", str(levels)]
    process = start(tmp_path / "run", *COLOCATED, *fixed)
    assert next_line(process).startswith("training ")  # checked by the command
    shutil.rmtree(levels)  # while Ray starts
    line = _the_line(process)
    log = tmp_path / "run" / "logs" / "worker_0.log"
    assert f"worker 0 failed: there is no level file or directory {levels}" in line
    assert f"traceback in {log}; checkpoints are untouched, go on with --run {tmp_path / 'run'} --resume" in line
    assert "load_level_set" in log.read_text()
    events = [json.loads(text) for text in (tmp_path / "run" / "events.jsonl").read_text().splitlines()]
    kinds = [event["event"] for event in events if event["event"] != "token_secured"]  # of the user's own Ray
    assert kinds == ["run_started", "process_started", "run_failed"]


@pytest.mark.skipif(not support.why_no_device(), reason="the kernels run here")
def test_kernels_that_the_device_of_a_worker_cannot_run_are_refused(tmp_path):
    """The driver leaves devices alone: the worker finds out."""
    network = ["--policy.encoder_size", "128", "--policy.num_heads", "8", "--policy.attention_features", "16"]
    options = ["--policy.kernels", "fused", "--policy.dtype", "bfloat16", *network]
    line = _the_line(start(tmp_path / "run", *COLOCATED, *options), status=2)
    assert "policy.kernels is 'fused', but" in line and line.endswith("use 'auto' or 'xla'")
    assert not (tmp_path / "run" / "config.json").exists()


@pytest.mark.long
def test_a_run_on_ray_is_seen_by_nobody_else_and_ends_when_a_worker_is_lost_too_often(tmp_path, monkeypatch):
    """Two workers: JAX's coordinator and the sockets of collectives are there too."""
    run = tmp_path / "run"
    monkeypatch.setenv("HOME", str(tmp_path))  # there is no token yet
    for name in ("RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH", "RAY_AUTH_MODE", "RAY_ADDRESS"):
        monkeypatch.delenv(name, raising=False)
    options = ["--run.num_workers", "2", "--run.max_restarts", "0", "--run.total_env_steps", "10000000"]
    process = start(run, *COLOCATED, *options)
    wait_for(lambda: bool(rows(run)), process, "an update")
    found = listening(process.pid)
    assert found.keys() <= {"127.0.0.1", "::1"}, found
    assert {"gcs_server", "raylet"} <= {name for names in found.values() for name in names}
    token = tmp_path / ".ray" / "auth_token"
    assert token.stat().st_mode & 0o777 == 0o600
    assert len(token.read_text()) == 64
    assert not places_of(token.read_text(), process.pid)
    kill_newest(run, "worker 0")
    line = _the_line(process)
    assert "worker 0 died" in line and "loss 1 within an hour, and run.max_restarts is 0" in line
    assert "--resume" in line
    assert not any(token.read_text() in file.read_text(errors="replace") for file in run.rglob("*") if file.is_file())
