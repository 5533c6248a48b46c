"""A run under faults: processes ended at random times or at intervals. It has to end as if nothing had been.

    python -m bench.fault_tests --kills 50                                # random times, two at once now and then
    python -m bench.fault_tests --every 30 --seconds 600 --placement split

When the faults are over the run is stopped by SIGTERM and resumed for one more update, the last. The same is run
without a fault that is given adoptions.json. Exit code 1, and the record's
"wrong" says what, unless both have the same bits, every update has one row, no command wrote a traceback, and no
process, shared memory or draft of a checkpoint is left.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import os
import random
import shutil
import signal
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Generator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from bench.fault_run import FOR_EVER, OPTIONS, STEPS_PER_UPDATE, FaultError, FaultRun, machine, shared_memory
from bench.program import exit_code, output_file, parser_of, report_each
from kinetix_dist.checkpoint import load_checkpoint
from kinetix_dist.errors import UserError
from kinetix_dist.runtime.driver.stopping import EXIT_STOPPED
from kinetix_dist.telemetry.names import ROLES

# Half of the kills come some time after the one before, which is mostly within its recovery; the others come a while
# after the first update that follows it.
AFTER_KILL_S = (0.5, 25.0)
AFTER_UPDATE_S = (0.0, 2.0)
HEARTBEAT_S = 15.0  # after which a stopped process is taken for lost


class Faults:
    """The faults of one run, at random with a seed."""

    def __init__(self, run: FaultRun, seed: int) -> None:
        self.run = run
        self.choose = random.Random(seed)
        self.done: collections.Counter[str] = collections.Counter()
        self.killed: collections.Counter[str] = collections.Counter()  # by process
        self.statuses: list[int] = []  # of commands that a fault ended, as they should be and are

    def kill(self, number: int = 1) -> int:
        """SIGKILL for some processes of the run; how many there were."""
        living = self.run.living()
        chosen = self.choose.sample(sorted(living), k=min(len(living), number))
        for pid in chosen:
            _send(pid, signal.SIGKILL)
            self.killed[living[pid]] += 1
        return len(chosen)

    def kill_two(self) -> int:
        return self.kill(2)

    def stop(self) -> int:
        """SIGSTOP: the process is there and does not answer."""
        if not (living := self.run.living()):
            return 0
        pid = self.choose.choice(sorted(living))
        _send(pid, signal.SIGSTOP)
        self.killed[living[pid]] += 1
        return 1

    def damage(self) -> int:
        """A byte of the newest checkpoint is another, and a process is lost."""
        newest = self.run.newest_checkpoint()
        files = sorted(path for path in newest.rglob("*") if path.is_file()) if newest is not None else []
        if len(self.run.events("checkpoint_saved")) < 3 or not files:
            return 0  # there has to be one to fall back to
        try:
            file = max(files, key=lambda path: path.stat().st_size)
            content = bytearray(file.read_bytes())
            content[self.choose.randrange(len(content))] ^= 1  # the same one twice would mend it
            file.write_bytes(content)
        except FileNotFoundError:  # just pruned
            return 0
        return self.kill()

    def driver(self) -> int:
        """SIGKILL for the command, and the same command with --resume."""
        return self._again(signal.SIGKILL, -signal.SIGKILL)

    def term(self) -> int:
        """SIGTERM for the command, and the same command with --resume."""
        return self._again(signal.SIGTERM, EXIT_STOPPED)

    def _again(self, number: int, expected: int) -> int:
        status = self.run.end(number)
        if status != expected:
            raise FaultError(f"after {signal.Signals(number).name} the command ended with {status}, not {expected}")
        self.run.start(resume=True)
        return 1


KINDS = ("kill", "kill_two", "stop", "damage", "driver", "term")


def measure(options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """The record of one faults."""
    settings = ("--run.max_restarts", "100000", "--run.checkpoint_every", "25", "--run.keep_checkpoints", "3")
    settings += ("--recording.num_rollouts", "1", "--recording.make_pictures", "False", "--evaluation.every", "100")
    settings += ("--run.heartbeat_seconds", str(HEARTBEAT_S), "--run.stop_seconds", "120")
    run = FaultRun(folder / "run", options.placement, settings)
    shm_before, before = shared_memory(), machine()
    faults, began, wrong = Faults(run, options.seed), time.monotonic(), []
    run.start("--run.total_env_steps", FOR_EVER)
    try:
        if options.every:
            _at_intervals(faults, options)
        else:
            _at_random(faults, options.kills)
        run.wait_for_update()
        seconds = time.monotonic() - began
        status = run.end()
    except FaultError as error:
        return {"benchmark": "fault_tests", "placement": options.placement, "wrong": [str(error)]}
    finally:
        if run.is_alive:
            run.end(signal.SIGKILL)
    if status != EXIT_STOPPED:
        wrong.append(f"the run ended with {status} after SIGTERM: {run.said()[-300:]}")
    to_last = ("--run.total_env_steps", str((run.updates()[-1] + 1) * STEPS_PER_UPDATE))
    run.start(*to_last, resume=True)
    if (status := run.finished()) != 0:
        wrong.append(f"its last update ended with {status}: {run.said()[-300:]}")
    wrong += [f"a process is left: {left}" for left in run.left_processes()]
    wrong += [f"/dev/shm/{name} is left" for name in sorted(shared_memory() - shm_before)]
    wrong += [f"a draft is left: {name}" for name in run.drafts()]
    for words in ("Traceback", "(raylet)", "Unhandled error"):
        wrong += [f"the console has {words!r}"] * run.said().count(words)
    updates = run.updates()
    if updates != list(range(1, len(updates) + 1)):
        wrong.append(f"{len(updates)} rows of metrics are not updates 1 to {len(updates)}")
    wrong += _compared(run, folder / "whole", len(updates), (*settings, *to_last))
    losses = run.events("process_lost")
    return {
        "benchmark": "fault_tests",
        "placement": options.placement,
        "seed": options.seed,
        "faults": dict(faults.done),
        "processes": dict(faults.killed),
        "seconds": round(seconds, 1),
        "cpu_seconds": round(run.cpu_seconds, 1),
        "updates": len(updates),
        "losses": len(losses),
        "losses_by_section": dict(collections.Counter(row["section"] for row in losses)),
        "recovery_seconds": _recoveries(run),
        "late_buffers": len(run.events("buffer_late")),
        "rejected_checkpoints": len(run.events("checkpoint_rejected")),
        "resumed": len(run.events("run_started")) - 1,
        "before": before,
        "after": machine(),
        "wrong": wrong,
    }


def _at_random(faults: Faults, number: int) -> None:
    run = faults.run
    while faults.killed.total() < number:
        if faults.choose.random() < 0.5:
            _sleep(run, faults.choose.uniform(*AFTER_KILL_S))
        else:
            run.wait_for_update()
            _sleep(run, faults.choose.uniform(*AFTER_UPDATE_S))
        found = faults.kill(min(faults.choose.choice([1, 1, 2]), number - faults.killed.total()))
        faults.done["kill_two" if found == 2 else "kill"] += found > 0
        _report(faults)


def _at_intervals(faults: Faults, options: argparse.Namespace) -> None:
    """Kinds take turns in a random order, so that each comes as often."""
    faults.run.wait_for_update()
    end, kinds = time.monotonic() + options.seconds, []
    while time.monotonic() < end:
        began = time.monotonic()
        kinds = kinds or faults.choose.sample(options.kinds, k=len(options.kinds))
        calls: Mapping[str, Callable[[], int]] = {kind: getattr(faults, kind) for kind in KINDS}
        kind = kinds.pop()
        faults.done[kind] += calls[kind]() > 0
        _report(faults)
        _sleep(faults.run, max(began + options.every - time.monotonic(), 0.0))


def _report(faults: Faults) -> None:
    print(f"{time.strftime('%H:%M:%S')} {dict(faults.done)}", file=sys.stderr, flush=True)


def _sleep(run: FaultRun, seconds: float) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if not run.is_alive:
            raise FaultError(f"the command ended ({run.driver.returncode}): {run.said()[-500:]}")
        time.sleep(0.05)


def _compared(run: FaultRun, path: Path, num_updates: int, settings: tuple[str, ...]) -> list[str]:
    """Differences from a run without faults to the same update."""
    path.mkdir()
    shutil.copy(run.path / "adoptions.json", path)
    whole = FaultRun(path, run.placement, settings)
    whole.start()
    if (status := whole.finished()) != 0:
        return [f"the run without faults ended with {status}: {whole.said()[-300:]}"]
    wrong = [f"the run without faults lost {row['process']}" for row in whole.events("process_lost")]
    if (path / "adoptions.json").read_bytes() != (run.path / "adoptions.json").read_bytes():
        wrong.append("adoptions.json differs")
    arrays = [_arrays(path, num_updates) for path in (run.path, path)]
    if arrays[0].keys() != arrays[1].keys():
        wrong.append(f"other arrays: {sorted(arrays[0].keys() ^ arrays[1].keys())}")
    differ = [name for name, array in arrays[0].items() if not _same_bits(array, arrays[1].get(name))]
    return wrong + ([f"{len(differ)} arrays have other bits: {differ[:3]}"] if differ else [])


def _arrays(path: Path, num_updates: int) -> dict[str, np.ndarray]:
    return load_checkpoint(path / "checkpoints" / f"{num_updates:08d}").arrays


def _same_bits(ours: np.ndarray, theirs: np.ndarray | None) -> bool:
    return theirs is not None and ours.dtype == theirs.dtype and ours.tobytes() == theirs.tobytes()


def _recoveries(run: FaultRun) -> dict[str, dict[str, float]]:
    """Recoveries by role: from a loss to the first new result, other losses in between included."""
    found = {role: [row["seconds"] for row in run.events("recovered", role=role)] for role in ROLES}
    return {
        role: {"number": len(seconds), "median": round(statistics.median(seconds), 1), "max": round(max(seconds), 1)}
        for role, seconds in found.items()
        if seconds
    }


def _send(pid: int, number: int) -> None:
    with contextlib.suppress(ProcessLookupError):  # it ended by itself just now
        os.kill(pid, number)


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--placement", nargs="+", choices=sorted(OPTIONS), default=["colocated"])
    parser.add_argument("--kills", type=int, default=50, help="SIGKILLs at random times")
    parser.add_argument("--every", type=float, default=0.0, help="seconds between faults; 0: --kills instead")
    parser.add_argument("--seconds", type=float, default=600.0, help="for which faults come, with --every")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS), help="of faults, with --every")
    parser.add_argument("--seed", type=int, default=11)
    parser.add_argument("--json", type=output_file)
    arguments = parser.parse_args()
    return exit_code(parser, lambda: run(arguments))


def run(options: argparse.Namespace) -> int:
    if options.kills < 1 or options.every < 0 or options.seconds <= 0:
        raise UserError("give --kills 1 or more, --every 0 or more and --seconds above 0")
    failed = []

    def records() -> Generator[dict[str, Any]]:
        for placement in options.placement:
            folder = Path(tempfile.mkdtemp(prefix="kinetix-faults-"))
            record = measure(argparse.Namespace(**vars(options) | {"placement": placement}), folder)
            if record["wrong"]:
                failed.append(folder)
                record["kept"] = str(folder)
            else:
                shutil.rmtree(folder)
            yield record

    report_each(records(), options.json)
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
