"""Verdict on a run: is it working? Computed from the files of its directory, each statement with its evidence.

    evaluations.jsonl                --verdict_sets---------> held-out sets now and before, sets that got worse
    curriculum/outcomes.jsonl        --verdict_trend--------> solve rate of fresh levels
    metrics.jsonl                    --verdict_stability----> signs of a collapse
                                     --verdict_speed--------> speed and its bottleneck
                                     --warnings-------------> rules that hold
    curriculum/refresh_*.npz         --verdict_learnability-> labels of the buffer, learnability against fresh levels
                                     --verdict_levels-------> made easy, never touched
    all of these                     --verdict_advice-------> what to try next

docs/dashboard.md, section Verdict, has each rule and its data. No rule changes a run, and none needs all files: what
is not recorded is `unknown`, in words.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from kinetix_dist.studio.runs.evaluations import evaluations
from kinetix_dist.studio.runs.first_buffer import WITHOUT_BUFFER, first_buffer
from kinetix_dist.studio.runs.processes import Processes
from kinetix_dist.studio.runs.refreshes import Refreshes
from kinetix_dist.studio.runs.run_files import RunFileError, read_config
from kinetix_dist.studio.runs.run_index import RunStatus, status_of
from kinetix_dist.studio.runs.run_reader import RunReader
from kinetix_dist.studio.runs.statements import BAD, GOOD, NEUTRAL, UNKNOWN, Statement, counted, percent
from kinetix_dist.studio.runs.verdict_advice import (
    COLLAPSED,
    EARLY,
    FELL_SILENT,
    FLAWED,
    HAS_FAILED,
    OUTCOMES,
    PARTLY,
    UNCLEAR,
    WORKS,
    WORSE,
    Evidence,
    NextStep,
    next_step,
)
from kinetix_dist.studio.runs.verdict_failing import failing_statement
from kinetix_dist.studio.runs.verdict_learnability import (
    Learnability,
    claim_statement,
    learnability_of,
    learnability_statement,
    no_buffer_statement,
)
from kinetix_dist.studio.runs.verdict_levels import easy_statement, replayed, untouched_statement
from kinetix_dist.studio.runs.verdict_sets import SetHistory, set_histories, set_statements
from kinetix_dist.studio.runs.verdict_speed import speed_statement
from kinetix_dist.studio.runs.verdict_stability import Stability, stability_of, stability_statement
from kinetix_dist.studio.runs.verdict_trend import ALL_LEVELS, Trend, trend_of, trend_statement
from kinetix_dist.studio.runs.warnings import warning_statements, warnings_of
from kinetix_dist.telemetry.curriculum_log import REFRESH, Snapshot
from kinetix_dist.telemetry.status import FAILED, SILENT, STOPPED

STATES = {
    **dict.fromkeys((HAS_FAILED, FELL_SILENT, COLLAPSED, WORSE, FLAWED), BAD),
    **dict.fromkeys((UNCLEAR, PARTLY), NEUTRAL),
    EARLY: UNKNOWN,
    WORKS: GOOD,
}
MAX_NAMED = 2  # sets, in the heading
SNAPSHOTS = 32  # the newest, so that a long run takes no longer
ARRAYS = (
    "level_id",
    "features",
    "feature_names",
    "solved",
    "finished",
    "curriculum",
    "candidates/features",
    "candidates/solved",
    "candidates/finished",
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Verdict:
    """Answer to "is it working?" in a sentence, and its parts."""

    outcome: str  # of OUTCOMES
    heading: str
    statements: tuple[Statement, ...]
    next_step: NextStep
    problems: tuple[str, ...]  # a line for each file that is damaged or cannot be read

    @property
    def state(self) -> str:
        """State of a statement by the same outcome."""
        return STATES[self.outcome]

    def to_json(self) -> dict[str, Any]:
        return {
            **self.summary(),
            "next": self.next_step.to_json(),
            "statements": [statement.to_json() for statement in self.statements],
            "problems": [*self.problems],
        }

    def summary(self) -> dict[str, Any]:
        """For a row of a table; `rank` rises from the worst outcome to the best."""
        return {
            "outcome": self.outcome,
            "rank": OUTCOMES.index(self.outcome),
            "state": self.state,
            "heading": self.heading,
        }


def verdict_of(reader: RunReader, refreshes: Refreshes, processes: Processes) -> Verdict:
    """Verdict on a run; refreshes, processes: readers of its directory."""
    path, problems = reader.path, []

    def read(load: Callable[[], Any]) -> Any:
        try:
            return load()
        except RunFileError as error:
            problems.append(str(error))
            return None

    config = read(lambda: read_config(path)) or {}
    evaluated = read(lambda: evaluations(path))
    status = status_of(path)
    snapshots, windows, damaged = refreshes.newest(SNAPSHOTS)
    chosen = _whole_refreshes(snapshots, damaged)
    described = read(lambda: processes.describe(reader.events))
    problems += [line for found in (evaluated, described) if found for line in found["problems"]] + damaged
    histories = set_histories(evaluated)
    with reader.lock:
        table = reader.table
        trend = trend_of(table, windows)
        stability = stability_of(table, histories, trend, reader.events)
        learnability = learnability_of(chosen, windows, table)
        warnings = warnings_of(table)
        speed = speed_statement(table, described, warnings)
        update = int(table.column("update")[-1]) if table.num_rows else None
    if learnability is None:
        curriculum = [no_buffer_statement(windows, _no_buffer(config, snapshots, windows, update))]
    else:
        curriculum = [
            learnability_statement(learnability),
            claim_statement(learnability),
            easy_statement(replayed(chosen, windows)),
            untouched_statement(chosen),
        ]
    outcome, heading = _heading(status, update, histories, trend, stability)
    if stability.is_collapsed:  # whatever else is wrong may follow from that
        curriculum = [dataclasses.replace(statement, remedy="") for statement in curriculum]
    else:
        outcome, heading = _with_curriculum(outcome, heading, curriculum, learnability)
    statements = (
        *_status_statement(status, update),
        *set_statements(histories, config),
        *failing_statement(histories),
        trend_statement(trend),
        stability_statement(stability),
        *curriculum,
        speed,
        *warning_statements(warnings),
    )
    evidence = Evidence(
        path=path,
        config=config,
        status=status,
        table=table,
        histories=histories,
        trend=trend,
        stability=stability,
        learnability=learnability,
        warnings=warnings,
        statements=statements,
    )
    with reader.lock:
        advice = next_step(outcome, evidence)
    return Verdict(
        outcome=outcome,
        heading=heading,
        statements=statements,
        next_step=advice,
        problems=tuple(dict.fromkeys(problems)),
    )


def _whole_refreshes(snapshots: Sequence[Snapshot], problems: list[str]) -> list[Snapshot]:
    """Refreshes with all arrays that are read; a line for others."""
    found = []
    for snapshot in snapshots:
        if snapshot.kind != REFRESH:
            continue
        if missing := [name for name in ARRAYS if name not in snapshot.arrays]:
            problems.append(f"refresh {snapshot.number} lacks {missing[0]}; it is left out")
        else:
            found.append(snapshot)
    return found


def _no_buffer(
    config: Mapping[str, Any], snapshots: Sequence[Snapshot], windows: Sequence[Mapping[str, Any]], update: int | None
) -> str:
    """Sentence for a run without refreshes: its curriculum has none, or the first is expected."""
    curriculum = config.get("curriculum")
    name = str(curriculum.get("name")) if isinstance(curriculum, dict) else "unknown"
    if name in WITHOUT_BUFFER:
        return f"Curriculum {name} keeps no buffer."
    if not snapshots:
        return first_buffer(config, update)
    sources = {}
    for row in windows:
        for source, counts in row["sources"].items():
            solved, attempts = sources.get(source, (0, 0))
            sources[source] = (solved + counts["solved"], attempts + counts["attempts"])
    rates = [f"{source} {100 * s / n:.1f} % ({s:,} of {n:,})" for source, (s, n) in sources.items() if n]
    text = (
        f"Curriculum {name} claims no solve rates and logs no candidates, so that there is nothing to hold against "
        "training."
    )
    return f"{text} Solved in training: {', '.join(rates)}." if rates else text


def _status_statement(status: RunStatus, update: int | None) -> list[Statement]:
    """A statement where a run ended before its end."""
    if status.state not in (FAILED, SILENT, STOPPED):
        return []
    state = NEUTRAL if status.state == STOPPED else BAD
    at = f" at update {update:,}" if update is not None else " before its first update"
    sentence = f"{status.state.capitalize()}{at}: {status.text}."
    return [Statement(key="status", title="State", state=state, sentence=sentence, query={"panel": "Events"})]


def _heading(
    status: RunStatus,
    update: int | None,
    histories: Sequence[SetHistory],
    trend: Trend | None,
    stability: Stability,
) -> tuple[str, str]:
    """(outcome, sentence) that answers "is it working?", without the curriculum."""
    outcome, sentence = _learning(update, histories, trend, stability, is_over=status.is_over)
    if status.state in (FAILED, SILENT):
        ended, what = (HAS_FAILED, "failed") if status.state == FAILED else (FELL_SILENT, "fell silent")
        if update is None:
            return ended, f"The run {what} before its first update."
        return ended, f"The run {what}. Until then: {sentence[0].lower()}{sentence[1:]}"
    if update is None and status.phase is not None and not status.is_over:
        sentence = f"{sentence} The run is {status.phase}."
    return outcome, sentence


def _learning(
    update: int | None, histories: Sequence[SetHistory], trend: Trend | None, stability: Stability, *, is_over: bool
) -> tuple[str, str]:
    if stability.is_collapsed:
        cause = f", and {stability.causes[0]}" if stability.causes else ""
        return COLLAPSED, f"No: training collapsed; {stability.signs[0]}{cause}."
    compared = [one for one in histories if one.since_first is not None]
    gained = [one.name for one in compared if one.has_gained and not one.is_worse]
    worse = [one.name for one in compared if one.is_worse]
    of = f"{len(gained)} of {counted(len(compared), 'held-out set')}"
    if worse and not gained:
        return WORSE, f"No: {', '.join(worse)} got worse by more than chance, and no held-out set rose."
    if worse:
        return PARTLY, f"In part: {of} rose by more than chance, {', '.join(worse)} got worse."
    below = [one.name for one in compared if one.above_random is not None and one.above_random[0] <= 0]
    if gained and set(gained) <= set(below):
        return PARTLY, f"In part: {of} rose by more than chance, but not above random actions."
    if gained:
        return (
            WORKS,
            f"Yes: {'it learned' if is_over else 'it learns'}. {of} rose by more than chance: {_gains(compared)}.",
        )
    rises = trend is not None and trend.source != ALL_LEVELS and trend.since_first[1] > 0
    if compared:
        also = " Solve rates in training rose, on levels of its own generator." if rises else ""
        names = (
            f"{compared[0].name} did not rise" if len(compared) == 1 else f"none of {len(compared)} held-out sets rose"
        )
        return UNCLEAR, f"Not shown: {names} by more than chance{'' if is_over else ' so far'}.{also}"
    if rises and trend is not None:
        return (
            WORKS,
            f"Yes on {trend.source} in training, which are solved more often; no held-out set was evaluated twice yet.",
        )
    if update is None:
        return EARLY, "Too early to tell: no update is done."
    once = "each held-out set was evaluated once" if histories else "no held-out set was evaluated"
    rate = (
        "there are too few attempts in training"
        if trend is None
        else "solve rates in training have not risen by more than chance"
    )
    return EARLY, f"Cannot be told yet: {once}, and {rate}."


def _gains(histories: Sequence[SetHistory]) -> str:
    """random_s 33.9 → 53.6 % (random actions 35.0 %), of the sets that gained most"""
    gained = sorted((one for one in histories if one.has_gained), key=lambda one: one.first["rate"] - one.now["rate"])
    texts = []
    for one in gained[:MAX_NAMED]:
        random = f" (random actions {percent(one.random['rate'])})" if one.random is not None else ""
        texts.append(f"{one.name} {100 * one.first['rate']:.1f} → {percent(one.now['rate'])}{random}")
    return ", ".join(texts) + (", ..." if len(gained) > MAX_NAMED else "")


def _with_curriculum(
    outcome: str, heading: str, curriculum: Sequence[Statement], learnability: Learnability | None
) -> tuple[str, str]:
    """A buffer that is not what it claims, or offers less than fresh levels, is part of the answer."""
    bad = {statement.key for statement in curriculum if statement.state == BAD}
    if "claim" in bad and learnability is not None and not learnability.claimed:
        flaw = "its buffer holds no level that is solved sometimes"
    elif "claim" in bad:
        flaw = "its buffer is mislabelled: training finds far less learnability than scoring claims"
    elif "learnability" in bad:
        flaw = "its buffer is less learnable than fresh levels"
    else:
        return outcome, heading
    if outcome == WORKS:
        return PARTLY, f"{heading} But {flaw}."
    return (outcome if STATES[outcome] == BAD else FLAWED), f"{heading} Also, {flaw}."
