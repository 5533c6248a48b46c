"""Results of a sweep so far, as JSON: `sweep.json`. Tables and the picture are drawn from it alone.

{format, name, hash, state, objective, runs: [...], arms: [...], effects: {area: [...], last: [...]} or null}
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from kinetix_dist.config import to_dict
from kinetix_dist.sweep.arms import Run
from kinetix_dist.sweep.design import Design
from kinetix_dist.sweep.effects import Estimate, main_effects, mean_of_arms
from kinetix_dist.sweep.factorial import two_level_design
from kinetix_dist.sweep.objective import Curve, Score, score

FORMAT = 1
OBJECTIVES = ("area", "last")  # fields of Score
WAITING, PART, DONE = "waiting", "part", "done"  # states of a run
COMPLETE, INCOMPLETE = "complete", "incomplete"  # of a sweep


def results(
    design: Design,
    runs: Sequence[Run],
    curves: Mapping[str, Curve],
    targets: Mapping[str, float],
    *,
    design_hash: str,
    is_complete: bool,
) -> dict[str, Any]:
    """Content of sweep.json. targets: second until which each run is to be trained, by its name."""
    scored = {run.name: _scores(design, curves[run.name]) for run in runs}
    done = {run.name for run in runs if curves[run.name].reaches(targets[run.name])}
    return {
        "format": FORMAT,
        "name": design.name,
        "hash": design_hash,
        "state": COMPLETE if is_complete else INCOMPLETE,
        "objective": to_dict(design.objective),
        "runs": [
            {
                "name": run.name,
                "arm": run.arm.name,
                "seed": run.seed,
                "levels": dict(run.arm.levels),
                "is_fold_over": run.arm.is_fold_over,
                "options": dict(run.arm.options),
                "state": DONE if run.name in done else PART if len(curves[run.name].seconds) > 1 else WAITING,
                "scores": [{"until": until, "area": s.area, "last": s.last} for until, s in scored[run.name].items()],
                "curve": _curve(curves[run.name]),
            }
            for run in runs
        ],
        "arms": _arms(design, runs, scored),
        "effects": _effects(design, runs, scored),
    }


def _scores(design: Design, curve: Curve) -> dict[float, Score]:
    """Scores at each rung that the curve reaches."""
    return {until: score(curve, design.objective, until) for until in design.rung_seconds if curve.reaches(until)}


def _curve(curve: Curve) -> dict[str, Any]:
    return {
        "updates": curve.updates.tolist(),
        "seconds": curve.seconds.tolist(),
        "values": curve.values.tolist(),
        "rates": {name: rates.tolist() for name, rates in curve.rates.items()},
    }


def _arms(design: Design, runs: Sequence[Run], scored: Mapping[str, Mapping[float, Score]]) -> list[dict[str, Any]]:
    """Means, at each rung, of the arms all of whose runs reached it; best first."""
    rows: list[dict[str, Any]] = []
    for until in design.rung_seconds:
        reached = _reached(runs, scored, until)
        if not reached:
            continue
        estimates = {
            objective: mean_of_arms({arm: [getattr(s, objective) for s in scores] for arm, scores in reached.items()})
            for objective in OBJECTIVES
        }
        ordered = sorted(range(len(reached)), key=lambda index: -estimates["area"][index].value)
        rows += [
            {
                "arm": estimates["area"][index].name,
                "until": until,
                **{objective: estimates[objective][index].as_json() for objective in OBJECTIVES},
            }
            for index in ordered
        ]
    return rows


def _reached(runs: Sequence[Run], scored: Mapping[str, Mapping[float, Score]], until: float) -> dict[str, list[Score]]:
    """Scores of the seeds of each arm, where all of them are there."""
    by_arm: dict[str, list[Run]] = {}
    for run in runs:
        by_arm.setdefault(run.arm.name, []).append(run)
    return {
        arm: [scored[run.name][until] for run in own]
        for arm, own in by_arm.items()
        if all(until in scored[run.name] for run in own)
    }


def _effects(design: Design, runs: Sequence[Run], scored: Mapping[str, Mapping[float, Score]]) -> dict[str, Any] | None:
    """Effects of the whole design; of its first half where its fold-over is not complete; None before."""
    if design.factorial is None:
        return None
    whole = two_level_design(design.factorial)
    for plan in (whole, whole.first_half()):
        part = [run for run in runs if plan.fold_over or not run.arm.is_fold_over]
        found = _reached(part, scored, design.seconds)
        names = list(dict.fromkeys(run.arm.name for run in part))
        if len(found) < len(names):
            continue
        estimates: dict[str, list[Estimate]] = {
            objective: main_effects(plan, [[getattr(s, objective) for s in found[name]] for name in names])
            for objective in OBJECTIVES
        }
        return {
            "of": f"{len(names)} arms",
            "is_whole": plan.fold_over == whole.fold_over,
            "aliases": plan.aliases(),
            "resolution": plan.resolution,
            **{
                objective: [estimate.as_json() for estimate in of_factors]
                for objective, of_factors in estimates.items()
            },
        }
    return None
