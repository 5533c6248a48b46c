"""Smoke run of a machine: trains a run on Ray, resumes, evaluates and measures training, each by a user's command.

    python -m bench.smoke --json runs/smoke.json                                 # recipe tiny, on the CPU
    python -m bench.smoke --device gpu --json runs/smoke.json                    # recipe sfl_s, one process a GPU
    python -m bench.smoke --device gpu --options run.gpu_memory_gib=40 curriculum.refresh_every=2
    python -m bench.smoke --device gpu --measured pretrain_m                     # `bench train` of this recipe only

Curator and evaluator work beside training, as by default. `bench train` runs on Ray too, for each recipe of --measured
(GPUs: pretrain_m and pretrain_l). Each command gives a record: exit code, seconds, seconds from its start until the
metrics of its first update were written, and the seconds of training in these (`warmup_seconds`: the rest is imports,
processes and checkpoint), seconds of compiling, environment steps a second of later updates (median). `bench train`
adds `unmeasured_seconds`, between its first update, which compiles, and the measured ones.

The exit code is 1 if a command fails or leaves out its result: a row of every update, with finite values (except means
over no episode and errors over one level), a solve rate, a measured speed. A table with the last words of each failed
command ends the output.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
import os
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil

from bench.fault_run import python_path
from bench.program import exit_code, output_file, parser_of, report_each
from kinetix_dist.child_python import command_of
from kinetix_dist.config import ConfigError
from kinetix_dist.errors import UserError
from kinetix_dist.recipes import recipe
from kinetix_dist.telemetry.json_lines import read_lines

RECIPES = {"cpu": "tiny", "gpu": "sfl_s"}
MEASURED = {"cpu": ("tiny",), "gpu": ("pretrain_m", "pretrain_l")}
MEASURED_UPDATES = 6  # of `bench train`, which measures all but two
UNMEASURED_S = 60.0  # from the end of compiling until `bench train` measures
OPTIONS = ("--run.checkpoint_every", "2", "--evaluation.sets", "random_s", "--recording.make_pictures", "False")
ATTEMPTS = 4
LAST_WORDS = 2000  # characters kept of a command that failed
LOOK_EVERY_S = 0.05
# Rates of a size or source of levels that an update need not play, and an error that needs two levels.
MAY_BE_MISSING = ("train/solve_rate_", "curriculum/learnability_now_error")
GRACE_S = 40.0  # for a run to save and end after SIGTERM
OWN_OPTIONS = ("rollout.", "phases", "run.total_env_steps", "run.device", "run.placement")  # smoke sets these


@dataclasses.dataclass
class Smoke:
    """One run directory, and the commands that work on it, one after the other."""

    folder: Path
    args: argparse.Namespace

    @property
    def run(self) -> Path:
        return self.folder / "run"

    def records(self) -> Iterator[dict[str, Any]]:
        steps = recipe(self.args.recipe).rollout.steps_per_update * self.args.updates
        options = [part for option in self.args.options for part in f"--{option}".split("=", 1)]
        new = ["--recipe", self.args.recipe, "--run.device", self.args.device, "--run.placement", "colocated"]
        train = ["train", "--run", str(self.run)]
        yield self._train("train", [*train, *new, *OPTIONS, *options, "--run.total_env_steps", str(steps)], 1)
        yield self._train("resume", [*train, "--resume", "--run.total_env_steps", str(2 * steps)], 2)
        yield self._evaluate()
        for name in self.args.measured:
            yield self._measure(name)

    def _train(self, name: str, arguments: list[str], times: int) -> dict[str, Any]:
        before = len(self._rows())
        record = self._command(name, arguments, num_rows=before)
        rows = self._rows()
        record["env_steps_per_second"] = _median(row["progress/env_steps_per_second"] for row in rows[before + 1 :])
        record["compile_seconds"] = rows[-1].get("runtime/compile_seconds") if rows else None
        warmup = [0.0, *(row["progress/warmup_seconds"] for row in rows)]  # of all sessions so far
        record["warmup_seconds"] = round(warmup[-1] - warmup[min(before, len(rows))], 2)
        expected = list(range(1, times * self.args.updates + 1))
        if (found := [row["update"] for row in rows]) != expected:
            record["wrong"].append(f"metrics are of updates {found}, {expected[0]} to {expected[-1]} were to be made")
        for row in rows:  # a file of metrics has null for a number that is not finite
            nulls = [key for key in row if row[key] is None and not key.startswith(MAY_BE_MISSING)]
            record["wrong"] += [f"{key} of update {row['update']} is not finite" for key in nulls]
        return record

    def _evaluate(self) -> dict[str, Any]:
        file = self.folder / "eval.json"
        arguments = ["--run", str(self.run), "--levels", self.args.levels, "--attempts", str(ATTEMPTS)]
        record = self._command("eval", ["eval", *arguments, "--json", str(file)])
        record["solve_rate"] = json.loads(file.read_text())["solve_rate"]["trained"]["rate"] if file.exists() else None
        if record["solve_rate"] is None:
            record["wrong"].append("there is no solve rate")
        return record

    def _measure(self, name: str) -> dict[str, Any]:
        """The record of `bench train` of a recipe."""
        file = self.folder / f"bench-{name}.json"
        options = ["--recipe", name, "--device", self.args.device, "--placement", "colocated"]
        arguments = ["bench", "train", *options, "--updates", str(MEASURED_UPDATES), "--json", str(file)]
        record = self._command(f"bench {name}", arguments) | {"recipe": name}
        measured = json.loads(file.read_text() or "[]") if file.exists() else []
        if not measured:
            record["wrong"].append("no speed was measured")
            return record
        (found,) = measured
        record |= {name: found[name] for name in ("env_steps_per_second", "compile_seconds", "unmeasured_seconds")}
        record["warmup_seconds"] = found["first_update_seconds"]
        if (seconds := found["unmeasured_seconds"]) > UNMEASURED_S:
            record["wrong"].append(f"it measured {seconds:.0f} s after compiling; the limit is {UNMEASURED_S:.0f} s")
        return record

    def _command(self, name: str, arguments: list[str], num_rows: int | None = None) -> dict[str, Any]:
        """Return the record of a command, with the time of the first row of metrics after `num_rows`, if given."""
        command = command_of("kinetix_dist.cli.main", *arguments)
        began, first = time.monotonic(), None
        with (self.folder / f"{name.replace(' ', '-')}.log").open("w+") as said:
            process = subprocess.Popen(
                command,
                env=os.environ | {"PYTHONPATH": python_path()},
                stdin=subprocess.DEVNULL,
                stdout=said,
                stderr=subprocess.STDOUT,
            )
            try:
                while process.poll() is None and time.monotonic() - began < self.args.seconds:
                    if num_rows is not None and first is None and len(self._rows()) > num_rows:
                        first = round(time.monotonic() - began, 2)
                    time.sleep(LOOK_EVERY_S)
            finally:
                was_ended = _end(process)
            said.seek(0)
            words = said.read()
        seconds = round(time.monotonic() - began, 1)
        wrong = []
        if was_ended:
            wrong.append(f"it took more than {self.args.seconds:g} s and was ended")
        elif process.returncode:
            wrong.append(f"exit code {process.returncode}: {words[-LAST_WORDS:]}")
        return {
            "command": name,
            "recipe": self.args.recipe,
            "device": self.args.device,
            "exit_code": process.returncode,
            "seconds": seconds,
            "first_update_seconds": first,
            "wrong": wrong,
        }

    def _rows(self) -> list[dict[str, Any]]:
        return read_lines(self.run / "metrics" / "metrics.jsonl").rows


def _end(process: subprocess.Popen[Any]) -> bool:
    """End a command that still runs, with its processes. Return False if it had ended before."""
    if process.poll() is not None:
        return False
    started = psutil.Process(process.pid).children(recursive=True)
    process.terminate()  # `train` saves, and ends its processes
    try:
        process.wait(GRACE_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    for child in started:
        with contextlib.suppress(psutil.NoSuchProcess):
            child.kill()
    psutil.wait_procs(started, timeout=GRACE_S)
    return True


def _median(values: Iterator[float]) -> float | None:
    found = list(values)
    return round(statistics.median(found)) if found else None


def main() -> int:
    parser = parser_of(__doc__, "python -m bench.smoke")
    parser.add_argument("--device", choices=tuple(RECIPES), default="cpu")
    parser.add_argument("--recipe", help=f"default: {RECIPES['cpu']} on a CPU, {RECIPES['gpu']} on GPUs")
    parser.add_argument("--updates", type=int, default=4, help="of each of the two trainings")
    parser.add_argument("--levels", default="designed_s", help="that are evaluated at the end")
    parser.add_argument(
        "--measured", nargs="*", metavar="RECIPE", help="of bench train; default: tiny, on GPUs pretrain_m pretrain_l"
    )
    parser.add_argument("--options", nargs="*", default=[], metavar="NAME=VALUE", help="of train, without the dashes")
    parser.add_argument("--seconds", type=float, default=600.0, help="for each command")
    parser.add_argument("--keep", type=Path, help="a new directory for run and logs, which are thrown away otherwise")
    parser.add_argument("--json", type=output_file, help="a file for the records")
    args = parser.parse_args()
    args.recipe = args.recipe or RECIPES[args.device]
    args.measured = MEASURED[args.device] if args.measured is None else args.measured
    return exit_code(parser, lambda: _smoke(args))


def _smoke(args: argparse.Namespace) -> int:
    if args.updates < 2:
        raise UserError(f"--updates is {args.updates}; the first one is not timed, so give 2 or more")
    if args.keep is not None and args.keep.exists():
        raise UserError(f"{args.keep} exists; name a new directory")
    try:
        for name in (args.recipe, *args.measured):
            recipe(name)
    except ConfigError as error:
        raise UserError(str(error)) from None
    for option in args.options:
        if "=" not in option or option.startswith(OWN_OPTIONS):
            raise UserError(f"--options has {option!r}; give NAME=VALUE, none of {', '.join(OWN_OPTIONS)}")
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that commands are ended with this one
    folder = args.keep or Path(tempfile.mkdtemp(prefix="kinetix-smoke-"))
    folder.mkdir(parents=True, exist_ok=True)
    try:
        return _show(args, folder)
    finally:
        if args.keep is None:
            shutil.rmtree(folder)


def _show(args: argparse.Namespace, folder: Path) -> int:
    records = Smoke(folder, args).records()
    found = report_each(records, args.json, text=lambda record: f"{record['command']}: {record['seconds']} s")
    print(f"\n{'command':<16} {'exit':>4} {'seconds':>8} {'first update':>13} {'its own':>8} {'env steps/s':>12}")
    for record in found:
        rate = record.get("env_steps_per_second") or ""
        first = record["first_update_seconds"] or ""
        its_own = record.get("warmup_seconds") or ""
        start = f"{record['command']:<16} {record['exit_code']:>4} {record['seconds']:>8}"
        print(f"{start} {first:>13} {its_own:>8} {rate:>12}")
    wrong = [f"{record['command']}: {what}" for record in found for what in record["wrong"]]
    print("\n".join(wrong) if wrong else "all as it is to be")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
