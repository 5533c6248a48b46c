"""A run at its configured end: resuming writes nothing, and a longer one adds its figures to those before."""

from __future__ import annotations

import json
import shutil

import pytest

from kinetix_dist.checkpoint import list_checkpoints, load_checkpoint
from kinetix_dist.cli.main import main
from kinetix_dist.config import from_dict
from kinetix_dist.runtime.driver.run_directory import RunDirectory, newest_run
from kinetix_dist.runtime.driver.totals import SessionTotals, totals_before
from tests.runtime.conftest import NUM_UPDATES, STEPS, tiny_options


@pytest.fixture
def copy(finished_run, tmp_path):
    shutil.copytree(finished_run, tmp_path / "run")
    return tmp_path / "run"


def _content(path):
    return {file: (file.read_bytes(), file.stat().st_mtime_ns) for file in path.rglob("*") if file.is_file()}


def _report(path):
    return json.loads((path / "report.json").read_text())


def test_a_finished_run_says_how_it_goes_on_and_nothing_is_written(copy, capsys):
    before = _content(copy)
    assert main(["train", "--run", str(copy), "--resume"]) == 0
    said = capsys.readouterr()
    assert said.err == "" and said.out.startswith(f"{copy} is finished: {NUM_UPDATES * STEPS} env steps in ")
    assert said.out.endswith(f"; --run.total_env_steps {2 * NUM_UPDATES * STEPS} goes on\n")
    assert _content(copy) == before


def test_a_run_that_a_time_limit_ended_names_that_limit(copy, capsys):
    content = json.loads((copy / "config.json").read_text())
    content["config"]["run"] |= {"total_env_steps": 0, "max_seconds": _report(copy)["training_seconds"] / 2}
    (copy / "config.json").write_text(json.dumps(content))
    assert main(["train", "--run", str(copy), "--resume"]) == 0
    assert "; --run.max_seconds " in capsys.readouterr().out


def test_other_evaluations_of_a_finished_run_are_made(copy, capsys):
    assert main(["train", "--run", str(copy), "--resume", "--evaluation.min_attempts", "8"]) == 0
    assert "is finished" not in capsys.readouterr().out
    assert _report(copy)["policy_updates"] == NUM_UPDATES
    assert json.loads((copy / "config.json").read_text())["config"]["evaluation"]["min_attempts"] == 8


@pytest.mark.parametrize("lost", ["report.json", "checkpoints"])
def test_what_is_missing_of_a_finished_run_is_made_again(copy, lost, capsys):
    if lost == "report.json":
        (copy / lost).unlink()
    else:
        (list_checkpoints(copy / lost)[-1] / "manifest.json").unlink()
    assert main(["train", "--run", str(copy), "--resume"]) == 0
    assert "is finished" not in capsys.readouterr().out
    assert _report(copy)["policy_updates"] == NUM_UPDATES
    assert len(list_checkpoints(copy / "checkpoints")) == 2


def test_a_report_has_the_figures_of_all_sessions(copy):
    first = _report(copy)
    more = NUM_UPDATES + 1
    assert main(["train", "--run", str(copy), "--resume", "--run.total_env_steps", str(more * STEPS)]) == 0
    second = _report(copy)
    config = from_dict(json.loads((copy / "config.json").read_text())["config"])
    assert first["physics"]["physics_steps"] == NUM_UPDATES * STEPS * config.env.frame_skip
    assert second["physics"]["physics_steps"] == more * STEPS * config.env.frame_skip
    assert second["wall_seconds"] > first["wall_seconds"]
    for role, seconds in first["seconds_by_role"].items():
        assert second["seconds_by_role"][role] >= seconds > 0 or seconds == 0
    assert second["seconds_by_role"]["evaluate"] > first["seconds_by_role"]["evaluate"]


def test_a_run_that_was_killed_goes_on_with_the_sums_of_its_checkpoint(copy):
    """Its report is of an earlier end, or there is none."""
    sums = {"wall_seconds": 30.0, "seconds_by_role": {"learn": 12.0}, "physics": {"physics_steps": 7}}
    description = {"num_updates": NUM_UPDATES + 5, "training_seconds": 20.0, "sessions": sums}
    assert totals_before(copy / "report.json", description) == SessionTotals(**sums)
    del description["sessions"]  # of an earlier version
    assert totals_before(copy / "nothing", description) == SessionTotals(wall_seconds=20.0)


def test_a_directory_with_characters_of_patterns_holds_a_run_like_any_other(finished_run, tmp_path, monkeypatch):
    """Orbax takes them for a pattern; the run is trained on and its checkpoint read again."""
    here = tmp_path / "a [1] b*?"
    shutil.copytree(finished_run, here / "plain[2]")
    monkeypatch.chdir(here)
    more = NUM_UPDATES + 1
    assert main(["train", "--run", "plain[2]", "--resume", "--run.total_env_steps", str(more * STEPS)]) == 0
    newest = list_checkpoints(here / "plain[2]" / "checkpoints")[-1]
    assert load_checkpoint(newest).description["num_updates"] == more
    assert newest_run(here, "plain[2]") == here / "plain[2]"


def test_a_run_whose_configuration_has_no_space_has_to_start_again(tmp_path, monkeypatch, capsys):
    """No checkpoint exists that --resume could go on with."""

    def full(run, path, content):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(RunDirectory, "write_json", full)
    assert main(["train", "--run", str(tmp_path / "run"), *tiny_options(NUM_UPDATES)]) == 1
    line = capsys.readouterr().err.splitlines()[-1]
    assert line.endswith("config.json cannot be written: [Errno 28] No space left on device; free space there, then "
                         "start the run again")  # fmt: skip
    monkeypatch.undo()
    assert main(["train", "--run", str(tmp_path / "run"), "--resume"]) == 2
