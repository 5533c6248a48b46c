"""Goal following, from records of `bench goals`: correlations, and a heat map per policy and kind of body."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from kinetix_dist.level.level import WORLD_SIZE_M
from kinetix_dist.study.command_results.kind import Row, Written, records_of

PANEL_INCHES = 2.6
DPI = 90
POLICY, RANDOM = "policy", "random"  # of "actions"


class GoalFollowing:
    """Results of `bench goals`."""

    def rows(self, written: Sequence[Written]) -> list[Row]:
        return records_of(written)

    def sentences(self, rows: Sequence[Row]) -> list[str]:
        found = []
        for arm in dict.fromkeys(row["arm"] for row in rows):
            each = [
                f"{row['morphology']} {row['correlation']:.2f} ({row['low']:.2f} to {row['high']:.2f})"
                for row in rows
                if row["arm"] == arm and row["actions"] == POLICY
            ]
            found.append(f"Correlation of the x of body and goal over levels, {arm}: {', '.join(each)}.")
        if random := [abs(row["correlation"]) for row in rows if row["actions"] == RANDOM]:
            found.append(f"Of random actions it is at most {max(random):.2f}. Intervals are 95 % over levels.")
        return found

    def finding(self, rows: Sequence[Row]) -> str:
        parts = [
            f"{row['arm']} {row['morphology']} {row['correlation']:.2f}" for row in rows if row["actions"] == POLICY
        ]
        return f"correlation of body and goal: {', '.join(parts)}"

    def draw(self, question: str, rows: Sequence[Row], file: Path) -> None:
        import matplotlib

        matplotlib.use("Agg")
        import matplotlib.pyplot as plt

        lines = [(arm, POLICY) for arm in dict.fromkeys(row["arm"] for row in rows)] + (
            [(rows[0]["arm"], RANDOM)] if rows else []
        )
        bodies = list(dict.fromkeys(row["morphology"] for row in rows))
        shape = (max(len(lines), 1), max(len(bodies), 1))
        size = (PANEL_INCHES * shape[1], PANEL_INCHES * shape[0] + 0.4)
        figure, grid = plt.subplots(*shape, figsize=size, layout="constrained", squeeze=False)
        for (arm, actions), panels in zip(lines, grid, strict=False):
            for body, panel in zip(bodies, panels, strict=True):
                own = [row for row in rows if (row["arm"], row["actions"], row["morphology"]) == (arm, actions, body)]
                _draw_map(panel, own, f"{arm if actions == POLICY else 'random actions'}: {body}")
        figure.suptitle("\n".join(textwrap.wrap(question, 25 * shape[1])))
        figure.savefig(file, dpi=DPI)
        plt.close(figure)


def _draw_map(panel: Any, rows: Sequence[Row], title: str) -> None:
    """Share of the time at each x of the body (upwards), for each x of the goal (a column sums to one)."""
    panel.set_title(title, fontsize=8)
    panel.set_xlabel("x of the goal, m", fontsize=7)
    panel.set_ylabel("x of the body, m", fontsize=7)
    panel.tick_params(labelsize=6)
    if rows:
        counts = np.sum([row["counts"] for row in rows], axis=0).astype(float)  # [goal, body]
        share = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
        end = WORLD_SIZE_M
        panel.imshow(share.T, origin="lower", extent=(0, end, 0, end), cmap="Blues", vmin=0, interpolation="nearest")
