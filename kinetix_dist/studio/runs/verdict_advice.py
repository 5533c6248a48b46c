"""Advice of a verdict: one next step, from the evidence, with the command that takes it.

    outcome (a word), statements, measures --next_step--> NextStep

The first rule that applies is the advice: what stopped the run, then what broke it, then what its curriculum lacks,
then what it waits for, and where nothing is wrong, whether it still learns. Settings that change the numbers of a run
need a new one, which begins with the configuration of this one (`train --recipe DIR`).
"""

from __future__ import annotations

import dataclasses
import re
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from kinetix_dist.studio.runs.finetune_command import checkpoints_of
from kinetix_dist.studio.runs.run_index import RunStatus
from kinetix_dist.studio.runs.series import SeriesTable
from kinetix_dist.studio.runs.statements import BAD, Statement, is_above, is_below, percent, points
from kinetix_dist.studio.runs.verdict_learnability import Learnability
from kinetix_dist.studio.runs.verdict_sets import SetHistory
from kinetix_dist.studio.runs.verdict_stability import Stability
from kinetix_dist.studio.runs.verdict_trend import ALL_LEVELS, Trend
from kinetix_dist.studio.runs.warnings import RECENT_ROWS, SPEED, Warned
from kinetix_dist.telemetry.status import FAILED

# Outcomes of a verdict, a word each, the worst first.
FELL_SILENT, HAS_FAILED, COLLAPSED, WORSE, FLAWED = "silent", "failed", "collapsed", "worse", "flawed"
UNCLEAR, EARLY, PARTLY, WORKS = "unclear", "early", "partly", "works"
OUTCOMES = (HAS_FAILED, FELL_SILENT, COLLAPSED, WORSE, FLAWED, UNCLEAR, EARLY, PARTLY, WORKS)

LARGE_KL = 0.1  # nat, of any row: an update went too far
FAR_KL = 1.0  # nat, of any row: it went so far that half of the rate would not do
SMALL_KL = 0.005  # nat, mean of the last rows: updates hardly move the policy
LARGE_UPDATES = ("learner/approx_kl", "learner/clip_fraction")  # metrics whose warnings say so
FALLEN = 0.8  # of the learnability of an earlier buffer, below which more candidates are suggested
EVALUATE_EVERY = 20  # updates, suggested where no evaluation comes during training
# Metric whose warning names a bottleneck: the setting to double, and whether a run can resume with another value of it.
BOTTLENECKS = {
    "time/idle": ("rollout.num_envs", False),
    "time/curate": ("curriculum.refresh_every", False),
    "time/checkpoint": ("run.checkpoint_every", True),
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class NextStep:
    """One thing to try, and why. command: does it, for a terminal; "": there is none."""

    sentence: str
    command: str = ""
    page: str = "overview"  # that shows the evidence
    query: Mapping[str, str] = dataclasses.field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self) | {"query": dict(self.query)}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Evidence:
    """Measures of a run that advice follows from."""

    path: Path
    config: Mapping[str, Any]  # {} where it cannot be read
    status: RunStatus
    table: SeriesTable
    histories: Sequence[SetHistory]
    trend: Trend | None
    stability: Stability
    learnability: Learnability | None
    warnings: Sequence[Warned]
    statements: Sequence[Statement]

    def statement(self, key: str) -> Statement | None:
        return next((one for one in self.statements if one.key == key), None)

    def value(self, option: str) -> Any:
        """Value of `section.field` in the configuration; None where it is not known."""
        section, field = option.split(".")
        values = self.config.get(section)
        return values.get(field) if isinstance(values, Mapping) else None

    def scaled(self, option: str, factor: float) -> str:
        """ "ppo.learning_rate 0.0015 → 0.00075"; the option alone where its value is not known."""
        new = self._times(option, factor)
        return option if new is None else f"{option} {self.value(option):g} → {new}"

    def new_run(self, option: str, factor: float, *, checkpoint: Path | None = None) -> str:
        """Command of a new run with the configuration of this one and another value; "" where that is not known."""
        value = self._times(option, factor)
        if value is None:
            return ""
        words = ["kinetix-dist", "train", "--recipe", str(self.path.resolve())]
        words += ["--from", str(checkpoint.resolve())] if checkpoint is not None else []
        return shlex.join([*words, f"--{option}", value])

    def resumed(self, *options: str) -> str:
        return shlex.join(["kinetix-dist", "train", "--run", str(self.path.resolve()), "--resume", *options])

    def resumed_for_longer(self) -> str:
        """With the limits doubled that the run has reached."""
        steps, seconds = self.value("run.total_env_steps"), self.value("run.max_seconds")
        options = ["--run.total_env_steps", f"{2 * steps}"] if steps else []
        options += ["--run.max_seconds", f"{2 * seconds:g}"] if seconds else []
        return self.resumed(*options)

    def _times(self, option: str, factor: float) -> str | None:
        value = self.value(option)
        if isinstance(value, bool) or not isinstance(value, int | float) or not value:
            return None
        return str(max(round(value * factor), 1)) if isinstance(value, int) else f"{value * factor:g}"


def next_step(outcome: str, evidence: Evidence) -> NextStep:
    """outcome: of OUTCOMES."""
    if outcome in (HAS_FAILED, FELL_SILENT):
        return _after_an_end(evidence)
    if outcome == COLLAPSED:
        return _after_a_collapse(evidence)
    if outcome == EARLY:
        return _too_early(evidence)
    if outcome == WORSE:
        return _after_a_loss(evidence)
    return (
        _better_labels(evidence)
        or _more_learnable(evidence)
        or _bottleneck(evidence)
        or (_not_shown(evidence) if outcome in (UNCLEAR, FLAWED) else _further(evidence))
    )


def _after_an_end(evidence: Evidence) -> NextStep:
    """Next step of a run that failed or fell silent."""
    failed = evidence.status.state == FAILED
    first = f"mend what ended it ({evidence.status.text})" if failed else "look whether its process is still there"
    if not checkpoints_of(evidence.path):
        return NextStep(sentence=f"{first}, then begin again: it has saved no checkpoint", query={"panel": "Events"})
    sentence = f"{first}, then go on from its last checkpoint"
    return NextStep(sentence=sentence, command=evidence.resumed(), query={"panel": "Events"})


def _after_a_collapse(evidence: Evidence) -> NextStep:
    stability = evidence.stability
    page, panel = stability.link
    link: dict[str, Any] = {"page": page, "query": {"panel": panel}}
    checkpoint = _checkpoint_before(evidence)
    begin = (
        "begin a new run"
        if checkpoint is None
        else f"begin a new run from the checkpoint of update {int(checkpoint.name):,}"
    )
    if stability.causes:
        return NextStep(sentence=f"{begin}, without what changed as it fell: {stability.causes[0]}", **link)
    largest = evidence.table.known("learner/approx_kl").max(initial=0.0)
    if largest > LARGE_KL:  # entropy that falls at once falls by these
        option, factor = "ppo.learning_rate", 0.5 if largest < FAR_KL else 0.1
        why = f"an update moved the policy by {largest:.2g} nat (learner/approx_kl)"
    elif stability.is_entropy_alone:
        option, factor, why = "ppo.entropy_coefficient", 2.0, stability.signs[-1]
    else:
        option, factor, why = "ppo.learning_rate", 0.5, stability.signs[-1]
    return NextStep(
        sentence=f"{begin} with {evidence.scaled(option, factor)}: {why}",
        command=evidence.new_run(option, factor, checkpoint=checkpoint),
        **link,
    )


def _checkpoint_before(evidence: Evidence) -> Path | None:
    """Newest checkpoint from before the fall, if one is left."""
    since = evidence.stability.since
    if since is None:
        return None
    return next((path for path in reversed(checkpoints_of(evidence.path)) if int(path.name) <= since), None)


def _too_early(evidence: Evidence) -> NextStep:
    query = {"panel": "Evaluation"}
    if evidence.status.is_over:
        sentence = "train for longer: what was played is too little to tell"
        return NextStep(sentence=sentence, command=evidence.resumed_for_longer(), query=query)
    if not evidence.table.num_rows:
        return NextStep(sentence="wait for the first update: programs are compiled before it, which may take minutes")
    every, seconds = evidence.value("evaluation.every"), evidence.value("evaluation.every_seconds")
    if every:
        update = int(evidence.table.column("update")[-1])
        sentence = f"wait for the evaluation at update {(update // every + 1) * every:,} (evaluation.every {every})"
        return NextStep(sentence=f"{sentence}, the first that can show a change", query=query)
    if seconds:
        sentence = f"wait for the next evaluation: one comes every {seconds:g} s (evaluation.every_seconds)"
        return NextStep(sentence=sentence, query=query)
    sentence = "stop it (Ctrl-C) and go on with evaluations on the way: so far one comes only after the last update"
    return NextStep(sentence=sentence, command=evidence.resumed("--evaluation.every", f"{EVALUATE_EVERY}"), query=query)


def _after_a_loss(evidence: Evidence) -> NextStep:
    lost = next(one for one in evidence.histories if one.is_worse)
    link: dict[str, Any] = {
        "page": "evaluation",
        "query": {"set": lost.name, "sort": "lost_best", "panel": f"{lost.name}: "},
    }
    large = next((one for one in evidence.warnings if one.rule.metric in LARGE_UPDATES), None)
    trend = evidence.trend
    if large is None and trend is not None and trend.source != ALL_LEVELS and is_above(trend.since_first):
        sentence = (
            f"train on levels nearer to {lost.name} (curriculum.generator, see kinetix-dist train --help): "
            f"{trend.source} in training are learned ({points(trend.since_first)}), at the cost of this set"
        )
        return NextStep(sentence=sentence, **link)
    why = f"{lost.name} fell, and nothing rose" if large is None else f"{large.rule.metric} {large.finding}"
    return NextStep(
        sentence=f"try smaller updates, {evidence.scaled('ppo.learning_rate', 0.5)}: {why}",
        command=evidence.new_run("ppo.learning_rate", 0.5),
        **link,
    )


def _better_labels(evidence: Evidence) -> NextStep | None:
    """Next step where labels of the buffer do not hold."""
    found, claim = evidence.learnability, evidence.statement("claim")
    if found is None or claim is None or claim.state != BAD:
        return None
    link: dict[str, Any] = {"page": claim.page, "query": claim.query}
    if not found.claimed:
        option, why = "curriculum.num_candidates", "no candidate was solved sometimes"
    else:
        option = "curriculum.scoring_steps"
        why = f"{found.episodes_per_level:.1f} episodes per level label the buffer wrongly"
    sentence = f"score more, {evidence.scaled(option, 2)}: {why}"
    return NextStep(sentence=sentence, command=evidence.new_run(option, 2), **link)


def _bottleneck(evidence: Evidence) -> NextStep | None:
    slowed = next((one for one in evidence.warnings if one.rule.part == SPEED), None)
    if slowed is None:
        return None
    option, can_change = BOTTLENECKS[slowed.rule.metric]
    command = evidence.new_run(option, 2)
    value = re.search(r"\S+$", command)
    return NextStep(
        sentence=f"mend the bottleneck, {evidence.scaled(option, 2)}: {slowed.rule.metric} {slowed.finding}",
        command=evidence.resumed(f"--{option}", value[0]) if can_change and value is not None else command,
        query={"panel": slowed.rule.metric},
    )


def _more_learnable(evidence: Evidence) -> NextStep | None:
    """Next step where the buffer offers less than fresh levels, or less than it did."""
    found, statement = evidence.learnability, evidence.statement("learnability")
    if found is None or found.measured is None or statement is None:
        return None
    if found.before is not None and is_below(found.since_before) and found.measured[0] < FALLEN * found.before[1][0]:
        number, before = found.before
        why = f"learnability of the buffer fell from {before[0]:.3f} (buffer {number}) to {found.measured[0]:.3f}"
    elif statement.state == BAD:
        why = "the buffer has less learnability than fresh levels"
    else:
        return None
    option = "curriculum.num_candidates"
    return NextStep(
        sentence=f"choose levels from more candidates, {evidence.scaled(option, 2)}: {why}",
        command=evidence.new_run(option, 2),
        page=statement.page,
        query=statement.query,
    )


def _not_shown(evidence: Evidence) -> NextStep:
    """Next step where no held-out set rose by more than chance, and nothing else is wrong."""
    if (going_on := _still_rising(evidence)) is not None:
        return going_on
    share = _share_done(evidence)
    if not evidence.status.is_over and share is not None and share < 0.5:
        return NextStep(
            sentence=f"let it train: {percent(share)} of its env steps are done", query={"panel": "Evaluation"}
        )
    kl = evidence.table.known("learner/approx_kl")[-RECENT_ROWS:]
    if len(kl) and kl.mean() < SMALL_KL:
        return NextStep(
            sentence=f"try larger updates, {evidence.scaled('ppo.learning_rate', 2)}: they move the policy by "
            f"{kl.mean():.2g} nat (learner/approx_kl), which is little",
            command=evidence.new_run("ppo.learning_rate", 2),
            query={"panel": "learner/approx_kl"},
        )
    highs = [(one.since_first[2], one.name) for one in evidence.histories if one.since_first is not None]
    if not highs:
        return NextStep(sentence="train for longer", command=evidence.resumed_for_longer())
    high, name = max(highs)
    attempts = evidence.value("evaluation.attempts")
    if attempts and high > 0:
        return NextStep(
            sentence=f"evaluate with more attempts, {evidence.scaled('evaluation.attempts', 4)}: {name} may have "
            f"gained up to {100 * high:.1f} points, which so few cannot show",
            command=evidence.resumed("--evaluation.attempts", f"{4 * attempts}"),
            page="evaluation",
            query={"set": name},
        )
    return NextStep(
        sentence=f"try smaller updates, {evidence.scaled('ppo.learning_rate', 0.5)}: no set rose",
        command=evidence.new_run("ppo.learning_rate", 0.5),
    )


def _further(evidence: Evidence) -> NextStep:
    """Next step of a run that works."""
    if (going_on := _still_rising(evidence)) is not None:
        return going_on
    if not evidence.status.is_over:
        share = _share_done(evidence)
        done = f": {percent(share)} of its env steps are done" if share is not None else ""
        return NextStep(sentence=f"let it train{done}, and look at what fails meanwhile", **_failing(evidence))
    if evidence.trend is None or evidence.trend.late is None:
        sentence = "train for longer: it is too short to say whether it has levelled off"
        return NextStep(sentence=sentence, command=evidence.resumed_for_longer(), query={"panel": "Evaluation"})
    sentence = (
        "it levelled off: look at what still fails; the page Evaluation hands the command that trains on these levels"
    )
    return NextStep(sentence=sentence, **_failing(evidence))


def _failing(evidence: Evidence) -> dict[str, Any]:
    failing = evidence.statement("failing")
    return {} if failing is None else {"page": failing.page, "query": failing.query}


def _still_rising(evidence: Evidence) -> NextStep | None:
    """Go on, where solve rates in training or of a set rose over the last half, too, by more than chance."""
    trend = evidence.trend
    rising = [(one.name, one.since_half) for one in evidence.histories if is_above(one.since_half)]
    late = None if trend is None else trend.late
    if trend is not None and is_above(late):
        why = f"solve rates of {trend.source} still rise ({points(late)} over the last half)"
        page, query = trend.link[0], {"panel": trend.link[1]}
    elif rising:
        name, since_half = rising[0]
        why = f"{name} rose over the last half of the run, too ({points(since_half)})"
        page, query = "evaluation", {"set": name, "panel": f"{name}: "}
    else:
        return None
    if evidence.status.is_over:
        sentence = f"train for longer: {why}"
        return NextStep(sentence=sentence, command=evidence.resumed_for_longer(), page=page, query=query)
    return NextStep(sentence=f"let it train: {why}", page=page, query=query)


def _share_done(evidence: Evidence) -> float | None:
    """Share of its env steps that a run has made; None where it ends by something else."""
    total, done = evidence.value("run.total_env_steps"), evidence.table.known("progress/env_steps")
    return float(np.clip(done[-1] / total, 0, 1)) if total and len(done) else None
