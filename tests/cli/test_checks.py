"""The start of commands that compute: a JAX that computes wrongly or otherwise, and directories that are not there."""

from __future__ import annotations

import getpass
import os
import pwd
import time
from pathlib import Path

import jax
import numpy as np
import pytest

from kinetix_dist import jax_checks, user_directories
from kinetix_dist.cli import doctor
from kinetix_dist.cli.checks import start_computing
from kinetix_dist.cli.main import main
from kinetix_dist.jax_checks import NUM_ROWS, SETTINGS, arithmetic_complaint, check_settings, wrong_rows
from kinetix_dist.program_cache import enable_compile_cache

# Commands with which somebody computes; {tmp} is an empty directory.
COMMANDS = (
    "train --recipe tiny --run {tmp}/run",
    "finetune --levels s/kick --run {tmp}/run",
    "eval --policy random --levels s/kick",
    "levels solve s/kick",
    "levels generate {tmp}/out --count 4",
)


def _arguments(command: str, folder: Path) -> list[str]:
    return command.format(tmp=folder).split()


# Arithmetic


def test_the_jax_that_is_installed_computes_rightly_and_that_is_known_in_milliseconds():
    arithmetic_complaint.cache_clear()
    began = time.process_time()
    assert arithmetic_complaint() == ""
    assert time.process_time() - began < 5.0  # 0.05 s on a machine that does nothing else


@pytest.mark.parametrize("value", [0.0, 1e9, np.nan, np.inf])
def test_one_wrong_row_is_found(value):
    right = np.random.default_rng(1).normal(size=NUM_ROWS) ** 2
    computed = right.astype(np.float32)
    assert wrong_rows(computed, right).size == 0
    computed[-1] = value
    assert wrong_rows(computed, right).tolist() == [NUM_ROWS - 1]


@pytest.fixture
def wrong_arithmetic(monkeypatch):
    """A JAX like 0.10.2, whose last row is not what it should be."""
    right = jax_checks._computed

    def wrong(matrix, rows):
        computed = right(matrix, rows).copy()
        computed[-1] *= 0.5
        return computed

    monkeypatch.setattr(jax_checks, "_computed", wrong)
    arithmetic_complaint.cache_clear()
    yield
    arithmetic_complaint.cache_clear()


@pytest.mark.parametrize("command", COMMANDS)
def test_nothing_is_computed_by_a_jax_that_computes_wrongly(wrong_arithmetic, command, tmp_path, capsys):
    assert main(_arguments(command, tmp_path)) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"kinetix-dist: jax {jax.__version__} computes wrong numbers on this CPU: 1 of {NUM_ROWS}")
    assert "row 32768" in line and "install" in line
    assert not list(tmp_path.iterdir())


def test_doctor_says_that_training_cannot_run_with_such_a_jax():
    line = "jax 0.10.2 computes wrong numbers on this CPU: 1 of 9; install another"
    found = doctor.check_arithmetic(doctor.Check(name="jax", status="ok", detail="", facts={"wrong_arithmetic": line}))
    assert (found.status, found.remedy) == ("error", "install another")


# Settings


@pytest.mark.parametrize("command", COMMANDS)
def test_a_setting_of_jax_that_ends_programs_is_one_line(command, tmp_path, capsys):
    with jax.numpy_rank_promotion("raise"):
        assert main(_arguments(command, tmp_path)) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("kinetix-dist: JAX_NUMPY_RANK_PROMOTION is 'raise'") and "unset it" in line
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("variable", "value"),
    [
        ("JAX_NUMPY_DTYPE_PROMOTION", jax.numpy_dtype_promotion("strict")),
        ("JAX_TRANSFER_GUARD_HOST_TO_DEVICE", jax.transfer_guard_host_to_device("disallow")),
        ("JAX_TRANSFER_GUARD_DEVICE_TO_HOST", jax.transfer_guard_device_to_host("disallow_explicit")),
    ],
)
def test_each_setting_in_the_list_is_looked_at(variable, value):
    check_settings()
    with value, pytest.raises(Exception, match=f"^{variable} is '"):
        check_settings()


def test_the_list_names_settings_of_this_jax_with_its_defaults_first():
    for setting in SETTINGS:
        assert getattr(jax.config, setting.name) == setting.values[0]


# Directories of the user


@pytest.fixture
def fallback(monkeypatch, tmp_path):
    """A user of whom the system knows nothing; temporary files go to tmp_path."""

    def unknown(uid):
        raise KeyError(f"getpwuid(): uid not found: {uid}")

    for name in ("HOME", "XDG_CACHE_HOME", "LOGNAME", "USER", "LNAME", "USERNAME", "RAY_AUTH_TOKEN_PATH"):
        monkeypatch.setenv(name, "")  # so that it is as before at the end
        monkeypatch.delenv(name)
    monkeypatch.setattr(pwd, "getpwuid", unknown)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    return tmp_path / f"kinetix-dist-{os.getuid()}"


def test_without_home_caches_go_to_a_temporary_directory_of_this_user_alone(fallback, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    said = user_directories.settle.__wrapped__()
    assert said.startswith(f"user uid{os.getuid()} has no home directory: caches are stored in {fallback}; set HOME")
    assert fallback.stat().st_mode & 0o777 == 0o700
    assert (Path.home(), os.environ["XDG_CACHE_HOME"]) == (fallback, str(fallback / ".cache"))
    assert getpass.getuser() == f"uid{os.getuid()}"
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    before = jax.config.values["jax_compilation_cache_dir"]
    try:
        assert enable_compile_cache("") == fallback / ".cache" / "kinetix-dist" / "jax"
    finally:
        jax.config.update("jax_compilation_cache_dir", before)
    assert [path.name for path in tmp_path.iterdir()] == [fallback.name]  # no "~"
    assert user_directories.settle.__wrapped__() == ""  # nothing is left to replace


def test_a_home_that_cannot_be_written_stays_and_caches_go_elsewhere(fallback, monkeypatch, tmp_path):
    home = tmp_path / "home"
    home.mkdir()
    (home / ".cache").write_text("a file")  # also for root
    monkeypatch.setattr(os, "access", lambda path, mode: not Path(path).is_relative_to(home))
    monkeypatch.setenv("HOME", str(home))
    said = user_directories.settle.__wrapped__()
    assert said.startswith(f"{home / '.cache'} cannot be written: caches are stored in {fallback};")
    assert (os.environ["HOME"], os.environ["XDG_CACHE_HOME"]) == (str(home), str(fallback / ".cache"))
    assert os.environ["RAY_AUTH_TOKEN_PATH"] == str(fallback / "ray_auth_token")


def test_rays_token_moves_too_where_only_the_caches_have_a_directory(fallback, monkeypatch, tmp_path):
    home, cache = tmp_path / "home", tmp_path / "cache"
    home.mkdir()
    cache.mkdir()
    monkeypatch.setattr(os, "access", lambda path, mode: not Path(path).is_relative_to(home))
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache))
    said = user_directories.settle.__wrapped__()
    assert said.startswith(f"{home / '.ray'} cannot be written: Ray's token goes to {fallback};")
    assert os.environ["RAY_AUTH_TOKEN_PATH"] == str(fallback / "ray_auth_token")
    assert os.environ["XDG_CACHE_HOME"] == str(cache)


def test_a_directory_of_that_name_that_others_can_read_is_not_taken(fallback, tmp_path):
    fallback.mkdir(mode=0o755)
    user_directories.settle.__wrapped__()
    assert os.environ["HOME"] != str(fallback) and Path(os.environ["HOME"]).parent == tmp_path


def test_a_usable_home_stays_as_it_is(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("LOGNAME", "someone")
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    before = dict(os.environ)
    assert user_directories.settle.__wrapped__() == "" and dict(os.environ) == before
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("variable", ["JAX_COMPILATION_CACHE_DIR", "WARP_CACHE_PATH", "RAY_TMPDIR"])
def test_doctor_writes_where_training_does(variable, monkeypatch, tmp_path):
    monkeypatch.setenv("RAY_TMPDIR", str(tmp_path))
    monkeypatch.setenv(variable, str(tmp_path / "new"))
    assert doctor.check_caches().status == "ok"
    (tmp_path / "file").write_text("")
    monkeypatch.setenv(variable, str(tmp_path / "file"))
    found = doctor.check_caches()
    assert found.status == "error" and str(tmp_path / "file") in found.detail and variable in found.remedy


def test_a_compile_cache_that_cannot_be_written_is_said_once(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    before = jax.config.values["jax_compilation_cache_dir"]
    for _ in range(2):
        start_computing(str(tmp_path / "file"))
    assert jax.config.values["jax_compilation_cache_dir"] == before
    assert capsys.readouterr().err.count("the compile cache cannot be written") == 1
