"""Levels of a verdict: what the curriculum has made easy, and what it never touches, by counts of features.

Easy: levels of a buffer, played again by the policy of the next refresh (a probe); without one, by the last attempts of
training at that buffer. Untouched: candidates that are hardly ever solved, and values of features that no buffer held
although chance would have brought some.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from kinetix_dist.evaluation.intervals import Estimate, difference_interval, wilson_interval, z_95
from kinetix_dist.evaluation.paired_levels import difference_over_levels
from kinetix_dist.studio.runs.refreshes import CHOOSES_WHILE_SCORING, Plays, training_plays, windows_of
from kinetix_dist.studio.runs.statements import (
    GOOD,
    NEUTRAL,
    UNKNOWN,
    Statement,
    change,
    counted,
    is_above,
    percent,
    rate_with_count,
)
from kinetix_dist.telemetry.curriculum_log import Snapshot

MIN_EPISODES = 3  # of a level that is called solved always
MIN_LEVELS = 10  # of a value of a feature that is named
EXPECTED = 5  # levels of a buffer that chance would bring; a value that none has is then no chance
HARDLY = 0.05  # solve rate, upper end of the interval: hardly ever solved
MAX_NAMED = 3


@dataclasses.dataclass(frozen=True, kw_only=True)
class Replayed:
    """Levels [n] of a buffer that were played again, and their earlier plays in training."""

    number: int  # of the refresh that chose them
    solved: np.ndarray
    finished: np.ndarray  # above 0
    earlier: Plays | None  # of the same levels, in the first half of the windows of their use
    features: np.ndarray  # [n, F]
    feature_names: tuple[str, ...]
    how: str  # and when
    query: Mapping[str, str]  # of page Curriculum


def replayed(refreshes: Sequence[Snapshot], windows: Sequence[Mapping[str, Any]]) -> Replayed | None:
    """The newest probe; else the last half of the windows of the newest buffer that has two or more."""
    by_number = {snapshot.number: snapshot for snapshot in refreshes}
    for snapshot in reversed(refreshes):
        arrays = snapshot.arrays
        before = by_number.get(int(arrays["probe/policy_version"])) if "probe/index" in arrays else None
        if before is not None:
            rows, first = np.unique(arrays["probe/index"], return_index=True)
            now = [arrays[f"probe/{name}"][first].astype(np.int64) for name in ("solved", "finished")]
            own = windows_of(windows, before.number)
            return _replayed(before, rows, now, own, f"played again at refresh {snapshot.number}")
    for snapshot in reversed(refreshes):
        own = windows_of(windows, snapshot.number)
        late = training_plays(own[len(own) // 2 :]).get(snapshot.number) if len(own) > 1 else None
        if late is not None and len(late.solved) == len(snapshot.arrays["level_id"]):
            rows = np.flatnonzero(late.attempts >= MIN_EPISODES)
            if len(rows) >= MIN_LEVELS:
                how = f"played in training in updates {late.from_update:,} to {late.update:,}"
                return _replayed(snapshot, rows, [late.solved[rows], late.attempts[rows]], own, how)
    return None


def _replayed(
    snapshot: Snapshot, rows: np.ndarray, now: Sequence[np.ndarray], own: Sequence[Mapping[str, Any]], how: str
) -> Replayed:
    arrays = snapshot.arrays
    is_played = now[1] > 0
    rows = rows[is_played]
    earlier = training_plays(own[: max(len(own) // 2, 1)]).get(snapshot.number)
    if earlier is not None and len(earlier.solved) == len(arrays["level_id"]):
        earlier = dataclasses.replace(earlier, solved=earlier.solved[rows], attempts=earlier.attempts[rows])
    else:
        earlier = None
    return Replayed(
        number=snapshot.number,
        solved=now[0][is_played],
        finished=now[1][is_played],
        earlier=earlier,
        features=arrays["features"][rows],
        feature_names=tuple(map(str, arrays["feature_names"])),
        how=how,
        query={"panel": "What was learned", "refresh": str(snapshot.number)},
    )


def easy_statement(found: Replayed | None) -> Statement:
    """Share of the levels that are solved in each of their episodes, features that stand out, and the rise of their
    solve rate since they came in.

    Few episodes chose the levels, so that some were easy from the start: the rise is measured from plays in training,
    which chose nothing.
    """
    title = "Made easy"
    if found is None or not len(found.solved):
        sentence = (
            "Not known yet: no level of a buffer was played again (curriculum_log.probe_levels), "
            f"or {MIN_EPISODES} times in the last windows of its use."
        )
        return Statement(key="easy", title=title, state=UNKNOWN, sentence=sentence, page="curriculum")
    is_easy = found.solved == found.finished
    num, easy = len(is_easy), int(is_easy.sum())
    sentence = (
        f"Of {counted(num, 'level')} of buffer {found.number}, {found.how}, "
        f"{rate_with_count(easy, num, *wilson_interval(easy, num))} were solved in every episode "
        f"({found.finished.mean():.1f} each)."
    )
    named = _standing_out(found, is_easy)
    sentence += f" More often than others: {', '.join(named)}." if named else " No count of a feature stands out."
    rise, text = _rise(found)
    state = GOOD if is_above(rise) else NEUTRAL
    return Statement(
        key="easy", title=title, state=state, sentence=f"{sentence} {text}", page="curriculum", query=found.query
    )


def _standing_out(found: Replayed, is_easy: np.ndarray) -> list[str]:
    """Values of features whose levels are easy more often than the others, by more than chance; the easiest first."""
    groups = [
        (name, value, mask)
        for name, values in zip(found.feature_names, found.features.T, strict=True)
        for value in np.unique(values)
        if (mask := values == value).sum() >= MIN_LEVELS and (~mask).sum() >= MIN_LEVELS
    ]
    standing_out = []
    for name, value, mask in groups:
        inside, outside = (_estimate(is_easy[each], len(groups)) for each in (mask, ~mask))
        if is_above(difference_interval(inside, outside)):
            standing_out.append((inside[0], f"{_value(name, value)} ({int(is_easy[mask].sum())} of {int(mask.sum())})"))
    return [text for _, text in sorted(standing_out, reverse=True)[:MAX_NAMED]]


def _rise(found: Replayed) -> tuple[Estimate | None, str]:
    """Mean solve rate now less that in the first plays of training, paired by level; and a sentence."""
    earlier = found.earlier
    both = earlier.attempts > 0 if earlier is not None else np.zeros(len(found.solved), bool)
    if earlier is None or both.sum() < MIN_LEVELS:
        return None, "How easy they were before is not known: training counted too few attempts at them."
    now = found.solved[both] / found.finished[both]
    then = earlier.solved[both] / earlier.attempts[both]
    rise = difference_over_levels(now.tolist(), then.tolist(), [str(level) for level in range(len(now))])
    if rise is None:  # all differ alike: by attempts then
        counts = ((found.solved, found.finished), (earlier.solved, earlier.attempts))
        rates = (_rate(int(solved[both].sum()), int(plays[both].sum())) for solved, plays in counts)
        rise = difference_interval(*rates)
    when = f"updates {earlier.from_update:,} to {earlier.update:,}"
    return rise, (
        f"Their mean solve rate went from {percent(float(then.mean()))} in training ({when}, "
        f"{counted(int(earlier.attempts[both].sum()), 'attempt')}) to {percent(float(now.mean()))} "
        f"({counted(int(found.finished[both].sum()), 'episode')}): {change(rise)}."
    )


def _rate(solved: int, plays: int) -> Estimate:
    return (solved / plays, *wilson_interval(solved, plays))


def _estimate(flags: np.ndarray, comparisons: int) -> Estimate:
    low, high = wilson_interval(int(flags.sum()), len(flags), z_95(comparisons))
    return float(flags.mean()), low, high


def untouched_statement(refreshes: Sequence[Snapshot]) -> Statement:
    """Candidates of the newest refresh that were never solved, and values of features that no buffer of these held.

    refreshes: one or more, oldest first.
    """
    title = "Never touched"
    newest = refreshes[-1]
    arrays = newest.arrays
    query = {"panel": "Solve rate by number of", "refresh": str(newest.number)}
    if str(arrays["curriculum"]) in CHOOSES_WHILE_SCORING:
        sentence = (
            "Not known: this curriculum scores some candidates again, so that they are no sample of the generator."
        )
        return Statement(key="untouched", title=title, state=UNKNOWN, sentence=sentence, page="curriculum", query=query)
    solved, finished = (arrays[f"candidates/{name}"].astype(np.int64) for name in ("solved", "finished"))
    is_never = (solved == 0) & (finished > 0)
    num, never = int((finished > 0).sum()), int(is_never.sum())
    chosen = int(((arrays["solved"] == 0) & (arrays["finished"] > 0)).sum())
    if not num:
        sentence = f"No candidate of refresh {newest.number} finished an episode."
        return Statement(key="untouched", title=title, state=UNKNOWN, sentence=sentence, page="curriculum", query=query)
    sentence = (
        f"Of the candidates of refresh {newest.number}, {rate_with_count(never, num, *wilson_interval(never, num))} "
        f"were solved in none of their {finished[finished > 0].mean():.1f} episodes; the buffer holds {chosen} of "
        "these."
    )
    features = _untouched_features(refreshes)
    buffers = f"the newest {counted(len(refreshes), 'buffer')}" if len(refreshes) > 1 else "the buffer"
    sentence += (
        f" Hardly solved and in none of {buffers}: {', '.join(features[:MAX_NAMED])}."
        if features
        else f" No count of a feature is hardly solved and missing in {buffers}."
    )
    return Statement(key="untouched", title=title, state=NEUTRAL, sentence=sentence, page="curriculum", query=query)


def _untouched_features(refreshes: Sequence[Snapshot]) -> list[str]:
    """Values of features whose candidates are hardly ever solved, of which chance would have brought EXPECTED levels
    into buffers, and none is there; the most frequent first."""
    arrays = refreshes[-1].arrays
    names = [str(name) for name in arrays["feature_names"]]
    same = [one for one in refreshes if [str(name) for name in one.arrays["feature_names"]] == names]
    solved, finished = (arrays[f"candidates/{name}"].astype(np.int64) for name in ("solved", "finished"))
    held = np.concatenate([one.arrays["features"] for one in same])
    found = []
    for column, name in enumerate(names):
        values = arrays["candidates/features"][:, column]
        for value in np.unique(values):
            mask = (values == value) & (finished > 0)
            count = int(mask.sum())
            if count < MIN_LEVELS or len(held) * count / len(values) < EXPECTED or (held[:, column] == value).any():
                continue
            rate = float((solved[mask] / finished[mask]).mean())
            _, high = wilson_interval(rate * count, count)  # a level as one episode: never too narrow
            if high < max(HARDLY, 3 / count):
                episodes = f"{int(solved[mask].sum()):,} of {int(finished[mask].sum()):,} episodes"
                found.append((count, f"{_value(name, value)} ({counted(count, 'candidate')}, {episodes} solved)"))
    return [text for _, text in sorted(found, reverse=True)]


def _value(name: str, value: Any) -> str:
    """3 thrusters, 1 joint"""
    noun = name.replace("_", " ")
    return f"{int(value)} {noun.removesuffix('s') if int(value) == 1 else noun}"
