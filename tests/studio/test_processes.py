"""Processes of a run, against lines as training writes them (docs/run_data.md): one process lost, one gone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from kinetix_dist.studio.runs.processes import MAX_COLUMNS, Processes
from kinetix_dist.telemetry.json_lines import append_line

LOST = {"event": "process_lost", "process": "rollout 1", "role": "rollout", "error": "rollout 1 died"}


def line(update: int, **processes: tuple[int, float | None]) -> dict[str, Any]:
    """processes: pid and busy share by name, `rollout_1` for `rollout 1`."""
    described: list[dict[str, Any]] = []
    for name, (pid, busy) in processes.items():
        described.append({"name": name.replace("_", " "), "role": name.split("_")[0], "pid": pid, "host": "a"})
        described[-1] |= {"resident_bytes": 1000} | ({} if busy is None else {"busy": busy})
    return {"format": 1, "time": "2026-01-31T12:00:00Z", "update": update, "processes": described}


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "processes.jsonl"
    append_line(path, line(1, driver=(1, None), rollout_0=(2, None), rollout_1=(3, None)))
    append_line(path, line(5, driver=(1, None), rollout_0=(2, 0.8)))
    append_line(path, line(6, driver=(1, None), rollout_0=(2, 0.6), rollout_1=(4, 0.5)))
    return path


def test_readings_idle_shares_and_losses_of_each_process(file: Path) -> None:
    found = Processes(file.parent).describe([{"event": "started"}, LOST])
    by_name = {process["name"]: process for process in found["processes"]}
    assert found["update"] == 6 and list(by_name) == ["driver", "rollout 0", "rollout 1"]
    assert by_name["rollout 0"]["idle"] == pytest.approx((0.2 + 0.4) / 2)
    assert by_name["driver"]["idle"] is None
    assert (by_name["rollout 1"]["pid"], by_name["rollout 1"]["lost"]) == (4, 1)
    assert by_name["rollout 1"]["error"] == "rollout 1 died" and by_name["rollout 0"]["lost"] == 0
    assert found["updates"] == [1, 5, 6]
    assert found["idle"]["rollout 0"] == [None, pytest.approx(0.2), pytest.approx(0.4)]


def test_one_that_is_gone_is_said_with_its_last_update_and_new_lines_are_read(file: Path) -> None:
    processes = Processes(file.parent)
    processes.describe([])
    append_line(file, line(9, driver=(1, None), rollout_0=(2, 1.0)))
    by_name = {process["name"]: process for process in processes.describe([])["processes"]}
    assert not by_name["rollout 1"]["is_there"] and by_name["rollout 1"]["seen_at"] == 6
    assert by_name["rollout 0"]["is_there"] and by_name["rollout 0"]["idle"] == pytest.approx(0.2)


def test_many_lines_are_put_together_and_damaged_ones_counted(tmp_path: Path) -> None:
    file = tmp_path / "processes.jsonl"
    for update in range(1, 101):
        append_line(file, line(update, rollout_0=(2, 0.25 if update <= 50 else 0.75)))
    with file.open("ab") as stream:
        stream.write(b'{"update": 101, "processes": [{"name": 3}]}\ngarbage\n')
    found = Processes(tmp_path).describe([])
    assert len(found["updates"]) == MAX_COLUMNS and found["updates"][-1] == 100
    assert found["idle"]["rollout 0"][0] == 0.75 and found["idle"]["rollout 0"][-1] == 0.25
    assert found["problems"] == ["2 lines are damaged in processes.jsonl and left out"]


def test_a_run_without_the_file_has_no_processes(tmp_path: Path) -> None:
    found = Processes(tmp_path).describe([])
    assert (found["processes"], found["updates"], found["time"]) == ([], [], None)
