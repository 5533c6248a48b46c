"""One specialist per level, from results of `finetune --each`: solve rates and steps to them, by start.

A run has trained some of the levels (`--part`); the rows of an arm are those of all its runs. The figure has the mean
over levels, and each level that not all arms solve.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from kinetix_dist.errors import UserError
from kinetix_dist.evaluation.intervals import NO_SPREAD
from kinetix_dist.evaluation.over_seeds import bootstrap_interval, mean
from kinetix_dist.finetune.results import THRESHOLDS
from kinetix_dist.stored_specialists import read_results
from kinetix_dist.study.command_results.kind import Row, Written

FOLDER = "specialists"  # in the directory of a run
SOLVED = 0.5  # final rate from which a level counts as solved
COLUMNS = 5  # of panels
PANEL_INCHES = (2.6, 2.0)
MAX_PANELS = 19  # of single levels
DPI = 90


class Specialists:
    """Results of `finetune --each`."""

    def rows(self, written: Sequence[Written]) -> list[Row]:
        return [row for one in written for row in _rows_of(one)]

    def sentences(self, rows: Sequence[Row]) -> list[str]:
        found = []
        for arm in _arms(rows):
            own = [row for row in rows if row["arm"] == arm]
            rates = _by_level(own, "final")
            interval = bootstrap_interval([*rates.values()], mean)
            low_to_high = f" ({NO_SPREAD})" if len(rates) > 1 else ""
            if interval is not None:
                low_to_high = f" ({100 * interval[0]:.1f} to {100 * interval[1]:.1f})"
            counts = " and ".join(
                f"{sum(rate >= share for rate in rates.values())} by {share:.0%} or more" for share in THRESHOLDS
            )
            found.append(
                f"{arm}: {len(rates)} levels, solved {100 * np.mean([*rates.values()]):.1f} %{low_to_high} at the end, "
                f"{counts}."
            )
        for arm in _arms(rows):
            for other in _arms(rows):
                if other > arm and (line := _compared(rows, arm, other)):
                    found.append(line)
        if rows:
            found.append("Rates are means over seeds, intervals 95 % over levels, by bootstrap.")
        return found

    def finding(self, rows: Sequence[Row]) -> str:
        parts = []
        for arm in _arms(rows):
            rates = _by_level([row for row in rows if row["arm"] == arm], "final")
            parts.append(f"{arm} {sum(rate >= SOLVED for rate in rates.values())} of {len(rates)}")
        return f"levels solved by half of the attempts or more: {', '.join(parts)}"

    def draw(self, question: str, rows: Sequence[Row], file: Path) -> None:
        import matplotlib

        matplotlib.use("Agg")
        import matplotlib.pyplot as plt

        contested = _contested(rows)[:MAX_PANELS]
        num_rows = math.ceil((1 + len(contested)) / COLUMNS)
        size = (PANEL_INCHES[0] * COLUMNS, PANEL_INCHES[1] * num_rows + 0.5)
        figure, grid = plt.subplots(num_rows, COLUMNS, figsize=size, layout="constrained", squeeze=False)
        for panel, level in zip(grid.flat, ["", *contested], strict=False):
            for number, arm in enumerate(_arms(rows)):
                own = [row for row in rows if row["arm"] == arm and level in ("", row["level"])]
                if own:
                    panel.plot(*_mean_curve(own), color=f"C{number}", linewidth=1.2, label=arm)
            panel.set_title(level or "mean over levels", fontsize=8)
            panel.set_ylim(-2, 102)
            panel.tick_params(labelsize=6)
            panel.set_xlabel("million environment steps", fontsize=6)
            panel.grid(alpha=0.3)
        if rows:
            grid.flat[0].legend(fontsize=6)
        for panel in grid.flat[1 + len(contested) :]:
            panel.set_visible(False)
        figure.suptitle("\n".join(textwrap.wrap(f"{question} Solved, %", 100)), fontsize=10)
        figure.savefig(file, dpi=DPI)
        plt.close(figure)


def _rows_of(one: Written) -> list[Row]:
    """Raises ValueError for results that cannot be read."""
    try:
        records = read_results(one.directory / FOLDER)
    except UserError as error:
        raise ValueError(str(error)) from error
    return [
        {
            "arm": one.arm,
            "seed": one.seed,
            "level": record["level"],
            "before": record["curve"][0]["solved"] / record["curve"][0]["attempts"],
            "final": record["final"]["rate"],
            "env_steps": record["env_steps"],
            **{f"env_steps_to_{share}": record["env_steps_to"][str(share)] for share in THRESHOLDS},
            "seconds": record["seconds"]["training"],
            "curve": record["curve"],
        }
        for record in records
    ]


def _arms(rows: Iterable[Row]) -> list[str]:
    return list(dict.fromkeys(row["arm"] for row in rows))


def _by_level(rows: Iterable[Row], column: str) -> dict[str, float]:
    """Mean over seeds of a column, by level."""
    values: dict[str, list[float]] = {}
    for row in rows:
        values.setdefault(row["level"], []).append(row[column])
    return {level: float(np.mean(each)) for level, each in values.items()}


def _compared(rows: Sequence[Row], arm: str, other: str) -> str:
    """Sentence about environment steps to the last threshold on levels that reached it in both arms; "": none did."""
    column = f"env_steps_to_{THRESHOLDS[-1]}"
    steps = [
        {(row["level"], row["seed"]): row[column] for row in rows if row["arm"] == name and row[column] is not None}
        for name in (arm, other)
    ]
    shared = [key for key in steps[0] if key in steps[1] and steps[0][key] and steps[1][key]]
    if not shared:
        return ""
    ratio = float(np.median([steps[1][key] / steps[0][key] for key in shared]))
    return (
        f"To {THRESHOLDS[-1]:.0%} solved {other} needs {ratio:.1f} times the environment steps of {arm} "
        f"(median of {len(shared)} specialists that both trained that far, and that were not there at once)."
    )


def _contested(rows: Sequence[Row]) -> list[str]:
    """Levels that some arms solve in the end and others do not."""
    finals = [_by_level([row for row in rows if row["arm"] == arm], "final") for arm in _arms(rows)]
    levels = dict.fromkeys(row["level"] for row in rows)
    return [level for level in levels if len({each[level] >= SOLVED for each in finals if level in each}) > 1]


def _mean_curve(rows: Sequence[Row]) -> tuple[list[float], list[float]]:
    """(million environment steps, percent solved), a specialist that ended early with its last rate to the end."""
    steps = sorted({point["env_steps"] for row in rows for point in row["curve"]})
    rates = [
        np.interp(
            steps,
            [point["env_steps"] for point in row["curve"]],
            [point["solved"] / point["attempts"] for point in row["curve"]],
        )
        for row in rows
    ]
    return [each / 1e6 for each in steps], (100 * np.mean(rates, axis=0)).tolist()
