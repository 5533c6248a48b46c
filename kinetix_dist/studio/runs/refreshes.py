"""Summaries of a curriculum's refreshes: levels chosen, their solve rates in training, and learning measured by probes.

    curriculum/refresh_*.npz, buffer_*.npz --Refreshes--> one summary per file, cached until it changes
    curriculum/outcomes.jsonl --Tail------> windows, --training_plays--> plays of each level while its buffer was in use

The curator **claims** the plug-in learnability of the few episodes by which it chose a level. Since levels are chosen
by their largest values, these are too high. Training plays other episodes: its estimate is unbiased for levels played
twice or more often (`evaluation/learnability.py`).

Training counts attempts, the first episode of each world in an update: independent, each solved with the chance p of
its level. Episodes that scored a level are all that one world finished: solved / finished has the mean p for one level,
but not for the sums of many levels, since levels of short episodes count more often. So rates of scored levels are
means over levels.
"""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from kinetix_dist.evaluation.intervals import wilson_interval
from kinetix_dist.evaluation.learnability import mean_and_error, plug_in_learnability, unbiased_learnability
from kinetix_dist.studio.runs import run_files
from kinetix_dist.studio.runs.fresh_pairs import FIELD as FRESH_PAIRS
from kinetix_dist.studio.runs.fresh_pairs import is_pairs, learnability_of_pairs
from kinetix_dist.telemetry.curriculum_log import (
    BUFFER,
    KINDS,
    REFRESH,
    Snapshot,
    SnapshotError,
    is_outcomes,
    list_snapshots,
    read_snapshot,
)
from kinetix_dist.telemetry.tail import Tail

# Curricula that try some candidates again because of how they fared: solved / finished of these is no estimate of p.
CHOOSES_WHILE_SCORING = ("sfl_slices",)
BINS = 10  # of histograms of p, besides those of p = 0 and p = 1


@dataclasses.dataclass
class Plays:
    """Attempts [n] at the levels of a buffer while it was in use, over windows `from_update` to `update`."""

    solved: np.ndarray
    attempts: np.ndarray
    from_update: int
    update: int


def training_plays(outcomes: Iterable[Mapping[str, Any]]) -> dict[int, Plays]:
    """Sums of the windows of each buffer, by policy version; windows of another length than before are left out."""
    plays: dict[int, Plays] = {}
    for row in outcomes:
        if not isinstance(row.get("buffer"), int) or "solved" not in row:
            continue
        solved, attempts = (np.asarray(counts, np.int64) for counts in (row["solved"], row["attempts"]))
        window = Plays(solved, attempts, row["from_update"], row["update"])
        found = plays.get(row["buffer"])
        if found is None:
            plays[row["buffer"]] = window
        elif found.solved.shape == solved.shape:
            found.solved, found.attempts = found.solved + solved, found.attempts + attempts
            found.update = row["update"]
    return plays


def counts_table(solved: np.ndarray, finished: np.ndarray) -> list[list[int]]:
    """Table [[solved, finished, levels], ...] of the pairs that occur."""
    width = int(finished.max(initial=0)) + 1  # a pair as one number, which sorts faster than rows
    pairs, levels = np.unique(solved.astype(np.int64) * width + finished, return_counts=True)
    return np.stack([pairs // width, pairs % width, levels], 1).tolist()


def histogram_of_p(solved: np.ndarray, finished: np.ndarray) -> list[int]:
    """Levels with p = 0, those in BINS bins between, and those with p = 1. Levels without an episode do not count."""
    is_played = finished > 0
    s, f = solved[is_played], finished[is_played]
    between = (s > 0) & (s < f)
    bins = np.minimum((BINS * s[between]) // f[between], BINS - 1)
    return [int((s == 0).sum()), *np.bincount(bins, minlength=BINS).astype(int).tolist(), int((s == f).sum())]


def rate(solved: Any, episodes: Any) -> dict[str, Any]:
    """Rate {solved, episodes, rate, low, high} of independent episodes, with its 95 % Wilson interval."""
    solved, episodes = int(solved), int(episodes)
    low, high = wilson_interval(solved, episodes)
    return {
        "solved": solved,
        "episodes": episodes,
        "rate": solved / episodes if episodes else None,
        "low": low,
        "high": high,
    }


def rate_over_levels(solved: np.ndarray, finished: np.ndarray) -> dict[str, Any]:
    """Mean solve rate {levels, solved, episodes, rate, low, high} of scored levels, from counts [n].

    The interval counts a level as one episode: levels are independent, and means of its episodes vary no more. Levels
    that finished none are left out.
    """
    is_played = finished > 0
    rates = solved[is_played] / finished[is_played]
    low, high = wilson_interval(float(rates.sum()), len(rates))
    return {
        "levels": len(rates),
        "solved": int(solved.sum()),
        "episodes": int(finished.sum()),
        "rate": float(rates.mean()) if len(rates) else None,
        "low": low,
        "high": high,
    }


def rates_by_feature(
    names: Iterable[str], features: np.ndarray, solved: np.ndarray, finished: np.ndarray
) -> dict[str, list[dict[str, Any]]]:
    """Rates {feature: [{value} and `rate_over_levels` of its levels]}. features: [N, F], counts: [N]."""
    return {
        str(name): [
            {"value": int(value)} | rate_over_levels(solved[is_in], finished[is_in])
            for value in np.unique(values)
            for is_in in [values == value]
        ]
        for name, values in zip(names, features.T, strict=True)
    }


def describe_snapshot(snapshot: Snapshot) -> dict[str, Any]:
    """Summary of one snapshot, without its levels. Fields that it lacks are left out."""
    arrays = snapshot.arrays
    described: dict[str, Any] = {
        "kind": snapshot.kind,
        "number": snapshot.number,
        "curriculum": str(arrays["curriculum"]),
        "size": str(arrays["size"]),
        "written_after": int(arrays["written_after"]),
        "num_levels": len(arrays["level_id"]),
        "has_levels": snapshot.has_levels,
        "mean_score": mean_and_error(arrays["score"])[0],
        "scores": _histogram(arrays["score"]),
    }
    if snapshot.kind == BUFFER:
        return described
    solved, finished = (arrays[name].astype(np.int64) for name in ("solved", "finished"))
    all_solved = arrays["candidates/solved"].astype(np.int64)
    all_finished = arrays["candidates/finished"].astype(np.int64)
    is_sample = described["curriculum"] not in CHOOSES_WHILE_SCORING
    described |= {
        "first_batch": int(arrays["first_batch"]),
        "scoring_seconds": mean_and_error(np.atleast_1d(arrays["scoring_seconds"]))[0],
        "is_sample": is_sample,
        "buffer": _group(solved, finished),
        "candidates": _group(all_solved, all_finished) | _fresh_learnability(all_solved, all_finished, is_sample),
        "by_feature": rates_by_feature(
            arrays["feature_names"], arrays["candidates/features"], all_solved, all_finished
        ),
    }
    return described


def _group(solved: np.ndarray, finished: np.ndarray) -> dict[str, Any]:
    return rate_over_levels(solved, finished) | {
        "levels": len(solved),
        "claimed": mean_and_error(plug_in_learnability(solved, finished))[0],
        "histogram": histogram_of_p(solved, finished),
        "counts": counts_table(solved, finished),
    }


def _fresh_learnability(solved: np.ndarray, finished: np.ndarray, is_sample: bool) -> dict[str, Any]:
    """Unbiased learnability {learnability, learnability_error} of fresh levels, the baseline of a buffer.

    None where some finished fewer than two episodes (the others are biased to short episodes), or where
    candidates are no sample of fresh levels.
    """
    learnability, error = None, None
    if is_sample and (finished > 1).all():
        learnability, error = mean_and_error(unbiased_learnability(solved, finished))
    return {"learnability": learnability, "learnability_error": error}


def describe_training(plays: Plays) -> dict[str, Any]:
    """Solve rates of a buffer in training while it was in use. `learnability`: the unbiased estimate.

    Worlds draw levels of a buffer at random: attempts at all of them are independent, given the policy.
    """
    values = unbiased_learnability(plays.solved, plays.attempts)
    learnability, error = mean_and_error(values)
    return rate(plays.solved.sum(), plays.attempts.sum()) | {
        "learnability": learnability,
        "learnability_error": error,
        "learnability_levels": int((~np.isnan(values)).sum()),
        "histogram": histogram_of_p(plays.solved, plays.attempts),
        "from_update": plays.from_update,
        "update": plays.update,
    }


def describe_probe(before: Snapshot, after: Snapshot) -> dict[str, Any] | None:
    """Learning of one refresh cycle: levels of `before`, played again by the policy that scored `after`.

    A level counts once, also where it was played twice. None: `after` has no such plays. `moves`: [[p before, p after,
    levels]] with p as 0 never, 1 sometimes, 2 always.
    """
    if "probe/index" not in after.arrays:
        return None
    index, first = np.unique(after.arrays["probe/index"], return_index=True)
    then = [before.arrays[name][index].astype(np.int64) for name in ("solved", "finished")]
    now = [after.arrays[f"probe/{name}"][first].astype(np.int64) for name in ("solved", "finished")]
    both = (then[1] > 0) & (now[1] > 0)
    classes = np.stack([_class_of_p(*then), _class_of_p(*now)], 1)[both]
    moves, levels = np.unique(classes, axis=0, return_counts=True) if both.any() else (np.zeros((0, 2)), np.zeros(0))
    return {
        "levels": len(index),
        "policy_version": after.number,
        "before": rate_over_levels(*then),
        "after": rate_over_levels(*now),
        "after_learnability": mean_and_error(unbiased_learnability(*now))[0],
        "moves": np.concatenate([moves, levels[:, None]], 1).astype(int).tolist(),
    }


def _class_of_p(solved: np.ndarray, finished: np.ndarray) -> np.ndarray:
    return np.where(solved == 0, 0, np.where(solved == finished, 2, 1))


class Refreshes:
    """Summaries of all snapshots of a run; each file is read once, and again where it changed."""

    def __init__(self, path: Path) -> None:
        """path: the run directory."""
        self._path = path
        self._lock = threading.Lock()
        self._read: dict[Path, tuple[tuple[int, int], Snapshot]] = {}
        self._described: dict[tuple[str, int], tuple[Snapshot, dict[str, Any]]] = {}
        self._outcomes = Tail(path / run_files.OUTCOMES, is_row=_is_window)
        self._rows: list[dict[str, Any]] = []  # of outcomes, as far as it was read

    def read(self) -> tuple[list[Snapshot], list[dict[str, Any]], list[str]]:
        """Read all snapshots without levels, oldest first, the windows of outcomes, and a line per damaged file."""
        with self._lock:
            problems: list[str] = []
            return self._snapshots(problems), self._windows(problems), problems

    def newest(self, count: int) -> tuple[list[Snapshot], list[dict[str, Any]], list[str]]:
        """The same of the newest snapshots alone, so many of each kind."""
        with self._lock:
            problems: list[str] = []
            return self._snapshots(problems, count), self._windows(problems), problems

    def summaries(self) -> dict[str, Any]:
        """Summaries {snapshots, windows, problems}; windows: of outcomes.

        Snapshots come oldest first, each as `describe_snapshot`, with `training`, `fresh_pairs` (learnability of fresh
        levels in the same windows), `probe` and `retained` (levels that the snapshot before it had too) where known.
        """
        snapshots, windows, problems = self.read()
        plays = training_plays(windows)
        described = []
        for position, snapshot in enumerate(snapshots):
            try:
                entry = self._describe(snapshot)
            except KeyError as error:
                problems.append(f"{snapshot.kind} {snapshot.number} lacks {error}; it is left out")
                continue
            following = next((other for other in snapshots[position + 1 :] if other.kind == snapshot.kind), None)
            before = next((other for other in reversed(snapshots[:position]) if other.kind == snapshot.kind), None)
            if snapshot.kind == REFRESH and snapshot.number in plays:
                entry["training"] = describe_training(plays[snapshot.number])
                entry["fresh_pairs"] = learnability_of_pairs(windows_of(windows, snapshot.number))
            if snapshot.kind == REFRESH and following is not None:
                if following.arrays.get("probe/policy_version") == snapshot.number:
                    entry["probe"] = describe_probe(snapshot, following)
            if before is not None:
                entry["retained"] = len(np.intersect1d(before.arrays["level_id"], snapshot.arrays["level_id"]))
            described.append(entry)
        return {"snapshots": described, "windows": [_describe_window(row) for row in windows], "problems": problems}

    def _describe(self, snapshot: Snapshot) -> dict[str, Any]:
        """A copy of `describe_snapshot`, which is worked out once for a file. Raises KeyError."""
        key = (snapshot.kind, snapshot.number)
        if key not in self._described or self._described[key][0] is not snapshot:
            self._described[key] = (snapshot, describe_snapshot(snapshot))
        return dict(self._described[key][1])

    def snapshot(self, kind: str, number: int) -> Snapshot:
        """Snapshot without levels. Raises KeyError where there is none, SnapshotError, OSError."""
        for found_kind, found_number, path in list_snapshots(self._path / run_files.CURRICULUM):
            if (found_kind, found_number) == (kind, number):
                with self._lock:
                    return self._snapshot(path)
        raise KeyError(f"there is no {kind} {number} in this run")

    def plays(self, number: int) -> Plays | None:
        """Plays in training of the buffer of a refresh."""
        with self._lock:
            return training_plays(self._windows([])).get(number)

    def _snapshots(self, problems: list[str], newest: int | None = None) -> list[Snapshot]:
        """newest: how many of each kind; None: all."""
        listed, found = list_snapshots(self._path / run_files.CURRICULUM), []
        if newest is not None:
            kept = {path for kind in KINDS for _, _, path in [one for one in listed if one[0] == kind][-newest:]}
            listed = [one for one in listed if one[2] in kept]
        for _, _, path in listed:
            try:
                found.append(self._snapshot(path))
            except SnapshotError as error:
                problems.append(str(error).replace(f"{path}", path.name))
            except OSError as error:
                problems.append(f"{path.name} cannot be read ({error.strerror})")
        return found

    def _snapshot(self, path: Path) -> Snapshot:
        status = path.stat()
        key = (status.st_mtime_ns, status.st_size)
        if path not in self._read or self._read[path][0] != key:
            self._read[path] = (key, read_snapshot(path, with_levels=False))
        return self._read[path][1]

    def _windows(self, problems: list[str]) -> list[dict[str, Any]]:
        bytes_left = 1
        while bytes_left:
            try:
                found = self._outcomes.poll()
            except OSError as error:
                problems.append(f"{run_files.OUTCOMES} cannot be read ({error.strerror})")
                return []
            self._rows = [*([] if found.is_restarted else self._rows), *found.rows]
            bytes_left = found.bytes_left
        if damaged := self._outcomes.num_damaged:
            problems.append(run_files.damaged_lines(damaged, run_files.OUTCOMES))
        return self._rows


def windows_of(windows: Iterable[Mapping[str, Any]], buffer: int) -> list[Mapping[str, Any]]:
    """Windows in which the buffer of a refresh was in use."""
    return [row for row in windows if row.get("buffer") == buffer]


def _describe_window(row: Mapping[str, Any]) -> dict[str, Any]:
    """Window {from_update, update, sources: {name: rate}, fresh_pairs}; `buffer` is the source of levels that the
    window lists, and fresh_pairs is None where the run does not record them."""
    sources = {name: rate(counts["solved"], counts["attempts"]) for name, counts in row["sources"].items()}
    if "solved" in row:
        sources = {"buffer": rate(sum(row["solved"]), sum(row["attempts"]))} | sources
    return {
        "from_update": row["from_update"],
        "update": row["update"],
        "sources": sources,
        "fresh_pairs": learnability_of_pairs([row]),
    }


def _is_window(row: dict[str, Any]) -> bool:
    """True for a line with all fields that are read; other lines count as damaged."""
    if not is_outcomes(row) or not isinstance(row.get("from_update"), int):
        return False
    if FRESH_PAIRS in row and not is_pairs(row[FRESH_PAIRS]):
        return False
    counts = [row.get("solved", []), row.get("attempts", [])]
    sources = row["sources"].values()
    if not all(isinstance(source, dict) for source in sources):
        return False
    counts += [[source.get(name) for source in sources] for name in ("solved", "attempts")]
    return _are_counts(*counts[:2]) and _are_counts(*counts[2:])


def _are_counts(solved: Any, attempts: Any) -> bool:
    """True for two lists of as many integers, of which none of the first is above that of the second or below 0."""
    if not isinstance(solved, list) or not isinstance(attempts, list) or len(solved) != len(attempts):
        return False
    if not solved:
        return True
    try:
        arrays = [np.asarray(values) for values in (solved, attempts)]
    except ValueError:  # lists in lists, of different lengths
        return False
    if not all(array.ndim == 1 and array.dtype.kind == "i" for array in arrays):
        return False
    return bool((arrays[0] >= 0).all() and (arrays[0] <= arrays[1]).all())


def _histogram(values: np.ndarray) -> dict[str, Any]:
    """Histogram {edges, counts, unknown} with 20 bins over finite values."""
    finite = values[np.isfinite(values)]
    counts, edges = np.histogram(finite, bins=20) if len(finite) else (np.zeros(0, int), np.zeros(0))
    return {"edges": edges.tolist(), "counts": counts.tolist(), "unknown": int(len(values) - len(finite))}
