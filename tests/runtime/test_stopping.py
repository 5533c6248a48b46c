"""SIGTERM and Ctrl-C: the update is finished, saved, and the command ends with a status of its own."""

import os
import re
import shutil
import signal
import subprocess
import sys
import time

import psutil
import pytest

from kinetix_dist.checkpoint import list_checkpoints, newest_good
from kinetix_dist.cli.main import main
from kinetix_dist.cli.train import parse
from kinetix_dist.config import to_dict
from kinetix_dist.runtime.driver.colocated import ColocatedTrainer
from kinetix_dist.runtime.driver.controller import Controller, Roles
from kinetix_dist.runtime.driver.refreshes import CuratorClient
from kinetix_dist.runtime.driver.run_directory import RunDirectory
from kinetix_dist.runtime.driver.stopping import EXIT_STOPPED, StoppedError, StopSignals
from kinetix_dist.runtime.processes.local import LocalBackend
from kinetix_dist.runtime.processes.placement import ProcessPlan
from kinetix_dist.runtime.processes.ray_setup import SERVERS
from tests.helpers import PATIENCE_S, REPOSITORY, next_line
from tests.runtime.conftest import NUM_UPDATES, STEPS
from tests.runtime.runs import QuietReporter, assert_same_bits, final_arrays, tiny_config
from tests.runtime.train_process import TINY, events, rows, start, wait_for

LIMIT_S = 30.0
FOR_EVER = ["--run.total_env_steps", "1000000000", "--run.checkpoint_every", "1000000"]


def _stopped(process, number, *, group=False):
    """Sends a signal, waits; (exit status, seconds, what it said at last)."""
    began = time.monotonic()
    if group:
        os.killpg(process.pid, number)
    else:
        process.send_signal(number)
    _, errors = process.communicate(timeout=120)
    assert "Traceback" not in errors, errors
    return process.returncode, time.monotonic() - began, errors.strip().splitlines()[-1]


def test_sigterm_finishes_the_update_and_saves_it(tmp_path):
    run = tmp_path / "run"
    process = start(run, *TINY, *FOR_EVER)
    wait_for(lambda: len(rows(run)) >= 3, process, "three updates")
    status, seconds, line = _stopped(process, signal.SIGTERM)
    assert (status, seconds < LIMIT_S) == (EXIT_STOPPED, True)
    number = rows(run)[-1]["update"]
    assert line == (
        f"kinetix-dist: stopped by SIGTERM after update {number}, which is saved; go on with --run {run} --resume"
    )
    assert [path.name for path in list_checkpoints(run / "checkpoints")] == [f"{number:08d}"]
    assert [row["saved"] for row in events(run, "stopped")] == [True]


@pytest.mark.slow
def test_a_run_that_was_stopped_goes_on_bit_for_bit(finished_run, tmp_path):
    config = tiny_config(num_updates=1000, checkpoint_every=1000)
    backend = LocalBackend()
    trainer = ColocatedTrainer(config, backend, [ProcessPlan(role="worker", index=0)])
    curator = CuratorClient(config, backend, [ProcessPlan(role="curator", index=0)])
    reporter = QuietReporter(lambda number: os.kill(os.getpid(), signal.SIGTERM) if number == 3 else None)
    run = RunDirectory.create(tmp_path / "run", numbered=False)
    run.write_json(run.config_path, {"config": to_dict(config)})
    before = signal.getsignal(signal.SIGTERM)  # Ray's, where tests before used it in this process
    with StopSignals() as stop:
        controller = Controller(config, run, Roles(trainer=trainer, curator=curator), reporter, stop=stop)
        controller.restore(resume=False)
        with pytest.raises(StoppedError, match="stopped by SIGTERM after update 3, which is saved"):
            controller.train()
    controller.close()
    run.close()
    assert signal.getsignal(signal.SIGTERM) == before  # put back
    total = ["--run.total_env_steps", str(NUM_UPDATES * STEPS)]
    assert main(["train", "--run", str(run.path), "--resume", *total]) == 0
    assert_same_bits(final_arrays(run.path), final_arrays(finished_run))


def test_while_it_starts_a_run_ends_at_once(tmp_path):
    run = tmp_path / "run"
    process = start(run, *TINY, *FOR_EVER)
    assert next_line(process).startswith("training ")
    status, seconds, line = _stopped(process, signal.SIGINT)
    assert (status, seconds < LIMIT_S) == (EXIT_STOPPED, True)
    assert ("stopped by SIGINT" in line and "--resume" in line) or "before the run began" in line


@pytest.mark.long
@pytest.mark.parametrize("signal_number", [signal.SIGTERM, signal.SIGINT])
def test_while_it_evaluates_a_run_ends_at_once(tmp_path, signal_number):
    """Its computation goes on behind it, at the end of Python too."""
    evaluation = ["--evaluation.sets", "random_s", "--evaluation.attempts", "1000", "--evaluation.every", "1"]
    process = start(tmp_path / "run", *TINY, *FOR_EVER, *evaluation, "--run.placement", "local")
    assert process.stderr is not None
    assert any(line.startswith("evaluating") for line in process.stderr)
    time.sleep(4.5)  # it compiles first
    status, seconds, line = _stopped(process, signal_number)
    assert (status, seconds < LIMIT_S) == (EXIT_STOPPED, True)
    assert "--resume" in line or "before the run began" in line


SWALLOWED = """
import os, signal, time
from kinetix_dist.runtime.driver.stopping import StopRequested, StopSignals
class Dying:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(0.01)
with StopSignals() as stop:
    try:
        Dying()
        time.sleep(60)
    except StopRequested:
        print("requested", stop.requested)
"""


@pytest.mark.long
def test_while_its_processes_on_ray_start_a_run_ends_at_once(tmp_path):
    """Ray's wait, in which the signal comes then, hands on an error of its own."""
    run = tmp_path / "run"
    process = start(run, *TINY, *FOR_EVER, "--run.placement", "colocated")
    wait_for(lambda: events(run, "process_started", process="worker 0"), process, "its worker")
    status, seconds, line = _stopped(process, signal.SIGTERM)
    assert (status, seconds < LIMIT_S) == (EXIT_STOPPED, True)
    assert line == f"kinetix-dist: stopped by SIGTERM outside of updates; go on with --run {run} --resume"
    assert parse(["--run", str(run), "--resume"]).run == run  # as the line says


@pytest.mark.long
@pytest.mark.parametrize(
    "reaches", [pytest.param("the process group", marks=pytest.mark.slow), "the servers of Ray as well"]
)
def test_with_processes_on_ray_a_signal_to_all_ends_the_run_in_order(tmp_path, reaches):
    """timeout(1) signals its process group: the update is saved. Slurm signals at the end of a job everything in it:
    Ray's servers end themselves then, and no process that they are to end, so an update may be lost."""
    run = tmp_path / "run"
    process = start(run, *TINY, *FOR_EVER, "--run.placement", "colocated", new_session=True)
    wait_for(lambda: len(rows(run)) >= 3, process, "three updates")
    family = psutil.Process(process.pid).children(recursive=True)
    servers = [child for child in family if child.name() in SERVERS]
    assert len(servers) == 2
    assert os.getpgid(process.pid) not in {os.getpgid(server.pid) for server in servers}
    if reaches == "the servers of Ray as well":
        for server in servers:
            server.terminate()
    status, seconds, line = _stopped(process, signal.SIGTERM, group=True)
    assert (status, seconds < LIMIT_S) == (EXIT_STOPPED, True)
    number = rows(run)[-1]["update"]
    saved = f"stopped by SIGTERM after update {number}, which is saved"
    if reaches == "the process group":
        assert line == f"kinetix-dist: {saved}; go on with --run {run} --resume"
    else:
        lost = r"stopped by SIGTERM in (an|the) update.*, which was lost \(.+\)"
        assert re.fullmatch(rf"kinetix-dist: ({saved}|{lost}); go on with --run {run} --resume", line), line
    assert psutil.wait_procs(family, timeout=LIMIT_S)[1] == []


def test_a_signal_while_an_object_is_collected_is_not_swallowed():
    """Python prints what is raised there and goes on."""
    done = subprocess.run([sys.executable, "-c", SWALLOWED], cwd=REPOSITORY, capture_output=True, timeout=PATIENCE_S)
    assert (done.stdout, done.stderr) == (b"requested SIGTERM\n", b"")


SLOW = """
import os, signal, sys, time
from kinetix_dist.runtime.driver.stopping import StopRequested, StopSignals
with StopSignals(limit_s=float(sys.argv[1])) as stop:
    with stop.deferred():
        print("updating", flush=True)
        time.sleep(60) if sys.argv[2] == "update" else None
    try:
        print("between", flush=True)
        time.sleep(60)
    except StopRequested:
        print("requested", stop.requested, flush=True)
"""


def _slow(limit_s, where):
    process = subprocess.Popen(
        [sys.executable, "-c", SLOW, str(limit_s), where],
        cwd=REPOSITORY,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    assert next_line(process) == b"updating\n"
    if where != "update":
        assert next_line(process) == b"between\n"
    return process


def test_a_second_signal_ends_at_once():
    for first, second in ((signal.SIGTERM, signal.SIGINT), (signal.SIGINT, signal.SIGTERM)):
        process = _slow(50, "update")
        process.send_signal(first)
        time.sleep(0.3)
        assert process.poll() is None  # it waits for the update
        process.send_signal(second)
        _, errors = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == 128 + second and b"second signal" in errors


def test_a_signal_sent_twice_at_the_same_time_is_one():
    """timeout(1) sends a signal to the process and to its group."""
    process = _slow(1.5, "update")
    process.send_signal(signal.SIGTERM)
    time.sleep(0.02)
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == EXIT_STOPPED and b"not done 1.5 s after SIGTERM" in errors


def test_an_update_that_does_not_end_is_given_up_and_waiting_is_left_at_once():
    process = _slow(0.5, "update")
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == EXIT_STOPPED and b"not done 0.5 s after SIGTERM" in errors
    process = _slow(50, "between")
    process.send_signal(signal.SIGTERM)
    output, _ = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, output) == (0, b"requested SIGTERM\n")


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_to_all_processes_of_a_run_on_ray(tmp_path, number):
    """Ctrl-C at a terminal reaches the whole process group, Slurm's signals whole job steps."""
    run = tmp_path / "run"
    options = [*TINY, *FOR_EVER, "--run.placement", "colocated", "--run.num_workers", "2"]
    process = start(run, *options, new_session=True)
    wait_for(lambda: len(rows(run)) >= 5, process, "five updates")
    status, seconds, line = _stopped(process, number, group=True)
    assert (status, seconds < LIMIT_S) == (EXIT_STOPPED, True), line
    checkpoint, rejected = newest_good(run / "checkpoints")
    if number == signal.SIGINT:  # Ray's processes are sessions or block it; SIGTERM may end them first
        assert checkpoint is not None and not rejected


# The Slurm script, with a scheduler that runs everything here


STUBS = {
    "scontrol": "echo node1",
    "srun": 'while [ "${1#-}" != "$1" ]; do shift; done\nexec "$@"',
    "hostname": "echo 127.0.0.1",
    "sleep": "exit 0",
}
DRIVER = """#!{python}
import pathlib, signal, sys, time
said = pathlib.Path("said")
def stop(number, frame):
    said.write_text("stopping")
    time.sleep(1.5)  # the update in progress, and its checkpoint
    said.write_text(f"saved {{' '.join(sys.argv[1:])}}")
    sys.exit(75)
signal.signal(signal.SIGTERM, stop)
said.write_text("training")
time.sleep(60)
"""


def write_script(path, text):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    path.chmod(0o755)


def test_the_slurm_script_waits_for_the_run_and_ends_with_its_status(tmp_path):
    for name, body in STUBS.items():
        write_script(tmp_path / "stubs" / name, f"#!/bin/sh\n{body}\n")
    write_script(tmp_path / ".venv" / "bin" / "ray", "#!/bin/sh\nexec tail -f /dev/null\n")
    write_script(tmp_path / ".venv" / "bin" / "kinetix-dist", DRIVER.format(python=sys.executable))
    write_script(tmp_path / ".venv" / "bin" / "python", "#!/bin/sh\nexit 0\n")  # all nodes are there
    shutil.copy(REPOSITORY / "cluster" / "slurm.sbatch", tmp_path)
    environment = {**os.environ, "PATH": f"{tmp_path / 'stubs'}:{os.environ['PATH']}"}
    environment |= {"SLURM_SUBMIT_DIR": str(tmp_path), "SLURM_JOB_ID": "7", "SLURM_JOB_NODELIST": "node1"}
    job = subprocess.Popen(
        ["bash", "slurm.sbatch", "train", "--recipe", "tiny"],
        env=environment | {"SLURM_NNODES": "1"},
        cwd=tmp_path,
        start_new_session=True,
    )
    said = tmp_path / "said"
    try:
        deadline = time.monotonic() + PATIENCE_S
        while not (said.exists() and said.read_text() == "training"):
            assert time.monotonic() < deadline and job.poll() is None
            time.sleep(0.02)
        job.send_signal(signal.SIGTERM)  # to the script alone, as --signal=B: does
        assert job.wait(timeout=PATIENCE_S) == EXIT_STOPPED
        assert said.read_text() == "saved train --recipe tiny"
    finally:
        os.killpg(job.pid, signal.SIGKILL)  # what the scheduler does with job steps that are left
