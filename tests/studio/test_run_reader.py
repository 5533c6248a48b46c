"""A run directory while it is written: new rows, runs that go back, damaged and missing files."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from kinetix_dist.errors import UserError
from kinetix_dist.studio.runs import run_files
from kinetix_dist.studio.runs.run_files import LastRow, last_row
from kinetix_dist.studio.runs.run_index import RunIndex, status_of, summary
from kinetix_dist.studio.runs.run_reader import RunReader
from kinetix_dist.telemetry.json_lines import append_line
from kinetix_dist.telemetry.sinks.jsonl import is_metrics_row
from tests.studio.runs_for_tests import solve_rate, write_config, write_rows, write_run


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return write_run(tmp_path / "runs" / "a")


def test_rows_and_events_are_read_once(run: Path) -> None:
    reader = RunReader(run)
    first = reader.poll()
    assert first.first_row == 0 and len(first.events) == 1 and first.rewound_to is None
    assert not reader.poll()
    write_rows(run, 21, 22, resume_at=None)
    assert reader.poll().first_row == 20
    np.testing.assert_allclose(reader.table.column("train/solve_rate"), [solve_rate(u) for u in range(1, 23)])


def test_a_run_that_is_resumed_goes_back_to_its_checkpoint(run: Path) -> None:
    reader = RunReader(run)
    reader.read_first(lambda left: None)
    write_rows(run, 13, 15, resume_at=12, **{"runtime/restarts": 1.0})
    changes = reader.poll()
    assert changes.rewound_to == 12 and changes.first_row == 12 and reader.revision == 1
    assert reader.table.column("update").tolist() == list(range(1, 16))
    assert np.isnan(reader.table.column("runtime/restarts")[:12]).all()


def test_the_same_rows_in_another_file_are_no_news(run: Path) -> None:
    reader = RunReader(run)
    reader.read_first(lambda left: None)
    content = (run / run_files.METRICS).read_bytes()
    (run / "copy").write_bytes(content)
    (run / "copy").replace(run / run_files.METRICS)
    assert not reader.poll() and reader.revision == 0


def test_damage_is_counted_and_said(run: Path) -> None:
    with (run / run_files.METRICS).open("ab") as file:
        file.write(b'\0\0\0\n{"no": "update"}\n')
    reader = RunReader(run)
    reader.read_first(lambda left: None)
    assert list(reader.problems.values()) == ["2 lines are damaged in metrics/metrics.jsonl and left out"]
    assert reader.table.num_rows == 20


def test_a_run_without_anything_but_its_config_is_read(tmp_path: Path) -> None:
    run = write_config(tmp_path / "a")
    reader = RunReader(run)
    assert not reader.poll() and not reader.problems
    assert status_of(run).state == "not started"


def test_runs_are_found_two_levels_deep_and_named_apart(tmp_path: Path) -> None:
    for name in ("x/a", "y/a", "b", "x/deep/er/c"):
        write_config(tmp_path / name)
    index = RunIndex([tmp_path])
    assert sorted(index.runs) == ["a", "a~2", "b"]
    assert index.runs["a"] == tmp_path / "x" / "a"
    write_config(tmp_path / "new")
    assert sorted(index.scan()) == ["a", "a~2", "b", "new"]
    (tmp_path / "x" / "a" / "config.json").unlink()
    assert sorted(index.scan()) == ["a~2", "b", "new"], "ids stay with their directories"


def test_wrong_paths_are_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "notes").write_text("")
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match=r"nowhere does not exist; name a run"):
        RunIndex([tmp_path / "nowhere"])
    with pytest.raises(UserError, match="is no directory"):
        RunIndex([tmp_path / "file"])
    with pytest.raises(UserError, match="is no run"):
        RunIndex([tmp_path / "other"])
    with pytest.raises(UserError, match="other is no run"):
        RunIndex([write_run(tmp_path / "good"), tmp_path / "other"])
    assert RunIndex([tmp_path / "empty"]).runs == {}, "its first run may come"


@pytest.mark.parametrize("content", [b"", b"{", b"[1]", b"\0\0", b'{"config": 3}'])
def test_a_damaged_config_is_a_line_in_the_table(run: Path, content: bytes) -> None:
    (run / "config.json").write_bytes(content)
    row = summary("a", run)
    assert row["last"]["update"] == 20
    assert len(row["problems"]) == 1 and row["problems"][0].startswith("config.json ")
    json.dumps(row, allow_nan=False)


def test_the_last_row_is_read_from_the_end(run: Path) -> None:
    file = run / run_files.METRICS
    with file.open("ab") as out:
        out.write(b'{"update": 21, "half')
    found = last_row(file, is_row=is_metrics_row)
    assert found.row is not None and found.row["update"] == 20
    assert found.problem is None, "it is being written"
    with file.open("ab") as out:
        out.write(b"\n" + b'{"update": 22, "half')
    found = last_row(file, is_row=is_metrics_row)
    assert found.row is not None and found.row["update"] == 20
    assert found.problem is not None and found.problem.startswith("the last line of metrics.jsonl is damaged (")
    assert last_row(run / "nothing", is_row=is_metrics_row) == LastRow(None)


def test_how_a_run_is_follows_from_its_files(run: Path) -> None:
    assert status_of(run).state == "running", "its metrics were written a moment ago"
    (run / "report.json").write_text('{"policy_updates": 20}')
    assert status_of(run).state == "finished"
    write_rows(run, 21, 21)
    assert status_of(run).state == "running", "it was resumed after its report"
    append_line(run / "events.jsonl", {"time": "2026-01-31T13:00:00Z", "event": "run_failed", "reason": "why"})
    assert (status_of(run).state, status_of(run).text) == ("failed", "reason why")


def test_the_table_has_the_newest_evaluation_of_the_policy(run: Path) -> None:
    def evaluate(phase: str, update: int, solved: list[int]) -> None:
        sets = {"random_s": {"names": ["x", "y"], "solved": solved, "attempts": 4}}
        line = {"phase": phase, "update": update, "env_steps": 128 * update, "sets": sets}
        append_line(run / run_files.EVALUATION_LINES, line)

    def rate() -> float | None:
        found = summary("a", run)["evaluated"]
        return found["random_s"]["rate"] if found else None

    assert rate() is None
    evaluate("random_policy", 0, [4, 4])
    assert rate() is None, "that is not how good the policy is"
    evaluate("before", 0, [1, 0])
    evaluate("training", 8, [4, 2])
    assert rate() == 6 / 8 and summary("a", run)["evaluated"]["random_s"]["attempts"] == 8
    (run / run_files.EVALUATION_LINES).unlink()
    (run / "report.json").write_text(json.dumps({"solve_rate": {"after": {"random_s": {"rate": 0.25}}}}))
    assert rate() == 0.25, "an older run has its report alone"
    over = {"low": 0.1, "high": 0.5, "base_levels": 2, "levels": 16}
    after = {"random_s": {"rate": 0.75, "low": 0.7, "high": 0.8, "attempts": 64, "interval_over_levels": over}}
    (run / "report.json").write_text(json.dumps({"solve_rate": {"after": after}}))
    assert summary("a", run)["evaluated"]["random_s"]["interval_over_levels"] == over
    (run / "report.json").write_text("{")
    assert "report.json is damaged" in summary("a", run)["problems"][0]
