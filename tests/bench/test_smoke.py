"""The smoke run itself: a run on Ray passes it, and one that fails, or learns nothing but NaN, does not."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import psutil
import pytest

from bench import smoke
from kinetix_dist.telemetry.sinks.jsonl import JsonlSink
from tests.helpers import next_line


@pytest.mark.slow
def test_a_run_on_ray_is_trained_resumed_and_evaluated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "smoke.json"
    monkeypatch.setattr(sys, "argv", ["smoke", "--json", str(file), "--keep", str(tmp_path / "kept")])
    assert smoke.main() == 0
    train, resume, evaluation, measured = json.loads(file.read_text())
    for record in (train, resume):
        assert record["exit_code"] == 0 and not record["wrong"]
        assert 0 < record["warmup_seconds"] < record["first_update_seconds"] < record["seconds"]
        assert record["env_steps_per_second"] > 0
    assert 0 <= evaluation["solve_rate"] <= 1
    assert (measured["command"], measured["exit_code"], measured["wrong"]) == ("bench tiny", 0, [])
    assert measured["env_steps_per_second"] > 0 and 0 < measured["warmup_seconds"] < measured["seconds"]


@pytest.mark.parametrize(
    ("unmeasured", "says"),
    [(2.0, None), (61.0, "it measured 61 s after compiling"), (None, "no speed was measured")],
)
def test_a_speed_that_comes_late_or_never_is_wrong(unmeasured: float | None, says: str | None, tmp_path: Path) -> None:
    speed = {"env_steps_per_second": 10.0, "compile_seconds": 1.0, "first_update_seconds": 3.0}
    content = "" if unmeasured is None else json.dumps([speed | {"unmeasured_seconds": unmeasured}])

    class Said(smoke.Smoke):
        """`bench train` is not run: its file is written."""

        def _command(self, name: str, arguments: list[str], num_rows: int | None = None) -> dict[str, Any]:
            Path(arguments[arguments.index("--json") + 1]).write_text(content)
            return {"command": name, "wrong": []}

    record = Said(tmp_path, argparse.Namespace(device="cpu"))._measure("tiny")
    assert [line.split(";")[0] for line in record["wrong"]] == ([says] if says else [])
    assert record["recipe"] == "tiny" and record.get("unmeasured_seconds") == unmeasured


class _Said(smoke.Smoke):
    """Commands are not run: the metrics that they would have left are written, as a run writes them."""

    def __init__(self, updates: list[int], loss: float, tmp_path: Path) -> None:
        super().__init__(tmp_path, argparse.Namespace(updates=2))
        self.updates, self.loss = updates, loss

    def _command(self, name: str, arguments: list[str], num_rows: int | None = None) -> dict[str, Any]:
        (self.run / "metrics").mkdir(parents=True, exist_ok=True)
        sink = JsonlSink(self.run / "metrics" / "metrics.jsonl")
        for update in self.updates:
            times = {"progress/env_steps_per_second": 10.0, "progress/warmup_seconds": 3.0 if update > 2 else 2.0}
            sink.write(update, times | {"learner/policy_loss": self.loss})
        sink.close()
        return {"command": name, "wrong": []}


@pytest.mark.parametrize(
    ("updates", "loss", "says"),
    [
        ([1, 2], 0.5, None),
        ([1], 0.5, "metrics are of updates [1], 1 to 2 were to be made"),
        ([1, 1], 0.5, "metrics are of updates [1, 1], 1 to 2 were to be made"),
        ([1, 2], float("nan"), "learner/policy_loss of update 1 is not finite"),
        ([1, 2], float("inf"), "learner/policy_loss of update 1 is not finite"),
    ],
)
def test_what_a_run_leaves_out_is_wrong(updates: list[int], loss: float, says: str | None, tmp_path: Path) -> None:
    wrong = _Said(updates, loss, tmp_path)._train("train", [], 1)["wrong"]
    assert wrong[:1] == ([says] if says else [])


def test_warm_up_is_that_of_the_session(tmp_path: Path) -> None:
    said = _Said([1, 2], 0.5, tmp_path)
    assert said._train("train", [], 1)["warmup_seconds"] == 2.0
    said.updates = [1, 2, 3, 4]  # the sink starts over
    assert said._train("resume", [], 2)["warmup_seconds"] == 1.0


def test_rows_that_a_resume_took_away_are_wrong(tmp_path: Path) -> None:
    said = _Said([1, 2], 0.5, tmp_path)
    said._train("train", [], 1)
    (said.run / "metrics" / "metrics.jsonl").unlink()
    said.updates = [1]
    assert said._train("resume", [], 2)["wrong"][0].startswith("metrics are of updates [1], 1 to 4 were")


def test_a_command_that_hears_nothing_is_ended_with_what_it_started(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(smoke, "GRACE_S", 0.5)
    child = "import subprocess, sys; print(subprocess.Popen(['sleep', '60']).pid, flush=True); "
    deaf = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); time.sleep(60)"
    process = subprocess.Popen([sys.executable, "-c", child + deaf], stdout=subprocess.PIPE, text=True)
    pid, began = int(next_line(process)), time.monotonic()
    time.sleep(0.3)  # until it is deaf
    assert smoke._end(process)
    assert time.monotonic() - began < 10 and process.returncode == -9
    assert not psutil.pid_exists(pid) or psutil.Process(pid).status() == psutil.STATUS_ZOMBIE
    assert not smoke._end(process)  # it is over


def test_a_command_that_fails_is_wrong_with_its_last_words(tmp_path: Path) -> None:
    args = argparse.Namespace(recipe="tiny", device="cpu", seconds=60.0)
    record = smoke.Smoke(tmp_path, args)._command("train", ["trian"])
    assert record["exit_code"] == 2 and "did you mean 'train'" in record["wrong"][0]
