"""Processes that are lost, whatever the run is at: real ones, ended or stopped by signals. The result is the same."""

import dataclasses
import json
import os
import signal
import socket
import threading
import time
from collections.abc import Callable
from typing import Any

import pytest

from kinetix_dist.config import RecordingConfig
from kinetix_dist.runtime.driver.colocated import ColocatedTrainer
from kinetix_dist.runtime.driver.refreshes import MIN_PATIENCE_S, CuratorClient
from kinetix_dist.runtime.driver.run_directory import RunDirectory
from kinetix_dist.runtime.driver.training_run import RunFailedError, train
from kinetix_dist.runtime.processes.calls import Call
from kinetix_dist.runtime.processes.failures import Losses, TooManyLossesError, WorkerLostError
from kinetix_dist.runtime.processes.local import LocalBackend, LocalFuture, LocalHandle
from kinetix_dist.runtime.processes.placement import ProcessPlan, plan_placement
from kinetix_dist.runtime.processes.ray_backend import RayBackend
from tests.runtime.runs import QuietReporter, assert_same_bits, final_arrays, run_updates, tiny_config
from tests.runtime.train_process import events, rows

NUM_UPDATES = 5


@pytest.fixture(scope="module")
def backend():
    backend = RayBackend(heartbeat_seconds=60.0)
    yield backend
    backend.stop()


def _config(**run):
    config = tiny_config(num_updates=NUM_UPDATES, device="cpu", **run)
    recording = RecordingConfig(num_rollouts=1, make_pictures=False)
    return dataclasses.replace(config, recording=recording)


def _train(config, path):
    run = RunDirectory.create(path, numbered=False)
    try:
        return train(config, run, resume=False)
    finally:
        run.close()


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory):
    """Arrays of a run in this process, which a run with one worker has to reproduce."""
    path = tmp_path_factory.mktemp("unbroken") / "run"
    _train(_config(placement="local"), path)
    return final_arrays(path)


def _before_calls(monkeypatch, do):
    """`do(method, trainer)` before each call of a run to its trainer."""
    for method in ("start", "evaluate", "record", "run_update", "snapshot", "facts"):
        call = getattr(ColocatedTrainer, method)

        def doing(trainer, *arguments, call=call, method=method, **options):
            do(method, trainer)
            return call(trainer, *arguments, **options)

        monkeypatch.setattr(ColocatedTrainer, method, doing)


def test_what_a_loss_cut_off_is_repeated_whatever_the_run_was_at(unbroken, tmp_path, monkeypatch):
    """One process stands for all: it is lost in words only, and built again. The slow tests end processes."""
    left = ["start", "start", "evaluate", "run_update", "snapshot", "record", "facts"]

    def lose(method, trainer):
        if left and left[0] == method:
            left.pop(0)
            raise WorkerLostError("worker 0 died", process="worker 0")

    _before_calls(monkeypatch, lose)
    path = tmp_path / "run"
    _train(_config(placement="local"), path)
    sections = [row["section"] for row in events(path, "process_lost", process="worker 0", role="worker")]
    assert sections == ["start", "recover", "evaluate", "update", "save", "record", "report"]
    assert [row["update"] for row in rows(path)] == list(range(1, NUM_UPDATES + 1))
    (first, *_) = events(path, "recovered")  # nothing new came of the start that was lost, nor of the next one
    assert (first["section"], first["from_update"], first["to_update"]) == ("start", 0, 0)
    assert_same_bits(final_arrays(path), unbroken)


class Killer:
    """Ends a process once for every given moment."""

    def __init__(self, moments):
        self._left = list(moments)

    def at(self, moment, pid):
        """moment: "start" and "recover" once a process is there, else the name of the call."""
        if moment in self._left:
            self._left.remove(moment)
            os.kill(pid, signal.SIGKILL)

    def install(self, monkeypatch):
        """Listens to the calls that a run makes; the calls themselves go to a process that is dying."""
        _before_calls(
            monkeypatch, lambda method, trainer: trainer._handles and self.at(method, trainer._handles[0].pid)
        )
        event = RunDirectory.event

        def listening(run, kind, **details):
            event(run, kind, **details)
            if kind == "process_started" and details["process"] == "worker 0":
                is_first = len(events(run.path, "process_lost")) == 0
                self.at("start" if is_first else "recover", details["pid"])

        monkeypatch.setattr(RunDirectory, "event", listening)

    @property
    def is_done(self):
        return not self._left


def _lose(moments, unbroken, path, monkeypatch):
    killer = Killer(moments)
    killer.install(monkeypatch)
    _train(_config(placement="colocated"), path)
    assert killer.is_done
    assert_same_bits(final_arrays(path), unbroken)
    return [row["section"] for row in events(path, "process_lost", process="worker 0", role="worker")]


@pytest.mark.slow
def test_losses_at_the_start_in_an_evaluation_and_in_the_recovery_change_nothing(
    backend, unbroken, tmp_path, monkeypatch
):
    path = tmp_path / "run"
    assert _lose(["start", "evaluate", "recover"], unbroken, path, monkeypatch) == ["start", "recover", "evaluate"]
    last = rows(path)[-1]
    assert last["runtime/restarts"] == last["runtime/restarts_worker"] == 3
    recovered = events(path, "recovered")  # nothing new came in between: one figure a loss, of all at the same time
    assert [row["section"] for row in recovered] == ["start", "recover", "evaluate"]
    assert last["runtime/recovery_seconds_worker"] == pytest.approx(recovered[-1]["seconds"], abs=0.01)


@pytest.mark.slow
def test_losses_in_an_update_a_save_a_recording_and_the_report_change_nothing(backend, unbroken, tmp_path, monkeypatch):
    found = _lose(["run_update", "snapshot", "record", "facts"], unbroken, tmp_path / "run", monkeypatch)
    assert found == ["update", "save", "record", "report"]


@pytest.mark.slow
def test_a_worker_that_stands_still_for_less_than_the_heartbeat_costs_nothing(backend, tmp_path, monkeypatch):
    """Longer than the 30 s after which its group would end, if the limit of the run did not reach JAX."""
    path, left = tmp_path / "run", ["run_update"] * 3

    def stop(method, trainer):
        if not left or left[0] != method:
            return
        left.pop(0)
        if not left:  # what the first update compiles is there
            pid = trainer._handles[1].pid
            os.kill(pid, signal.SIGSTOP)
            threading.Timer(45.0, os.kill, (pid, signal.SIGCONT)).start()

    _before_calls(monkeypatch, stop)
    _train(_config(placement="colocated", num_workers=2), path)
    assert not left and not events(path, "process_lost")
    assert [row["update"] for row in rows(path)] == list(range(1, NUM_UPDATES + 1))


@pytest.mark.slow
def test_more_losses_than_allowed_end_the_run_with_one_line(backend, tmp_path, monkeypatch):
    Killer(["evaluate", "recover"]).install(monkeypatch)
    with pytest.raises(
        RunFailedError, match=r"worker 0 died.*loss 2 within an hour, and run.max_restarts is 1"
    ) as caught:
        _train(_config(placement="colocated", max_restarts=1), tmp_path / "run")
    assert "\n" not in str(caught.value) and "--resume" in str(caught.value)


def test_losses_of_an_hour_ago_are_forgotten(monkeypatch):
    losses, now = Losses(limit=2), [1000.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    for _ in range(5):
        losses.lost(WorkerLostError("worker 0 died", process="worker 0"))
        now[0] += 1801.0
    losses.lost(WorkerLostError("worker 0 died", process="worker 0"))
    with pytest.raises(TooManyLossesError, match="max_restarts is 2"):
        losses.lost(WorkerLostError("worker 0 died", process="worker 0"))


def test_the_ends_of_the_logs_of_a_lost_process_and_its_group_are_stored(tmp_path):
    stored, noted = {}, []

    def keep(name, text):
        stored[name] = text
        return tmp_path / name

    losses = Losses(limit=9, on_event=lambda kind, **details: noted.append(details), on_log=keep)
    texts = {"worker 0": "old\n" + "x" * 70_000 + "\nF1122 check failed", "worker 1": "lost its peer", "worker 2": ""}
    for process, text in {**texts, "curator 0": "well"}.items():
        (tmp_path / "log").mkdir(exist_ok=True)
        (file := tmp_path / "log" / process).write_text(text)
        losses.started(process, {"host": socket.gethostname(), "log": str(file)})
    losses.started("worker 3", {"host": "another", "log": str(tmp_path / "log" / "worker 0")})
    losses.started("worker 4", {"host": socket.gethostname(), "log": str(tmp_path / "gone")})
    losses.lost(WorkerLostError("worker 0 died", process="worker 0"))
    assert sorted(stored) == ["worker_0", "worker_1"] and "old" not in stored["worker_0"]
    assert stored["worker_0"].endswith("F1122 check failed") and stored["worker_1"] == "lost its peer"
    losses.lost(WorkerLostError("worker 2 died", process="worker 2"))
    assert [row.get("log") for row in noted] == [str(tmp_path / "worker_0"), None]


# The curator


@dataclasses.dataclass(frozen=True)
class LaterTicket(LocalFuture[dict[str, Any]]):
    is_done: Callable[[], bool]

    def is_ready(self) -> bool:
        return self.is_done()


class BusyCurator:
    """Core of a curator that answers with the version of the policy."""

    def refresh(self, weights: Any, policy_version: int, *others: Any) -> tuple[dict[str, Any], int]:
        del weights, others
        return {"seconds": 1.0, "probe": {}}, policy_version


class BusyHandle(LocalHandle[Any]):
    """Its calls are ready once the test says so."""

    def __init__(self, plan: ProcessPlan) -> None:
        super().__init__(plan, BusyCurator())
        self.requested: list[int] = []
        self.done = 0

    def _call_with_header(self, call: Call) -> tuple[LocalFuture[dict[str, Any]], LocalFuture[Any]]:
        number = len(self.requested)
        header, content = super()._call_with_header(call)
        self.requested.append(content.value)
        return LaterTicket(header.value, lambda: self.done > number), content


class BusyBackend(LocalBackend):
    def __init__(self) -> None:
        super().__init__()
        self.handle = BusyHandle(ProcessPlan(role="curator", index=0))

    def spawn_in_background(self, plan: ProcessPlan, build: Callable[..., Any], *arguments: Any) -> LocalHandle[Any]:
        del plan, build, arguments
        return self.handle


def test_what_was_given_up_does_not_pile_up_at_a_curator_that_is_late() -> None:
    backend = BusyBackend()
    process = backend.handle
    curator = CuratorClient(tiny_config(num_updates=1), backend, [process.plan])
    for version in (0, 3, 6, 9):
        curator.request(LocalFuture(None), version, None, None)
        assert curator.take(patience_s=-1.0) is None
        curator.cancel()
    assert process.requested == [0]
    curator.request(LocalFuture(None), 12, None, None)
    process.done = 1
    curator.watch()
    assert process.requested == [0, 12]
    # It is at work again, so it is waited for: else one that is slower than its orders come would never be in time.
    threading.Timer(0.1, setattr, (process, "done", 2)).start()
    refresh = curator.take(patience_s=1.0)
    assert refresh is not None and refresh.parts[0].fetch() == 12


def _train_in_background(config, backend, path, at_update=None):
    """(controller, rows). at_update(number, curator) is called after every update."""
    placement = plan_placement(config, num_gpus=0)
    trainer = ColocatedTrainer(config, backend, placement.of("worker"))
    curator = CuratorClient(config, backend, placement.of("curator"))
    reporter = QuietReporter(lambda number: at_update(number, curator) if at_update else None)
    try:
        run_updates(config, path, trainer, curator, reporter=reporter)
    finally:
        curator.stop()
        trainer.stop()
    return reporter.rows


@pytest.mark.slow
@pytest.mark.parametrize("number_of_signal", [signal.SIGSTOP, signal.SIGKILL])
def test_training_goes_on_without_a_curator_and_what_is_computed_again_does_the_same(
    backend, tmp_path, number_of_signal
):
    """The refresh requested at 3 is due at 5. In an update in which nothing is computed, waiting is what takes time."""
    config = tiny_config(num_updates=40, placement="colocated", checkpoint_every=100)
    times, stopped = {}, []

    def stop_it(number, curator):
        times[number] = time.monotonic()
        if number == 3:
            stopped.append(curator.processes[0]._handle.pid)
            os.kill(stopped[0], number_of_signal)
        if number == 8 and number_of_signal == signal.SIGSTOP:
            os.kill(stopped[0], signal.SIGCONT)

    rows_of = _train_in_background(config, backend, tmp_path / "ray", stop_it)
    stale = [row["update"] for row in rows_of if row["curriculum/buffer_is_stale"]]
    assert 6 in stale, stale
    (late,) = events(tmp_path / "ray", "buffer_late", policy_version=3)
    assert late["update"] == 5
    longest = max(times[number + 1] - times[number] for number in range(4, 40))
    assert longest < MIN_PATIENCE_S + 2.0
    lost = [row["role"] for row in events(tmp_path / "ray", "process_lost")]
    assert lost == (["curator"] if number_of_signal == signal.SIGKILL else [])
    # The refresh of version 3 was adopted late or never: a run with its adoptions.json is the same, bit for bit.
    record = json.loads((tmp_path / "ray" / "adoptions.json").read_text())
    assert record["0"] == 0
    assert record["3"] is None or record["3"] > 5
    if number_of_signal == signal.SIGSTOP:  # it went on, and is waited for again
        assert record["36"] == 38
    again = RunDirectory.create(tmp_path / "again", numbered=False)
    again.write_json(again.adoptions_path, record)
    again.close()
    _train_in_background(config, LocalBackend(), tmp_path / "again")
    assert_same_bits(final_arrays(tmp_path / "again"), final_arrays(tmp_path / "ray"))
