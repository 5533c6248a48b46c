"""Seconds from the end of a process to the first new update, seen from outside of the run.

    python -m bench.recovery --losses worker rollout driver --repeats 3 --json runs/recovery.json
    python -m bench.recovery --device gpu --losses curator worker driver --repeats 2 --recipe sfl_s --settled 6

SIGKILL for the curator (until its first new buffer), for a worker (colocated), for a rollout actor (split), or for the
command, which is started again with --resume. On a CPU there are two workers, or two learners and two rollout actors;
on GPUs one process a GPU. Each record has wall seconds, the seconds of the
run's own event, CPU seconds of all processes of the run in that time, and the load of the machine: on a machine that
others use, CPU seconds divided by the cores are what it would take alone.

The last record of a placement says whether programs were found in the cache (compile seconds of every process, by
start: the first is cold where the cache was; files that came to the cache after the first start), what the GPUs held
before, while and after the run, and what is left of it. Exit code 1 where something is, or where a recovery did not
come; a table of all comes last.
"""

from __future__ import annotations

import argparse
import itertools
import os
import shutil
import signal
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Generator
from pathlib import Path
from typing import Any

from bench.fault_run import (
    FOR_EVER,
    GONE_S,
    FaultError,
    FaultRun,
    gpu_memory_mib,
    machine,
    shared_memory,
)
from bench.program import exit_code, output_file, parser_of, report_each
from kinetix_dist.errors import UserError
from kinetix_dist.program_cache import default_directory
from kinetix_dist.recipes import recipe
from kinetix_dist.telemetry.json_lines import read_lines

PLACEMENTS = {"curator": "colocated", "worker": "colocated", "driver": "colocated", "rollout": "split"}
OPTIONS = ("--run.max_restarts", "1000", "--run.checkpoint_every", "5", "--recording.num_rollouts", "0")
REFRESH_EVERY = 8  # updates, at most: a new curator is back with its first buffer
NOTICEABLE_MIB = 64  # a GPU's memory in use wavers by less


def measure(options: argparse.Namespace) -> Generator[dict[str, Any]]:
    """A record a loss, and one of what is left of each run."""
    ends_at = time.monotonic() + options.seconds
    options_of_run = [part for option in options.options for part in f"--{option}".split("=", 1)]
    for placement, losses in itertools.groupby(sorted(options.losses, key=_order), key=PLACEMENTS.__getitem__):
        folder = Path(tempfile.mkdtemp(prefix="kinetix-recovery-"))
        settings = (*OPTIONS, "--curriculum.refresh_every", str(refresh_every(options.recipe)), *options_of_run)
        run = FaultRun(folder / "run", placement, settings, options.device, options.recipe, ends_at)
        for record in _losses_of(run, list(losses), options):
            if is_kept := bool(record.get("wrong")):
                record["kept"] = str(folder)
            yield record
        if not is_kept:
            shutil.rmtree(folder)


def _losses_of(run: FaultRun, losses: list[str], options: argparse.Namespace) -> Generator[dict[str, Any]]:
    about = {"benchmark": "recovery", "placement": run.placement, "recipe": run.recipe, "device": run.device}
    memory, shared = {"before": gpu_memory_mib()}, shared_memory()
    after_start, killed, wrong = _cache_files(), [], []
    run.start("--run.total_env_steps", FOR_EVER)
    began = time.monotonic()
    try:
        run.wait(lambda: bool(run.updates()), "the first update")
        yield about | {"lost": "nothing, the first start", "seconds": round(time.monotonic() - began, 2)}
        for lost, _ in itertools.product(losses, range(options.repeats)):
            _settle(run, options.settled)
            if len(memory) == 1:
                after_start, memory["while"] = _cache_files(), gpu_memory_mib()
            killed += [lost] if lost != "driver" else []
            yield about | _recovery(run, lost)
        _settle(run, options.settled)
    except FaultError as error:
        wrong.append(str(error))
    finally:
        run.end(signal.SIGKILL)
        wrong += [f"a process is left: {left}" for left in run.left_processes()]
        memory["after"] = _memory_once_given_back(memory["before"])
    if len(lost := run.events("process_lost")) > len(killed):
        wrong.append(f"{len(lost)} processes were lost, of which {len(killed)} were killed: {lost[-1]['error']}")
    wrong += [f"/dev/shm/{name} is left" for name in sorted(shared_memory() - shared)]
    wrong += [
        f"GPU {gpu} has {now} MiB in use, and had {before}"
        for gpu, (before, now) in enumerate(zip(memory["before"], memory["after"], strict=True))
        if now > before + NOTICEABLE_MIB
    ]
    yield about | {
        "lost": "nothing, the end",
        "compile_seconds": _compile_seconds(run),
        "new_cache_files": sorted(_cache_files() - after_start),
        "gpu_memory_mib": memory,
        "wrong": wrong,
    }


def refresh_every(name: str) -> int:
    """Updates between refreshes of the curriculum in a run of this recipe here."""
    return min(recipe(name).curriculum.refresh_every, REFRESH_EVERY)


def _order(lost: str) -> tuple[str, int]:
    """Order by placement, the curator first: a process reports when another was started again."""
    return PLACEMENTS[lost], list(PLACEMENTS).index(lost)


def _settle(run: FaultRun, num_updates: int) -> None:
    """Until what compiles has compiled."""
    last = max(run.updates(), default=0)
    run.wait(lambda: max(run.updates(), default=0) >= last + num_updates, f"{num_updates} updates")


def _recovery(run: FaultRun, lost: str) -> dict[str, Any]:
    before, reached = machine(), max(run.updates())
    num_started, num_recovered = len(run.events("process_started")), len(run.events("recovered", role=lost))
    cpu, began = run.cpu_now(), time.monotonic()
    if lost == "driver":
        run.end(signal.SIGKILL)
        run.start(resume=True)
    else:
        os.kill(max(pid for pid, name in run.living().items() if name.startswith(lost)), signal.SIGKILL)
    if lost == "curator":
        run.wait(lambda: len(run.events("recovered", role=lost)) > num_recovered, "a buffer")
    else:
        run.wait(lambda: len(run.events("process_started")) > num_started and run.wait_for_update() > 0, "a new update")
    seconds = time.monotonic() - began
    recovered = run.events("recovered", role=lost)[num_recovered:]
    return {
        "lost": lost,
        "at_update": reached,
        "seconds": round(seconds, 2),
        "event_seconds": recovered[-1]["seconds"] if recovered else None,  # by the run's event
        "cpu_seconds": round(run.cpu_now() - cpu, 2),
        **before,
    }


def _compile_seconds(run: FaultRun) -> dict[str, list[float]]:
    """Compile seconds of every start of each process, in order."""
    found: dict[str, dict[int, float]] = defaultdict(dict)
    for line in read_lines(run.path / "processes.jsonl").rows:
        for process in line["processes"]:
            found[process["name"]][process["pid"]] = round(process["compile_seconds"], 1)
    return {name: list(seconds.values()) for name, seconds in found.items() if name != "driver"}


def _cache_files() -> set[str]:
    """Programs that JAX keeps on disk."""
    directory = Path(os.environ.get("JAX_COMPILATION_CACHE_DIR") or default_directory())
    return {path.name for path in directory.iterdir() if path.name.endswith("-cache")} if directory.is_dir() else set()


def _memory_once_given_back(before: list[int]) -> list[int]:
    """Memory of GPUs when they are back at that, or GONE_S later."""
    deadline = time.monotonic() + GONE_S
    while True:
        found = gpu_memory_mib()
        is_back = all(now <= then + NOTICEABLE_MIB for now, then in zip(found, before, strict=True))
        if is_back or time.monotonic() > deadline:
            return found
        time.sleep(0.2)


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--losses", nargs="+", choices=list(PLACEMENTS), default=["worker", "rollout", "driver"])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--device", choices=("cpu", "gpu"), default="cpu")
    parser.add_argument("--recipe", default="tiny")
    parser.add_argument(
        "--options", nargs="+", default=[], metavar="NAME=VALUE", help="of the run: run.limits.start=60"
    )
    parser.add_argument("--settled", type=int, default=20, help="updates before each loss, until all has compiled")
    parser.add_argument("--seconds", type=float, default=3600.0, help="after which nothing is waited for any more")
    parser.add_argument("--json", type=output_file)
    arguments = parser.parse_args()
    return exit_code(parser, lambda: run(arguments))


def run(options: argparse.Namespace) -> int:
    if options.repeats < 1 or options.settled < 1 or options.seconds <= 0:
        raise UserError("give --repeats 1 or more, --settled 1 or more and --seconds above 0")
    records = report_each(measure(options), options.json)
    print(table(records), flush=True)
    return int(any(record.get("wrong") for record in records))


def table(records: list[dict[str, Any]]) -> str:
    """Table of all losses, and what each run left."""
    lines = [f"{'placement':10} {'lost':26} {'wall s':>8} {'event s':>8} {'CPU s':>8}"]
    for record in records:
        if "seconds" in record:
            figures = [record.get(name) for name in ("seconds", "event_seconds", "cpu_seconds")]
            cells = " ".join(f"{'' if figure is None else format(figure, '.1f'):>8}" for figure in figures)
            lines.append(f"{record['placement']:10} {record['lost']:26} {cells}")
        else:
            lines.append(f"compile seconds by start: {record['compile_seconds']}")
            lines.append(f"programs that came to the cache after the first start: {len(record['new_cache_files'])}")
            lines.append(f"MiB of the GPUs: {record['gpu_memory_mib']}")
            lines += [f"WRONG: {what}" for what in record["wrong"]] or ["nothing left, nothing wrong"]
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
