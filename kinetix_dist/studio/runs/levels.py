"""Levels of one snapshot of a buffer: sorted, filtered, a page of them at a time, each with its counts."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from kinetix_dist.studio.runs.refreshes import Plays, rate
from kinetix_dist.telemetry.curriculum_log import Snapshot

# What levels are sorted by; a snapshot has what it has.
SORTS = ("place", "score", "p", "p_training", "attempts_training")
_FILTER = re.compile(r"(\w+)\s*(<=|>=|=|<|>)\s*(-?\d+(?:\.\d+)?)")
_COMPARE = {"<": np.less, "<=": np.less_equal, "=": np.equal, ">=": np.greater_equal, ">": np.greater}


class LevelQueryError(ValueError):
    """A sort or a filter that a snapshot has no data for."""


def level_page(
    snapshot: Snapshot, plays: Plays | None, *, sort: str, descending: bool, filter_text: str, offset: int, limit: int
) -> dict[str, Any]:
    """{total, matching, levels: [{index, id, score, features, solved, finished, ..., training}]}.

    filter_text: conditions on columns, "joints>=1 p<0.5". Raises LevelQueryError.
    """
    columns = level_columns(snapshot, plays)
    chosen = np.flatnonzero(_matches(columns, filter_text, len(snapshot.arrays["level_id"])))
    if sort != "place":
        if sort not in columns:
            raise LevelQueryError(f"these levels have no {sort!r}; they can be sorted by place, {', '.join(columns)}")
        keys = columns[sort][chosen].astype(float)
        keys = np.where(np.isnan(keys), np.inf, -keys if descending else keys)  # what is unknown comes last
        chosen = chosen[np.argsort(keys, kind="stable")]
    elif descending:
        chosen = chosen[::-1]
    levels = [_describe(snapshot, plays, int(index)) for index in chosen[offset : offset + limit]]
    return {
        "total": len(snapshot.arrays["level_id"]),
        "matching": len(chosen),
        "columns": list(columns),
        "has_levels": snapshot.has_levels,
        "levels": levels,
    }


def level_columns(snapshot: Snapshot, plays: Plays | None) -> dict[str, np.ndarray]:
    """[n] each, by the names that filters and sorts use; nan where a level was not played."""
    arrays = snapshot.arrays
    columns: dict[str, np.ndarray] = {"score": arrays["score"]}
    if "solved" in arrays:
        columns["p"] = _share(arrays["solved"], arrays["finished"])
    if plays is not None and len(plays.solved) == len(arrays["level_id"]):
        columns["p_training"] = _share(plays.solved, plays.attempts)
        columns["attempts_training"] = plays.attempts
    for number, name in enumerate(arrays["feature_names"]):
        columns[str(name)] = arrays["features"][:, number]
    return columns


def _matches(columns: dict[str, np.ndarray], text: str, count: int) -> np.ndarray:
    is_matching = np.ones(count, bool)
    rest = _FILTER.sub("", text).replace(",", " ").strip()
    if rest:
        raise LevelQueryError(f"the filter has {rest!r}; write conditions such as joints>=1 p<0.5")
    for name, comparison, value in _FILTER.findall(text):
        if name not in columns:
            raise LevelQueryError(f"the filter names {name!r}; these levels have {', '.join(columns)}")
        is_matching &= _COMPARE[comparison](columns[name].astype(float), float(value))
    return is_matching


def _describe(snapshot: Snapshot, plays: Plays | None, index: int) -> dict[str, Any]:
    arrays = snapshot.arrays
    score = float(arrays["score"][index])
    described: dict[str, Any] = {
        "index": index,
        "id": f"{int(arrays['level_id'][index]):016x}",
        "score": score if np.isfinite(score) else None,
        "features": {
            str(name): int(value)
            for name, value in zip(arrays["feature_names"], arrays["features"][index], strict=True)
        },
    }
    if "solved" in arrays:
        described["scored"] = rate(arrays["solved"][index], arrays["finished"][index])
    if plays is not None and len(plays.solved) == len(arrays["level_id"]):
        described["training"] = rate(plays.solved[index], plays.attempts[index]) | {
            "of_all_episodes": plays.of_all_episodes
        }
    for name in ("born", "last_played", "place"):
        if name in arrays:
            described[name] = int(arrays[name][index])
    return described


def _share(solved: np.ndarray, finished: np.ndarray) -> np.ndarray:
    return np.divide(solved, finished, out=np.full(len(solved), np.nan), where=finished > 0)
