"""The picture of `bench engine growth`: steps a second over worlds, time and memory over shapes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from kinetix_dist.benchmarks.growth_fit import exponents
from kinetix_dist.benchmarks.results import Record

COLOURS = {"s": "#2ca02c", "m": "#1f77b4", "l": "#d62728", "row": "#1f77b4", "platforms": "#ff7f0e", "heap": "#7f3c8d"}
TABLES = {"scene": "#1f77b4", "state": "#ff7f0e", "out": "#2ca02c"}

Records = Sequence[Record]


def draw(records: Records, file: Path) -> None:
    """Writes the picture; the format follows the file's ending."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (worlds, shapes, memory) = plt.subplots(1, 3, figsize=(15, 4.6), layout="constrained")
    _over_worlds(worlds, [record for record in records if record["swept"] == "worlds"])
    over_shapes = [record for record in records if record["swept"] == "shapes"]
    _over_shapes(shapes, over_shapes)
    _memory(memory, over_shapes)
    for panel in (worlds, shapes, memory):
        panel.set_xscale("log", base=10 if panel is worlds else 2)
        panel.set_yscale("log")
        panel.grid(alpha=0.3)
        if panel.get_legend_handles_labels()[0]:
            panel.legend(fontsize=9)
    figure.suptitle(" / ".join(sorted({f"{record['device']}, preset {record['preset']}" for record in records})))
    figure.savefig(file, dpi=80)
    plt.close(figure)


def _measured(records: Records, **wanted: Any) -> Records:
    return [
        record
        for record in records
        if record["left_out"] is None and all(record[name] == value for name, value in wanted.items())
    ]


def _over_worlds(panel: Any, records: Records) -> None:
    _lines(
        panel, records, by="size", x="worlds", y="physics_steps_per_second", label=lambda size: f"levels {size.upper()}"
    )
    panel.set_title("physics steps a second, all worlds")
    panel.set_xlabel("worlds")


def _over_shapes(panel: Any, records: Records) -> None:
    powers = exponents(records)

    def label(scene: str) -> str:
        return f"{scene}, power {powers[scene]:.2f}" if scene in powers else scene

    _lines(panel, records, by="scene", x="shapes", y="us_per_world_step", label=label)
    panel.set_title("microseconds a world-step")
    panel.set_xlabel("shapes a world")


def _lines(panel: Any, records: Records, *, by: str, x: str, y: str, label: Callable[[str], str]) -> None:
    """One line of y over x for each value of `by`."""
    for value in dict.fromkeys(record[by] for record in records):
        points = _measured(records, **{by: value})
        xs, ys = ([point[name] for point in points] for name in (x, y))
        panel.plot(xs, ys, "o-", color=COLOURS[value], label=label(value))


def _memory(panel: Any, records: Records) -> None:
    sizes = {record["shapes"]: record for record in records}
    for table, colour in TABLES.items():
        kilobytes = [record["bytes_per_world"][table] / 1024 for record in sizes.values()]
        panel.plot(list(sizes), kilobytes, "o-", color=colour, label=table)
    local = {shapes: record["thread_bytes"] / 1024 for shapes, record in sizes.items() if record["thread_bytes"]}
    if local:
        panel.plot(list(local), list(local.values()), "s--", color="#333333", label="local memory of a thread")
    panel.set_title("KiB a world, by table")
    panel.set_xlabel("shapes a world")
