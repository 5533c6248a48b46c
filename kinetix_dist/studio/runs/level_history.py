"""What is known of one level over a run: when it was scored, kept, played in training, and played again.

A level is told by `level_id`, a hash of its arrays: the same level has the same id in all snapshots.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from kinetix_dist.studio.runs.refreshes import is_of_all_episodes, rate, tries_of
from kinetix_dist.telemetry.curriculum_log import REFRESH, Snapshot


def level_history(
    snapshots: Sequence[Snapshot], windows: Iterable[Mapping[str, Any]], kind: str, number: int, index: int
) -> dict[str, Any]:
    """{id, snapshots, windows, played_again} of level `index` of snapshot (kind, number).

    snapshots: where the level is, oldest first: {kind, number, index, update, score, scored (rate or absent)}.
    windows: {from_update, update, of_all_episodes, solved, episodes, rate, low, high} of training, those that played it
    alone. played_again: rates by the policy of a later refresh, {policy_version, solved, ...}.
    Raises KeyError for a snapshot that is not there, IndexError for a level that it does not have.
    """
    chosen = {(snapshot.kind, snapshot.number): snapshot for snapshot in snapshots}[kind, number]
    level_id = chosen.arrays["level_id"][index]
    found = [
        (snapshot, int(place))
        for snapshot in snapshots
        for place in np.flatnonzero(snapshot.arrays["level_id"] == level_id)
    ]
    rows_of = {snapshot.number: place for snapshot, place in found if snapshot.kind == REFRESH}
    return {
        "id": f"{int(level_id):016x}",
        "snapshots": [_appearance(snapshot, place) for snapshot, place in found],
        "windows": [
            {
                "from_update": window["from_update"],
                "update": window["update"],
                "of_all_episodes": is_of_all_episodes(window),
                **counts,
            }
            for window in windows
            if (counts := _plays_in(window, rows_of)) is not None
        ],
        "played_again": [again for snapshot in snapshots if (again := _played_again(snapshot, rows_of)) is not None],
    }


def _appearance(snapshot: Snapshot, place: int) -> dict[str, Any]:
    arrays = snapshot.arrays
    score = float(arrays["score"][place])
    described: dict[str, Any] = {
        "kind": snapshot.kind,
        "number": snapshot.number,
        "index": place,
        "update": int(arrays["written_after"]),
        "score": score if np.isfinite(score) else None,
    }
    if "solved" in arrays:
        described["scored"] = rate(arrays["solved"][place], arrays["finished"][place])
    return described


def _plays_in(window: Mapping[str, Any], rows_of: Mapping[int, int]) -> dict[str, Any] | None:
    """Counts of the level in a window; None where its buffer was not in use, or it was not played."""
    place = rows_of.get(window["buffer"]) if isinstance(window.get("buffer"), int) else None
    if place is None:
        return None
    tries = window[tries_of(window)]
    if place >= len(tries) or not tries[place]:
        return None
    return rate(window["solved"][place], tries[place])


def _played_again(snapshot: Snapshot, rows_of: Mapping[int, int]) -> dict[str, Any] | None:
    arrays = snapshot.arrays
    place = rows_of.get(int(arrays["probe/policy_version"])) if "probe/index" in arrays else None
    if place is None:
        return None
    where = np.flatnonzero(arrays["probe/index"] == place)
    if not len(where):
        return None
    return {"policy_version": snapshot.number} | rate(
        arrays["probe/solved"][where[0]], arrays["probe/finished"][where[0]]
    )
