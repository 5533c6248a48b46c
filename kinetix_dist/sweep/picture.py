"""The picture of a sweep, from `sweep.json` alone: curves of all runs, and effects of factors or means of arms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from kinetix_dist.sweep.results import OBJECTIVES

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
