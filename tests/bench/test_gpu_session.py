"""The session on a GPU: what fails or takes too long costs only itself, and is named."""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path

import pytest

from bench import gpu_session
from bench.gpu_session import Step, at_their_best, files_with_gpu_tests, run_step, steps_of, summary
from tests.helpers import PATIENCE_S, REPOSITORY


def script(code: str) -> list[str]:
    return [sys.executable, "-c", code, "{json}"]


def test_commands_of_a_step_succeed_and_fail_by_themselves(tmp_path: Path) -> None:
    writes = "import sys, pathlib; pathlib.Path(sys.argv[1]).write_text('[1, 2]'); print('written')"
    step = Step("both", {"one": script(writes), "two": script("print('broken'); raise SystemExit(3)")}, 60)
    with (tmp_path / "log").open("w") as log:
        one, two = run_step(step, 60, tmp_path, log)
    assert (one["outcome"], one["records"], one["last_line"]) == ("done", [1, 2], "written")
    assert (two["outcome"], two["records"], two["last_line"]) == ("exit code 3", None, "broken")
    assert "broken" in (tmp_path / "log").read_text()


def test_what_is_not_done_in_time_ends_with_all_that_it_started(tmp_path: Path) -> None:
    child = "import subprocess, sys; p = subprocess.Popen(['sleep', '60']); print(p.pid, flush=True); p.wait()"
    started = time.monotonic()
    with (tmp_path / "log").open("w") as log:
        (record,) = run_step(Step("slow", {"": script(child)}, 2), 2, tmp_path, log)
    assert time.monotonic() - started < 30
    assert record["outcome"] == "not done after 2 s"
    grandchild = Path(f"/proc/{record['last_line']}")
    until = time.monotonic() + PATIENCE_S  # it is killed; a busy machine may take a while to take it away
    while has_not_ended(grandchild) and time.monotonic() < until:
        time.sleep(0.1)
    assert not has_not_ended(grandchild)


def has_not_ended(process: Path) -> bool:
    try:
        return (process / "stat").read_text().split()[2] != "Z"
    except FileNotFoundError:
        return False


def test_the_table_names_what_is_not_done(capsys: pytest.CaptureFixture[str]) -> None:
    machine = {"gpus": "none", "versions": {}}
    steps = [{"step": "a", "outcome": "done", "seconds": 1.0}, {"step": "b", "outcome": "exit code 1", "seconds": 2.0}]
    assert summary({"part": 1, "revision": "x", "machine": machine, "steps": steps}, 3.0) == 1
    assert capsys.readouterr().out.splitlines()[-1] == "not done: b"
    assert summary({"part": 1, "revision": "x", "machine": machine, "steps": steps[:1]}, 3.0) == 0


def test_engines_are_compared_where_each_is_at_its_best() -> None:
    def record(engine: str, preset: str, worlds: int, speed: float) -> dict:
        names = {"engine": engine, "preset": preset, "size": "m", "worlds": worlds}
        return names | {"physics_steps_per_second": speed}

    beside = [record("ours", "standard", 8, 30e6), record("published", "paper", 8, 2e6)]
    steps = [{"records": beside}, {"records": [record("ours", "standard", 64, 90e6)]}, {"records": None}]
    assert at_their_best(steps) == [
        "M ours standard: 90 M steps/s at 64 worlds, 45.0 times the published engine at its best",
        "M published paper: 2 M steps/s at 8 worlds",
    ]


@pytest.mark.parametrize("part", [1, 2, 3])
def test_every_step_has_its_miniature_and_fits_its_part(part: int) -> None:
    full, mini = steps_of(part, False), steps_of(part, True)
    assert [step.name for step in full] == [step.name for step in mini]
    assert all(step.limit < gpu_session.PART_SECONDS for step in full)
    scripts = [word for step in full for command in step.commands.values() for word in command if word.endswith(".py")]
    assert all((REPOSITORY / name).is_file() for name in scripts)


def test_training_on_ray_comes_first() -> None:
    first = steps_of(1, False)[0]
    (command,) = first.commands.values()
    assert "tests/runtime/test_gpu_run.py" in command and "gpu" in command


def test_files_with_tests_for_a_gpu_are_found() -> None:
    files = files_with_gpu_tests()
    assert {"tests/engine/test_reference.py", "tests/learner/test_update_across_devices.py"} <= set(files)
    assert "tests/engine/test_builder.py" not in files


def test_a_step_of_a_part_runs_from_the_command_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(gpu_session, "steps_of", lambda part, mini: [Step("hello", {"": script("print('hello')")}, 60)])
    monkeypatch.setattr(
        sys, "argv", ["gpu_session", "--part", "1", "--out", str(tmp_path / "out"), "--revision", "abc"]
    )
    assert gpu_session.main() == 0
    assert "Part 1 of abc" in capsys.readouterr().out
    written = json.loads((tmp_path / "out" / "part_1.json").read_text())
    assert (written["revision"], written["steps"][0]["outcome"]) == ("abc", "done")
    assert written["machine"]["cpus"] == os.cpu_count()
