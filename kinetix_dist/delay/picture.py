"""Picture of delay curves: the mean over levels first, then a panel a level; a line for each policy and method."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

PANEL_INCHES = (4.6, 3.4)
ALONE_INCHES = (7.0, 4.8)  # of a panel that is the only one
MAX_COLUMNS = 4
LETTERS_PER_INCH = 10  # of the title
LINES_APART = 0.04  # steps by which points of one delay are moved, so that their intervals can be told apart
MAX_LEVELS = 23  # panels of levels
DPI = 90

Record = dict[str, Any]


def draw(records: Sequence[Record], file: Path) -> None:
    """Writes the picture; the format follows the file's ending. Raises OSError, and ValueError for a format that is
    none."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    levels = [level["name"] for level in records[0]["levels"]][:MAX_LEVELS]
    panels: list[tuple[str, Callable[[Record], Record]]] = [("mean over levels", lambda record: record)]
    panels += [(name, lambda record, i=i: record["levels"][i]) for i, name in enumerate(levels)] if levels[1:] else []
    columns = min(len(panels), MAX_COLUMNS)
    rows = -(-len(panels) // columns)
    size = (PANEL_INCHES[0] * columns, PANEL_INCHES[1] * rows) if panels[1:] else ALONE_INCHES
    figure, grid = plt.subplots(rows, columns, figsize=size, layout="constrained", squeeze=False)
    for panel, (title, of) in zip(grid.flat, panels, strict=False):
        _draw_lines(panel, records, of)
        panel.set_title(f"{title}: solved, %", fontsize=9)
        panel.set_xlabel("delay, environment steps")
        panel.xaxis.get_major_locator().set_params(integer=True)
        panel.set_ylim(-3, 103)
        panel.grid(alpha=0.3)
    for panel in grid.flat[len(panels) :]:
        panel.set_visible(False)
    grid[0, 0].legend(fontsize=7)
    attempts = records[0]["attempts_per_level"]
    title = f"Solve rate under delay, 95 % intervals over attempts, {attempts} attempts a level and point"
    figure.suptitle(textwrap.fill(title, round(LETTERS_PER_INCH * size[0])))
    figure.savefig(file, dpi=DPI)
    plt.close(figure)


def _draw_lines(panel: Any, records: Sequence[Record], of: Callable[[Record], Record]) -> None:
    policies = list(dict.fromkeys(record["policy"] for record in records))
    lines = list(dict.fromkeys((record["policy"], record["method"]) for record in records))
    for number, (policy, method) in enumerate(lines):
        points = sorted(
            (record for record in records if (record["policy"], record["method"]) == (policy, method)),
            key=lambda record: record["delay"],
        )
        delays = np.array([point["delay"] for point in points]) + LINES_APART * (number - (len(lines) - 1) / 2)
        rates, low, high = (100 * np.array([of(point)[name] for point in points]) for name in ("rate", "low", "high"))
        label = method if len(policies) == 1 else f"{Path(policy).name}: {method}"
        ends = np.maximum([rates - low, high - rates], 0.0)  # rounding
        panel.errorbar(
            delays, rates, ends, fmt=".-", color=f"C{number % 10}", linewidth=1.2, elinewidth=0.8, label=label
        )
