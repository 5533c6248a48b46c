"""The picture of specialists: samples to each threshold, level by level, from scratch and from a policy."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kinetix_dist.finetune.results import THRESHOLDS, Record

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLOURS = ("#d62728", "#1f77b4", "#2ca02c", "#ff7f0e")  # of starts, in their order
ROW_INCHES = 0.32


def draw(records: Sequence[Record], file: Path) -> None:
    """Writes the picture; the format follows the file's ending. records: as `read_results` gives them."""
    figure_of(records).savefig(file, dpi=100)


def figure_of(records: Sequence[Record]) -> Figure:
    """A panel for each threshold.

    A dot is where the solve rate was first at the threshold; an open triangle at the end of training says that it
    never was. The axis is linear up to the first evaluation, and logarithmic from there on.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import EngFormatter, SymmetricalLogLocator

    levels = list(dict.fromkeys(record["level"] for record in records))
    figure = Figure(figsize=(11, 1.6 + ROW_INCHES * max(len(levels), 4)), layout="constrained")
    panels = figure.subplots(1, len(THRESHOLDS), sharey=True, squeeze=False)
    first = max(min(_first_evaluation(record) for record in records), 1)
    end = max(record["env_steps"] for record in records)
    for panel, threshold in zip(panels[0], THRESHOLDS):
        _samples(panel, records, levels, threshold)
        panel.set_title(f"environment steps to {threshold:.0%} solved")
        panel.set_xscale("symlog", linthresh=first, linscale=0.4)
        panel.set_xlim(-0.15 * first, 1.6 * max(end, first))
        panel.xaxis.set_major_locator(SymmetricalLogLocator(base=10, linthresh=first, subs=(1, 2, 5)))
        panel.xaxis.set_major_formatter(EngFormatter(sep=" "))
        panel.grid(alpha=0.3)
        panel.legend(
            fontsize=9, loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=2, title="levels that reached it"
        )
    panels[0][0].set_yticks(range(len(levels)), levels)
    panels[0][0].set_ylim(len(levels) - 0.5, -0.5)
    return figure


def _samples(panel: Any, records: Sequence[Record], levels: list[str], threshold: float) -> None:
    starts = list(dict.fromkeys(record["start"] for record in records))
    gap = 0.4 / max(len(starts), 1)
    for number, start in enumerate(starts):
        colour = COLOURS[number % len(COLOURS)]
        mine = [record for record in records if record["start"] == start]
        offset = gap * (number - (len(starts) - 1) / 2)
        reached, missed = [], []
        for record in mine:
            steps = record["env_steps_to"][str(threshold)]
            row = levels.index(record["level"]) + offset
            (missed if steps is None else reached).append((record["env_steps"] if steps is None else steps, row))
        label = f"{mine[0]['label']}: {len(reached)} of {len(mine)}"
        panel.plot(*_columns(reached), "o", color=colour, label=label)
        panel.plot(*_columns(missed), ">", color=colour, fillstyle="none", label=None)


def _columns(points: list[tuple[float, float]]) -> tuple[list[float], list[float]]:
    return [x for x, _ in points], [y for _, y in points]


def _first_evaluation(record: Record) -> int:
    """Environment steps at the first evaluation after training began."""
    return next((point["env_steps"] for point in record["curve"] if point["env_steps"]), 1)
