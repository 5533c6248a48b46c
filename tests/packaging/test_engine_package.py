"""`jax2d` is the name of the engine and of a published package: which one is imported is said in one line."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from kinetix_dist import installation
from kinetix_dist.cli.doctor import check_engine
from kinetix_dist.cli.main import COMMANDS, main
from kinetix_dist.installation import ENGINE, engine_complaint, engine_note
from tests.cli.test_main import assert_one_line, run_command
from tests.helpers import PATIENCE_S, REPOSITORY


@pytest.fixture
def published(tmp_path, monkeypatch):
    """A directory with the published package, first on the path of this process and its children."""
    (tmp_path / "jax2d").mkdir()
    for name in ("__init__", "engine", "sim_state"):
        (tmp_path / "jax2d" / f"{name}.py").write_text("")
    (tmp_path / "jax2d-1.0.1.dist-info").mkdir()
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "jax2d", raising=False)
    yield tmp_path
    engine_complaint.cache_clear()
    engine_note.cache_clear()


@pytest.fixture(autouse=True)
def looked_at_anew():
    engine_complaint.cache_clear()
    engine_note.cache_clear()


def test_there_is_nothing_to_say_of_this_installation():
    assert engine_complaint() == engine_note() == "" and check_engine().status == "ok"


@pytest.mark.parametrize("name", [name for name in COMMANDS if name != "doctor"])
def test_every_command_says_in_one_line_that_another_package_is_imported(published, name, capsys):
    assert main([name]) == 2
    line = capsys.readouterr().err
    assert_one_line(line, f"the package jax2d at {published / 'jax2d'} is imported", str(ENGINE), "pip uninstall jax2d")
    assert "make install" not in line


def test_doctor_says_so_and_that_training_cannot_run(published, monkeypatch):
    monkeypatch.setenv("PYTHONSAFEPATH", "1")  # else this checkout comes first
    done = run_command("doctor", path=published)
    assert done.returncode == 1 and done.stderr == ""
    (line,) = [line for line in done.stdout.splitlines() if line.startswith("ERROR")]
    assert str(published / "jax2d") in line and "training cannot run here" in done.stdout


def test_importing_what_needs_the_engine_says_so(published):
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(published), str(REPOSITORY)])}
    command = [sys.executable, "-P", "-c", "import kinetix_dist.config"]
    said = subprocess.run(
        command, env=environment, capture_output=True, text=True, timeout=PATIENCE_S
    ).stderr.splitlines()
    assert said[-1].startswith("kinetix_dist.installation.EngineImportError: the package jax2d at ")


def test_the_engine_first_and_the_published_package_elsewhere_is_a_warning(published, monkeypatch):
    monkeypatch.setattr(sys, "path", [str(REPOSITORY), *sys.path])
    assert engine_complaint() == ""
    with pytest.warns(UserWarning, match=r"^the published package jax2d 1\.0\.1 is installed at .*; jax2d is the"):
        installation.guard()
    assert check_engine().status == "warning"


def test_files_of_both_in_one_directory_are_refused(published, monkeypatch):
    monkeypatch.setattr(installation, "ENGINE", Path(published / "jax2d").resolve())
    assert engine_complaint().startswith("files of the published package jax2d 1.0.1 lie among those of the engine")
