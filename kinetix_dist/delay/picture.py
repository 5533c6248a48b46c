"""Picture of delay curves: the mean over levels first, then a panel a level; a line for each policy and method."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

PANEL_INCHES = (4.6, 3.4)
MAX_COLUMNS = 4
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
    size = (PANEL_INCHES[0] * columns, PANEL_INCHES[1] * rows)
    figure, grid = plt.subplots(rows, columns, figsize=size, layout="constrained", squeeze=False)
    for panel, (title, of) in zip(grid.flat, panels, strict=False):
        _draw_lines(panel, records, of)
        panel.set_title(f"{title}: solved, %", fontsize=9)
        panel.set_xlabel("delay, environment steps")
        panel.set_ylim(-3, 103)
        panel.grid(alpha=0.3)
    for panel in grid.flat[len(panels) :]:
        panel.set_visible(False)
    grid[0, 0].legend(fontsize=7)
    attempts = records[0]["attempts_per_level"]
    figure.suptitle(f"Solve rate under delay, 95 % intervals over attempts, {attempts} attempts a level and point")
    figure.savefig(file, dpi=DPI)
    plt.close(figure)


def _draw_lines(panel: Any, records: Sequence[Record], of: Callable[[Record], Record]) -> None:
    policies = list(dict.fromkeys(record["policy"] for record in records))
    for number, (policy, method) in enumerate(dict.fromkeys((r["policy"], r["method"]) for r in records)):
        points = sorted(
            (record for record in records if (record["policy"], record["method"]) == (policy, method)),
            key=lambda record: record["delay"],
        )
        delays = [point["delay"] for point in points]
        rates, low, high = (100 * np.array([of(point)[name] for point in points]) for name in ("rate", "low", "high"))
        label = method if len(policies) == 1 else f"{Path(policy).name}: {method}"
        panel.plot(delays, rates, ".-", color=f"C{number % 10}", linewidth=1.2, label=label)
        panel.fill_between(delays, low, high, color=f"C{number % 10}", alpha=0.15, linewidth=0)
