"""Held-out sets of a verdict: solve rates now, before and at best, against each other and against random actions.

Two rates of one set are compared by the interval of their difference:

    a set of variants        over base levels, paired by level (evaluation/paired_levels.py)
    other sets               of two independent rates, from Wilson's intervals (Newcombe). The levels are the same, so
                             that it is too wide rather than too narrow

The best of k earlier evaluations is best by chance too: its interval is of k comparisons together (Bonferroni).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

from kinetix_dist.evaluation.intervals import (
    Estimate,
    difference_interval,
    for_readers,
    t_95,
    wilson_interval,
    z_95,
)
from kinetix_dist.evaluation.paired_levels import difference_over_levels
from kinetix_dist.level.level_data import base_levels
from kinetix_dist.studio.runs.evaluations import PHASES
from kinetix_dist.studio.runs.statements import (
    BAD,
    GOOD,
    NEUTRAL,
    UNKNOWN,
    Statement,
    change,
    counted,
    is_above,
    is_below,
    percent,
    points,
)

Point = Mapping[str, Any]  # of `evaluations.evaluations`
RANDOM = PHASES[0]
LOST_SHARE = 0.5  # of what was gained until the best evaluation: a set that lost as much collapsed


@dataclasses.dataclass(frozen=True, kw_only=True)
class SetHistory:
    """Evaluations of one set: the first, the best before the last, the last, random actions; and their differences."""

    name: str
    levels: Sequence[str] | None  # names of its levels; None: there are counts of the whole set alone
    first: Point
    best: Point
    now: Point
    random: Point | None
    since_first: Estimate | None  # None: there is one evaluation
    since_best: Estimate | None
    since_half: Estimate | None  # since the last evaluation of the first half of its updates
    above_random: Estimate | None

    @property
    def has_gained(self) -> bool:
        return is_above(self.since_first)

    @property
    def is_worse(self) -> bool:
        """Below its first or its best evaluation, or below random actions after it was not."""
        return is_below(self.since_first) or is_below(self.since_best)

    @property
    def is_lost(self) -> bool:
        """Half of what was gained until the best evaluation is gone, or half of the first rate where none was."""
        if not self.is_worse:
            return False
        floor = self.first["rate"] if self.best["rate"] > self.first["rate"] else 0.0
        return self.now["rate"] <= self.top["rate"] - LOST_SHARE * (self.top["rate"] - floor)

    @property
    def top(self) -> Point:
        """The best evaluation before the last one, the first one included."""
        return self.best if self.best["rate"] > self.first["rate"] else self.first


def set_histories(evaluated: Mapping[str, Any] | None) -> list[SetHistory]:
    """Histories of the sets that the policy was evaluated on. evaluated: `evaluations.evaluations` of the run."""
    found = []
    for name, entry in (evaluated or {"sets": {}})["sets"].items():
        known = [point for point in entry["points"] if point["rate"] is not None and point["episodes"]]
        random = next((point for point in known if point["phase"] == RANDOM), None)
        # A run that was resumed after its end goes on behind its evaluation `after`.
        played = sorted(
            (point for point in known if point["phase"] != RANDOM),
            key=lambda point: (point["update"] or 0, PHASES.index(point["phase"])),
        )
        if played:
            found.append(_history(name, entry["names"], played, random))
    return found


def _history(name: str, levels: Sequence[str] | None, played: Sequence[Point], random: Point | None) -> SetHistory:
    first, now, earlier = played[0], played[-1], played[:-1]
    best = max(earlier, key=lambda point: point["rate"]) if earlier else now
    return SetHistory(
        name=name,
        levels=levels,
        first=first,
        best=best,
        now=now,
        random=random,
        since_first=_difference(name, levels, now, first) if earlier else None,
        since_best=_difference(name, levels, now, best, len(earlier)) if earlier else None,
        since_half=_difference(name, levels, now, _halfway(earlier, now)) if earlier else None,
        above_random=None if random is None else _difference(name, levels, now, random),
    )


def _halfway(earlier: Sequence[Point], now: Point) -> Point:
    half = (now["update"] or 0) / 2
    return [point for point in earlier if (point["update"] or 0) <= half or point is earlier[0]][-1]


def _difference(
    name: str, levels: Sequence[str] | None, now: Point, other: Point, comparisons: int = 1
) -> Estimate | None:
    """Difference of the rates of two evaluations, with its 95 % interval."""
    if levels is not None and now["solved"] is not None and other["solved"] is not None:
        bases = base_levels(name, levels)
        if len(set(bases)) < len(bases):
            rates = [[solved / point["attempts"] for solved in point["solved"]] for point in (now, other)]
            paired = difference_over_levels(rates[0], rates[1], bases, comparisons=comparisons)
            if paired is not None:
                return paired
    return difference_interval(_estimate(now, comparisons), _estimate(other, comparisons))


def _estimate(point: Point, comparisons: int) -> Estimate:
    over = point["interval_over_levels"]
    if over is not None and over["base_levels"] < over["levels"]:
        low, high = for_readers(point)
        widened = t_95(over["base_levels"] - 1, comparisons) / t_95(over["base_levels"] - 1)
        rate = point["rate"]
        return rate, rate - widened * (rate - low), rate + widened * (high - rate)
    low, high = wilson_interval(point["rate"] * point["episodes"], point["episodes"], z_95(comparisons))
    return point["rate"], low, high


def set_statements(histories: Sequence[SetHistory], config: Mapping[str, Any]) -> list[Statement]:
    """A statement per set, and one that names the sets that got worse."""
    if not histories:
        return [
            Statement(key="sets", title="Held-out sets", state=UNKNOWN, sentence=_none_yet(config), page="evaluation")
        ]
    return [*(_set_statement(history, config) for history in histories), _worse_statement(histories)]


def _set_statement(history: SetHistory, config: Mapping[str, Any]) -> Statement:
    now, random, above = history.now, history.random, history.above_random
    sentence = f"{_rate(now)} {_when(now)}"
    if history.since_first is not None:
        sentence = f"{_rate(history.first)} {_when(history.first)} → {sentence}: {change(history.since_first)}"
    if random is None or above is None:
        sentence += ". Random actions were not played."
    else:
        side = "above" if is_above(above) else "below" if is_below(above) else "not different by more than chance"
        sentence += f". Random actions {_rate(random)}: {side} ({points(above)})."
    if history.since_first is None:
        sentence += f" {_next_evaluation(config)}"
    return Statement(
        key=f"set/{history.name}",
        title=history.name,
        state=_set_state(history),
        sentence=sentence,
        page="evaluation",
        query={
            "set": history.name,
            "sort": "lost_best" if history.is_worse else "least",
            "panel": f"{history.name}: ",
        },
    )


def _set_state(history: SetHistory) -> str:
    if history.is_worse or (is_below(history.above_random) and history.since_first is not None):
        return BAD
    if history.since_first is None:
        return UNKNOWN
    beats_random = history.random is None or is_above(history.above_random)
    return GOOD if history.has_gained and beats_random else NEUTRAL


def _worse_statement(histories: Sequence[SetHistory]) -> Statement:
    title, compared = "Sets that got worse", [one for one in histories if one.since_first is not None]
    worse = [one for one in compared if one.is_worse]
    if not compared:
        sentence = "Needs two evaluations of a set; there is one."
        return Statement(key="worse", title=title, state=UNKNOWN, sentence=sentence, page="evaluation")
    if not worse:
        names = compared[0].name if len(compared) == 1 else f"None of {len(compared)} sets"
        isnt = "is not" if len(compared) == 1 else "is"
        sentence = f"{names} {isnt} below its first or its best evaluation by more than chance."
        return Statement(key="worse", title=title, state=GOOD, sentence=sentence, page="evaluation")
    losses = []
    for one in worse:
        since = "best" if is_below(one.since_best) else "first"
        point, difference = (one.best, one.since_best) if since == "best" else (one.first, one.since_first)
        assert difference is not None
        losses.append(
            f"{one.name}, {change(difference)} since its {since} evaluation ({percent(point['rate'])} {_when(point)})"
        )
    return Statement(
        key="worse",
        title=title,
        state=BAD,
        sentence=f"{len(worse)} of {counted(len(compared), 'set')}: {'; '.join(losses)}.",
        remedy="lower ppo.learning_rate, or train on levels nearer to these sets",
        page="evaluation",
        query={"set": worse[0].name, "sort": "lost_best", "panel": f"{worse[0].name}: "},
    )


def _rate(point: Point) -> str:
    low, high = for_readers(point)
    return f"{percent(point['rate'])} ({100 * low:.1f} to {100 * high:.1f}; {counted(point['episodes'], 'attempt')})"


def _when(point: Point) -> str:
    if point["phase"] == "before":
        return "before training"
    return "at an unknown update" if point["update"] is None else f"at update {point['update']:,}"


def _none_yet(config: Mapping[str, Any]) -> str:
    evaluation = config.get("evaluation")
    sets = evaluation.get("sets") if isinstance(evaluation, dict) else None
    if sets == [] or sets == ():
        return "No set is evaluated: evaluation.sets is empty."
    return f"No evaluation so far; the first comes before the first update. {_next_evaluation(config)}"


def _next_evaluation(config: Mapping[str, Any]) -> str:
    evaluation = config.get("evaluation")
    values = evaluation if isinstance(evaluation, dict) else {}
    if values.get("every"):
        return f"Evaluations come every {counted(values['every'], 'update')} (evaluation.every)."
    if values.get("every_seconds"):
        return f"Evaluations come every {values['every_seconds']:g} s (evaluation.every_seconds)."
    return "One comes after the last update; evaluation.every brings some in between."
