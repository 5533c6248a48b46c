"""Stability of a verdict: signs that training collapsed, and what changed while solve rates fell."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from kinetix_dist.studio.runs.series import SeriesTable
from kinetix_dist.studio.runs.statements import BAD, GOOD, NEUTRAL, UNKNOWN, Statement, counted, percent
from kinetix_dist.studio.runs.verdict_sets import SetHistory
from kinetix_dist.studio.runs.verdict_trend import Trend
from kinetix_dist.studio.runs.warnings import RECENT_ROWS
from kinetix_dist.telemetry.names import RED

ENTROPY_SHARE = 0.05  # of the first row: the policy hardly varies its actions any more
STALLED_SHARE = 0.5  # of the last rows with skipped gradient steps: little is learned


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
    is_entropy_alone: bool  # near 0, with gradients and losses that are finite
    since: int | None  # update of the best evaluation of a set that was lost


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
    if since is not None and until is not None:
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
        is_entropy_alone=entropy is not None and entropy[2] and not skipped and not lost,
        since=since,
    )


def _changes(events: Sequence[Mapping[str, Any]], since: int, until: int) -> list[str]:
    """Phases that began after update `since` and not after `until`, with what they changed."""
    return [
        f"phase {event['phase']} began at update {event['update']:,} and set "
        + ", ".join(f"{name} {value}" for name, value in event["changed"].items())
        for event in events
        if event.get("event") == "phase_began"
        and isinstance(event.get("changed"), dict)
        and isinstance(event.get("update"), int)
        and since <= event["update"] <= until
    ]


def _checkpoint_before(events: Sequence[Mapping[str, Any]], update: int) -> str:
    saved = [
        event["update"]
        for event in events
        if event.get("event") == "checkpoint_saved"
        and isinstance(event.get("update"), int)
        and event["update"] <= update
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


def _entropy(table: SeriesTable) -> tuple[float, float, bool] | None:
    """(first, mean of the last rows, it is near 0); of continuous actions entropy may be negative: no judgement."""
    known = table.known("learner/entropy")
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
