"""Checkpoints of resumed runs: all bad, of other devices or versions, drafts of a killed process."""

import json
import shutil

import numpy as np
import pytest

from kinetix_dist.checkpoint import list_checkpoints, load_checkpoint, save_checkpoint
from kinetix_dist.checkpoint.manifest import write_manifest
from kinetix_dist.cli.main import main
from kinetix_dist.runtime.driver.checkpoints import Saver
from kinetix_dist.runtime.driver.run_directory import RunDirectory
from kinetix_dist.telemetry.json_lines import read_lines
from tests.runtime.conftest import NUM_UPDATES, STEPS
from tests.runtime.runs import NotingReporter


@pytest.fixture
def copy(finished_run, tmp_path):
    shutil.copytree(finished_run, tmp_path / "run")
    return tmp_path / "run"


def _resume(path):
    return main(["train", "--run", str(path), "--resume", "--run.total_env_steps", str((NUM_UPDATES + 2) * STEPS)])


def _events(path, kind):
    return [row for row in read_lines(path / "events.jsonl").rows if row["event"] == kind]


def test_where_all_checkpoints_are_bad_the_run_is_refused_and_nothing_is_overwritten(copy, capsys):
    for number, path in enumerate(list_checkpoints(copy / "checkpoints")):
        (path / ("checkpoint.json" if number else "manifest.json")).unlink()
    events = copy / "events.jsonl"
    before = {file: file.read_bytes() for file in copy.rglob("*") if file.is_file() and file.name != "lock"}
    assert _resume(copy) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert "checkpoint 00000004 passed over" in lines[-3] and "checkpoint.json is missing" in lines[-3]
    assert "checkpoint 00000002 passed over" in lines[-2] and "it has no manifest.json" in lines[-2]
    assert lines[-1].startswith("kinetix-dist: none of the 2 checkpoints in ")
    assert "put back a good copy of one, or start a new run with another --run" in lines[-1]
    after = {file: file.read_bytes() for file in copy.rglob("*") if file.is_file() and file.name != "lock"}
    assert after.pop(events).startswith(before.pop(events))  # what happened is added
    status = copy / "status.json"
    assert json.loads(before.pop(status))["state"] == "finished" and json.loads(after.pop(status))["state"] == "failed"
    assert after == before
    assert [row["checkpoint"] for row in _events(copy, "checkpoint_rejected")] == ["00000004", "00000002"]


def test_a_checkpoint_that_was_passed_over_does_not_come_back_when_it_can_be_read_again(copy):
    """The run has gone on from the one before: rows of metrics between the two were removed."""
    newest = list_checkpoints(copy / "checkpoints")[-1]
    manifest = (newest / "manifest.json").read_bytes()
    (newest / "manifest.json").unlink()
    assert _resume(copy) == 0
    aside = newest.with_name(f"{newest.name}.rejected")
    (aside / "manifest.json").write_bytes(manifest)
    again = NUM_UPDATES + 3
    assert main(["train", "--run", str(copy), "--resume", "--run.total_env_steps", str(again * STEPS)]) == 0
    assert [row["update"] for row in read_lines(copy / "metrics" / "metrics.jsonl").rows] == list(range(1, again + 1))
    assert [row["update"] for row in _events(copy, "resumed")] == [2, NUM_UPDATES + 2]
    assert [row["checkpoint"] for row in _events(copy, "checkpoint_rejected")] == [newest.name]


def test_a_checkpoint_says_what_made_it_and_the_same_devices_go_on_without_a_word(copy, capsys):
    description = load_checkpoint(list_checkpoints(copy / "checkpoints")[-1]).description
    assert {"python", "engine", "kinetix-dist", "jax", "numpy"} <= description["versions"].keys()
    topology = description["topology"]
    assert (topology["placement"], topology["processes"], topology["devices"]) == ("local", 1, 1)
    (copy / "checkpoints" / ".saving-00000006-4194305").mkdir()  # beyond the largest process number
    assert _resume(copy) == 0
    assert "not bit for bit" not in capsys.readouterr().err
    assert _events(copy, "resumed")[-1]["differs"] == []
    assert _events(copy, "drafts_removed")[-1]["drafts"] == [".saving-00000006-4194305"]
    assert not list((copy / "checkpoints").glob(".saving-*"))


def test_other_devices_and_versions_are_said_in_one_line(copy, capsys):
    path = list_checkpoints(copy / "checkpoints")[-1]
    description = json.loads((path / "checkpoint.json").read_text())
    description["topology"] |= {"devices": 4, "processes": 4}
    description["versions"]["jax"] = "0.0.1"
    (path / "checkpoint.json").write_text(json.dumps(description))
    write_manifest(path)
    assert _resume(copy) == 0
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "not bit for bit" in line]
    assert "processes 1 instead of 4, devices 1 instead of 4, jax " in line and "instead of 0.0.1: works" in line
    assert len(_events(copy, "resumed")[-1]["differs"]) == 3


def test_a_save_runs_in_the_background_and_its_failure_is_reported_at_the_next_update(tmp_path):
    """The directory cannot be written: a file is in its place. Real writes, no time limit that could be missed."""
    run = RunDirectory.create(tmp_path / "run", numbered=False)
    reporter = NotingReporter()
    saver = Saver(run, reporter, keep=2)
    arrays = {"a": np.arange(4.0)}
    run.checkpoints.write_text("")
    saver.save(2, arrays, {})
    saver.wait()
    assert saver.saved_at is None
    (failed,) = _events(run.path, "checkpoint_failed")
    assert failed["update"] == 2 and "checkpoints" in failed["error"]
    assert "training goes on" in reporter.notes[0]
    run.checkpoints.unlink()
    saver.save(4, arrays, {})
    saver.save(6, arrays, {})  # waits for the one before
    saver.close()
    assert saver.saved_at == 6 and saver.seconds is not None and saver.seconds > 0
    assert [path.name for path in list_checkpoints(run.checkpoints)] == ["00000004", "00000006"]
    save_checkpoint(run.checkpoints, 8, arrays, {}, keep=1)
    run.close()


def test_a_directory_that_is_replaced_during_a_run_can_be_gone_on_with(tmp_path):
    """A mount drops and comes back empty: no checkpoint is saved while it is gone; later ones have the config."""
    run = RunDirectory.create(tmp_path / "run", numbered=False)
    run.config = {"hash": "abc", "config": {}}
    run.write_json(run.config_path, run.config)
    reporter = NotingReporter()
    saver = Saver(run, reporter, keep=2)
    arrays = {"a": np.arange(4.0)}
    run.path.rename(tmp_path / "moved")
    saver.save(2, arrays, {})
    saver.wait()
    assert saver.saved_at is None and saver.error == (
        f"run directory {run.path} is gone; put it back, nothing is saved until then"
    )
    assert not run.path.exists()
    run.path.mkdir()
    saver.save(4, arrays, {})
    saver.save(6, arrays, {})
    saver.close()
    assert saver.saved_at == 6 and json.loads(run.config_path.read_text()) == run.config
    assert len([note for note in reporter.notes if "config.json was gone and is written again" in note]) == 1
    assert [row["file"] for row in _events(run.path, "file_failed")] == ["config.json"]
    run.close()
