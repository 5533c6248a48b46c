"""Teaching a level: training on it, or a search for a solution, in the background, and the files that come out.

    Teaching.begin(kind, document, seconds) -> check -> command(s) -> state "done", "failed" or "cancelled"

What computes are the commands that a person would type, one after another in a child process:

    teach   kinetix-dist levels solve FILE --seconds N                                            its proof
            kinetix-dist finetune --recipe teach --from generalist --levels FILE --run DIR --run.max_seconds N
                --run.imitation_steps 150 --run.stop_at 0.5              imitates it, trains on below half
    solve   kinetix-dist levels solve FILE --seconds N

Where the search of `teach` finds nothing it trains on the level alone, says so, and then

            kinetix-dist levels solve FILE --method policy --checkpoint DIR/checkpoints/...

FILE is NAME-TIME.json in the directory of results, DIR is NAME-TIME and the proof NAME-TIME.proof.json next to it. All
are new: nothing is overwritten. How far training is comes from the files of its run.
"""

from __future__ import annotations

import asyncio
import dataclasses
import re
import shlex
import shutil
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

from kinetix_dist.errors import one_line
from kinetix_dist.evaluation.intervals import difference_interval
from kinetix_dist.json_text import json_text
from kinetix_dist.level.proof import proof_path, read_proof
from kinetix_dist.level.structure import LevelFormatError
from kinetix_dist.studio.runs import run_files
from kinetix_dist.studio.runs.evaluations import evaluations
from kinetix_dist.studio.runs.run_files import RunFileError, last_row
from kinetix_dist.studio.server.background_command import PROGRAM, BackgroundCommand
from kinetix_dist.studio.server.run_service import RunService
from kinetix_dist.studio.server.worker_client import WorkerClient
from kinetix_dist.telemetry.sinks.jsonl import is_metrics_row
from kinetix_dist.telemetry.status import StatusError, read_status

TEACH, SOLVE = KINDS = ("teach", "solve")
SECONDS = (60, 120, 300)  # that a person may choose
POLICY = "generalist"  # that training starts from
RECIPE = "teach"
IMITATION_STEPS = 150  # gradient steps, 0.2 CPU seconds each
PROOF_SECONDS = 20  # for a proof by the trained policy, which has solved the level before
STAGES = ("imitating", "compiling", "training")  # of training, phases of its run (status.json)
SOLVED_ALREADY = 0.95  # share of attempts of the untrained policy from which on there is nothing to teach
MIN_LEARNED = 0.5  # share of attempts below which a level counts as partly learned at most
METHODS = {"random": "random actions", "cem": "the cross-entropy method", "best_first": "best-first search"}
POLL_SECONDS = 1.0
NOT_SOLVED = "not solved in"  # in the line of `levels solve` about a search that found nothing
MAX_NAME = 40

Start = Callable[[list[str]], Awaitable[BackgroundCommand]]


class TeachingError(Exception):
    """A request that is refused, in one line."""


class BusyError(TeachingError):
    """Another level is taught or searched now."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Files:
    """Files of one result."""

    level: Path
    run: Path

    @property
    def proof(self) -> Path:
        return proof_path(self.level)


@dataclasses.dataclass(kw_only=True)
class Job:
    """One level that is taught or searched, and what came of it. Rates are {solved, attempts, rate, low, high}."""

    number: int
    kind: str
    seconds: int  # requested
    document: dict[str, Any]
    files: Files
    state: str = "running"  # then "done", "failed" or "cancelled"
    stage: str = "checking"  # "searching", "trying", then those of STAGES, "evaluating", "proving"
    began: float = dataclasses.field(default_factory=time.time)
    ended: float | None = None
    command: str = ""  # as typed in a terminal
    progress: dict[str, Any] = dataclasses.field(default_factory=dict)
    text: str = ""  # the result, or the reason, in one line
    advice: str = ""
    before: dict[str, Any] | None = None
    after: dict[str, Any] | None = None
    solves_already: bool = False  # the policy that training would start from
    learned: bool = False  # by more than chance
    proof: dict[str, Any] | None = None  # {steps, method, robustness, actions}
    run: str | None = None  # name of its run in addresses

    @property
    def is_over(self) -> bool:
        return self.state != "running"

    def as_json(self) -> dict[str, Any]:
        fields = {field.name: getattr(self, field.name) for field in dataclasses.fields(self) if field.name != "files"}
        files = {"level": self.files.level, "run": self.files.run, "proof": self.files.proof}
        end = self.ended or time.time()
        return fields | {
            "elapsed": round(end - self.began, 1),
            "files": {name: str(path.resolve()) for name, path in files.items() if path.exists()},
        }


class Teaching:
    """The one job of a server at a time. All methods are called in the event loop."""

    def __init__(
        self, results: Path, worker: WorkerClient, service: RunService, *, start: Start = BackgroundCommand.start
    ) -> None:
        """results: directory that gets the files, made when it is needed. start: of commands, another one for tests."""
        self.results = results
        self.job: Job | None = None
        self._worker = worker
        self._service = service
        self._start = start
        self._task: asyncio.Task[None] | None = None
        self._command: BackgroundCommand | None = None

    async def begin(self, kind: str, document: dict[str, Any], seconds: int) -> Job:
        """Begins a job. Raises TeachingError for a level that cannot be taught, BusyError while another one runs,
        WorkerError without an engine, and OSError where nothing can be written."""
        if kind not in KINDS or seconds not in SECONDS:
            raise TeachingError(f"give kind {' or '.join(KINDS)}, and seconds {', '.join(map(str, SECONDS))}")
        self._refuse_while_busy()
        await self._check(kind, document)
        self._refuse_while_busy()  # another page may have been quicker
        number = self.job.number + 1 if self.job is not None else 1
        self.job = Job(number=number, kind=kind, seconds=seconds, document=document, files=self._claim(document))
        self._task = asyncio.create_task(self._work(self.job))
        return self.job

    async def cancel(self) -> None:
        """Ends the job. What is not complete by then is removed."""
        if self._task is not None and not self._task.done():
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)

    def _refuse_while_busy(self) -> None:
        if self.job is not None and not self.job.is_over:
            what = "taught" if self.job.kind == TEACH else "searched"
            raise BusyError(f"level {self.job.document.get('name')!r} is being {what} now; wait for it, or cancel it")

    async def _check(self, kind: str, document: dict[str, Any]) -> None:
        checked = (await self._worker.request("check", {"document": document, "play": True})).content
        if checked["problems"]:
            first = checked["problems"][0]
            raise TeachingError(f"the level has {checked['num_problems']} problems; {first['path']} {first['problem']}")
        if (step := checked["facts"]["noop_solved_at"]) is not None:
            raise TeachingError(
                f"the level solves itself: without any action green reaches blue after {step} steps; move one of them"
            )
        if any(warning["kind"] == "uncontrollable" for warning in checked["warnings"]):
            raise TeachingError("no action moves anything in the level; add a motor with a speed, or a thruster")
        if kind == TEACH and POLICY not in (await self._worker.hello())["pretrained"]:
            raise TeachingError(
                f"the policy {POLICY!r} is not installed, which training starts from; use `solve it`, which needs none"
            )

    def _claim(self, document: dict[str, Any]) -> Files:
        """New files, of which the level is written. Raises OSError."""
        self.results.mkdir(parents=True, exist_ok=True)
        self._service.add(self.results)
        base = f"{file_name(document)}-{time.strftime('%Y%m%d-%H%M%S')}"
        number = 1
        while True:
            name = base if number == 1 else f"{base}-{number}"
            files = Files(level=self.results / f"{name}.json", run=self.results / name)
            if not files.run.exists() and not files.proof.exists():
                try:
                    with files.level.open("x", encoding="utf-8") as file:
                        file.write(json_text(document, indent=1) + "\n")
                    return files
                except FileExistsError:
                    pass
                except OSError:
                    files.level.unlink(missing_ok=True)
                    raise
            number += 1

    async def _work(self, job: Job) -> None:
        try:
            if job.kind == TEACH:
                await self._teach(job)
            else:
                await self._search(job)
            job.state = "done"
        except asyncio.CancelledError:
            await self._end_command()
            job.state = "done" if job.after is not None else "cancelled"
            job.text = (
                f"{job.text}; cancelled before a proof was found" if job.after else "cancelled; nothing was stored"
            )
        except (TeachingError, RunFileError, LevelFormatError, OSError) as error:
            await self._end_command()
            job.state, job.text = "failed", one_line(error)
        except BaseException:
            job.state, job.text = "failed", "a bug in the server; its console has the traceback"
            raise
        finally:
            job.ended = time.time()
            if job.state != "done":
                await asyncio.to_thread(_remove, job.files)
            elif job.proof is None:
                job.files.proof.unlink(missing_ok=True)  # one that was not complete

    async def _teach(self, job: Job) -> None:
        await self._prove(job, [], job.seconds, "searching")
        await self._train(job)
        if not job.solves_already:
            job.run = await self._service.id_of(job.files.run)
        _judge(job)
        if job.proof is None and job.after and job.after["solved"]:
            checkpoint = POLICY if job.solves_already else str(_newest_checkpoint(job.files.run))
            await self._prove(job, ["--method", "policy", "--checkpoint", checkpoint], PROOF_SECONDS, "proving")

    async def _train(self, job: Job) -> None:
        files = job.files
        imitates: list[str] = []
        if job.proof is not None:  # PPO can lose what a nearly deterministic policy has: only where imitation failed
            imitates = ["--run.imitation_steps", str(IMITATION_STEPS), "--run.stop_at", str(MIN_LEARNED)]
        await self._begin_command(
            job, "trying",
            ["finetune", "--recipe", RECIPE, "--from", POLICY, "--levels", str(files.level), "--run", str(files.run),
             "--run.max_seconds", str(job.seconds), *imitates],
        )  # fmt: skip
        assert self._command is not None
        ending = asyncio.ensure_future(self._command.wait())
        try:
            while not ending.done():
                await asyncio.wait([ending], timeout=POLL_SECONDS)
                await asyncio.to_thread(_read_progress, job)
                if job.before is not None and job.before["rate"] >= SOLVED_ALREADY and not ending.done():
                    job.solves_already = True
                    await self._command.end()
        finally:
            ending.cancel()
        if job.solves_already:
            await asyncio.to_thread(shutil.rmtree, files.run, True)
            job.after = job.before
            return
        self._refuse_failure(ending.result())
        await asyncio.to_thread(_read_rates, job)
        if job.after is None:
            raise TeachingError("training ended without an evaluation; its console has more")

    async def _search(self, job: Job) -> None:
        await self._prove(job, [], job.seconds, "searching")
        if job.proof is None:
            assert self._command is not None
            line = next(line for line in self._command.lines if NOT_SOLVED in line)
            job.text = line[line.index(NOT_SOLVED) :]
            job.advice = (
                "Try: a longer search; the goal nearer, or a stronger motor; `teach it`, which learns from attempts "
                "that came near."
            )
        else:
            job.text = f"solved in {job.proof['steps']} steps by {METHODS[job.proof['method']]}"

    async def _prove(self, job: Job, options: list[str], seconds: int, stage: str) -> None:
        """Searches for a proof, which the command replays before it writes it."""
        words = ["levels", "solve", str(job.files.level), "--seconds", str(seconds), *options]
        await self._begin_command(job, stage, words)
        assert self._command is not None
        status = await self._command.wait()
        if not job.files.proof.is_file():
            if status == 1 and any(NOT_SOLVED in line for line in self._command.lines):
                return  # a search that ended without a solution
            self._refuse_failure(status or 1)
        proof = await asyncio.to_thread(read_proof, job.files.proof)
        job.proof = {
            "steps": proof.num_steps,
            "method": proof.method,
            "robustness": proof.robustness,
            "actions": proof.actions.tolist(),
        }

    async def _begin_command(self, job: Job, stage: str, words: list[str]) -> None:
        line = shlex.join([PROGRAM, *words])
        job.stage, job.progress = stage, {"since": time.time()}
        job.command = f"{job.command}\n{line}" if job.command else line
        self._command = await self._start(words)

    async def _end_command(self) -> None:
        if self._command is not None:
            await self._command.end()

    def _refuse_failure(self, status: int) -> None:
        assert self._command is not None
        if status:
            raise TeachingError(f"the command ended with status {status}: {self._command.last_line}")


def file_name(document: dict[str, Any]) -> str:
    """Name of a level as part of the name of a file."""
    return re.sub(r"[^A-Za-z0-9_-]+", "_", str(document.get("name", ""))).strip("_")[:MAX_NAME] or "level"


def _remove(files: Files) -> None:
    """Removes what a job that came to nothing wrote: all of it is its own."""
    shutil.rmtree(files.run, ignore_errors=True)
    files.level.unlink(missing_ok=True)
    files.proof.unlink(missing_ok=True)


def _read_progress(job: Job) -> None:
    """Reads how far the run is. A file that is being written is read again later."""
    run = job.files.run
    try:
        status = read_status(run / run_files.STATUS)
        _read_rates(job)
    except (StatusError, OSError, RunFileError):
        return
    row = last_row(run / run_files.METRICS, is_row=is_metrics_row).row or {}
    if status is not None and status.phase in STAGES:
        job.stage = status.phase
    elif job.stage in STAGES:  # the last of them is over
        job.stage = "evaluating"
    trained = row.get("progress/seconds", 0.0) - row.get("progress/warmup_seconds", 0.0)
    job.progress |= {
        "phase": status.phase if status is not None else "starting",
        "updates": row.get("progress/updates"),
        "env_steps": row.get("progress/env_steps"),
        "solve_rate": row.get("train/solve_rate"),
        "attempts": row.get("train/attempts"),
        "seconds_left": max(job.seconds - trained, 0.0) if row else None,
    }


def _read_rates(job: Job) -> None:
    """Solve rates before and after training. Raises RunFileError."""
    for entry in evaluations(job.files.run)["sets"].values():
        for point in entry["points"]:
            rate = {name: point[name] for name in ("rate", "low", "high")}
            rate |= {"solved": sum(point["solved"] or [0]), "attempts": point["episodes"]}
            if point["phase"] == "before":
                job.before = rate
            elif point["phase"] == "after":
                job.after = rate


def _judge(job: Job) -> None:
    """Result in words."""
    assert job.after is not None and job.before is not None
    counts = f"{job.after['solved']} of {job.after['attempts']} attempts"
    if job.solves_already:
        job.text = f"{POLICY} solves it already, without any training: {counts}"
        job.advice = "Make it harder if it is to be learned."
        return
    _, low, high = difference_interval(*((rate["rate"], rate["low"], rate["high"]) for rate in (job.after, job.before)))
    counts += f", {job.before['solved']} before"
    job.learned = low > 0
    if job.learned:
        result = "learned" if job.after["rate"] >= MIN_LEARNED else "partly learned"
    elif high < 0:
        result = f"unlearned, {POLICY} plays it better than what was trained"
    elif job.before["rate"] >= MIN_LEARNED:
        result = f"{POLICY} solves most of it already, and training changed nothing clear"
    else:
        result = "not learned"
    job.text = f"{result}: {counts}"
    if job.proof is None:
        job.text += f"; no solution was found in {job.seconds} s of search, so it trained on the level alone"
    elif not job.learned:
        job.text += f"; the solution that was found solves it in {job.proof['steps']} steps"
    if not job.learned or job.after["rate"] < MIN_LEARNED:
        job.advice = "Try: a longer time; the goal nearer, or an easier way to it" + (
            "; or play the proof." if job.proof else "; or go on in a terminal with `train --resume`."
        )


def _newest_checkpoint(run: Path) -> Path:
    found = sorted(path for path in (run / "checkpoints").iterdir() if path.name.isdecimal())
    if not found:
        raise TeachingError("training ended without a checkpoint")
    return found[-1]
