"""Results of a sweep so far, as JSON: `sweep.json`. Tables and the picture are drawn from that file alone.

{format, name, hash, state, objective, runs: [...], arms: [...], effects: {area: [...], last: [...]} or null}
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
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


COLOURS = {"area": "#1f77b4", "last": "#ff7f0e"}
LABELS = {"area": "area under the curve / span", "last": "mean of the last three values"}
MAX_NAMED = 12  # curves with a name each; more have one colour


def draw(found: Mapping[str, Any], file: Path) -> None:
    """Writes the picture; the format follows the file's ending. Raises OSError."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (curves, estimates) = plt.subplots(1, 2, figsize=(13, 5), layout="constrained")
    _draw_curves(curves, found)
    effects = found["effects"]
    if effects is not None:
        rows = {name: effects[name] for name in OBJECTIVES}
        _draw_estimates(estimates, rows)
        estimates.axvline(0.0, color="#333333", linewidth=0.8)
        estimates.set_title(f"main effects of {effects['of']}: high less low, 95 % intervals")
    else:
        last = [row for row in found["arms"] if row["until"] == max(r["until"] for r in found["arms"])]
        rows = {name: [{**row[name], "name": row["arm"]} for row in last] for name in OBJECTIVES}
        _draw_estimates(estimates, rows)
        seconds = f" after {last[0]['until']:g} s" if last else ""
        estimates.set_title(f"arms{seconds}: mean over seeds, 95 % intervals")
    figure.suptitle(f"{found['name']} ({found['state']})")
    figure.savefig(file, dpi=90)
    plt.close(figure)


def _draw_curves(panel: Any, found: Mapping[str, Any]) -> None:
    runs = [run for run in found["runs"] if len(run["curve"]["seconds"]) > 1]
    arms = list(dict.fromkeys(run["arm"] for run in runs))
    named: set[str] = set()
    for run in runs:
        label = None
        if len(arms) <= MAX_NAMED and run["arm"] not in named:
            label = run["arm"]
            named.add(run["arm"])
        colour = f"C{arms.index(run['arm']) % 10}" if len(arms) <= MAX_NAMED else "#1f77b4"
        curve = run["curve"]
        panel.plot(curve["seconds"], curve["values"], ".-", color=colour, label=label, linewidth=1)
    start = found["objective"]["from_second"]
    if start:
        panel.axvline(start, color="#333333", linewidth=0.8, linestyle=":")
    weights = ", ".join(f"{name} x {weight:g}" for name, weight in found["objective"]["sets"].items())
    panel.set_title(f"solve rate, mean of {weights}")
    panel.set_xlabel("seconds of training, without warm-up")
    panel.grid(alpha=0.3)
    if named:
        panel.legend(fontsize=8, title="arm")


def _draw_estimates(panel: Any, rows: Mapping[str, Sequence[Mapping[str, Any]]]) -> None:
    """Points with intervals, one below the other; of both objectives side by side."""
    for shift, objective in zip((-0.12, 0.12), rows, strict=True):
        for index, row in enumerate(rows[objective]):
            y = index + shift
            label = LABELS[objective] if index == 0 else None
            panel.plot(row["value"], y, "o", color=COLOURS[objective], label=label)
            if row["low"] is not None:
                panel.plot([row["low"], row["high"]], [y, y], "-", color=COLOURS[objective])
    names = [row["name"] for row in rows["area"]]
    panel.set_yticks(range(len(names)), names)
    panel.invert_yaxis()
    panel.grid(alpha=0.3, axis="x")
    if names:
        panel.legend(fontsize=8)
