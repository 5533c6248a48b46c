"""Picture of a study: solve rates over environment steps, a panel a set; and, by the kind of its figure, the
rate of each level, or the learnability of what a curriculum chose."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from kinetix_dist.study.learnability import KINDS, Refresh, over_seeds
from kinetix_dist.study.records import Record
from kinetix_dist.study.study_file import Study
from kinetix_dist.study.summary import Summary, estimate_at

PANEL_INCHES = (5.0, 3.8)
MAX_COLUMNS = 3
LETTERS_PER_COLUMN = 45  # of the title
DPI = 90


def draw(study: Study, summary: Summary, file: Path) -> None:
    """Writes the picture; the format follows the file's ending. Raises OSError."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    arms = [arm.name for arm in study.arms if _of(summary, arm.name)]
    by_level = arms if study.figure.kind == "levels" else []
    choosing = [arm for arm in arms if any(refresh.run.arm.name == arm for refresh in summary.refreshes)]
    num_columns = min(len(study.panels), MAX_COLUMNS)
    rows_of_sets = math.ceil(len(study.panels) / num_columns)  # of the curves, and of each arm's levels
    rows_of_choosing = math.ceil(len(choosing) / num_columns)
    num_rows = rows_of_sets * (1 + len(by_level)) + rows_of_choosing
    size = (PANEL_INCHES[0] * num_columns, PANEL_INCHES[1] * num_rows)
    figure, grid = plt.subplots(num_rows, num_columns, figsize=size, layout="constrained", squeeze=False)
    of_sets, of_choosing = np.split(grid, [num_rows - rows_of_choosing])
    blocks = of_sets.reshape(1 + len(by_level), rows_of_sets * num_columns)
    for number, level_set in enumerate(study.panels):
        _draw_curves(blocks[0, number], level_set, {arm: _of(summary, arm, level_set) for arm in arms})
        for block, arm in enumerate(by_level, start=1):
            _draw_levels(blocks[block, number], study, arm, _of(summary, arm, level_set))
    for panel, arm in zip(of_choosing.flat, choosing, strict=False):
        _draw_learnability(panel, arm, summary.refreshes)
    for panel in [*blocks[:, len(study.panels) :].flat, *of_choosing.flat[len(choosing) :]]:
        panel.set_visible(False)
    figure.suptitle(textwrap.fill(study.question, LETTERS_PER_COLUMN * num_columns))
    figure.savefig(file, dpi=DPI)
    plt.close(figure)


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
