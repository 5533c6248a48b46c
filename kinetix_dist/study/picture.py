"""Picture of a study: solve rates over environment steps, a panel a set; and, by the kind of its figure, the rate of
each level, the learnability of what a curriculum chose, or, first, the rates after each phase.

The kinds give blocks of panels. Each block begins a row.
"""

from __future__ import annotations

import functools
import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from kinetix_dist.study.forgetting import Forgetting
from kinetix_dist.study.learnability import KINDS, Refresh, over_seeds
from kinetix_dist.study.records import Record
from kinetix_dist.study.report import row_name
from kinetix_dist.study.study_file import LEVELS, Study
from kinetix_dist.study.summary import Summary, estimate_at

PANEL_INCHES = (5.0, 3.8)
MAX_COLUMNS = 3
LETTERS_PER_COLUMN = 45  # of the title
DPI = 90
MAX_WITH_NUMBERS = 8  # columns of a matrix


DrawPanel = Callable[[Any], None]


def draw(study: Study, summary: Summary, forgetting: Sequence[Forgetting], file: Path) -> None:
    """Writes the picture; the format follows the file's ending. forgetting: of arms, where the study is about that.
    Raises OSError."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    num_columns = min(len(study.panels), MAX_COLUMNS)
    blocks = _blocks(study, summary, forgetting)
    rows = [block[first : first + num_columns] for block in blocks for first in range(0, len(block), num_columns)]
    size = (PANEL_INCHES[0] * num_columns, PANEL_INCHES[1] * len(rows))
    figure, grid = plt.subplots(len(rows), num_columns, figsize=size, layout="constrained", squeeze=False)
    for panels, row in zip(grid, rows, strict=True):
        for panel, draw_panel in zip(panels, row, strict=False):
            draw_panel(panel)
        for panel in panels[len(row) :]:
            panel.set_visible(False)
    figure.suptitle(textwrap.fill(study.question, LETTERS_PER_COLUMN * num_columns))
    figure.savefig(file, dpi=DPI)
    plt.close(figure)


def _blocks(study: Study, summary: Summary, forgetting: Sequence[Forgetting]) -> list[list[DrawPanel]]:
    """Blocks of panels, from the top."""
    partial = functools.partial
    arms = [arm.name for arm in study.arms if _of(summary, arm.name)]
    by_set = {name: {arm: _of(summary, arm, name) for arm in arms} for name in study.panels}
    choosing = [arm for arm in arms if any(refresh.run.arm.name == arm for refresh in summary.refreshes)]
    levels: list[list[DrawPanel]] = []
    if study.figure.kind == LEVELS:
        levels = [
            [partial(_draw_levels, study=study, arm=arm, records=by_arm[arm]) for by_arm in by_set.values()]
            for arm in arms
        ]
    return [
        [partial(_draw_matrix, result=result) for result in forgetting],
        [partial(_draw_curves, level_set=name, by_arm=by_arm) for name, by_arm in by_set.items()],
        *levels,
        [partial(_draw_learnability, arm=arm, refreshes=summary.refreshes) for arm in choosing],
    ]


def _of(summary: Summary, arm: str, level_set: str | None = None) -> list[Record]:
    """Records of an arm that have points."""
    return [
        record
        for record in summary.records
        if record.run.arm.name == arm and record.points and level_set in (None, record.level_set)
    ]


def _draw_curves(panel: Any, level_set: str, by_arm: dict[str, list[Record]]) -> None:
    for number, (arm, records) in enumerate(by_arm.items()):
        if not records:
            continue
        colour = f"C{number % 10}"
        shared = sorted(set.union(*(set(record.points) for record in records)))
        steps, values, bands = [], [], []
        for point in shared:
            there = [record.points[point] for record in records if point in record.points]
            estimate = estimate_at(there, records[0].base_levels)
            steps.append(np.mean([each.env_steps for each in there]) / 1e6)
            values.append(100 * estimate.value)
            low, high = estimate.low, estimate.high
            bands.append((values[-1], values[-1]) if low is None or high is None else (100 * low, 100 * high))
        word = "seed" if len(records) == 1 else "seeds"
        panel.plot(steps, values, ".-", color=colour, linewidth=1.2, label=f"{arm}, {len(records)} {word}")
        panel.fill_between(steps, *np.transpose(bands), color=colour, alpha=0.15, linewidth=0)
    panel.set_title(f"{level_set}: solved, %, with 95 % intervals")
    panel.set_xlabel("million environment steps")
    panel.grid(alpha=0.3)
    if any(by_arm.values()):
        panel.legend(fontsize=8)


def _draw_matrix(panel: Any, result: Forgetting) -> None:
    """Rates on each set after each phase, from white to dark, with numbers where there is room for them; what the phase
    trained for has a frame."""
    from matplotlib.patches import Rectangle

    num_rows, num_columns = result.rates.shape
    panel.imshow(result.rates, aspect="auto", cmap="Blues", vmin=0, vmax=1, interpolation="nearest")
    for row, task in enumerate(result.tasks, start=1):
        corner = (result.sets.index(task) - 0.5, row - 0.5)
        panel.add_patch(Rectangle(corner, 1, 1, fill=False, edgecolor="C1", linewidth=1.5))
    if num_columns <= MAX_WITH_NUMBERS:
        for row, column in np.ndindex(num_rows, num_columns):
            rate = result.rates[row, column]
            panel.text(column, row, f"{100 * rate:.0f}", ha="center", va="center", color="w" if rate > 0.6 else "k")
    panel.set_xticks(range(num_columns), result.sets, rotation=90 if num_columns > MAX_WITH_NUMBERS else 20, fontsize=7)
    panel.set_yticks(range(num_rows), [row_name(row, result.tasks) for row in range(num_rows)], fontsize=7)
    panel.set_title(f"{result.arm}: solved, %, after each phase", fontsize=9)


def _draw_learnability(panel: Any, arm: str, refreshes: Sequence[Refresh]) -> None:
    names = {"fresh": "fresh levels", "claimed": "buffer, claimed", "measured": "buffer, measured in training"}
    for kind in KINDS:
        panel.plot(*over_seeds(refreshes, arm, kind), ".-", linewidth=1.2, label=names[kind])
    panel.set_title(f"{arm}: learnability p (1 - p)")
    panel.set_xlabel("million environment steps")
    panel.set_ylim(0, 0.26)  # it is 0.25 at most
    panel.grid(alpha=0.3)
    panel.legend(fontsize=8)


def _draw_levels(panel: Any, study: Study, arm: str, records: Sequence[Record]) -> None:
    """Rate of each level, mean over seeds, from white (never solved) to dark (always); those solved most on top."""
    if not records:
        panel.set_visible(False)
        return
    rates = np.full((len(records[0].names), study.num_points_of(arm) + 1), np.nan)
    for number in range(rates.shape[1]):
        there = [record.points[number].rates for record in records if number in record.points]
        if there:
            rates[:, number] = np.mean(there, axis=0)
    order = np.argsort(-np.nan_to_num(rates[:, -1]), kind="stable")
    panel.imshow(
        rates[order],
        aspect="auto",
        cmap="Blues",
        vmin=0,
        vmax=1,
        interpolation="nearest",
        extent=(0, study.env_steps_of(arm) / 1e6, len(rates), 0),
    )
    panel.set_title(f"{arm}: levels of {records[0].level_set}", fontsize=9)
    panel.set_xlabel("million environment steps")
    panel.set_ylabel("levels")
