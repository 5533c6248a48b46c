"""The results of specialists: a directory that is complete after every level, and goes on where it was left.

    OUT/design.json              the design: another one is refused
    OUT/scratch/hop_home.json    one specialist: its curve, samples to each threshold, final rate, seconds
    OUT/scratch/hop_home/        its policy, a checkpoint of parameters
    OUT/sfl_s/hop_home.json      the same from a policy
    OUT/samples.png              drawn from the JSON files alone

The JSON file of a specialist is written last, by one rename: where it is, the specialist is done.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from kinetix_dist.atomic_files import replace_file
from kinetix_dist.checkpoint import flatten_arrays, save_alone
from kinetix_dist.config import TrainConfig, differing, numbers_of, to_dict
from kinetix_dist.errors import UserError, one_line, user_errors
from kinetix_dist.evaluation.intervals import wilson_interval
from kinetix_dist.evaluation.load_policy import PARAMS_PREFIX
from kinetix_dist.finetune.specialists import FROM_SCRATCH, Point, Specialist, Start
from kinetix_dist.level.level import Level
from kinetix_dist.runtime import LOCK_NAME, RunDirectoryError, lock_directory, versions
from kinetix_dist.text_files import read_json

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FORMAT = 1
DESIGN_NAME = "design.json"
THRESHOLDS = (0.5, 0.9)  # solve rates whose samples are compared

Record = dict[str, Any]
_OF_A_DESIGN: dict[str, type] = {"levels": dict}  # what a file has to have to be read
_OF_A_SPECIALIST: dict[str, type] = {
    "level": str,
    "start": str,
    "label": str,
    "env_steps_to": dict,
    "final": dict,
    "seconds": dict,
    "curve": list,
}


def design_of(config: TrainConfig, levels: Level, names: Sequence[str], *, stop_at: float) -> Record:
    """Design of a directory, which all its specialists share whatever they start from: plain values.

    config: without a start. levels [L, ...] with their names; a level that was changed makes another design.
    """
    numbers = numbers_of(config)
    run = numbers["run"] | {"total_env_steps": config.run.total_env_steps, "max_seconds": config.run.max_seconds}
    return numbers | {
        "format": FORMAT,
        "run": run,
        "stop_at": stop_at,
        "evaluation": {"every": config.evaluation.every, "attempts": config.evaluation.attempts_of(1)},
        "levels": {name: _digest(jax.tree.map(lambda x, i=i: x[i], levels)) for i, name in enumerate(names)},
    }


class ResultsDirectory:
    """Results of one design, for one process at a time. Raises UserError where the directory is of another design, in
    use, or cannot be written."""

    def __init__(self, path: Path, design: Record) -> None:
        self.path = path
        with user_errors(OSError, prefix=f"{path} cannot be written: "):
            path.mkdir(parents=True, exist_ok=True)
            is_new = not (path / DESIGN_NAME).exists()
            if is_new and any(file.name != LOCK_NAME for file in path.iterdir()):
                raise UserError(f"{path} holds other files and no {DESIGN_NAME}; choose an empty directory")
            if not is_new:
                self._check(design)
            with user_errors(RunDirectoryError):
                self._lock = lock_directory(path)
            if is_new:
                _write_json(path / DESIGN_NAME, design)

    def close(self) -> None:
        """Lets others have the directory."""
        self._lock.close()

    def _check(self, design: Record) -> None:
        stored = _read_json(self.path / DESIGN_NAME)
        if stored.get("format") != FORMAT:
            raise UserError(f"{self.path} has format {stored.get('format')!r}; this version reads {FORMAT}")
        if differs := differing(design, stored):
            more = f" and {len(differs) - 1} more" if len(differs) > 1 else ""
            raise UserError(
                f"{self.path} holds results of another design: {differs[0]}{more}; choose another directory, or the "
                "options that it was made with"
            )

    def done(self, start: Start, level: str) -> Record | None:
        """Stored results of a specialist; None where it is still to be trained. Raises UserError where it started from
        another policy of the same name."""
        file = self._file(start, level)
        if not file.exists():
            return None
        stored = _read_json(file)
        theirs, ours = stored["from"], start.description
        if (theirs or {}).get("sha256") != (ours or {}).get("sha256"):
            raise UserError(
                f"{file} is of a specialist from another policy ({(theirs or {}).get('checkpoint')}); choose another "
                "directory"
            )
        return stored

    def add(self, start: Start, level: str, specialist: Specialist, config: TrainConfig) -> Record:
        """Stores a specialist: its policy, then its figures. Returns these. Raises UserError for a full disk."""
        file = self._file(start, level)
        record = record_of(start, level, specialist)
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
                "level": level,
            }
            save_alone(policy, specialist.points[-1].updates, arrays, description)
            _write_json(file, record)
        return record

    def _file(self, start: Start, level: str) -> Path:
        return self.path / start.name / f"{level}.json"


def record_of(start: Start, level: str, specialist: Specialist) -> Record:
    """The figures of a specialist as JSON."""
    last = specialist.points[-1]
    low, high = wilson_interval(last.solved, last.attempts)
    return {
        "level": level,
        "start": start.name,
        "label": start.label,
        "from": start.description,
        "env_steps_to": {str(threshold): env_steps_to(specialist.points, threshold) for threshold in THRESHOLDS},
        "final": {"rate": last.rate, "low": low, "high": high, "attempts": last.attempts},
        "env_steps": last.env_steps,
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


def read_results(path: Path) -> list[Record]:
    """All that is stored in a directory: starts in order, from scratch first, and levels in the order of the design.
    Raises UserError where there is nothing."""
    if not (path / DESIGN_NAME).is_file():
        raise UserError(f"{path} holds no results of specialists (no {DESIGN_NAME}); give a directory that has them")
    levels = list(_read_json(path / DESIGN_NAME)["levels"])
    records = [_read_json(file) for file in path.glob("*/*.json") if file.stem in levels]
    if not records:
        raise UserError(f"{path} holds no finished specialist yet")
    return sorted(records, key=lambda one: (one["start"] != FROM_SCRATCH, one["start"], levels.index(one["level"])))


def _digest(level: Level) -> str:
    """Digest of all numbers of a level."""
    digest = hashlib.sha256()
    for name, array in sorted(flatten_arrays(level).items()):
        digest.update(f"{name} {array.dtype} {array.shape}".encode() + np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _write_json(file: Path, content: Mapping[str, Any]) -> None:
    replace_file(file, (json.dumps(content, indent=1) + "\n").encode())


def _read_json(file: Path) -> Record:
    """Raises UserError, one line, for a file that is damaged."""
    is_design = file.name == DESIGN_NAME
    advice = "choose another directory" if is_design else "remove it, and its specialist is trained again"
    try:
        content = read_json(file)
    except (OSError, ValueError) as error:
        raise UserError(f"{file} cannot be read ({one_line(error)}); {advice}") from None
    if not isinstance(content, dict):
        raise UserError(f"{file} holds no object; {advice}")
    for name, expected in (_OF_A_DESIGN if is_design else _OF_A_SPECIALIST).items():
        if not isinstance(content.get(name), expected):
            raise UserError(f"{file} is damaged: {name!r} is missing or of another type; {advice}")
    return content


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
