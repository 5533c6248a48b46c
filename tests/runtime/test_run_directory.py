"""A run directory belongs to one driver, and a finished run is never overwritten."""

import subprocess
import sys

import pytest

from kinetix_dist.runtime.driver.run_directory import RunDirectory, RunDirectoryError, RunInUseError, newest_run
from tests.helpers import next_line


def _make_run(path, *, numbered=True):
    run = RunDirectory.create(path, numbered=numbered)
    run.write_json(run.config_path, {})
    return run


def test_a_second_run_of_a_recipe_gets_a_number(tmp_path):
    first = _make_run(tmp_path / "quickstart")
    first.close()
    second = _make_run(tmp_path / "quickstart")
    third = _make_run(tmp_path / "quickstart")
    assert [run.path.name for run in (first, second, third)] == ["quickstart", "quickstart-2", "quickstart-3"]
    assert newest_run(tmp_path, "quickstart") == tmp_path / "quickstart-3"
    assert newest_run(tmp_path, "quick") is None


def test_a_directory_given_by_name_is_not_renamed(tmp_path):
    _make_run(tmp_path / "mine", numbered=False).close()
    with pytest.raises(RunDirectoryError, match="holds a run already"):
        RunDirectory.create(tmp_path / "mine", numbered=False)


def test_a_second_driver_in_another_process_is_refused_until_the_first_is_gone(tmp_path):
    code = (
        "import pathlib, sys; from kinetix_dist.runtime.driver.run_directory import RunDirectory;"
        "run = RunDirectory.open_existing(pathlib.Path(sys.argv[1])); print('locked', flush=True); sys.stdin.read()"
    )
    path = tmp_path / "run"
    _make_run(path).close()
    other = subprocess.Popen(
        [sys.executable, "-c", code, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    try:
        assert next_line(other) == "locked\n"
        with pytest.raises(RunInUseError, match=f"in use by process {other.pid}"):
            RunDirectory.open_existing(path)
    finally:
        other.kill()  # the lock goes with the process, even by SIGKILL
        other.wait()
    RunDirectory.open_existing(path).close()


def test_a_run_directory_below_a_file_is_refused_in_words(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(RunDirectoryError, match=r"file/run"):
        RunDirectory.create(tmp_path / "file" / "run", numbered=False)


def test_resuming_a_directory_without_a_run_is_refused(tmp_path):
    with pytest.raises(RunDirectoryError, match="holds no run"):
        RunDirectory.open_existing(tmp_path)
