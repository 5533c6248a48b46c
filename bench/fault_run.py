"""A real `kinetix-dist train` that test-faults end parts of: its command, its processes, and what it leaves behind.

Used by `bench.fault_tests` and `bench.recovery`. Ray processes are real ones; the recipe is `tiny` and the device the
CPU, unless another is given.
"""

from __future__ import annotations

import dataclasses
import math
import os
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil

from kinetix_dist.checkpoint import list_checkpoints
from kinetix_dist.child_python import command_of
from kinetix_dist.recipes import recipe
from kinetix_dist.runtime.processes.watchdog import is_alive
from kinetix_dist.telemetry.json_lines import read_lines

REPOSITORY = Path(__file__).resolve().parent.parent
SHARED_MEMORY = Path("/dev/shm")
LOOK_EVERY_S = 1.0  # at the processes below a driver
GONE_S = 30.0  # for what a driver left behind to be ended by the watchdog
LIMIT_S = 900.0  # for anything that is waited for, where the test has no end of its own
MIN_END_S = 5.0  # for a command that was ended to be gone, whatever the limit
STEPS_PER_UPDATE = recipe("tiny").rollout.steps_per_update
FOR_EVER = str(1_000_000_000 * STEPS_PER_UPDATE)  # environment steps

OPTIONS = {  # on a CPU; on GPUs a run has one process a GPU
    "colocated": ("--run.num_workers", "2"),
    "split": ("--run.num_learners", "2", "--run.num_rollout_actors", "2"),
}


def python_path() -> str:
    """PYTHONPATH of a command that is to run this checkout."""
    return os.pathsep.join(filter(None, (str(REPOSITORY), os.environ.get("PYTHONPATH", ""))))


class FaultError(Exception):
    """The run did not do what is waited for."""


@dataclasses.dataclass
class FaultRun:
    """One run directory and the command that works in it, if any. Used by one thread."""

    path: Path
    placement: str
    options: tuple[str, ...] = ()
    device: str = "cpu"  # or "gpu"
    recipe: str = "tiny"
    ends_at: float = math.inf  # time.monotonic() after which nothing is waited for any more
    _driver: subprocess.Popen[bytes] | None = None
    _seen: dict[int, psutil.Process] = dataclasses.field(default_factory=dict)
    _cpu: dict[tuple[int, float], float] = dataclasses.field(default_factory=dict)  # (pid, began) -> CPU seconds

    def start(self, *options: str, resume: bool = False) -> None:
        """Begins the command; its words go to files next to the run directory."""
        command = command_of("kinetix_dist.cli.main", "train", "--run", self.path)
        if resume:
            command += ["--resume"]
        else:
            command += ["--recipe", self.recipe, "--run.device", self.device, "--run.placement", self.placement]
            command += ["--evaluation.sets", "s/kick", "--evaluation.min_attempts", "4"]
            command += [*(OPTIONS[self.placement] if self.device == "cpu" else ()), *self.options]
        left_out = ("JAX_PLATFORMS", "XLA_PYTHON", "RAY_ADDRESS")
        environment = {name: value for name, value in os.environ.items() if not name.startswith(left_out)}
        environment["PYTHONPATH"] = python_path()
        if self.device == "cpu":
            environment["JAX_PLATFORMS"] = "cpu"
        with self.said_path.open("ab") as said:
            self._driver = subprocess.Popen(
                [*command, *options],
                env=environment,
                cwd=REPOSITORY,
                stdin=subprocess.DEVNULL,
                stdout=said,
                stderr=said,
                start_new_session=True,
            )
        self._watching = threading.Event()
        self._watcher = threading.Thread(target=self._watch, args=(self._driver.pid, self._watching), daemon=True)
        self._watcher.start()

    @property
    def said_path(self) -> Path:
        """All that the commands said."""
        return self.path.with_suffix(".said")

    @property
    def driver(self) -> subprocess.Popen[bytes]:
        assert self._driver is not None, "nothing was started"
        return self._driver

    @property
    def is_alive(self) -> bool:
        return self._driver is not None and self._driver.poll() is None

    def said(self) -> str:
        return self.said_path.read_text(errors="replace")

    def events(self, kind: str, **details: Any) -> list[dict[str, Any]]:
        """Events of a kind so far, with these details."""
        found = (row for row in read_lines(self.path / "events.jsonl").rows if row["event"] == kind)
        return [row for row in found if all(row.get(name) == value for name, value in details.items())]

    def updates(self) -> list[int]:
        return [row["update"] for row in read_lines(self.path / "metrics" / "metrics.jsonl").rows]

    def last_processes(self) -> list[dict[str, Any]]:
        """Last rows that the processes gave of themselves, as processes.jsonl has them."""
        lines = read_lines(self.path / "processes.jsonl").rows
        return lines[-1]["processes"] if lines else []

    def wait(self, condition: Callable[[], bool], what: str) -> None:
        """Raises FaultError where the command ends before, or where that takes too long."""
        limit = self._limit()
        deadline = time.monotonic() + limit
        while not condition():
            if not self.is_alive:
                raise FaultError(f"the command ended ({self.driver.returncode}) before {what}: {self.said()[-500:]}")
            if time.monotonic() > deadline:
                raise FaultError(f"{what} did not come in {limit:.0f} s; the run said last: {self.said()[-500:]}")
            time.sleep(0.02)

    def wait_for_update(self) -> float:
        """Until metrics of an update are written that begin to be from now on. Returns when: time.monotonic()."""
        file, now = self.path / "metrics" / "metrics.jsonl", time.time()
        self.wait(lambda: file.exists() and file.stat().st_mtime > now, "an update")
        return time.monotonic()

    def living(self) -> dict[int, str]:
        """Names of its processes by process id. Descendants of the driver alone: a number may be another's by now."""
        names = {row["pid"]: row["process"] for row in self.events("process_started")}
        try:
            below = psutil.Process(self.driver.pid).children(recursive=True)
        except psutil.NoSuchProcess:
            return {}
        return {child.pid: names[child.pid] for child in below if child.pid in names and is_alive(child)}

    def end(self, number: int = signal.SIGTERM) -> int:
        """Ends the command by a signal; its exit status."""
        if self.is_alive:
            self.driver.send_signal(number)
        return self.finished()

    def finished(self) -> int:
        """Waits for the command's end; its exit status."""
        limit = max(self._limit(), MIN_END_S)
        try:
            return self.driver.wait(limit)
        except subprocess.TimeoutExpired:
            self.driver.kill()
            raise FaultError(f"the command did not end in {limit:.0f} s: {self.said()[-500:]}") from None
        finally:
            self._watching.set()
            self._watcher.join()

    def _limit(self) -> float:
        return min(LIMIT_S, max(self.ends_at - time.monotonic(), 0.0))

    def left_processes(self) -> list[str]:
        """Processes of earlier commands that are there GONE_S later, and what they are."""
        deadline = time.monotonic() + GONE_S
        while left := [process for process in self._seen.values() if is_alive(process)]:
            if time.monotonic() > deadline:
                return [f"{process.pid} {' '.join(process.cmdline())[:80]}" for process in left]
            time.sleep(0.2)
        return []

    def drafts(self) -> list[str]:
        """Unfinished checkpoints."""
        return sorted(path.name for path in (self.path / "checkpoints").glob(".saving-*"))

    def newest_checkpoint(self) -> Path | None:
        return next(reversed(list_checkpoints(self.path / "checkpoints")), None)

    def cpu_now(self) -> float:
        """CPU seconds of all its processes so far."""
        if self.is_alive:
            self._look(self.driver.pid)
        return self.cpu_seconds

    @property
    def cpu_seconds(self) -> float:
        """The same, as they were looked at last."""
        return sum(list(self._cpu.values()))

    def _watch(self, pid: int, is_over: threading.Event) -> None:
        """Remembers all processes below the driver, and the CPU seconds that they took."""
        while True:
            self._look(pid)
            if is_over.wait(LOOK_EVERY_S):
                return

    def _look(self, pid: int) -> None:
        try:
            driver = psutil.Process(pid)
            for process in [driver, *driver.children(recursive=True)]:
                self._seen[process.pid] = process
                times = process.cpu_times()
                self._cpu[process.pid, process.create_time()] = times.user + times.system
        except psutil.NoSuchProcess:
            return  # the rest is looked at next time


def shared_memory() -> set[str]:
    """Names of files in /dev/shm that no process has open or mapped: no process will remove them."""
    names = {path.name for path in SHARED_MEMORY.iterdir()}
    return {name for name in names if not _is_held(SHARED_MEMORY / name)} if names else set()


def _is_held(path: Path) -> bool:
    for process in psutil.process_iter():
        try:
            if str(path) in Path(f"/proc/{process.pid}/maps").read_text():
                return True
            if any(os.readlink(link) == str(path) for link in Path(f"/proc/{process.pid}/fd").iterdir()):
                return True
        except OSError:
            continue
    return False


def gpu_memory_mib() -> list[int]:
    """Memory in use on each GPU by all programs; empty on a machine without an NVIDIA driver."""
    if shutil.which("nvidia-smi") is None:
        return []
    query = ["nvidia-smi", "--query-gpu=memory.used", "--format=csv,noheader,nounits"]
    return [int(line) for line in subprocess.run(query, capture_output=True, text=True, check=True).stdout.split()]


def machine() -> dict[str, Any]:
    """Machine that figures of this moment belong to."""
    return {"cores": psutil.cpu_count(), "load": [round(value, 1) for value in os.getloadavg()]}
