"""Real Ray runs on a GPU: worker and curator share it within their budgets, and losses and breaks change no bit.

`-m gpu --gpu-tests-on-cpu` runs them on the CPU, where there are no budgets.
"""

import json
import shutil
import signal
import subprocess
import threading
import time

import pytest

from kinetix_dist.runtime.driver.stopping import EXIT_STOPPED
from kinetix_dist.runtime.processes.placement import count_gpus
from tests.runtime.runs import assert_same_bits, final_arrays
from tests.runtime.train_process import (
    LIMIT_S,
    STEPS_PER_UPDATE,
    TINY,
    events,
    finish,
    kill_newest,
    rows,
    start,
    wait_for,
)

pytestmark = pytest.mark.gpu

NUM_UPDATES = 120
COLOCATED = [*TINY, "--run.placement", "colocated", "--run.num_workers", "1", "--run.checkpoint_every", "10"]
# Machines with GPUs are lent for minutes: these two tests end within so many seconds next to each other, and say
# with `-s` how far they are.
KILLED_LIMIT_S, SPLIT_LIMIT_S = 170, 100


@pytest.fixture(scope="module")
def device(request):
    return "cpu" if request.config.option.gpu_tests_on_cpu else "gpu"


@pytest.fixture(scope="module")
def unbroken(device, tmp_path_factory):
    """(a finished run, the process id of its driver, the most memory that processes were seen to take of the GPU, MiB
    by process id)"""
    run = tmp_path_factory.mktemp("unbroken") / "run"
    with MemoryOfProcesses() as memory:
        driver = start(run, *COLOCATED, *_until(NUM_UPDATES), device=device)
        finish(driver)
    return run, driver.pid, memory.max_mib


class MemoryOfProcesses:
    """Asks nvidia-smi every half second what each process takes of its GPU."""

    def __init__(self):
        self.max_mib = {}
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=self._watch)

    def __enter__(self):
        if shutil.which("nvidia-smi"):
            self._thread.start()
        return self

    def __exit__(self, *error):
        self._is_over.set()
        if self._thread.is_alive():
            self._thread.join()

    def _watch(self):
        query = ["nvidia-smi", "--query-compute-apps=pid,used_gpu_memory", "--format=csv,noheader,nounits"]
        while not self._is_over.wait(0.5):
            answer = subprocess.run(query, capture_output=True, text=True, check=False).stdout
            for line in answer.splitlines():
                pid, _, mib = line.partition(",")
                if pid.strip().isdigit() and mib.strip().isdigit():
                    self.max_mib[int(pid)] = max(int(mib), self.max_mib.get(int(pid), 0))


def test_a_colocated_run_on_one_gpu_ends_with_every_process_within_its_budget(unbroken, device):
    run, driver_pid, max_mib = unbroken
    report = json.loads((run / "report.json").read_text())
    assert report["policy_updates"] == NUM_UPDATES
    assert report["device"]["platform"] == device
    processes = {process["process"]: process for process in report["processes"]}
    assert list(processes) == ["worker 0", "curator 0"]
    if device == "cpu":
        return
    assert processes["worker 0"]["gpu"] == processes["curator 0"]["gpu"]
    assert driver_pid not in max_mib, "the driver takes memory of a GPU"
    seen = 0
    for name, process in processes.items():
        memory = process["memory_mib"]
        assert memory["pool"] == pytest.approx(memory["budget"] - memory["reserve"], rel=0.01), name  # XLA keeps to it
        assert 0 < memory["pool_peak"] <= memory["pool"], name
        if process["pid"] in max_mib:  # not in containers that hide process ids
            seen += 1
            assert max_mib[process["pid"]] <= memory["budget"], name
    print(f"budgets checked from outside: {seen} of 2; nvidia-smi saw {max_mib}")


def test_a_run_that_was_ended_half_way_and_resumed_equals_an_unbroken_one_bit_for_bit(unbroken, device, tmp_path):
    finish(start(tmp_path / "run", *COLOCATED, *_until(NUM_UPDATES // 2), device=device))
    finish(start(tmp_path / "run", "--resume", *_until(NUM_UPDATES), device=device))
    assert [row["update"] for row in rows(tmp_path / "run")] == list(range(1, NUM_UPDATES + 1))
    assert_same_bits(final_arrays(tmp_path / "run"), final_arrays(unbroken[0]))


class Steps:
    """Steps of a test that has to end in time: prints when each is done, and the rest of `limit_s`."""

    def __init__(self, limit_s):
        self._began = time.monotonic()
        self._limit_s = limit_s

    @property
    def left_s(self):
        return max(self._began + self._limit_s - time.monotonic(), 1.0)

    def done(self, what):
        print(f"{time.monotonic() - self._began:6.1f} s  {what}", flush=True)


def test_a_killed_curator_and_a_killed_worker_cost_time_and_change_no_bit(device, tmp_path):
    """Training does not wait for a curator that died, and updates may take milliseconds: the run goes on until a buffer
    of the new curator is used, however many updates that takes, and is stopped then."""
    run, steps = tmp_path / "run", Steps(KILLED_LIMIT_S if device == "gpu" else LIMIT_S)
    process = start(run, *COLOCATED, *_until(10**7), device=device)
    for number, killed in ((5, "curator"), (25, "worker")):
        wait_for(lambda n=number: len(rows(run)) >= n, process, f"update {number}", limit_s=steps.left_s)
        kill_newest(run, f"{killed} 0")
        steps.done(f"{len(rows(run))} updates, {killed} killed")
    killed_at = len(rows(run))
    wait_for(lambda: events(run, "recovered", role="worker"), process, "a recovery", limit_s=steps.left_s)
    steps.done("recovered")
    wait_for(lambda: _adopted_after(run, killed_at), process, "a new buffer", limit_s=steps.left_s)
    process.send_signal(signal.SIGTERM)
    finish(process, limit_s=steps.left_s, status=EXIT_STOPPED)
    steps.done(f"a buffer of the new curator is used from update {_adopted_after(run, killed_at)[0]} on; stopped")
    assert len(events(run, "process_started", process="worker 0")) == 2
    (recovered,) = events(run, "recovered", role="worker")
    assert recovered["seconds"] > 0
    assert [row["role"] for row in events(run, "process_lost")] == ["curator", "worker"]
    assert rows(run)[-1]["runtime/restarts"] == 2
    # To an end of its own, and a run without losses that gets adoptions.json.
    num_updates = rows(run)[-1]["update"] + 1
    finish(start(run, "--resume", *_until(num_updates), device=device), limit_s=steps.left_s)
    steps.done(f"resumed, ended after {num_updates} updates")
    repeated = tmp_path / "repeated"
    repeated.mkdir()
    shutil.copy(run / "adoptions.json", repeated)
    finish(start(repeated, *COLOCATED, *_until(num_updates), device=device), limit_s=steps.left_s)
    steps.done("the same run without losses ended")
    assert_same_bits(final_arrays(run), final_arrays(repeated))
    steps.done(f"the same bits; recoveries {[row['seconds'] for row in events(run, 'recovered')]} s")


def _until(num_updates):
    return ["--run.total_env_steps", str(num_updates * STEPS_PER_UPDATE)]


def _adopted_after(run, update):
    """Later updates from which on a buffer was used."""
    return [row["update"] for row in events(run, "buffer_adopted") if row["update"] > update]


def test_split_placement_runs_on_two_gpus_with_lag_one(device, tmp_path):
    if device == "gpu" and count_gpus() < 2:
        pytest.skip(f"split placement needs 2 GPUs; there is {count_gpus()}")
    run, steps = tmp_path / "run", Steps(SPLIT_LIMIT_S if device == "gpu" else LIMIT_S)
    process = start(run, *TINY, "--run.placement", "split", *_until(12), device=device)
    wait_for(lambda: len(events(run, "process_started")) == 3, process, "3 processes", limit_s=steps.left_s)
    steps.done("3 processes")
    wait_for(lambda: rows(run), process, "an update", limit_s=steps.left_s)
    steps.done("an update")
    finish(process, limit_s=steps.left_s)
    steps.done("the run ended")
    assert [row["runtime/policy_lag"] for row in rows(run)] == [0] + 11 * [1]
    processes = json.loads((run / "report.json").read_text())["processes"]
    assert [process["process"] for process in processes] == ["learner 0", "rollout 0", "curator 0"]
    if device == "gpu":
        gpus = [process["gpu"] for process in processes]
        assert gpus[0] != gpus[1] == gpus[2]
