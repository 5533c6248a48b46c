"""One specialist per level, from each start, stored as they come: `kinetix-dist finetune --each`."""

from __future__ import annotations

import dataclasses
import functools
import math
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from kinetix_dist.checkpoint import CheckpointError
from kinetix_dist.config import TrainConfig
from kinetix_dist.errors import UserError, user_errors
from kinetix_dist.finetune.results import Key, ResultsDirectory, design_of
from kinetix_dist.finetune.specialists import SCRATCH, Specialist, Specialists, Start
from kinetix_dist.level.level import Level
from kinetix_dist.level.sets import load_level_set
from kinetix_dist.near_names import first_shared
from kinetix_dist.runtime import starting_point
from kinetix_dist.stored_specialists import Record
from kinetix_dist.telemetry.sinks.console import ConsoleSink


@dataclasses.dataclass(frozen=True, kw_only=True)
class Plan:
    """Specialists of a command: each level from each start, with each seed."""

    starts: tuple[Start, ...]
    seeds: tuple[int, ...] = ()  # (): that of the configuration alone, which names no directory
    stop_at: float = 0.0
    part: tuple[int, int] = (0, 1)  # (k, n): only those with numbers k, k + n, k + 2 n, ...
    together: int = 1  # specialists at a time, in one program

    def keys(self, names: Sequence[str]) -> list[Key]:
        """Specialists of the part: seed by seed, level by level, start by start."""
        trained = [(seed, name) for seed in self.seeds or (None,) for name in names]
        chosen = trained[self.part[0] :: self.part[1]]
        return [Key(start, name, seed) for seed, name in chosen for start in self.starts]


class Prepared(NamedTuple):
    """Levels and configuration of a command, read and checked."""

    config: TrainConfig
    levels: Level
    names: list[str]
    design: Record


def prepare(config: TrainConfig, plan: Plan) -> Prepared:
    """Levels and design of the specialists. Raises UserError for levels and settings that they cannot have."""
    config = _alone(config)
    with user_errors(ValueError, OSError):
        levels, names = load_level_set(config.curriculum.levels, config.env.size)
    if shared := first_shared(names):
        first, second = shared
        other = "" if first == second else f" or {second!r}, which share a file on some file systems"
        raise UserError(f"{config.curriculum.levels} has more than one level {first!r}{other}; rename one of the files")
    design = design_of(config, levels, names, stop_at=plan.stop_at, has_seeds=bool(plan.seeds))
    return Prepared(config, levels, names, design)


def train_each(
    config: TrainConfig, plan: Plan, path: Path, *, report: Callable[[str], None] = lambda line: None
) -> None:
    """Trains what the results directory at `path` does not hold yet: each level of `config.curriculum.levels`.

    report: gets a line for a person about each. Raises UserError, before anything is computed for long, for levels and
    starts that do not fit, and for a directory of another design.
    """
    prepared = prepare(config, plan)
    config, levels, names, design = prepared
    with user_errors(CheckpointError):  # before the directory is claimed for a design that cannot be trained
        arrays = {start.name: starting_point(_starting(config, start)).arrays for start in plan.starts}
    results = ResultsDirectory(path, design)
    try:
        keys = plan.keys(names)
        todo = [key for key in keys if results.done(key) is None]
        if num_done := len(keys) - len(todo):
            report(f"{num_done} of {len(keys)} specialists are there already")
        if not todo:
            return
        size = even_size(len(todo), plan.together)
        with user_errors(ValueError):
            specialists = Specialists(config, stop_at=plan.stop_at, together=size)
            first = _filled(todo[:size], size)
            seconds = specialists.compile(_levels_of(first, levels, names), [arrays[key.start.name] for key in first])
        report(f"compiled in {seconds:.0f} s, once for all specialists")
        storing = _Storing(prepared, results, len(todo), report)
        for turn in range(0, len(todo), size):
            now = todo[turn : turn + size]
            filled, began = _filled(now, size), time.monotonic()
            more = f" and {len(now) - 1} more" if len(now) > 1 else f" {now[0].start.label}"
            progress = _Progress(config, f"{turn + 1}/{len(todo)} {now[0].level}{more}", size)
            try:
                specialists.train(
                    _levels_of(filled, levels, names),
                    [arrays[key.start.name] for key in filled],
                    seeds=[_seed_of(config, key) for key in filled],
                    on_update=progress.update,
                    on_end=functools.partial(storing.store, now, began),
                )
            finally:
                progress.close()
    finally:
        results.close()


def summary(record: Record) -> str:
    """A specialist in one line."""
    reached = [
        f"{float(threshold):.0%} after {steps:,} steps" if steps is not None else f"{float(threshold):.0%} never"
        for threshold, steps in record["env_steps_to"].items()
    ]
    final = record["final"]
    end = f"{final['rate']:.0%} ({final['low']:.0%}-{final['high']:.0%}) at {record['env_steps']:,}"
    return f"{record['level']} {record['label']}, seed {record['seed']}: {', '.join(reached)}; {end}"


class _Storing:
    """Stores specialists as they end, and says so."""

    def __init__(
        self, prepared: Prepared, results: ResultsDirectory, total: int, report: Callable[[str], None]
    ) -> None:
        """total: specialists of the command that are not there yet."""
        self._prepared, self._results, self._total, self._report = prepared, results, total, report
        self._stored = 0

    def store(self, keys: Sequence[Key], began: float, number: int, specialist: Specialist) -> None:
        """keys: of a program, which began at `time.monotonic()` `began`; number: of the specialist in it. Those from
        len(keys) on fill the program and are not stored."""
        if number >= len(keys):
            return
        config, levels, names, _ = self._prepared
        key = keys[number]
        own = _starting(config, key.start, seed=_seed_of(config, key))
        record = self._results.add(key, specialist, own, _levels_of([key], levels, names))
        self._stored += 1
        self._report(f"{self._stored}/{self._total}  {summary(record)}, {time.monotonic() - began:.0f} s")


class _Progress:
    """One line of progress, written over."""

    def __init__(self, config: TrainConfig, phase: str, together: int) -> None:
        self._steps_per_update = config.rollout.steps_per_update
        self._together = together
        self._began = time.monotonic()
        self._sink = ConsoleSink(total_env_steps=config.run.total_env_steps or None)
        self._sink.set_phase(phase)

    def update(self, number: int, metrics: Mapping[str, float]) -> None:
        env_steps = number * self._steps_per_update
        speed = self._together * env_steps / max(time.monotonic() - self._began, 1e-9)
        self._sink.write(
            number,
            {
                "progress/env_steps": env_steps,
                "progress/env_steps_per_second": speed,
                "train/solve_rate": metrics["train/solve_rate"],
            },
        )

    def close(self) -> None:
        self._sink.close()


def _alone(config: TrainConfig) -> TrainConfig:
    """Configuration of each specialist. Raises UserError for settings that specialists do not have."""
    if config.run.placement != "local":
        raise UserError(
            f"run.placement is {config.run.placement!r}, but specialists train in this process; use 'local', or leave "
            "--each out"
        )
    if config.phases:
        raise UserError("phases are of runs, and specialists are compiled once; leave --phases or --each out")
    if config.run.start_optimizer:
        raise UserError(
            "run.start_optimizer is True, but specialists start with an optimiser of their own; leave it out"
        )
    if config.run.stop_at:
        raise UserError(f"run.stop_at is {config.run.stop_at:g}, but specialists end by --stop-at; set it to 0")
    if config.evaluation.every < 1:
        raise UserError(
            "evaluation.every is 0, but samples to a solve rate are counted by evaluations; give --evaluation.every 4"
        )
    return _starting(config, SCRATCH)  # what parameters are at the start is no matter of the programs


def _starting(config: TrainConfig, start: Start, *, seed: int | None = None) -> TrainConfig:
    seed = config.run.seed if seed is None else seed
    return dataclasses.replace(config, run=dataclasses.replace(config.run, start_from=start.checkpoint, seed=seed))


def _seed_of(config: TrainConfig, key: Key) -> int:
    return config.run.seed if key.seed is None else key.seed


def even_size(count: int, limit: int) -> int:
    """Size of batches of `count` things, at most `limit` each, of which the last is the least short of the others."""
    return math.ceil(count / math.ceil(count / limit))


def _filled(now: Sequence[Key], size: int) -> list[Key]:
    """As many as one program trains: the last once more where there are fewer."""
    return [*now, *[now[-1]] * (size - len(now))]


def _levels_of(keys: Sequence[Key], levels: Level, names: Sequence[str]) -> Level:
    """[keys, ...]"""
    numbers = np.array([names.index(key.level) for key in keys])
    return jax.tree.map(lambda x: np.asarray(x)[numbers], levels)
