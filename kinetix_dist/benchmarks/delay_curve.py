"""`bench delay`: solve rates over inference delay, for policies of action chunks and of single actions.

    kinetix-dist bench delay --policy runs/flow --levels levels/ --delays 0..8 --json delay.json --picture delay.png

A record is a point: policy, method, delay, `rate` (mean over levels) with two intervals, levels, and, against the naive
method at the same delay, the difference with its interval (kinetix_dist/delay/curve.py). docs/delay.md explains methods
and figures.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from kinetix_dist.benchmarks.measuring import Record, Results
from kinetix_dist.checkpoint import CheckpointError
from kinetix_dist.delay.curve import (
    METHODS,
    SYNCHRONOUS,
    Contender,
    contender_at,
    played,
    record_of,
    with_differences,
)
from kinetix_dist.delay.execution import Schedule
from kinetix_dist.delay.picture import draw
from kinetix_dist.errors import UserError, user_errors
from kinetix_dist.evaluation.evaluate import Episodes
from kinetix_dist.evaluation.intervals import NO_SPREAD
from kinetix_dist.level.level_data import base_levels
from kinetix_dist.level.sets import load_level_set
from kinetix_dist.number_ranges import numbers_in
from kinetix_dist.stored_specialists import are_specialists

MAX_DELAY = 1000
PICTURES = (".png", ".svg", ".pdf")

MAX_EPISODES = 1_000_000  # attempts at each level


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """Solve rates over delay, by method, with intervals and a picture."""

    policy: tuple[Path, ...] = (Path("generalist"),)
    """Checkpoints, runs or bundled policies, of action chunks (`clone-flow`) or of single actions, or specialists of
    `finetune --each`, which play each its own level."""
    levels: str = "designed_m"
    """A set, a directory of level files, or one level file."""
    size: str | None = None
    """Play them at this size (s, m or l) instead of the smallest that fits all."""
    delays: tuple[str, ...] = ("0..8",)
    """Environment steps between an observation and what follows from it: 0..8, or single numbers."""
    methods: tuple[str, ...] = tuple(METHODS)
    """How the next chunk is made; a policy plays by those that it can."""
    horizon: int | None = None
    """Actions of a chunk that are used; left out: all that a policy gives."""
    execute: int | None = None
    """Steps from one chunk to the next; left out: the delay, and 1 at delay 0, as published."""
    episodes: int = 256
    """Attempts at each level, at each point; published curves have 2048."""
    action_noise: float = 0.0
    """Standard deviation of normal noise on every action; published curves have 0.1."""
    weak_policy: Path | None = None
    """An earlier checkpoint of a chunk policy, for the forward contrast of bidirectional decoding."""
    min_rate: float | None = None
    """Specialists play that solved this share of their level at the end of training; left out: 0.65, as published."""
    seed: int = 0
    """Seed of actions and noise."""
    json: Path | None = None
    """File for the records."""
    picture: Path | None = None
    """File for the picture: png, svg or pdf."""

    def __post_init__(self) -> None:
        delays_of(self.delays)
        for name in ("policy", "methods"):
            if not getattr(self, name):
                raise ValueError(f"--{name} is empty")
        for method in self.methods:
            METHODS[method]
        if self.min_rate is not None and not 0 <= self.min_rate <= 1:
            raise ValueError(f"--min-rate is {self.min_rate:g}; it is a solve rate, from 0 to 1")
        if not 1 <= self.episodes <= MAX_EPISODES:
            raise ValueError(f"--episodes is {self.episodes}; it must be from 1 to {MAX_EPISODES:,}")
        if self.picture is not None and self.picture.suffix not in PICTURES:
            raise ValueError(f"--picture {self.picture} ends in none of {', '.join(PICTURES)}")
        if self.picture is not None and self.picture.is_dir():
            raise ValueError(f"--picture {self.picture} is a directory; give a file")


def delays_of(words: Sequence[str]) -> list[int]:
    """[0, 1, 2, 3] of "0..3", or of "0 1 2 3". Raises ValueError."""
    return numbers_in(words, "--delays", most=MAX_DELAY)


def measure(options: Options, results: Results) -> None:
    """A record a point. Raises UserError, before anything is played, for what cannot be."""
    if options.min_rate is not None and not any(map(are_specialists, options.policy)):
        raise UserError("--min-rate is of specialists, and no --policy is a directory of them; leave it out")
    with user_errors(CheckpointError, ValueError, OSError):
        levels, names = load_level_set(options.levels, options.size)
        contenders = [
            contender_at(path, levels, names, weak=options.weak_policy, min_rate=options.min_rate)
            for path in options.policy
        ]
        for line in (line for contender in contenders for line in contender.left_out):
            results.report(f"left out: {line}")
        points = [point for contender in contenders for point in _points(options, contender, results)]
        for contender, _, schedule in points:
            schedule.check_space(contender.env.action_space)
            if contender.chunks is not None:
                schedule.check()
        if options.picture is not None:
            options.picture.parent.mkdir(parents=True, exist_ok=True)
    bases, max_delay = base_levels(options.levels, names), max(delays_of(options.delays))
    waiting: dict[tuple[str, int], Episodes] = {}  # a delay changes nothing in a world that waits
    for contender, method, schedule in points:
        key = (contender.name, schedule.execute)
        if method == SYNCHRONOUS and key in waiting:
            episodes = waiting[key]
        else:
            episodes = played(
                contender,
                method,
                levels,
                schedule,
                attempts=options.episodes,
                max_delay=max_delay,
                seed=options.seed,
            )
        if method == SYNCHRONOUS:
            waiting[key] = episodes
        results.add(record_of(contender, method, schedule, episodes, names, bases))
        results.report(_in_words(results.records[-1]))
    results.replace(with_differences(results.records, bases))
    for line in table(results.records):
        results.report(line)
    if options.picture is not None:
        with user_errors(OSError):
            draw(results.records, options.picture)


def _points(options: Options, contender: Contender, results: Results) -> Iterator[tuple[Contender, str, Schedule]]:
    """What is played, and a line about what is not. Raises UserError where nothing is."""
    horizon = contender.horizon
    if options.horizon is not None and contender.chunks is not None:
        if not 1 <= options.horizon <= horizon:
            raise UserError(f"--horizon is {options.horizon}, but {contender.name} gives chunks of {horizon} actions")
        horizon = options.horizon
    num_points = 0
    for method in options.methods:
        for delay in delays_of(options.delays):
            if reason := contender.cannot(method, delay):
                results.report(f"left out: {reason}")
                break
            execute = 1 if contender.chunks is None else options.execute or max(delay, 1)
            num_points += 1
            yield (
                contender,
                method,
                Schedule(delay=delay, execute=execute, horizon=horizon, action_noise=options.action_noise),
            )
    if not num_points:
        raise UserError(f"{contender.name} plays by none of --methods {' '.join(options.methods)}")


def _in_words(record: Record) -> str:
    waits = f", waits {record['mean_waiting']:.0f} steps besides" if record["mean_waiting"] else ""
    return (
        f"{Path(record['policy']).name} {record['method']:17} delay {record['delay']}: {_rate(record)} solved, "
        f"{record['mean_length']:.0f} steps{waits}"
    )


def _rate(record: Record) -> str:
    return f"{100 * record['rate']:.1f} % ({100 * record['low']:.1f} to {100 * record['high']:.1f})"


def table(records: Sequence[Record]) -> list[str]:
    """Lines: a row a policy and method, a column a delay; then differences from the naive method, in points."""
    delays = sorted({record["delay"] for record in records})
    lines = []
    for policy in dict.fromkeys(record["policy"] for record in records):
        own = [record for record in records if record["policy"] == policy]
        of_point = {(record["method"], record["delay"]): record for record in own}
        methods = list(dict.fromkeys(record["method"] for record in own))
        lines += ["", f"{policy}: solved, % (interval on these levels)", _row("delay", map(str, delays))]
        lines += [_row(method, [_cell(of_point.get((method, delay))) for delay in delays]) for method in methods]
        others = [method for method in methods if any(r["above_naive"] for r in own if r["method"] == method)]
        if others:
            lines += ["", "less naive, points (interval over levels)", _row("delay", map(str, delays))]
            lines += [_row(method, [_points_above(of_point.get((method, d))) for d in delays]) for method in others]
    return lines


def _row(name: str, cells: Iterable[str]) -> str:
    return f"{name:17}" + "".join(f"  {cell:>18}" for cell in cells)


def _cell(record: Record | None) -> str:
    if record is None:
        return "-"
    return f"{100 * record['rate']:.1f} ({100 * record['low']:.0f}-{100 * record['high']:.0f})"


def _points_above(record: Record | None) -> str:
    found = record and record["above_naive"]
    if not found:
        return "-"
    if found["low"] is None:
        return f"{100 * found['difference']:+.1f} ({NO_SPREAD})"
    return f"{100 * found['difference']:+.1f} ({100 * found['low']:+.0f} to {100 * found['high']:+.0f})"
