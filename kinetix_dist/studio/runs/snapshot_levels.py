"""Levels of snapshots: one snapshot sorted, filtered and paged; and the history of one level over all snapshots.

`level_id` is a hash of a level's arrays: the same level has the same id in all snapshots.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from kinetix_dist.studio.runs.refreshes import Plays, rate
from kinetix_dist.telemetry.curriculum_log import REFRESH, Snapshot

_FILTER = re.compile(r"(\w+)\s*(<=|>=|=|<|>)\s*(-?\d+(?:\.\d+)?)")
_COMPARE = {"<": np.less, "<=": np.less_equal, "=": np.equal, ">=": np.greater_equal, ">": np.greater}


class LevelQueryError(ValueError):
    """A sort or a filter that a snapshot has no data for."""


def level_page(
    snapshot: Snapshot, plays: Plays | None, *, sort: str, descending: bool, filter_text: str, offset: int, limit: int
) -> dict[str, Any]:
    """Page of levels {total, matching, levels: [{index, id, score, features, solved, finished, ..., training}]}.

    filter_text: conditions on columns, "joints>=1 p<0.5". Raises LevelQueryError.
    """
    columns = level_columns(snapshot, plays)
    chosen = np.flatnonzero(_matches(columns, filter_text, len(snapshot.arrays["level_id"])))
    if sort != "slot":
        if sort not in columns:
            raise LevelQueryError(f"these levels have no {sort!r}; they can be sorted by slot, {', '.join(columns)}")
        keys = columns[sort][chosen].astype(float)
        keys = np.where(np.isnan(keys), np.inf, -keys if descending else keys)  # unknown values come last
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
    """Columns [n] by the names that filters and sorts use; nan where a level was not played."""
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
        described["training"] = rate(plays.solved[index], plays.attempts[index])
    for name in ("born", "last_played", "slot"):
        if name in arrays:
            described[name] = int(arrays[name][index])
    return described


def _share(solved: np.ndarray, finished: np.ndarray) -> np.ndarray:
    return np.divide(solved, finished, out=np.full(len(solved), np.nan), where=finished > 0)


def level_history(
    snapshots: Sequence[Snapshot], windows: Iterable[Mapping[str, Any]], kind: str, number: int, index: int
) -> dict[str, Any]:
    """History {id, snapshots, windows, played_again} of level `index` of snapshot (kind, number).

    snapshots: where the level is, oldest first: {kind, number, index, update, score, scored (rate or absent)}.
    windows: {from_update, update, solved, episodes, rate, low, high} of training, only those that
    played it. played_again: rates by the policy of a later refresh, {policy_version, solved, ...}.
    Raises KeyError for a snapshot that is not there, IndexError for a level that it does not have.
    """
    chosen = {(snapshot.kind, snapshot.number): snapshot for snapshot in snapshots}[kind, number]
    level_id = chosen.arrays["level_id"][index]
    found = [
        (snapshot, int(row))
        for snapshot in snapshots
        for row in np.flatnonzero(snapshot.arrays["level_id"] == level_id)
    ]
    rows_of = {snapshot.number: row for snapshot, row in found if snapshot.kind == REFRESH}
    return {
        "id": f"{int(level_id):016x}",
        "snapshots": [_appearance(snapshot, row) for snapshot, row in found],
        "windows": [
            {
                "from_update": window["from_update"],
                "update": window["update"],
                **counts,
            }
            for window in windows
            if (counts := _plays_in(window, rows_of)) is not None
        ],
        "played_again": [again for snapshot in snapshots if (again := _played_again(snapshot, rows_of)) is not None],
    }


def _appearance(snapshot: Snapshot, row: int) -> dict[str, Any]:
    arrays = snapshot.arrays
    score = float(arrays["score"][row])
    described: dict[str, Any] = {
        "kind": snapshot.kind,
        "number": snapshot.number,
        "index": row,
        "update": int(arrays["written_after"]),
        "score": score if np.isfinite(score) else None,
    }
    if "solved" in arrays:
        described["scored"] = rate(arrays["solved"][row], arrays["finished"][row])
    return described


def _plays_in(window: Mapping[str, Any], rows_of: Mapping[int, int]) -> dict[str, Any] | None:
    """Counts of the level in a window; None where its buffer was not in use, or it was not played."""
    row = rows_of.get(window["buffer"]) if isinstance(window.get("buffer"), int) else None
    if row is None:
        return None
    attempts = window["attempts"]
    if row >= len(attempts) or not attempts[row]:
        return None
    return rate(window["solved"][row], attempts[row])


def _played_again(snapshot: Snapshot, rows_of: Mapping[int, int]) -> dict[str, Any] | None:
    arrays = snapshot.arrays
    row = rows_of.get(int(arrays["probe/policy_version"])) if "probe/index" in arrays else None
    if row is None:
        return None
    where = np.flatnonzero(arrays["probe/index"] == row)
    if not len(where):
        return None
    return {"policy_version": snapshot.number} | rate(
        arrays["probe/solved"][where[0]], arrays["probe/finished"][where[0]]
    )
