"""Training of a verdict: solve rates over time, signs of collapse, speed and its bottleneck, warnings.

Solve rates in training are of the fresh levels, an unbiased sample of the generator: those of a buffer fall with every
refresh. Windows are joined into CHUNKS parts of equal count, and the last part is compared with the first and with the
best. What came before the phase of now is left out, since another phase has other levels.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from kinetix_dist.studio.runs.series import SeriesTable
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
    rate_with_count,
)
from kinetix_dist.studio.runs.verdict_sets import SetHistory
from kinetix_dist.studio.runs.warnings import RECENT_ROWS
from kinetix_dist.evaluation.intervals import Estimate, difference_interval, wilson_interval, z_95
from kinetix_dist.telemetry.names import RED

CHUNKS = 10
MIN_ATTEMPTS = 100  # of a part that is compared
MIN_ROWS = 20  # of metrics, where there are no windows
LOST_SHARE = 0.5  # of its best: a solve rate that fell so far collapsed
ENTROPY_SHARE = 0.05  # of the first row: the policy hardly varies its actions any more
STALLED_SHARE = 0.5  # of the last rows with skipped gradient steps: little is learned
SLOW_SHARE = 0.5  # of the median speed
TIMES = {
    "rollout": "playing levels",
    "learn": "gradient steps",
    "curate": "scoring levels, or waiting for it",
    "evaluate": "evaluation",
    "record": "recording",
    "checkpoint": "checkpoints",
    "idle": "dispatch, transfers and waiting",
}
FRESH_PANEL = "Solve rate in training"  # of page Curriculum


@dataclasses.dataclass(frozen=True, kw_only=True)
class Part:
    """Solve rate over some updates. text: with its counts."""

    rate: float
    low: float
    high: float
    first_update: int
    last_update: int
    text: str

    @property
    def when(self) -> str:
        return f"updates {self.first_update:,} to {self.last_update:,}"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Trend:
    """Parts of a run, oldest first; at least two. source: of the levels."""

    source: str
    parts: tuple[Part, ...]
    link: tuple[str, str]  # page and panel

    @property
    def since_first(self) -> Estimate:
        return difference_interval(_estimate(self.parts[-1]), _estimate(self.parts[0]))

    @property
    def best(self) -> Part:
        return max(self.parts, key=lambda part: part.rate)

    @property
    def has_fallen(self) -> bool:
        """Half of its best is gone, by more than chance."""
        best, last = self.best, self.parts[-1]
        return last.rate <= LOST_SHARE * best.rate and is_below(difference_interval(_estimate(last), _estimate(best)))


def _estimate(part: Part) -> Estimate:
    return part.rate, part.low, part.high


def phase_start(table: SeriesTable) -> int:
    """Update after which the phase of the last row began; 0 for a run in its first."""
    phases, updates = table.column("progress/phase"), table.column("update")
    other = np.flatnonzero(phases != phases[-1]) if len(phases) and not np.isnan(phases[-1]) else np.zeros(0, int)
    return int(updates[other[-1]]) if len(other) else 0


def trend_of(table: SeriesTable, windows: Sequence[Mapping[str, Any]]) -> Trend | None:
    """Solve rates of fresh levels over the phase of now; None where there are too few.

    Of all levels where no window says where levels came from. A curriculum that chooses all levels has no trend: it may
    choose harder ones.
    """
    start = phase_start(table)
    if not windows:
        return _trend_of_rows(table, start)
    return _trend_of_windows([row for row in windows if row["from_update"] >= start])


def _trend_of_windows(windows: Sequence[Mapping[str, Any]]) -> Trend | None:
    counts = [(row["from_update"], row["update"], *counted) for row in windows if (counted := _fresh_counts(row))]
    total = sum(attempts for *_, attempts in counts)
    size = max(-(-total // CHUNKS), MIN_ATTEMPTS)
    parts: list[list[int]] = []
    for first, last, solved, attempts in counts:
        if not parts or parts[-1][3] >= size:
            parts.append([first, last, 0, 0])
        parts[-1][1], parts[-1][2], parts[-1][3] = last, parts[-1][2] + solved, parts[-1][3] + attempts
    if len(parts) > 1 and parts[-1][3] < MIN_ATTEMPTS:  # what is left joins the part before
        last = parts.pop()
        parts[-1] = [parts[-1][0], last[1], parts[-1][2] + last[2], parts[-1][3] + last[3]]
    if len(parts) < 2:
        return None
    z = z_95(len(parts) - 1)
    return Trend(
        source="fresh levels" if "fresh" in windows[-1]["sources"] else "its level set",
        parts=tuple(_part_of_counts(*part, z=z) for part in parts),
        link=("curriculum", FRESH_PANEL),
    )


def _fresh_counts(row: Mapping[str, Any]) -> tuple[int, int] | None:
    """(solved, attempts) of levels that no curriculum chooses: fresh ones, or those of a fixed set."""
    if "fresh" in row["sources"]:
        fresh = row["sources"]["fresh"]
        return (fresh["solved"], fresh["attempts"]) if fresh["attempts"] else None
    if "solved" in row and "buffer" not in row and sum(row["attempts"]):
        return sum(row["solved"]), sum(row["attempts"])
    return None


def _part_of_counts(first: int, last: int, solved: int, attempts: int, *, z: float) -> Part:
    low, high = wilson_interval(solved, attempts, z)
    text = rate_with_count(solved, attempts, *wilson_interval(solved, attempts))
    return Part(rate=solved / attempts, low=low, high=high, first_update=first, last_update=last, text=text)


def _trend_of_rows(table: SeriesTable, start: int) -> Trend | None:
    """Of a run without counts: means of rows, with intervals over rows."""
    updates, rates = table.column("update"), table.column("train/solve_rate")
    is_known = ~np.isnan(rates) & (updates > start)
    updates, rates = updates[is_known], rates[is_known]
    if len(rates) < MIN_ROWS:
        return None
    parts = []
    chunks = min(CHUNKS, len(rates) // (MIN_ROWS // 2))
    for rows in np.array_split(np.arange(len(rates)), chunks):
        mean, error = float(rates[rows].mean()), float(rates[rows].std(ddof=1) / np.sqrt(len(rows)))
        margin = z_95(chunks - 1) * error
        parts.append(
            Part(
                rate=mean,
                low=mean - margin,
                high=mean + margin,
                first_update=int(updates[rows[0]]),
                last_update=int(updates[rows[-1]]),
                text=f"{percent(mean)} (mean of {counted(len(rows), 'row')})",
            )
        )
    return Trend(source="all levels", parts=tuple(parts), link=("overview", "Training episodes"))


def trend_statement(trend: Trend | None) -> Statement:
    title = "Solve rate in training"
    if trend is None:
        sentence = f"Needs two parts of {MIN_ATTEMPTS} attempts at fresh levels (curriculum/outcomes.jsonl); they are not there (yet)."
        return Statement(key="training", title=title, state=UNKNOWN, sentence=sentence, page="curriculum")
    first, last, difference = trend.parts[0], trend.parts[-1], trend.since_first
    rates = f"{first.text} in {first.when} → {last.text} in {last.when}"
    sentence = f"{trend.source[0].upper()}{trend.source[1:]}: {rates}: {change(difference)}."
    if trend.source == "all levels":
        sentence += " A buffer that changes moves this rate, too."
    is_sample = trend.source != "all levels"
    state = GOOD if is_sample and is_above(difference) else BAD if is_below(difference) and is_sample else NEUTRAL
    page, panel = trend.link
    return Statement(key="training", title=title, state=state, sentence=sentence, page=page, query={"panel": panel})


@dataclasses.dataclass(frozen=True, kw_only=True)
class Stability:
    """Signs that training collapsed, each in words. is_collapsed: solve rates fell, or nothing is learned any more.

    causes: what changed while solve rates fell.
    """

    is_collapsed: bool
    signs: tuple[str, ...]
    causes: tuple[str, ...]
    calm: str  # the same quantities where there is no sign
    remedy: str
    link: tuple[str, str]


def stability_of(
    table: SeriesTable, histories: Sequence[SetHistory], trend: Trend | None, events: Sequence[Mapping[str, Any]] = ()
) -> Stability:
    """Judges held-out sets, solve rates in training, entropy, skipped gradient steps and numbers that are not finite.

    events: of the run; what changed while a set was lost is named with it.
    """
    fallen, signs, causes, calm, remedies = [], [], [], [], []
    link = ("overview", "Training episodes")
    since = until = None  # updates between which a set was lost
    for history in histories:
        if history.is_lost:
            fallen.append(
                f"{history.name} fell from {percent(history.top['rate'])} at update {history.top['update']:,} to "
                f"{percent(history.now['rate'])}"
            )
            link = ("evaluation", history.name)
            since, until = history.top["update"], history.now["update"]
    if trend is not None:
        best, last = trend.best, trend.parts[-1]
        if trend.has_fallen:
            fallen.append(
                f"{trend.source} in training fell from {best.text} in {best.when} to {last.text} in {last.when}"
            )
            link = trend.link
        else:
            calm.append(f"{trend.source} in training {percent(last.rate)} (best part {percent(best.rate)})")
    entropy = _entropy(table)
    if entropy is not None:
        first, recent, is_low = entropy
        text = f"entropy {recent:.3g} nat ({first:.3g} in the first row)"
        (signs if is_low else calm).append(f"{text}, below {100 * ENTROPY_SHARE:.0f} %" if is_low else text)
        if is_low:
            remedies.append("raise ppo.entropy_coefficient or lower ppo.learning_rate")
            link = link if fallen else ("overview", "Entropy")
    skipped, is_stalled = _skipped(table)
    if skipped:
        signs.append(skipped)
        remedies.append(RED["learner/skipped_steps"][1])
    elif not np.isnan(table.column("learner/skipped_steps")).all():
        calm.append("no gradient step skipped")
    lost = _not_finite(table)
    if lost:
        signs.append(lost)
        remedies.append(RED["learner/skipped_steps"][1])
    if since is not None:
        causes = _changes(events, since, until)
        if causes:
            remedies.insert(0, "take back what changed")
        elif not remedies:
            remedies.append("lower ppo.learning_rate")
        remedies.append(_checkpoint_before(events, since))
    elif fallen and not remedies:
        remedies.append("lower ppo.learning_rate, and go on from a checkpoint before the fall")
    return Stability(
        is_collapsed=bool(fallen) or is_stalled or bool(lost),
        signs=(*fallen, *signs),
        causes=tuple(causes),
        calm="; ".join(calm),
        remedy="; ".join(dict.fromkeys(remedies)),
        link=("overview", "Losses") if not fallen and (is_stalled or lost) else link,
    )


def _changes(events: Sequence[Mapping[str, Any]], since: int, until: int) -> list[str]:
    """Phases that began after update `since` and not after `until`, with what they changed."""
    return [
        f"phase {event['phase']} began at update {event['update']:,} and set "
        + ", ".join(f"{name} {value}" for name, value in event["changed"].items())
        for event in events
        if event.get("event") == "phase_began" and isinstance(event.get("changed"), dict)
        and isinstance(event.get("update"), int) and since <= event["update"] <= until
    ]


def _checkpoint_before(events: Sequence[Mapping[str, Any]], update: int) -> str:
    saved = [
        event["update"]
        for event in events
        if event.get("event") == "checkpoint_saved" and isinstance(event.get("update"), int) and event["update"] <= update
    ]
    if not saved:
        return f"begin again: no checkpoint is older than update {update:,}"
    return f"go on from the checkpoint of update {max(saved):,} or an earlier one, if it is still there"


def stability_statement(stability: Stability) -> Statement:
    text = "; ".join((*stability.signs, *stability.causes))
    if stability.is_collapsed:
        state, sentence = BAD, f"Collapsed: {text}."
    elif stability.signs:
        state, sentence = NEUTRAL, f"No collapse of solve rates, but {text}."
    elif stability.calm:
        state, sentence = GOOD, f"No sign of a collapse: {stability.calm}."
    else:
        state, sentence = UNKNOWN, "No metrics so far."
    page, panel = stability.link
    return Statement(
        key="stability",
        title="Stability",
        state=state,
        sentence=sentence,
        remedy=stability.remedy,
        page=page,
        query={"panel": panel},
    )


def _known(table: SeriesTable, name: str) -> np.ndarray:
    column = table.column(name)
    return column[~np.isnan(column)]


def _entropy(table: SeriesTable) -> tuple[float, float, bool] | None:
    """(first, mean of the last rows, it is near 0); of continuous actions entropy may be negative: no judgement."""
    known = _known(table, "learner/entropy")
    if not len(known):
        return None
    recent = float(known[-RECENT_ROWS:].mean())
    return float(known[0]), recent, bool(known[0] > 0 and 0 <= recent < ENTROPY_SHARE * known[0])


def _skipped(table: SeriesTable) -> tuple[str, bool]:
    """(sentence or "", so many of the last rows skipped steps that little is learned)."""
    column, updates = table.column("learner/skipped_steps"), table.column("update")
    rows = np.flatnonzero(column > 0)
    if not len(rows):
        return "", False
    recent = column[-RECENT_ROWS:]
    share = float((recent > 0).mean())
    text = (
        f"{counted(int(np.nansum(column)), 'gradient step')} skipped since gradients were not finite, in "
        f"{counted(len(rows), 'update')}, last at update {int(updates[rows[-1]]):,}"
    )
    return text, share >= STALLED_SHARE and len(recent) >= RECENT_ROWS


def _not_finite(table: SeriesTable) -> str:
    """Sentence where losses of the last rows are no numbers, and were before; else ""."""
    column = table.column("learner/policy_loss")
    recent = column[-RECENT_ROWS:]
    if len(recent) < RECENT_ROWS or np.isnan(column).all() or not np.isnan(recent).all():
        return ""
    last = int(table.column("update")[np.flatnonzero(~np.isnan(column))[-1]])
    return f"the policy loss is no finite number since update {last + 1:,}"


def speed_statement(
    table: SeriesTable, processes: Mapping[str, Any] | None, warnings: Sequence[Mapping[str, str]]
) -> Statement:
    """Env steps per second of the last rows, the largest share of their time, and the process that waits most.

    processes: `processes.Processes.describe`; warnings: `warnings.warnings_of`.
    """
    speeds = _known(table, "progress/env_steps_per_second")
    title, query = "Speed", {"panel": "Where the time goes"}
    if not len(speeds):
        return Statement(
            key="speed", title=title, state=UNKNOWN, sentence="No row of metrics so far.", query={"panel": "Speed"}
        )
    recent, median = float(speeds[-RECENT_ROWS:].mean()), float(np.median(speeds))
    rows = min(len(speeds), RECENT_ROWS)
    sentence = f"{recent:,.0f} env steps/s (mean of {counted(rows, 'row')})"
    state, remedy = NEUTRAL if len(speeds) < RECENT_ROWS else GOOD, ""
    if recent < SLOW_SHARE * median:
        state, remedy = BAD, RED["progress/env_steps_per_second"][1]
        sentence += f", less than half of its median {median:,.0f}"
    shares = {name: float(known[-RECENT_ROWS:].mean()) for name in TIMES if len(known := _known(table, f"time/{name}"))}
    if shares:
        name, share = max(shares.items(), key=lambda item: item[1])
        sentence += f"; most of its time is {TIMES[name]} ({percent(share)})"
    for warning in warnings:
        if warning["metric"].startswith("time/") and state != BAD:
            state, remedy = NEUTRAL, f"{warning['metric']} {warning['finding']}: {warning['remedy']}"
    if idle := _idlest(processes):
        sentence += f"; idlest process: {idle}"
        query = {"panel": "Processes"} if not shares else query
    return Statement(key="speed", title=title, state=state, sentence=f"{sentence}.", remedy=remedy, query=query)


def _idlest(processes: Mapping[str, Any] | None) -> str:
    """ "learner 0, in no call for 60.0 % of the time"; "" where no process that trains reports its idle share."""
    idle = {
        process["name"]: process["idle"]
        for process in (processes or {"processes": ()})["processes"]
        if process["is_there"]
        and process["idle"] is not None
        and process.get("role") in ("worker", "learner", "rollout")
    }
    if not idle:
        return ""
    name, share = max(idle.items(), key=lambda item: item[1])
    return f"{name}, in no call for {percent(share)} of the time"


def warnings_statement(warnings: Sequence[Mapping[str, str]]) -> Statement:
    """Number and names of warnings; runs/warnings.py has their rules."""
    if not warnings:
        return Statement(key="warnings", title="Warnings", state=GOOD, sentence="None.")
    names = ", ".join(warning["metric"] for warning in warnings)
    sentence = f"{counted(len(warnings), 'warning')}: {names}."
    return Statement(key="warnings", title="Warnings", state=NEUTRAL, sentence=sentence, query={"panel": "warnings"})
