"""Learnability p (1 - p) of a verdict: what a buffer claims, what training finds, and what fresh levels offer.

    claimed        plug-in estimate of the few episodes by which the buffer was chosen: too high, by selection
    in training    unbiased estimate over its levels that training played twice or more
    candidates     unbiased estimate over all levels that were scored: the generator without a choice, when scored
    fresh          pairs of worlds with the same fresh level in training: the control of the curriculum

Levels are learned while a buffer is in use, which lowers p (1 - p) too. So the claim is held against the first plays of
the buffer, and the control against all of them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from kinetix_dist.evaluation.intervals import Z_95, Estimate, difference_interval
from kinetix_dist.evaluation.learnability import mean_and_error, plug_in_learnability, unbiased_learnability
from kinetix_dist.studio.runs.fresh_pairs import learnability_of_pairs
from kinetix_dist.studio.runs.refreshes import CHOOSES_WHILE_SCORING, Plays, training_plays, windows_of
from kinetix_dist.studio.runs.series import SeriesTable
from kinetix_dist.studio.runs.statements import BAD, GOOD, NEUTRAL, UNKNOWN, Statement, counted, is_above, is_below
from kinetix_dist.telemetry.curriculum_log import Snapshot

MIN_LEVELS = 32  # played twice or more, or half of the buffer: below that nothing is said of it
MISLABELLED = 0.6  # measured / claimed, upper end: the buffer is not what it claims
INFLATED = 0.85  # a tenth of the claim is selection bias in a healthy run, see docs/training.md
UNSURE = 0.25  # half width of the measured interval / claimed, above which nothing is said
RECENT_WINDOWS = 8  # whose pairs count where no buffer names its windows
PANEL = "Learnability"  # of page Curriculum


@dataclasses.dataclass(frozen=True, kw_only=True)
class Learnability:
    """Learnability of the newest buffer that training has played enough; fields are None where they are unknown."""

    number: int  # of its refresh
    num_levels: int
    episodes_per_level: float
    claimed: float
    first: Estimate | None  # first plays in training
    measured: Estimate | None  # all plays in training
    num_played_twice: int
    attempts: int
    candidates: Estimate | None
    num_candidates: int
    fresh: dict[str, Any] | None  # of `learnability_of_pairs`
    share_undecided: float  # of its levels that were solved sometimes when they were scored
    before: tuple[int, Estimate] | None = None  # number and measure of the first buffer that training played enough

    @property
    def since_before(self) -> Estimate | None:
        """Change of the measure since that buffer."""
        if self.measured is None or self.before is None:
            return None
        return difference_interval(self.measured, self.before[1])

    @property
    def is_mislabelled(self) -> bool:
        """The first plays find far less than the claim, by more than chance."""
        return self.first is not None and self.first[2] < MISLABELLED * self.claimed

    @property
    def control(self) -> Estimate | None:
        """Fresh levels in training, else candidates."""
        return _estimate_of_pairs(self.fresh) if self.fresh is not None else self.candidates


def learnability_of(
    refreshes: Sequence[Snapshot], windows: Sequence[Mapping[str, Any]], table: SeriesTable
) -> Learnability | None:
    """refreshes: oldest first. None for a run without one."""
    described = [_describe(snapshot, windows, table) for snapshot in refreshes[-2:]]
    played = [one for one in described if one.measured is not None]
    if not played:
        return described[-1] if described else None
    found = played[-1]
    earlier = (_describe(snapshot, windows, table) for snapshot in refreshes if snapshot.number < found.number)
    before = next(((one.number, one.measured) for one in earlier if one.measured is not None), None)
    return dataclasses.replace(found, before=before)


def _describe(snapshot: Snapshot, windows: Sequence[Mapping[str, Any]], table: SeriesTable) -> Learnability:
    arrays = snapshot.arrays
    solved, finished = (arrays[name].astype(np.int64) for name in ("solved", "finished"))
    all_solved, all_finished = (arrays[f"candidates/{name}"].astype(np.int64) for name in ("solved", "finished"))
    own = windows_of(windows, snapshot.number)
    is_sample = str(arrays["curriculum"]) not in CHOOSES_WHILE_SCORING
    first, measured, plays = _first_plays(own, snapshot.number), None, training_plays(own).get(snapshot.number)
    num_twice = 0
    if plays is not None:
        values = unbiased_learnability(plays.solved, plays.attempts)
        num_twice = int((~np.isnan(values)).sum())
        measured = _estimate(values) if first is not None else None
    if not own and not is_sample:  # sfl_slices measures its own levels
        first = measured = _measured_by_metrics(table)
    played = finished > 0
    return Learnability(
        number=snapshot.number,
        num_levels=len(solved),
        episodes_per_level=float(finished.mean()) if len(finished) else 0.0,
        claimed=float(plug_in_learnability(solved, finished).mean()) if len(solved) else 0.0,
        first=first,
        measured=measured,
        num_played_twice=num_twice,
        attempts=int(plays.attempts.sum()) if plays is not None else 0,
        candidates=_estimate(unbiased_learnability(all_solved, all_finished))
        if is_sample and len(all_finished) and (all_finished > 1).all()
        else None,
        num_candidates=len(all_solved),
        fresh=learnability_of_pairs(own or windows[-RECENT_WINDOWS:]),
        share_undecided=float(((solved > 0) & (solved < finished))[played].mean()) if played.any() else 0.0,
    )


def _first_plays(own: Sequence[Mapping[str, Any]], number: int) -> Estimate | None:
    """Estimate from the first windows of a buffer in which enough of its levels were played twice or more; None: so far
    too few."""
    plays: Plays | None = None
    for row in own:
        window = training_plays([row])[number]
        if plays is None:
            plays = window
        elif plays.solved.shape == window.solved.shape:
            plays.solved, plays.attempts = plays.solved + window.solved, plays.attempts + window.attempts
        values = unbiased_learnability(plays.solved, plays.attempts)
        if (~np.isnan(values)).sum() >= min(MIN_LEVELS, max(len(values) // 2, 2)):
            return _estimate(values)
    return None


def _estimate(values: np.ndarray) -> Estimate | None:
    mean, error = mean_and_error(values)
    return None if mean is None or error is None else (mean, mean - Z_95 * error, mean + Z_95 * error)


def _measured_by_metrics(table: SeriesTable) -> Estimate | None:
    now, error = (table.column(f"curriculum/learnability_now{name}") for name in ("", "_error"))
    rows = np.flatnonzero(~np.isnan(now) & ~np.isnan(error))
    if not len(rows):
        return None
    mean, margin = float(now[rows[-1]]), Z_95 * float(error[rows[-1]])
    return mean, mean - margin, mean + margin


def _estimate_of_pairs(pairs: Mapping[str, Any]) -> Estimate:
    return pairs["learnability"], pairs["low"], pairs["high"]


def claim_statement(found: Learnability) -> Statement:
    """Claim of the buffer against its first plays in training."""
    title, query = "Labels of the buffer", {"panel": PANEL}

    def statement(state: str, sentence: str, remedy: str = "") -> Statement:
        return Statement(
            key="claim", title=title, state=state, sentence=sentence, remedy=remedy, page="curriculum", query=query
        )

    limits = f"{100 * MISLABELLED:.0f} % of the claim", f"{100 * INFLATED:.0f} % of the claim"
    claim = (
        f"buffer {found.number} claims p (1 - p) {found.claimed:.3f} by {found.episodes_per_level:.1f} scoring "
        f"episodes per level"
    )
    if found.first is None:
        return statement(
            UNKNOWN, f"{claim.capitalize()}; training has not played it enough yet to say whether it holds."
        )
    value, low, high = found.first
    measured = f"training finds {value:.3f} ({low:.3f} to {high:.3f}) at first"
    if not found.claimed:
        remedy = "widen curriculum.generator, or raise curriculum.num_candidates: no level was solved sometimes"
        return statement(BAD, f"{claim.capitalize()}: it holds no level that is solved sometimes; {measured}.", remedy)
    if (high - low) / 2 > UNSURE * found.claimed:
        return statement(
            UNKNOWN,
            f"{claim.capitalize()}; {measured}, too few plays to tell: the interval may reach {100 * UNSURE:.0f} % of "
            "the claim to each side.",
        )
    missing = max(1 - value / found.claimed, 0.0)
    sentence = f"{claim}; {measured}, {100 * missing:.0f} % less" if missing else f"{claim}; {measured}, not less"
    if found.is_mislabelled:
        remedy = (
            f"score with more episodes than {found.episodes_per_level:.1f} per level: raise curriculum.scoring_steps "
            "(or curriculum.name sfl_slices, which scores the best again); then curriculum.num_candidates"
        )
        return statement(
            BAD,
            f"Mislabelled: {sentence}; the whole interval is below {limits[0]}. So few episodes choose levels by "
            "chance.",
            remedy,
        )
    if high < INFLATED * found.claimed:
        remedy = "more scoring episodes (curriculum.scoring_steps) bring claims nearer to the truth"
        return statement(
            NEUTRAL,
            f"Inflated by selection: {sentence}; the interval ends below {limits[1]}, yet not below "
            f"{100 * MISLABELLED:.0f} % of it.",
            remedy,
        )
    return statement(GOOD, f"{sentence[0].upper()}{sentence[1:]}: labels hold, since the interval reaches {limits[1]}.")


def no_buffer_statement(windows: Sequence[Mapping[str, Any]], sentence: str) -> Statement:
    """Statement of a run without refreshes. sentence: why it has none, or when the first comes."""
    fresh = learnability_of_pairs(windows[-RECENT_WINDOWS:])
    return Statement(
        key="learnability",
        title="Learnability",
        state=UNKNOWN if fresh is None else NEUTRAL,
        sentence=f"{sentence} {_fresh(fresh, is_counted=bool(windows))}",
        page="curriculum",
        query={"panel": PANEL},
    )


def learnability_statement(found: Learnability) -> Statement:
    """Learnability of the buffer in training against fresh levels in training, else against candidates."""
    title, query = "Learnability", {"panel": PANEL}

    def statement(state: str, sentence: str, remedy: str = "") -> Statement:
        return Statement(
            key="learnability",
            title=title,
            state=state,
            sentence=sentence,
            remedy=remedy,
            page="curriculum",
            query=query,
        )

    candidates = (
        f"all {found.num_candidates:,} candidates {_interval(found.candidates)}"
        if found.candidates is not None
        else "candidates unknown (some finished fewer than two episodes, or they are no sample)"
    )
    rest = f"claimed by scoring {found.claimed:.3f}; {candidates}. {_fresh(found.fresh)}"
    if found.measured is None:
        return statement(UNKNOWN, f"Buffer {found.number}: not played enough in training yet; {rest}")
    plays = f", {found.num_played_twice:,} levels played twice or more, {counted(found.attempts, 'attempt')}"
    sentence = (
        f"Buffer {found.number} in training {_interval(found.measured)}{plays if found.attempts else ''}; "
        f"{rest}{_since(found)}"
    )
    control = found.control
    if control is None:
        return statement(NEUTRAL, f"{sentence} So there is nothing to compare it with.")
    name = "fresh levels in training" if found.fresh is not None else "candidates"
    difference = difference_interval(found.measured, control)
    factor = f"{found.measured[0] / control[0]:.1f} times" if control[0] > 0 else "more than"
    if is_above(difference):
        return statement(GOOD, f"{sentence} The buffer has {factor} that of {name}.")
    remedy = "raise curriculum.num_candidates or lower curriculum.buffer_size, so that the choice is narrower"
    if found.is_mislabelled:
        remedy = "more scoring episodes per level, see Labels of the buffer"
    elif found.share_undecided < 0.5:
        remedy += (
            f"; only {100 * found.share_undecided:.0f} % of its levels were solved sometimes when they were scored"
        )
    if is_below(difference):
        return statement(BAD, f"{sentence} The buffer has less than {name}: it costs more than it gives.", remedy)
    return statement(NEUTRAL, f"{sentence} No difference between the buffer and {name} can be told.", remedy)


def _since(found: Learnability) -> str:
    difference = found.since_before
    if difference is None or found.before is None:
        return ""
    number, before = found.before
    if is_below(difference) or is_above(difference):
        return f" It {'fell' if is_below(difference) else 'rose'} since buffer {number}, which had {_interval(before)}."
    return f" No change by more than chance since buffer {number}, which had {_interval(before)}."


def _fresh(pairs: Mapping[str, Any] | None, *, is_counted: bool = True) -> str:
    if pairs is None:
        return f"Fresh levels in training: {'not recorded by this run' if is_counted else 'no counts so far'}."
    return (
        f"Fresh levels in training {_interval(_estimate_of_pairs(pairs))}, {counted(pairs['pairs'], 'pair')} of worlds."
    )


def _interval(estimate: Estimate) -> str:
    return "{:.3f} ({:.3f} to {:.3f})".format(*estimate)
