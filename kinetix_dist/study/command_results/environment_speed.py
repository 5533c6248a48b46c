"""Environment steps per second, from records of `bench env`: a group of bars per size, a bar per observation."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path

from kinetix_dist.study.command_results.kind import Row, Written, records_of

DPI = 90


class EnvironmentSpeed:
    """Results of `bench env`."""

    def rows(self, written: Sequence[Written]) -> list[Row]:
        return records_of(written)

    def sentences(self, rows: Sequence[Row]) -> list[str]:
        return [
            f"{row['arm']}, size {row['size']}, {row['observation']}, {row['worlds']:,} worlds on {row['device']}: "
            f"{row['env_steps_per_second']:,.0f} environment steps/s."
            for row in _fastest(rows)
        ]

    def finding(self, rows: Sequence[Row]) -> str:
        best = max(rows, key=lambda row: row["env_steps_per_second"])
        return f"up to {best['env_steps_per_second']:,.0f} environment steps/s ({best['size']}, {best['observation']})"

    def draw(self, question: str, rows: Sequence[Row], file: Path) -> None:
        import matplotlib

        matplotlib.use("Agg")
        import matplotlib.pyplot as plt

        figure, panel = plt.subplots(figsize=(8.0, 4.2), layout="constrained")
        fastest = _fastest(rows)
        groups = list(dict.fromkeys((row["arm"], row["size"]) for row in fastest))
        kinds = list(dict.fromkeys(row["observation"] for row in fastest))
        width = 0.8 / max(len(kinds), 1)
        for number, kind in enumerate(kinds):
            own = {
                (row["arm"], row["size"]): row["env_steps_per_second"] for row in fastest if row["observation"] == kind
            }
            at = [position + number * width for position, group in enumerate(groups) if group in own]
            panel.bar(at, [own[group] for group in groups if group in own], width, label=kind)
        panel.set_xticks([index + 0.4 - width / 2 for index in range(len(groups))], [" ".join(each) for each in groups])
        panel.set_yscale("log")
        panel.set_ylabel("environment steps per second")
        panel.grid(alpha=0.3, axis="y")
        if kinds:
            panel.legend(title="observation", fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0))
        figure.suptitle("\n".join(textwrap.wrap(question, 80)))
        figure.savefig(file, dpi=DPI)
        plt.close(figure)


def _fastest(rows: Sequence[Row]) -> list[Row]:
    """Fastest number of worlds of each arm, size and observation, in the order of the rows."""
    best: dict[tuple[str, str, str], Row] = {}
    for row in rows:
        key = (row["arm"], row["size"], row["observation"])
        if key not in best or row["env_steps_per_second"] > best[key]["env_steps_per_second"]:
            best[key] = row
    return list(best.values())
