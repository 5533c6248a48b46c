"""Runs of a study of commands, their work in worker slots, and its results.

runs/studies/NAME/   design.json, arms/RUN/ (what each command writes, done.json), logs/RUN.log
                     NAME.csv, NAME.md, NAME.png, study.json, written again after each run
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

from kinetix_dist.atomic_files import replace_file
from kinetix_dist.errors import user_errors
from kinetix_dist.studio.runs.run_files import RunFileError, read_object
from kinetix_dist.study.choice import check_arms, seeds_in, seeds_to_run
from kinetix_dist.study.command_file import CommandStudy, words_of
from kinetix_dist.study.command_results import RESULTS, Row, Written
from kinetix_dist.study.directory import RESULTS as STUDY_JSON
from kinetix_dist.study.directory import StudyDirectory
from kinetix_dist.study.report import wrapped
from kinetix_dist.study.study_file import NOT_RUN
from kinetix_dist.study.tables import text_of
from kinetix_dist.sweep.arms import short_hash
from kinetix_dist.sweep.results_directory import ARMS, write_json

DONE = "done.json"
STOP_S = 60.0  # in which a command ends after SIGTERM


@dataclasses.dataclass(frozen=True, kw_only=True)
class CommandRun:
    """One arm with a seed, or a part of it."""

    arm: str
    seed: int
    part: int  # from 0 on
    name: str
    command: tuple[str, ...]  # with {out} still in it


@dataclasses.dataclass(frozen=True, kw_only=True)
class CommandPlan:
    """A study with its runs."""

    study: CommandStudy
    runs: tuple[CommandRun, ...]
    chosen: tuple[CommandRun, ...]  # those to be run now
    hash: str


def command_plan_of(
    study: CommandStudy, *, seeds: int | None = None, arms: Collection[str] = (), path: Path | None = None
) -> CommandPlan:
    """Plan with so many seeds (None: as many as the study says) for the named arms (none: all). Runs that lie in `path`
    are part of the study, too, so that results never leave them out. Raises DesignError."""
    check_arms(arms, [arm.name for arm in study.arms], f"unknown arm {{name}} of study {study.name}")
    wanted = seeds_to_run(study.first_seed, study.seeds, seeds)
    runs = tuple(
        _run(study, arm.name, {**study.values, **arm.values}, seed, part)
        for seed in sorted({*wanted, *seeds_in(path)})
        for arm in study.arms
        for part in range(study.parts)
    )
    chosen = tuple(run for run in runs if run.seed in wanted and (not arms or run.arm in arms))
    first = [run.command for run in runs if run.seed == study.first_seed]
    return CommandPlan(study=study, runs=runs, chosen=chosen, hash=short_hash([study.name, study.results, first]))


def _run(study: CommandStudy, arm: str, values: dict[str, Any], seed: int, part: int) -> CommandRun:
    built_in = {"seed": seed, "part": part, "parts": study.parts, "out": "{out}"}
    name = f"{arm}-seed{seed}" + (f"-part{part}" if study.parts > 1 else "")
    command = tuple(words_of(study.command, {**values, **built_in}))
    return CommandRun(arm=arm, seed=seed, part=part, name=name, command=command)


def _is_done(path: Path, run: CommandRun) -> bool:
    """True where its command has ended well. Raises RunFileError for a damaged file."""
    return (read_object(path / ARMS / run.name / DONE) or {}).get("command") == list(run.command)


@dataclasses.dataclass(frozen=True)
class _CommandWork:
    """Commands as work of `run_loop.py`, and their end as its goal."""

    path: Path
    began: dict[str, float] = dataclasses.field(default_factory=dict)  # s of time.monotonic(), by run

    def command(self, run: CommandRun) -> tuple[list[str], bool]:
        directory = self.path / ARMS / run.name
        goes_on = directory.is_dir() and any(directory.iterdir())
        directory.mkdir(parents=True, exist_ok=True)
        self.began[run.name] = time.monotonic()
        return [word.replace("{out}", str(directory)) for word in run.command], goes_on

    def seconds_to_stop(self, run: CommandRun) -> float:
        del run
        return STOP_S

    def ended(self, run: CommandRun, status: int) -> str:
        if status == 0:
            seconds = round(time.monotonic() - self.began[run.name], 1)
            write_json(self.path / ARMS / run.name / DONE, {"command": list(run.command), "seconds": seconds})
        return ""

    def is_reached(self, run: CommandRun) -> bool:
        return _is_done(self.path, run)

    def must_end(self, run: CommandRun) -> bool:
        del run
        return False

    def why_out_of_reach(self, run: CommandRun) -> str:
        return f"{run.name} was stopped before its end"

    def result(self, run: CommandRun) -> str:
        return f"in {_seconds(self.path, run):.0f} s"


def _seconds(path: Path, run: CommandRun) -> float:
    return float((read_object(path / ARMS / run.name / DONE) or {}).get("seconds", 0.0))


class CommandStudyDirectory(StudyDirectory[CommandPlan]):
    """Study of commands in a directory."""

    def seconds_left(self) -> dict[str, float]:
        return {run.name: 60 * self.plan.study.cost.minutes for run in self.plan.chosen if not _is_done(self.path, run)}

    def seconds_to_stop(self) -> float:
        return STOP_S

    def write(self) -> list[Path]:
        return write_command_results(self.path, self.plan)

    def _work_and_goal(self) -> tuple[_CommandWork, _CommandWork]:
        work = _CommandWork(self.path)
        return work, work


def write_command_results(path: Path, plan: CommandPlan) -> list[Path]:
    """Writes NAME.csv, NAME.md, NAME.png and study.json; returns the files, study.json aside. Raises UserError."""
    study = plan.study
    kind = RESULTS[study.results]
    with user_errors(RunFileError, prefix=f"{path}: "):
        done = [run for run in plan.runs if _is_done(path, run)]
        minutes = sum(_seconds(path, run) for run in done) / 60
    written = [Written(arm=run.arm, seed=run.seed, directory=path / ARMS / run.name) for run in done]
    with user_errors(OSError, ValueError, prefix=f"{path}: "):
        rows = kind.rows(written)
    finding = kind.finding(rows) if rows else NOT_RUN
    left = [run.name for run in plan.runs if run not in done]
    state = f"{len(done)} of {len(plan.runs)} runs" if done else NOT_RUN
    text = _markdown(study, kind.sentences(rows), left, f"{state}. {minutes:.1f} minutes of all runs together.")
    with user_errors(OSError, prefix=f"{path}: results cannot be written: "):
        replace_file(path / f"{study.name}.csv", _csv(rows).encode())
        replace_file(path / f"{study.name}.md", text.encode())
        kind.draw(study.question, rows, path / f"{study.name}.png")
    known = {"state": state, "finding": finding, "minutes": round(minutes, 1)}
    write_json(path / STUDY_JSON, {"name": study.name, "hash": plan.hash, **known})
    return [path / f"{study.name}.{ending}" for ending in ("csv", "md", "png")]


def _markdown(study: CommandStudy, found: Sequence[str], left: Sequence[str], state: str) -> str:
    missing = f" Not done: {', '.join(left)}." if left else ""
    parts = [
        f"# {study.name}",
        wrapped(f"**Question.** {study.question}"),
        wrapped(f"**The paper.** {study.paper}"),
        wrapped(f"**Ours.** {' '.join(found) or 'No run is complete.'}{missing}"),
        wrapped(f"**State.** {state}"),
        f"![{study.question}]({study.name}.png)",
    ]
    return "\n\n".join(parts) + "\n"


def _csv(rows: Sequence[Row]) -> str:
    """A row each, of the columns that are no lists or tables."""
    columns = [name for name, value in rows[0].items() if not isinstance(value, list | dict)] if rows else []
    return text_of(columns, ([row[name] for name in columns] for row in rows))
