"""A kill at any byte leaves a run that resumes: metrics.jsonl and events.jsonl of a real run, cut everywhere."""

import json
import shutil

import pytest

from kinetix_dist.cli.main import main
from kinetix_dist.runtime.driver.run_directory import RunDirectory
from kinetix_dist.telemetry.json_lines import append_line, damaged_path, mend_lines, read_lines
from kinetix_dist.telemetry.sinks.jsonl import JsonlSink, read_jsonl
from tests.runtime.conftest import NUM_UPDATES, STEPS

GARBAGE = (b"\x00\xff\xfe not text", b'{"update": 7, "train/', b"[1, 2]", b'{"other": 1}', b"[" * 5000, b'"half')


def _last_lines(path, count):
    """(what comes before the last lines, the last lines)"""
    lines = path.read_bytes().splitlines(keepends=True)
    return b"".join(lines[:-count]), b"".join(lines[-count:])


@pytest.mark.long
def test_metrics_cut_at_every_byte_go_on_with_whole_rows(finished_run, tmp_path):
    before, last = _last_lines(finished_run / "metrics" / "metrics.jsonl", 1)
    path = tmp_path / "metrics.jsonl"
    for cut in range(len(last) + 1):
        path.write_bytes(before + last[:cut])
        damaged_path(path).unlink(missing_ok=True)
        sink = JsonlSink(path, resume_at=NUM_UPDATES)
        sink.write(NUM_UPDATES + 1, {"train/solve_rate": 0.5})
        sink.close()
        rows = [json.loads(line) for line in path.read_text().splitlines()]  # every line is whole
        num_whole = NUM_UPDATES - 1 + sum(cut >= end for end in _ends(last))
        assert [row["update"] for row in rows] == [*range(1, num_whole + 1), NUM_UPDATES + 1], cut
        unfinished = last[:cut].rsplit(b"\n", 1)[-1]
        is_half = bool(unfinished) and not unfinished.endswith(b"}")
        assert sink.num_damaged == is_half, cut
        if is_half:
            assert damaged_path(path).read_bytes() == unfinished + b"\n"


def _ends(last):
    """Bytes after which each row is complete: its closing bracket, with or without the line end."""
    return [index + 1 for index, byte in enumerate(last) if byte == ord("}") and last[index + 1 : index + 2] == b"\n"]


def test_events_cut_at_every_byte_never_join_with_the_next(finished_run, tmp_path):
    before, last = _last_lines(finished_run / "events.jsonl", 2)
    (tmp_path / "config.json").write_text("{}")
    for cut in range(len(last) + 1):
        (tmp_path / "events.jsonl").write_bytes(before + last[:cut])
        (tmp_path / "events.damaged").unlink(missing_ok=True)
        run = RunDirectory.open_existing(tmp_path)
        run.event("resumed", update=4)
        run.close()
        rows = [json.loads(line) for line in run.events.read_text().splitlines()]
        unfinished = last[:cut].rsplit(b"\n", 1)[-1]
        reported = [row for row in rows if row["event"] == "lines_set_aside"]
        if unfinished and not unfinished.endswith(b"}"):
            assert [(row["lines"], row["to"]) for row in reported] == [(1, "events.damaged")]
            assert (tmp_path / "events.damaged").read_bytes() == unfinished + b"\n"
        else:
            assert not reported
        assert rows[-1]["event"] == "resumed", cut


def test_an_event_after_a_half_one_stands_on_a_line_of_its_own(tmp_path):
    path = tmp_path / "events.jsonl"
    path.write_bytes(b'{"event": "a"}\n{"event": "b", "upd')  # killed while writing; nobody has resumed since
    append_line(path, {"event": "c"})
    assert [row["event"] for row in read_lines(path).rows] == ["a", "c"]


def test_garbage_in_the_middle_is_set_aside_and_counted(finished_run, tmp_path):
    path = tmp_path / "metrics.jsonl"
    lines = (finished_run / "metrics" / "metrics.jsonl").read_bytes().splitlines()
    path.write_bytes(b"\n".join([lines[0], *GARBAGE[:3], lines[1], *GARBAGE[3:], *lines[2:], b""]))
    assert [row["update"] for row in read_jsonl(path)] == [1, 2, 3, 4]
    sink = JsonlSink(path, resume_at=3)
    sink.close()
    assert sink.num_damaged == len(GARBAGE)
    assert damaged_path(path).read_bytes().splitlines() == list(GARBAGE)
    assert path.read_bytes().splitlines() == lines[:3]
    again = JsonlSink(path, resume_at=3)
    again.close()
    assert again.num_damaged == 0 and damaged_path(path).read_bytes().splitlines() == list(GARBAGE)


def test_a_kill_while_rewriting_leaves_the_old_file_and_loses_nothing(tmp_path, monkeypatch):
    path = tmp_path / "metrics.jsonl"
    content = b'{"update": 1}\nhalf\n{"update": 2}\n'
    path.write_bytes(content)

    def killed(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr("kinetix_dist.atomic_files.os.replace", killed)
    with pytest.raises(KeyboardInterrupt):
        mend_lines(path, is_row=lambda row: "update" in row, keep=lambda row: row["update"] <= 1)
    assert path.read_bytes() == content
    monkeypatch.undo()
    assert mend_lines(path, is_row=lambda row: "update" in row, keep=lambda row: row["update"] <= 1) == 1
    assert path.read_bytes() == b'{"update": 1}\n'


@pytest.mark.parametrize("damage", ["half a row", "garbage in the middle", "half an event"])
def test_the_command_resumes_a_run_whose_files_were_cut(finished_run, tmp_path, damage, capsys):
    path = tmp_path / "run"
    shutil.copytree(finished_run, path)
    metrics, events = path / "metrics" / "metrics.jsonl", path / "events.jsonl"
    if damage == "half a row":
        metrics.write_bytes(metrics.read_bytes()[:-40])
    elif damage == "garbage in the middle":
        lines = metrics.read_bytes().splitlines(keepends=True)
        metrics.write_bytes(b"".join([*lines[:2], GARBAGE[0] + b"\n", *lines[2:]]))
    else:
        events.write_bytes(events.read_bytes()[:-5])
    more = str((NUM_UPDATES + 1) * STEPS)
    assert main(["train", "--run", str(path), "--resume", "--run.total_env_steps", more]) == 0
    updates = [json.loads(line)["update"] for line in metrics.read_text().splitlines()]
    assert updates == ([1, 2, 3, 5] if damage == "half a row" else [1, 2, 3, 4, 5])
    reported = [row for row in map(json.loads, events.read_text().splitlines()) if row["event"] == "lines_set_aside"]
    assert [(row["file"], row["lines"]) for row in reported] == [
        ("events.jsonl" if damage == "half an event" else "metrics/metrics.jsonl", 1)
    ]
    assert "Traceback" not in capsys.readouterr().err
