"""Results of a study in words: Markdown with the differences between arms, their intervals and a table."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

from kinetix_dist.evaluation.intervals import NO_SPREAD
from kinetix_dist.study.forgetting import MEASURES, Forgetting
from kinetix_dist.study.learnability import sentences as learnability
from kinetix_dist.study.plan import Plan
from kinetix_dist.study.study_file import NOT_RUN, Study
from kinetix_dist.study.summary import NO_INTERVAL, OVER_LEVELS, OVER_SEEDS, ArmResult, Estimate, Summary

WIDTH = 119  # columns of what is written
MAX_NAMED = 12  # runs that did not finish and are named one by one

_OVER = {
    OVER_SEEDS: "intervals are 95 % over seeds, by bootstrap, and by Welch's t for differences",
    OVER_LEVELS: "intervals are 95 % over base levels, since an arm has one seed, and say nothing of seeds",
    NO_SPREAD: "no spread means that an interval would have no width, as if all seeds (or, with one seed, all base "
    "levels) have the same result; other seeds may differ",
    NO_INTERVAL: "there is no interval, since an arm has one seed and the set one base level",
}


def markdown(plan: Plan, summary: Summary, forgetting: Sequence[Forgetting], minutes: float) -> str:
    """Text of NAME.md. forgetting: of arms, where the study is about that; minutes: of training, over all runs."""
    study = plan.study
    parts = [
        f"# {study.name}",
        wrapped(f"**Question.** {study.question}"),
        wrapped(f"**The paper.** {study.paper}"),
        wrapped(f"**Ours.** {paragraph(plan, summary)}"),
        wrapped(f"**State.** {state(plan, summary)}. {minutes:.1f} minutes of training, over all runs."),
    ]
    if forgetting:
        parts += [wrapped(forgetting_paragraph(forgetting)), *map(_matrix, forgetting)]
    if summary.results:
        parts += [_table(study, summary.results), f"![{study.question}]({study.name}.png)"]
    return "\n\n".join(parts) + "\n"


def paragraph(plan: Plan, summary: Summary) -> str:
    """Differences between arms and their intervals, in sentences."""
    study = plan.study
    if not summary.results:
        return " ".join(["No run is complete.", *_missing(plan, summary)])
    steps = f" after {in_millions(plan.runs[0].config.run.total_env_steps)} environment steps"
    after = steps if study.has_one_length else ""
    sentences = []
    for level_set in study.sets:
        own = [result for result in summary.results if result.level_set == level_set]
        if not own:
            continue
        rates = ", ".join(f"{_with_steps(study, result.arm)} {percent(result.last)}" for result in own)
        sentences.append(f"Solved of {level_set}{after}, %: {rates}.")
        sentences += [
            f"{result.arm} less {study.reference}: {points(result.difference)} points at the end, "
            f"{points(result.difference_over_training)} over training."
            for result in own
            if result.difference is not None and result.difference_over_training is not None
        ]
    if not study.has_one_length:
        sentences.append(
            "Arms are trained for different steps: the end is that of each, and differences over training are over the "
            "steps that both have."
        )
    used = {each.over for result in summary.results for each in _estimates(result)}
    sentences += [f"{_OVER[over][0].upper()}{_OVER[over][1:]}." for over in _OVER if over in used]
    return " ".join([*sentences, *learnability(plan, summary.refreshes), *_missing(plan, summary)])


def finding(plan: Plan, summary: Summary) -> str:
    """Differences on the first set of the figure, in one sentence; "not run yet"."""
    own = [result for result in summary.results if result.level_set == plan.study.panels[0]]
    found = [f"{each.arm} {points(each.difference)}" for each in own if each.difference is not None]
    if not found:
        found = [f"{each.arm} {percent(each.last)} %" for each in own]
    if not found:
        return NOT_RUN
    less = f", points less {plan.study.reference}" if own[0].difference or len(own) > 1 else ""
    return f"{plan.study.panels[0]}{less}: {', '.join(found)}"


def forgetting_paragraph(results: Sequence[Forgetting]) -> str:
    """Forgetting and transfer of each arm, in sentences."""
    sentences = ["Points of solve rate, over the sets that the phases train for (see docs/studies.md)."]
    for result in results:
        found = ", ".join(f"{name} {points(result.measures[name])}" for name in MEASURES[1:] if name in result.measures)
        at_the_end = f"{result.arm}: {percent(result.measures[MEASURES[0]])} % solved at the end"
        sentences.append(f"{at_the_end}; {found}." if found else f"{at_the_end}; it has no phases.")
    return f"**Forgetting.** {' '.join(sentences)}"


def forgetting_finding(results: Sequence[Forgetting]) -> str:
    """Rates at the end and forgetting of the arms, in one sentence; "not run yet"."""
    found = []
    for result in results:
        forgotten = result.measures.get(MEASURES[1])
        rate = f"{result.arm} {percent(result.measures[MEASURES[0]])} % at the end"
        found.append(rate if forgotten is None else f"{rate}, {points(forgotten)} forgotten")
    return "; ".join(found) or NOT_RUN


def _matrix(result: Forgetting) -> str:
    """Table of an arm: solve rates on each set, a row after each phase."""
    rows = [f"| {result.arm}, % | {' | '.join(result.sets)} |", f"|{'---|' * (len(result.sets) + 1)}"]
    for number, rates in enumerate(result.rates):
        cells = " | ".join(f"{100 * rate:.1f}" for rate in rates)
        rows.append(f"| {row_name(number, result.tasks)} | {cells} |")
    return "\n".join(rows)


def row_name(number: int, tasks: Sequence[str]) -> str:
    """Name of a row of a forgetting matrix. tasks: of the phases of an arm, or none."""
    if number == 0:
        return "before"
    return f"{number}: {tasks[number - 1]}" if tasks else "at the end"


def state(plan: Plan, summary: Summary) -> str:
    """How many runs are complete, in words."""
    done = len(plan.runs) - len(summary.unfinished)
    is_begun = done or any(each.env_steps for each in summary.unfinished)
    return f"{done} of {len(plan.runs)} runs" if is_begun else NOT_RUN


def percent(estimate: Estimate) -> str:
    return f"{100 * estimate.value:.1f}{_interval(estimate, '')}"


def points(estimate: Estimate | None) -> str:
    """Difference in percentage points with its intervals."""
    if estimate is None:
        return "-"
    welch = ""
    if estimate.welch is not None:
        low, high = (100 * value for value in estimate.welch)
        welch = f" [t: {low:+.1f} to {high:+.1f}]"
    return f"{100 * estimate.value:+.1f}{_interval(estimate, '+')}{welch}"


def in_millions(env_steps: float) -> str:
    """Environment steps in words: "503 M"; below a million with all digits."""
    millions = env_steps / 1e6
    return f"{millions:.0f} M" if millions >= 10 else f"{millions:.1f} M" if millions >= 1 else f"{round(env_steps):,}"


def _interval(estimate: Estimate, sign: str) -> str:
    if estimate.over == NO_SPREAD:
        return f" ({NO_SPREAD})"
    if estimate.low is None or estimate.high is None:
        return ""
    return f" ({100 * estimate.low:{sign}.1f} to {100 * estimate.high:{sign}.1f})"


def _estimates(result: ArmResult) -> list[Estimate]:
    found = (result.last, result.difference, result.difference_over_training)
    return [estimate for estimate in found if estimate is not None]


def _missing(plan: Plan, summary: Summary) -> list[str]:
    """Sentences that name what is not in the results."""
    sentences = []
    begun = [each for each in summary.unfinished if each.env_steps]
    for one in begun[:MAX_NAMED]:
        total = in_millions(one.run.config.run.total_env_steps)
        sentences.append(f"{one.run.name} did not finish: it has {in_millions(one.env_steps)} of {total} steps.")
    if more := begun[MAX_NAMED:]:
        sentences.append(f"Nor did {', '.join(each.run.name for each in more)}.")
    for arm in plan.study.arms:
        seeds = [each.run.seed for each in summary.unfinished if each.run.arm.name == arm.name and not each.env_steps]
        if seeds:
            word = "seed" if len(seeds) == 1 else "seeds"
            sentences.append(f"{arm.name} was not begun with {word} {', '.join(map(str, seeds))}.")
    if summary.gaps:
        sentences.append(f"Evaluations during training are missing in {', '.join(summary.gaps)}.")
    return sentences


def _with_steps(study: Study, arm: str) -> str:
    """Name of an arm, with its environment steps where arms differ in them."""
    return arm if study.has_one_length else f"{arm} ({in_millions(study.env_steps_of(arm))} steps)"


def _table(study: Study, results: Sequence[ArmResult]) -> str:
    rows = [
        "| set | arm | seeds | at the end, % | IQM | worst tenth | over training | difference | over training |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for result in results:
        cells = [
            result.level_set,
            _with_steps(study, result.arm),
            str(result.num_seeds),
            percent(result.last),
            percent(result.last_iqm),
            f"{100 * result.worst_tenth:.1f}",
            percent(result.over_training),
            points(result.difference),
            points(result.difference_over_training),
        ]
        rows.append(f"| {' | '.join(cells)} |")
    return "\n".join(rows)


def wrapped(text: str) -> str:
    """Paragraph in lines of at most WIDTH columns."""
    return textwrap.fill(text, WIDTH, break_long_words=False, break_on_hyphens=False)
