"""Failing of a verdict: levels that no attempt solves, and the group of levels that fails most beyond the rest.

    counts of evaluations.jsonl + features of levels --failure_groups--> groups of each set --failing_statement--> line

Features come from the engine, which builds a set again; where they are not known, families are grouped alone: they
follow from the names of the levels.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from kinetix_dist.studio.runs.failure_groups import DISTANCE, FAMILY, OTHER_NAMES, groups_of_set
from kinetix_dist.studio.runs.statements import NEUTRAL, Statement, counted, percent
from kinetix_dist.studio.runs.verdict_sets import SetHistory

Features = Mapping[str, Sequence[float]]  # columns of a set's levels, by name


def sets_with_counts(histories: Sequence[SetHistory]) -> list[SetHistory]:
    """Sets whose newest evaluation has counts of each level."""
    return [one for one in histories if one.now["solved"] and one.levels is not None]


def failing_statement(
    histories: Sequence[SetHistory],
    features: Mapping[str, Features] | None = None,
    problems: Mapping[str, str] | None = None,
) -> list[Statement]:
    """Statement on levels that fail now, and what goes with failing. Empty without counts.

    features: of each set, by its name. problems: why features of a set are not known, a line without its stop.
    """
    found = sets_with_counts(histories)
    if not found:
        return []
    never = {one.name: one.now["solved"].count(0) / len(one.now["solved"]) for one in found}
    parts = [
        f"{one.name} {one.now['solved'].count(0):,} of {counted(len(one.now['solved']), 'level')} "
        f"({percent(never[one.name])}, {counted(one.now['attempts'], 'attempt')} each)"
        for one in found
    ]
    sentences = [f"Solved in no attempt now: {', '.join(parts)}."]
    linked, gap = max(found, key=lambda one: never[one.name]).name, 0.0
    query: dict[str, str] = {}
    for one in found:
        known = (features or {}).get(one.name)
        worst = _worst_group(one, known or {})
        if worst is not None:
            feature, group = worst
            sentences.append(f"In {one.name}, {_named(feature, group)}.")
            if group["difference"]["high"] < gap:
                linked, gap, query = one.name, group["difference"]["high"], {"group": feature["feature"]}
        elif known is not None:
            sentences.append(f"In {one.name} no feature goes clearly with failing.")
        if known is None and one.name in (problems or {}):
            sentences.append(f"Features of its levels are not known: {(problems or {})[one.name]}.")
    return [
        Statement(
            key="failing",
            title="What fails",
            state=NEUTRAL,
            sentence=" ".join(dict.fromkeys(sentences)),
            page="evaluation",
            query={"set": linked, "sort": "least", "panel": f"What fails in {linked}"} | query,
        )
    ]


def _worst_group(history: SetHistory, features: Features) -> tuple[Mapping[str, Any], Mapping[str, Any]] | None:
    """(grouping, group) that is solved less than all other levels by most, by the end of its interval nearest to 0."""
    assert history.levels is not None
    now = history.now
    groupings = groups_of_set(history.name, history.levels, now["solved"], now["attempts"], features)
    below = [
        (grouping, group)
        for grouping in groupings
        for group in grouping["groups"]
        if group["is_clear"] and group["difference"]["high"] < 0 and group["label"] != OTHER_NAMES
    ]
    return min(below, key=lambda pair: pair[1]["difference"]["high"]) if below else None


def _named(grouping: Mapping[str, Any], group: Mapping[str, Any]) -> str:
    """levels with 4 or more joints fail most beyond the rest: 12.0 % (48 of 400) against 55.0 % (...) of all others"""
    others, difference = group["others"], group["difference"]
    value, low, high = (-100 * difference[end] for end in ("value", "high", "low"))
    feature, label = grouping["feature"], group["label"]
    levels = {FAMILY: f"levels of family {label}", DISTANCE: f"levels with green and blue {label} apart"}.get(
        feature, f"levels with {label}"
    )
    return (
        f"{levels} fail most beyond the rest: {percent(group['rate'])} ({group['solved']:,} of {group['attempts']:,} "
        f"attempts, {counted(len(group['levels']), 'level')}) are solved, of all others {percent(others['rate'])} "
        f"({others['solved']:,} of {others['attempts']:,}): {value:.1f} points less ({low:.1f} to {high:.1f})"
    )
