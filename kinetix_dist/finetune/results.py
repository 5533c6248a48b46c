"""The results of specialists: a directory that is complete after every level, and goes on where it was left.

    OUT/design.json              the design: another one is refused
    OUT/scratch/hop_home.json    one specialist: its curve, samples to each threshold, final rate, seconds
    OUT/scratch/hop_home/        its policy, a checkpoint of parameters
    OUT/scratch/hop_home.md      its card (card.py)
    OUT/sfl_s/hop_home.json      the same from a policy
    OUT/scratch-seed-3/...       the same with `--seeds`
    OUT/samples.png              drawn from the JSON files alone

`stored_specialists.py` reads them. The JSON file of a specialist is written last, by one rename: where it is, the
specialist is done.
"""

from __future__ import annotations

import dataclasses
import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np

from kinetix_dist.atomic_files import replace_file
from kinetix_dist.checkpoint import flatten_arrays, save_alone
from kinetix_dist.config import TrainConfig, differing, numbers_of, to_dict
from kinetix_dist.errors import UserError, user_errors
from kinetix_dist.evaluation.intervals import wilson_interval
from kinetix_dist.evaluation.load_policy import PARAMS_PREFIX
from kinetix_dist.finetune.card import card_of
from kinetix_dist.finetune.specialists import Point, Specialist, Start
from kinetix_dist.json_text import json_text
from kinetix_dist.level.fingerprints import fingerprint
from kinetix_dist.level.level import Level
from kinetix_dist.runtime import LOCK_NAME, RunDirectoryError, lock_directory, versions
from kinetix_dist.stored_specialists import DESIGN_NAME, FORMAT, Record, digest_of, file_name_of, folder_of, read_stored

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CARD_SUFFIX = ".md"
LOGS = "logs"  # of processes in worker slots
SEEDS = "--seeds"  # run.seed of a design whose specialists have seeds of their own
THRESHOLDS = (0.5, 0.9)  # solve rates whose samples are compared


class Key(NamedTuple):
    """One specialist of a directory."""

    start: Start
    level: str
    seed: int | None = None  # of `--seeds`; None: run.seed is that of all


def design_of(
    config: TrainConfig, levels: Level, names: Sequence[str], *, stop_at: float, has_seeds: bool = False
) -> Record:
    """Design of a directory, which all its specialists share whatever they start from: plain values.

    config: without a start. levels [L, ...] with their names; a level that was changed makes another design. has_seeds:
    each has a seed of its own, and more seeds may join them.
    """
    numbers = numbers_of(config)
    run = numbers["run"] | {"total_env_steps": config.run.total_env_steps, "max_seconds": config.run.max_seconds}
    if has_seeds:
        run["seed"] = SEEDS
    return numbers | {
        "format": FORMAT,
        "run": run,
        "stop_at": stop_at,
        "evaluation": {"every": config.evaluation.every, "attempts": config.evaluation.attempts_of(1)},
        "levels": {name: digest_of(jax.tree.map(lambda x, i=i: x[i], levels)) for i, name in enumerate(names)},
    }


class ResultsDirectory:
    """Results of one design, for one process at a time and its children. Raises UserError where the directory is of
    another design, in use, or cannot be written.

    A child finds it locked by its parent, and works in it without a lock of its own (`cli/specialist_slots.py`).
    """

    def __init__(self, path: Path, design: Record, *, is_parent: bool = False) -> None:
        """is_parent: children train, and write the design: levels are not the same to the bit on a CPU and a GPU."""
        self.path = path
        with user_errors(OSError, prefix=f"{path} cannot be written: "):
            path.mkdir(parents=True, exist_ok=True)
            there = {file.name for file in path.iterdir() if not file.name.startswith(".")} - {LOCK_NAME, LOGS}
            is_new = DESIGN_NAME not in there
            if is_new and there:
                raise UserError(f"{path} holds other files and no {DESIGN_NAME}; choose an empty directory")
            if not is_new:
                self._check(design, is_parent=is_parent)
            with user_errors(RunDirectoryError):
                self._lock = None if _is_held_by_parent(path) else lock_directory(path)
            if is_new and not is_parent:
                replace_file(path / DESIGN_NAME, _json(design), is_shared=True)

    def close(self) -> None:
        """Lets others have the directory."""
        if self._lock is not None:
            self._lock.close()

    def _check(self, design: Record, *, is_parent: bool) -> None:
        stored = read_stored(self.path / DESIGN_NAME)
        if stored.get("format") != FORMAT:
            raise UserError(f"{self.path} has format {stored.get('format')!r}; this version reads {FORMAT}")
        if is_parent:
            design, stored = (one | {"levels": dict.fromkeys(one["levels"], "")} for one in (design, stored))
        if differs := differing(design, stored):
            more = f" and {len(differs) - 1} more" if len(differs) > 1 else ""
            raise UserError(
                f"{self.path} holds results of another design: {differs[0]}{more}; choose another directory, or the "
                "options that it was made with"
            )

    def done(self, key: Key) -> Record | None:
        """Stored results of a specialist; None where it is still to be trained. Raises UserError where it started from
        another policy of the same name."""
        file = file_of(self.path, key)
        if not file.exists():
            return None
        stored = read_stored(file)
        theirs, ours = stored["from"], key.start.description
        if (theirs or {}).get("sha256") != (ours or {}).get("sha256"):
            raise UserError(
                f"{file} is of a specialist from another policy ({(theirs or {}).get('checkpoint')}); choose another "
                "directory"
            )
        return stored

    def add(self, key: Key, specialist: Specialist, config: TrainConfig, level: Level) -> Record:
        """Stores a specialist: its policy, its card, then its figures. Returns these. config: with its start and seed;
        level [1, ...]. Raises UserError for a full disk."""
        file = file_of(self.path, key)
        record = record_of(key, specialist, config) | {"fingerprint": fingerprint(level)}
        with user_errors(OSError, prefix=f"{file} cannot be written: "):
            file.parent.mkdir(exist_ok=True)
            policy = file.with_suffix("")
            shutil.rmtree(policy, ignore_errors=True)  # of one that was interrupted here
            arrays = {f"{PARAMS_PREFIX}/{name}": array for name, array in flatten_arrays(specialist.params).items()}
            description = {
                "config": to_dict(config),
                "config_hash": config.hash,
                "env_steps": record["env_steps"],
                "training_seconds": record["seconds"]["training"],
                "level": key.level,
            }
            save_alone(policy, specialist.points[-1].updates, arrays, description)
            replace_file(file.with_suffix(CARD_SUFFIX), card_of(record, config, policy).encode())
            replace_file(file, _json(record))
        return record


def file_of(path: Path, key: Key) -> Path:
    """Figures of a specialist in the results at `path`."""
    return path / folder_of(key.start.name, key.seed) / f"{file_name_of(key.level)}.json"


def _is_held_by_parent(path: Path) -> bool:
    """True where the process that started this one works in the directory: it gives its children parts (`--slots`)."""
    try:
        holder = (path / LOCK_NAME).read_text().strip()
    except (OSError, ValueError):
        return False
    return holder == str(os.getppid()) and not _can_lock(path)


def _can_lock(path: Path) -> bool:
    try:
        lock_directory(path).close()
    except RunDirectoryError:
        return False
    return True


def record_of(key: Key, specialist: Specialist, config: TrainConfig) -> Record:
    """The figures of a specialist as JSON."""
    last = specialist.points[-1]
    low, high = wilson_interval(last.solved, last.attempts)
    start = key.start
    return {
        "level": key.level,
        "seed": config.run.seed,
        "start": start.name,
        "label": start.label,
        "from": start.description,
        "env_steps_to": {str(threshold): env_steps_to(specialist.points, threshold) for threshold in THRESHOLDS},
        "final": {"rate": last.rate, "low": low, "high": high, "attempts": last.attempts},
        "env_steps": last.env_steps,
        "num_parameters": sum(int(np.size(array)) for array in jax.tree.leaves(specialist.params)),
        "config_hash": config.hash,
        "device": jax.devices()[0].device_kind,
        "seconds": {
            "training": round(specialist.training_seconds, 3),
            "evaluation": round(specialist.evaluation_seconds, 3),
            "compile": round(specialist.compile_seconds, 3),
        },
        "skipped_steps": specialist.skipped_steps,
        "curve": [dataclasses.asdict(point) for point in specialist.points],
        "versions": versions(),
    }


def env_steps_to(points: Sequence[Point], threshold: float) -> int | None:
    """Environment steps at the first evaluation whose solve rate is the threshold or more; None: there was none."""
    return next((point.env_steps for point in points if point.rate >= threshold), None)


def _json(content: Mapping[str, Any]) -> bytes:
    return (json_text(content, indent=1) + "\n").encode()


COLOURS = ("#d62728", "#1f77b4", "#2ca02c", "#ff7f0e")  # of starts, in their order
ROW_INCHES = 0.32


def draw(records: Sequence[Record], file: Path) -> None:
    """Writes the picture; the format follows the file's ending. records: as `read_results` gives them."""
    figure_of(records).savefig(file, dpi=100)


def figure_of(records: Sequence[Record]) -> Figure:
    """A panel for each threshold.

    A dot is where the solve rate was first at the threshold; an open triangle at the end of training says that it
    never was. The axis is linear up to the first evaluation, and logarithmic from there on.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import EngFormatter, SymmetricalLogLocator

    levels = list(dict.fromkeys(record["level"] for record in records))
    figure = Figure(figsize=(11, 1.6 + ROW_INCHES * max(len(levels), 4)), layout="constrained")
    panels = figure.subplots(1, len(THRESHOLDS), sharey=True, squeeze=False)
    first = max(min(_first_evaluation(record) for record in records), 1)
    end = max(record["env_steps"] for record in records)
    for panel, threshold in zip(panels[0], THRESHOLDS):
        _samples(panel, records, levels, threshold)
        panel.set_title(f"environment steps to {threshold:.0%} solved")
        panel.set_xscale("symlog", linthresh=first, linscale=0.4)
        panel.set_xlim(-0.15 * first, 1.6 * max(end, first))
        panel.xaxis.set_major_locator(SymmetricalLogLocator(base=10, linthresh=first, subs=(1, 2, 5)))
        panel.xaxis.set_major_formatter(EngFormatter(sep=" "))
        panel.grid(alpha=0.3)
        panel.legend(
            fontsize=9, loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=2, title="levels that reached it"
        )
    panels[0][0].set_yticks(range(len(levels)), levels)
    panels[0][0].set_ylim(len(levels) - 0.5, -0.5)
    return figure


def _samples(panel: Any, records: Sequence[Record], levels: list[str], threshold: float) -> None:
    starts = list(dict.fromkeys(record["start"] for record in records))
    gap = 0.4 / max(len(starts), 1)
    for number, start in enumerate(starts):
        colour = COLOURS[number % len(COLOURS)]
        mine = [record for record in records if record["start"] == start]
        offset = gap * (number - (len(starts) - 1) / 2)
        reached, missed = [], []
        for record in mine:
            steps = record["env_steps_to"][str(threshold)]
            row = levels.index(record["level"]) + offset
            (missed if steps is None else reached).append((record["env_steps"] if steps is None else steps, row))
        label = f"{mine[0]['label']}: {len(reached)} of {len(mine)}"
        panel.plot(*_columns(reached), "o", color=colour, label=label)
        panel.plot(*_columns(missed), ">", color=colour, fillstyle="none", label=None)


def _columns(points: list[tuple[float, float]]) -> tuple[list[float], list[float]]:
    return [x for x, _ in points], [y for _, y in points]


def _first_evaluation(record: Record) -> int:
    """Environment steps at the first evaluation after training began."""
    return next((point["env_steps"] for point in record["curve"] if point["env_steps"]), 1)
