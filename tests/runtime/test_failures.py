"""`kinetix-dist train` where a process of it fails: one line that says which and why, exit status 1, nothing lost."""

import json
import shutil

from kinetix_dist.level.paths import levels_root
from tests.runtime.train_process import TINY, kill_newest, rows, start, wait_for

COLOCATED = [*TINY, "--run.placement", "colocated"]


def _the_line(process) -> str:
    """What it said at last; fails where that is not one line with exit status 1."""
    _, errors = process.communicate(timeout=300)
    assert process.returncode == 1, errors
    assert "Traceback" not in errors
    line = errors.strip().splitlines()[-1]
    assert line.startswith("kinetix-dist: "), errors
    return line


def test_a_level_set_that_is_gone_when_a_worker_loads_it(tmp_path):
    levels = tmp_path / "levels"
    levels.mkdir()
    shutil.copy(levels_root() / "s" / "kick.json", levels)
    fixed = ["--curriculum.name", "fixed", "--curriculum.levels", str(levels)]
    process = start(tmp_path / "run", *COLOCATED, *fixed)
    assert process.stdout is not None and process.stdout.readline().startswith("training ")  # checked by the command
    shutil.rmtree(levels)  # while Ray starts
    line = _the_line(process)
    log = tmp_path / "run" / "logs" / "worker_0.log"
    assert f"worker 0 failed: unknown level set '{levels}'" in line
    assert f"traceback in {log}; checkpoints are kept, go on with --run {tmp_path / 'run'} --resume" in line
    assert "load_level_set" in log.read_text()
    events = [json.loads(text) for text in (tmp_path / "run" / "events.jsonl").read_text().splitlines()]
    assert [event["event"] for event in events] == ["process_started", "run_failed"]


def test_a_worker_that_is_lost_more_often_than_allowed(tmp_path):
    run = tmp_path / "run"
    process = start(run, *COLOCATED, "--run.max_restarts", "0", "--run.total_env_steps", "10000000")
    wait_for(lambda: bool(rows(run)), process, "an update")
    kill_newest(run, "worker 0")
    line = _the_line(process)
    assert "a process died" in line and "once more than run.max_restarts 0" in line and "--resume" in line
