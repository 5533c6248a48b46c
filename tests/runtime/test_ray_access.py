"""Ray's token is for its user alone, and a cluster that is not there or refuses ours is said in one line."""

import inspect
import os
import signal
import socket
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
import ray
from ray._private import utils

from kinetix_dist.cli.main import main
from kinetix_dist.runtime.processes.failures import RayFailedError
from kinetix_dist.runtime.processes.placement import PlacementError
from kinetix_dist.runtime.processes.ray_setup import joining, own_signals, secure_token, use_token, without_services
from tests.helpers import REPOSITORY, next_line, python_path

TINY_ON_RAY = ["train", "--recipe", "tiny", "--evaluation.sets", "s/kick", "--run.placement", "colocated"]


@pytest.fixture(autouse=True)
def home(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    for name in ("RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH", "RAY_AUTH_MODE", "RAY_ADDRESS"):
        monkeypatch.delenv(name, raising=False)
    return tmp_path


def test_a_new_token_is_for_its_user_alone(home):
    assert secure_token() is None
    path = home / ".ray" / "auth_token"
    token = path.read_text()
    assert path.stat().st_mode & 0o777 == 0o600 and len(token) == 64
    assert secure_token() is None and path.read_text() == token


def test_a_token_that_others_could_read_is_closed_and_stays(home, monkeypatch):
    path = home / "token"
    path.write_text("a" * 64)
    path.chmod(0o644)
    monkeypatch.setenv("RAY_AUTH_TOKEN_PATH", str(path))
    assert secure_token() == path
    assert path.stat().st_mode & 0o777 == 0o600 and path.read_text() == "a" * 64
    assert not (home / ".ray").exists()


def test_ray_leaves_signal_handlers_alone():
    """Ray's handler would end a run that is stopped while it starts, with a status of Ray's own."""
    before = signal.getsignal(signal.SIGTERM)
    with own_signals():
        utils.set_sigterm_handler(lambda number, frame: None)
        assert signal.getsignal(signal.SIGTERM) is before


def test_a_token_of_the_environment_needs_no_file(home, monkeypatch):
    monkeypatch.setenv("RAY_AUTH_TOKEN", "b" * 64)
    assert secure_token() is None and not (home / ".ray").exists()


def test_a_cluster_is_given_the_token_where_there_is_one(home, monkeypatch):
    monkeypatch.setenv("RAY_AUTH_MODE", "")
    monkeypatch.delenv("RAY_AUTH_MODE")
    use_token()
    assert "RAY_AUTH_MODE" not in os.environ
    secure_token()
    use_token()
    assert os.environ["RAY_AUTH_MODE"] == "token"
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")
    use_token()
    assert os.environ["RAY_AUTH_MODE"] == "disabled"


def test_a_token_file_that_cannot_be_made_is_refused(home):
    (home / ".ray").write_text("")
    with pytest.raises(PlacementError, match=r"auth_token cannot be hidden from others .*RAY_AUTH_TOKEN_PATH"):
        secure_token()


def test_a_cluster_that_is_not_there_is_said_in_one_line(home, monkeypatch, capsys):
    with socket.socket() as taken:  # bound and not listening: no program answers, and no other gets it
        taken.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        monkeypatch.setenv("RAY_ADDRESS", address)
        assert main([*TINY_ON_RAY, "--run", str(home / "run")]) == 2
    line = capsys.readouterr().err.strip().splitlines()[-1]
    assert line.startswith(f"kinetix-dist: no Ray cluster answers at {address}") and "unset RAY_ADDRESS" in line
    assert "KINETIX_DIST_LOOPBACK" not in os.environ  # a run that this process starts later is another's business


HEAD = """
import sys
from kinetix_dist.runtime.processes.ray_setup import secure_token
secure_token()
import ray
options = {"include_dashboard": False, "log_to_driver": False, "_node_ip_address": "127.0.0.1"}
print(ray.init(address="local", num_cpus=2, **options).address_info["gcs_address"], flush=True)
sys.stdin.read()
"""


@pytest.mark.slow
def test_a_wrong_and_a_missing_token_are_refused_in_one_line(home):
    """A real Ray cluster of one node, joined with another token and without one."""
    environment = {**os.environ, "PYTHONPATH": python_path(), "JAX_PLATFORMS": "cpu"}
    head = subprocess.Popen(
        [sys.executable, "-c", HEAD], env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    try:
        environment["RAY_ADDRESS"] = next_line(head).strip()
        (home / "elsewhere").mkdir()
        for name, change in (("wrong", {"RAY_AUTH_TOKEN": "c" * 64}), ("missing", {"HOME": str(home / "elsewhere")})):
            command = [sys.executable, "-m", "kinetix_dist.cli.main", *TINY_ON_RAY, "--run", str(home / name)]
            done = subprocess.run(
                command, env=environment | change, cwd=REPOSITORY, capture_output=True, text=True, timeout=120
            )
            assert done.returncode == 2, done.stderr
            lines = [line for line in done.stderr.splitlines() if "kinetix-dist: " in line or "Auth" in line]
            assert len(lines) == 1 and "its token is missing or another" in lines[0], done.stderr
            assert "c" * 64 not in done.stderr and "Traceback" not in done.stderr
    finally:
        head.communicate()  # its stdin ends, and Ray with it


def test_a_console_that_cannot_be_held_back_is_said_by_the_error_of_the_system(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The error used to be hidden by another one, of the text that was not there yet."""
    monkeypatch.setattr(tempfile, "tempdir", str(home / "missing"))
    with socket.create_server(("127.0.0.1", 0)) as server:
        host, port = server.getsockname()
        with pytest.raises(FileNotFoundError, match="missing"), joining(f"{host}:{port}"):
            pytest.fail("nothing joins")


def test_a_ray_that_did_not_start_in_its_time_is_one_line_that_says_what_to_do():
    said = "timed out during startup"
    assert said in inspect.getsource(ray._private.node), "Ray says it in other words now"
    with pytest.raises(RayFailedError, match=rf"^Ray did not start .*{said}.* --run\.placement local"):
        with without_services():
            raise Exception(f"The current node {said}.")
