"""A disk that is full, cannot be written or hangs costs rows and events in time, never training.

RLIMIT_FSIZE refuses what goes beyond a size, in the kernel and for all threads of this process: a full disk without a
mount. The test on a file system that is really full is slow and stands at the end.
"""

import contextlib
import itertools
import json
import os
import resource
import shutil
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable

import pytest
from rich.console import Console
from tensorboardX.proto.event_pb2 import Event  # pyrefly: ignore[missing-module-attribute]  # protobuf makes it at import

from kinetix_dist.checkpoint import list_checkpoints, newest_good
from kinetix_dist.cli.main import main
from kinetix_dist.runtime.driver.colocated import ColocatedTrainer
from kinetix_dist.runtime.driver.controller import Controller, Roles
from kinetix_dist.runtime.driver.evaluations import Recorder
from kinetix_dist.runtime.driver.refreshes import CuratorClient
from kinetix_dist.runtime.driver.reporting import RunReporter
from kinetix_dist.runtime.driver.run_directory import MAX_PENDING, RunDirectory
from kinetix_dist.runtime.processes.local import LocalBackend
from kinetix_dist.runtime.processes.placement import ProcessPlan
from kinetix_dist.telemetry.event_names import UnknownEventError
from kinetix_dist.telemetry.json_lines import read_lines
from kinetix_dist.telemetry.names import UnknownMetricError
from kinetix_dist.telemetry.sinks.background import PATIENCE_S, QUEUE_ROWS, BackgroundSink
from kinetix_dist.telemetry.sinks.console import ConsoleSink
from tests.helpers import PATIENCE_S as TEST_PATIENCE_S
from tests.helpers import REPOSITORY, python_path
from tests.runtime.conftest import NUM_UPDATES, STEPS
from tests.runtime.runs import tiny_config

ROW = {"progress/env_steps": 128.0, "train/solve_rate": 0.5}


@contextlib.contextmanager
def full_disk():
    """No file of this process can grow."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def _events(path, *kinds):
    return [row for row in read_lines(path / "events.jsonl").rows if row["event"] in kinds]


def _points(directory):
    """Steps of the scalars in the TensorBoard files; fails unless every record is whole."""
    steps = []
    for file in directory.glob("events.out.tfevents.*"):
        data, at = file.read_bytes(), 0
        while at < len(data):
            (length,) = struct.unpack_from("<Q", data, at)
            event = Event.FromString(data[at + 12 : at + 12 + length])
            assert at + 16 + length <= len(data)
            at += 16 + length
            if event.summary.value:
                steps.append(event.step)
    return steps


def _wait_until_dropped(reporter, num_rows):
    """A failing sink is not waited for: its thread may be a row or two behind."""
    deadline = time.monotonic() + TEST_PATIENCE_S
    while reporter._num_dropped() < num_rows:
        assert time.monotonic() < deadline
        time.sleep(0.01)


class _HookedReporter(RunReporter):
    """Calls `at_update(number)` after each update."""

    at_update: Callable[[int], None]

    def metrics(self, num_updates, metrics, seconds_left):
        super().metrics(num_updates, metrics, seconds_left)
        self.at_update(num_updates)


@pytest.mark.long
def test_training_goes_on_for_100_updates_on_a_full_disk_and_all_files_after_it(tmp_path):
    first, last = 3, 103
    config = tiny_config(num_updates=110, checkpoint_every=20)
    run = RunDirectory.create(tmp_path / "run", numbered=False)
    full = contextlib.ExitStack()
    log = (tmp_path / "console").open("w", buffering=1)

    def at_update(number):
        if number == first:
            full.enter_context(full_disk())
        elif number == last:
            _wait_until_dropped(reporter, 2 * (last - first))
            full.close()

    reporter = _HookedReporter(run, ConsoleSink(total_env_steps=None, console=Console(file=log)))
    reporter.at_update = at_update
    with full, log:
        backend = LocalBackend()
        trainer = ColocatedTrainer(config, backend, [ProcessPlan(role="worker", index=0)])
        curator = CuratorClient(config, backend, [ProcessPlan(role="curator", index=0)])
        controller = Controller(config, run, Roles(trainer=trainer, curator=curator), reporter)
        controller.restore(resume=False)
        controller.train()
        controller.close()
        reporter.close()
        run.close()
    assert controller.num_updates == 110
    written = [*range(1, first + 1), *range(last + 1, 111)]
    rows = [json.loads(line) for line in (run.metrics / "metrics.jsonl").read_text().splitlines()]  # all are whole
    assert [row["update"] for row in rows] == written
    assert rows[-1]["telemetry/dropped_rows"] == 2 * (last - first)
    assert sorted(set(_points(run.metrics))) == [number * STEPS for number in written]
    for sink in ("metrics.jsonl", "tensorboard"):
        (failing,) = [row for row in _events(run.path, "sink_failing") if row["sink"] == sink]
        (recovered,) = [row for row in _events(run.path, "sink_recovered") if row["sink"] == sink]
        assert "File too large" in failing["error"] and failing["update"] == first + 1
        assert recovered["dropped"] == last - first and recovered["time"] >= failing["time"]
    assert [row["update"] for row in _events(run.path, "checkpoint_failed")] == [20, 40, 60, 80, 100]
    checkpoint, rejected = newest_good(run.checkpoints)
    assert checkpoint is not None and checkpoint.description["num_updates"] == 110 and not rejected
    assert [path.name for path in run.checkpoints.iterdir()] == ["00000110"]  # no drafts are left


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_thread_that_died_is_replaced_and_its_row_counted():
    noted, rows = [], []

    class Sink:
        def write(self, update, metrics):
            if update == 2:
                sys.exit()  # ends the thread that it is called in
            rows.append((update, threading.current_thread()))

        def close(self):
            pass

    sink = BackgroundSink("x", Sink, lambda kind, details: noted.append((kind, details)))
    for update in (1, 2):
        sink.write(update, ROW)
    rows[0][1].join(0.2)
    sink._thread.join(5)  # it is on its way out
    for update in (3, 4):
        sink.write(update, ROW)
    sink.close()
    assert [update for update, _ in rows] == [1, 3, 4]
    assert rows[0][1] is not rows[1][1]
    assert sink.num_dropped == 1
    assert [kind for kind, _ in noted] == ["sink_failing", "sink_recovered"]
    assert noted[0][1]["error"] == "the thread that writes has ended" and noted[1][1]["dropped"] == 1


def test_a_disk_that_hangs_costs_a_second_once_and_then_rows():
    """A pipe without a reader takes 64 KiB and then blocks its writer, as a network disk does that is gone."""
    reading, writing = os.pipe()
    noted = []

    class Sink:
        def write(self, update, metrics):
            os.write(writing, b"x" * 4096)

        def close(self):
            pass

    sink = BackgroundSink("x", Sink, lambda kind, details: noted.append((kind, details)))
    began = time.monotonic()
    num_rows = QUEUE_ROWS + 40
    for update in range(num_rows):
        sink.write(update, ROW)
    assert PATIENCE_S <= time.monotonic() - began < 2 * PATIENCE_S
    dropped = num_rows - (1 << 16) // 4096 - 1 - QUEUE_ROWS  # one is being written
    assert sink.num_dropped == dropped > 0
    assert [kind for kind, _ in noted] == ["sink_failing"]
    num_read = 0
    while num_read < 4096 * (num_rows - dropped):
        num_read += len(os.read(reading, 1 << 16))
    sink.close()
    assert [kind for kind, _ in noted] == ["sink_failing", "sink_recovered"]
    assert noted[1][1]["dropped"] == dropped
    os.close(reading)
    os.close(writing)


def test_a_directory_that_cannot_be_written_and_comes_back(tmp_path):
    """A file is in its place: `chmod` would not stop root, whom containers run as."""
    run = RunDirectory.create(tmp_path / "run", numbered=False)
    run.metrics.mkdir()
    (run.metrics / "metrics.jsonl").write_text('{"update": 1}\n{"update": 2}\n{"update": 3}\n')  # of a killed session
    run.metrics.rename(run.path / "away")
    run.metrics.write_text("")
    reporter = RunReporter(run, ConsoleSink(total_env_steps=None, console=Console(quiet=True)))
    for update in (3, 4):
        reporter.metrics(update, ROW, None)
    _wait_until_dropped(reporter, 4)
    run.metrics.unlink()
    (run.path / "away").rename(run.metrics)
    for update in (5, 6):
        reporter.metrics(update, ROW, None)
    reporter.close()
    run.close()
    rows = read_lines(run.metrics / "metrics.jsonl").rows
    assert [row["update"] for row in rows] == [1, 2, 5, 6]  # of the killed session what is before this one's first
    assert [row["dropped"] for row in _events(run.path, "sink_recovered")] == [2, 2]


def test_metrics_and_events_that_nobody_described_are_refused_at_once(tmp_path):
    run = RunDirectory.create(tmp_path / "run", numbered=False)
    reporter = RunReporter(run, ConsoleSink(total_env_steps=None, console=Console(quiet=True)))
    with pytest.raises(UnknownMetricError):
        reporter.metrics(1, {**ROW, "train/luck": 1.0}, None)
    with pytest.raises(UnknownEventError):
        run.event("luck")
    reporter.close()
    run.close()


def test_events_wait_in_memory_and_are_written_in_order(tmp_path):
    run = RunDirectory.create(tmp_path / "run", numbered=False)
    run.event("resumed", update=0)
    with full_disk():
        for update in range(1, MAX_PENDING + 6):
            run.event("resumed", update=update)
    run.write_pending_events()
    rows = read_lines(run.events).rows
    assert [row["update"] for row in rows[:-1]] == list(range(MAX_PENDING + 1))
    assert (rows[-1]["event"], rows[-1]["events"]) == ("events_dropped", 5)
    run.close()


def test_a_run_cannot_begin_on_a_full_disk(capsys, tmp_path):
    with full_disk():
        assert main(["train", "--recipe", "tiny", "--run", str(tmp_path / "run")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.endswith(f"cannot write to run directory {tmp_path / 'run'}: File too large")


def test_a_recording_that_cannot_be_written_is_an_event(tmp_path):
    run = RunDirectory.create(tmp_path / "run", numbered=False)
    run.recordings.write_text("")
    rollout = type("Played", (), {"policy_version": 3})()
    Recorder(run)([rollout])
    assert "recordings" in _events(run.path, "recording_failed")[0]["error"]
    run.close()


def test_pictures_that_cannot_be_drawn_are_a_line_and_an_event(tmp_path, monkeypatch):
    run = RunDirectory.create(tmp_path / "run", numbered=False)
    recorder = Recorder(run)
    recorder.last = [type("Played", (), {"policy_version": 3, "solved": True})()]
    monkeypatch.setitem(sys.modules, "rerun", None)  # as where it is not installed
    line = recorder.make_pictures()
    assert line is not None and "rerun" in line and f"kinetix-dist replay {run.path}" in line and "\n" not in line
    assert "rerun" in _events(run.path, "pictures_failed")[0]["error"]
    run.close()


def test_damaged_evaluations_and_metrics_are_set_aside_on_resume(finished_run, tmp_path, capsys):
    path = tmp_path / "run"
    shutil.copytree(finished_run, path)
    (path / "evaluations.json").write_text('{"before": {"s/ki')
    (path / "evaluations.json.damaged").write_text("of an earlier time")
    (path / "metrics" / "metrics.jsonl").unlink()
    (path / "metrics" / "metrics.jsonl").mkdir()
    more = str((NUM_UPDATES + 1) * STEPS)
    assert main(["train", "--run", str(path), "--resume", "--run.total_env_steps", more]) == 0
    assert "Traceback" not in capsys.readouterr().err
    aside = {row["file"]: row["to"] for row in _events(path, "file_set_aside")}
    assert aside == {
        "evaluations.json": "evaluations.json.damaged-2",
        "metrics/metrics.jsonl": "metrics.jsonl.damaged",
    }
    assert (path / "evaluations.json.damaged-2").read_text() == '{"before": {"s/ki'
    assert (path / "metrics" / "metrics.jsonl.damaged").is_dir()
    assert list(json.loads((path / "evaluations.json").read_text())) == ["after"]
    assert [row["update"] for row in read_lines(path / "metrics" / "metrics.jsonl").rows] == [NUM_UPDATES + 1]


FULL_DISK = """
set -eu
mount -t tmpfs -o size=6m tmpfs "$DISK"
"$PYTHON" -m kinetix_dist.cli.main train --run "$DISK/run" --recipe tiny --evaluation.sets s/kick \
    --run.max_seconds 40 --run.total_env_steps 0 2>"$OUT/stderr" >"$OUT/stdout" & driver=$!
until [ "$(ls "$DISK/run/checkpoints" 2>/dev/null | grep -c '^[0-9]')" -ge 2 ]; do kill -0 $driver; sleep 0.1; done
dd if=/dev/zero of="$DISK/filler" bs=4096 2>/dev/null || true
sleep 10
rm "$DISK/filler"
wait $driver
cp -r "$DISK/run" "$OUT/run"
"""


@pytest.mark.slow
def test_a_file_system_of_6_mb_that_is_full_for_ten_seconds(tmp_path):
    """Runs in a mount namespace of its own; skipped where the machine gives none."""
    if subprocess.run(["unshare", "--map-root-user", "--mount", "true"], capture_output=True, check=False).returncode:
        pytest.skip("no mount namespaces here")
    (tmp_path / "disk").mkdir()
    environment = {**os.environ, "PYTHONPATH": python_path(), "JAX_PLATFORMS": "cpu", "PYTHON": sys.executable}
    environment |= {"DISK": str(tmp_path / "disk"), "OUT": str(tmp_path)}
    command = ["unshare", "--map-root-user", "--mount", "bash", "-c", FULL_DISK]
    done = subprocess.run(command, env=environment, cwd=REPOSITORY, capture_output=True, text=True, timeout=280)
    errors = (tmp_path / "stderr").read_text()
    assert done.returncode == 0, done.stderr + errors
    assert "No space left on device" in errors
    assert f"{REPOSITORY}/kinetix_dist/" not in errors  # no traceback of ours; Orbax's threads may print one of theirs
    rows = [json.loads(line) for line in (tmp_path / "run" / "metrics" / "metrics.jsonl").read_text().splitlines()]
    updates = [row["update"] for row in rows]
    gaps = [after - before for before, after in itertools.pairwise(updates) if after > before + 1]
    assert sum(gaps) > 100, gaps
    assert len(_events(tmp_path / "run", "sink_recovered")) == len(_events(tmp_path / "run", "sink_failing")) > 0
    assert int(list_checkpoints(tmp_path / "run" / "checkpoints")[-1].name) == updates[-1]
