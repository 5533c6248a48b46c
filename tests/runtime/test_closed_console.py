"""A console that stops reading (a pipe to a program that hangs) costs its lines, never training."""

import fcntl
import os
import subprocess
import sys
import time

import pytest
from rich.console import Console

from kinetix_dist.runtime.driver.reporting import RunReporter
from kinetix_dist.runtime.driver.run_directory import RunDirectory
from kinetix_dist.telemetry.json_lines import read_lines
from kinetix_dist.telemetry.sinks.background import CLOSE_S, PATIENCE_S, QUEUE_ROWS
from kinetix_dist.telemetry.sinks.console import ConsoleSink
from tests.helpers import REPOSITORY, python_path
from tests.runtime.conftest import tiny_options

NUM_NOTES = 2 * QUEUE_ROWS
SLACK_S = 5.0  # for a machine that is busy with other tests


def _events(run, kind):
    return [row for row in read_lines(run.events).rows if row["event"] == kind]


def test_lines_are_dropped_and_reported_once_and_the_rest_of_a_run_goes_on(tmp_path):
    reads, writes = os.pipe()
    os.set_blocking(writes, False)
    while True:  # until it takes no more
        try:
            os.write(writes, b"x" * 4096)
        except BlockingIOError:
            break
    os.set_blocking(writes, True)
    run = RunDirectory.create(tmp_path / "run", numbered=False)
    file = os.fdopen(writes, "w", buffering=1)
    reporter = RunReporter(run, ConsoleSink(total_env_steps=None, console=Console(file=file)))
    began = time.monotonic()
    reporter.phase("training")
    for number in range(NUM_NOTES):
        reporter.note(f"note {number}")
    reporter.metrics(1, {"progress/env_steps": 128.0}, None)
    assert time.monotonic() - began < PATIENCE_S + SLACK_S  # once, for the first line
    (failing,) = _events(run, "sink_failing")
    assert failing["sink"] == "console"
    began = time.monotonic()
    reporter.close()
    assert time.monotonic() - began < CLOSE_S + SLACK_S
    run.close()
    assert [row["update"] for row in read_lines(run.metrics / "metrics.jsonl").rows] == [1]
    os.close(reads)  # what is stuck in a write ends with an error


def test_a_pipe_whose_reader_has_ended_does_not_end_the_run(tmp_path):
    """rich would: with the exit status of an error."""
    reads, writes = os.pipe()
    os.close(reads)
    run = RunDirectory.create(tmp_path / "run", numbered=False)
    reporter = RunReporter(run, ConsoleSink(total_env_steps=None, console=Console(file=os.fdopen(writes, "w"))))
    reporter.note("one")
    reporter.metrics(1, {"progress/env_steps": 128.0}, None)
    reporter.close()
    run.close()
    (failing,) = _events(run, "sink_failing")
    assert (failing["sink"], failing["error"]) == ("console", "the console has no reader any more")


@pytest.mark.parametrize(
    "resumes", [pytest.param(False, id="a run", marks=pytest.mark.slow), pytest.param(True, id="a refusal")]
)
def test_a_command_ends_whose_last_lines_nobody_takes(tmp_path, resumes):
    """A pipe of one page, which the first line takes: neither the report nor a line on stderr fits."""
    run = tmp_path / "run"
    what = ["--run", str(run), *tiny_options(2)] if not resumes else ["--run", str(tmp_path / "none"), "--resume"]
    reads, writes = os.pipe()
    fcntl.fcntl(writes, fcntl.F_SETPIPE_SZ, 4096)
    os.write(writes, b"x" * (4096 if resumes else 2048))
    command = [sys.executable, "-m", "kinetix_dist.cli.main", "train", *what]
    environment = {**os.environ, "PYTHONPATH": python_path()}
    process = subprocess.Popen(command, env=environment, cwd=REPOSITORY, stdout=writes, stderr=writes)
    os.close(writes)
    try:
        assert process.wait(timeout=300) == (2 if resumes else 0)
        assert resumes or (run / "report.json").is_file()
        said = os.read(reads, 1 << 16).decode()
        assert "train on" not in said
    finally:
        process.kill()
        os.close(reads)
