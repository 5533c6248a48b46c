"""Report of `bench engine growth`: exponents, tables in Markdown as docs/engine_speed.md shows them, and a picture."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from kinetix_dist.benchmarks.growth_scenes import SCENES
from kinetix_dist.benchmarks.measuring import Record

FITTED_FROM_SHAPES = 64  # small heaps have fewer contacts a shape


def exponent(numbers: Sequence[float], costs: Sequence[float]) -> float:
    """k of cost = c number^k, by least squares in logarithms."""
    x, y = np.log(numbers), np.log(costs)
    return float(np.sum((x - x.mean()) * (y - y.mean())) / np.sum((x - x.mean()) ** 2))


def exponents(records: Sequence[Record], min_shapes: int = FITTED_FROM_SHAPES) -> dict[str, float]:
    """Exponents of time per world-step over the number of shapes, from `min_shapes` on, by scene."""
    found = {}
    for name in SCENES:
        points = [
            (record["shapes"], record["us_per_world_step"])
            for record in records
            if record["scene"] == name and record["shapes"] >= min_shapes and record["left_out"] is None
        ]
        if len(points) > 1:
            found[name] = exponent(*zip(*points))
    return found


Records = Sequence[Record]
EMPTY = "left out"


def tables(records: Records) -> str:
    """Physics steps per second over worlds; time over shapes; memory."""
    over_worlds = [record for record in records if record["swept"] == "worlds"]
    over_shapes = [record for record in records if record["swept"] == "shapes"]
    return "\n\n".join([_over_worlds(over_worlds), _over_shapes(over_shapes), _memory(records)]) + "\n"


def _over_worlds(records: Records) -> str:
    sizes = list(dict.fromkeys(record["size"] for record in records))
    rows = [
        [f"{worlds:,}"] + [_first(records, _speed, {"worlds": worlds, "size": size}) for size in sizes]
        for worlds in dict.fromkeys(record["worlds"] for record in records)
    ]
    (order,) = {record["order"] for record in records} or {""}
    return _markdown([f"worlds, {order}", *(f"{size.upper()}, physics steps/s" for size in sizes)], rows)


def _over_shapes(records: Records) -> str:
    rows = [
        [str(shapes), *(_first(records, _microseconds, {"shapes": shapes, "scene": scene}) for scene in SCENES)]
        for shapes in dict.fromkeys(record["shapes"] for record in records)
    ]
    powers = exponents(records)
    rows.append(
        [
            f"power from {FITTED_FROM_SHAPES} on",
            *(f"{powers[scene]:.2f}" if scene in powers else "" for scene in SCENES),
        ]
    )
    return _markdown(["shapes per world", *(f"{scene}, us per world-step (contacts)" for scene in SCENES)], rows)


def _memory(records: Records) -> str:
    names = {
        f"{record['size'].upper()} ({record['shapes']})" if record["size"] else str(record["shapes"]): record
        for record in records
    }
    rows = [
        [
            name,
            *(_kilobytes(record["bytes_per_world"][table]) for table in ("scene", "state", "out")),
            "" if record["thread_bytes"] is None else _kilobytes(record["thread_bytes"]),
        ]
        for name, record in names.items()
    ]
    return _markdown(["shapes", "scene, KiB per world", "state", "out", "local memory of a GPU thread, KiB"], rows)


def _first(records: Records, cell: Callable[[Record], str], wanted: Record) -> str:
    for record in records:
        if all(record[name] == value for name, value in wanted.items()):
            return EMPTY if record["left_out"] is not None else cell(record)
    return ""


def _speed(record: Record) -> str:
    speed = record["physics_steps_per_second"]
    return f"{speed / 1e6:.2f} M" if speed >= 1e6 else f"{speed / 1e3:.0f} k"


def _microseconds(record: Record) -> str:
    return f"{record['us_per_world_step']:.3g} ({record['contacts_per_world']:.0f})"


def _kilobytes(size: float) -> str:
    return f"{size / 1024:.1f}"


def _markdown(heads: list[str], rows: list[list[str]]) -> str:
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


COLOURS = {"s": "#2ca02c", "m": "#1f77b4", "l": "#d62728", "row": "#1f77b4", "platforms": "#ff7f0e", "heap": "#7f3c8d"}
TABLES = {"scene": "#1f77b4", "state": "#ff7f0e", "out": "#2ca02c"}


def draw(records: Records, file: Path) -> None:
    """Writes the picture; the format follows the file's ending."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (worlds, shapes, memory) = plt.subplots(1, 3, figsize=(15, 4.6), layout="constrained")
    _draw_over_worlds(worlds, [record for record in records if record["swept"] == "worlds"])
    over_shapes = [record for record in records if record["swept"] == "shapes"]
    _draw_over_shapes(shapes, over_shapes)
    _draw_memory(memory, over_shapes)
    for panel in (worlds, shapes, memory):
        panel.set_xscale("log", base=10 if panel is worlds else 2)
        panel.set_yscale("log")
        panel.grid(alpha=0.3)
        if panel.get_legend_handles_labels()[0]:
            panel.legend(fontsize=9)
    figure.suptitle(
        " / ".join(
            sorted({f"{record['device']}, preset {record['preset']}, worlds {record['order']}" for record in records})
        )
    )
    figure.savefig(file, dpi=80)
    plt.close(figure)


def _draw_over_worlds(panel: Any, records: Records) -> None:
    _draw_lines(
        panel, records, by="size", x="worlds", y="physics_steps_per_second", label=lambda size: f"levels {size.upper()}"
    )
    panel.set_title("physics steps per second, all worlds")
    panel.set_xlabel("worlds")


def _draw_over_shapes(panel: Any, records: Records) -> None:
    powers = exponents(records)

    def label(scene: str) -> str:
        return f"{scene}, power {powers[scene]:.2f}" if scene in powers else scene

    _draw_lines(panel, records, by="scene", x="shapes", y="us_per_world_step", label=label)
    panel.set_title("microseconds per world-step")
    panel.set_xlabel("shapes per world")


def _draw_lines(panel: Any, records: Records, *, by: str, x: str, y: str, label: Callable[[str], str]) -> None:
    """One line of y over x for each value of `by`."""
    for value in dict.fromkeys(record[by] for record in records):
        points = [record for record in records if record["left_out"] is None and record[by] == value]
        xs, ys = ([point[name] for point in points] for name in (x, y))
        panel.plot(xs, ys, "o-", color=COLOURS[value], label=label(value))


def _draw_memory(panel: Any, records: Records) -> None:
    sizes = {record["shapes"]: record for record in records}
    for table, colour in TABLES.items():
        kilobytes = [record["bytes_per_world"][table] / 1024 for record in sizes.values()]
        panel.plot(list(sizes), kilobytes, "o-", color=colour, label=table)
    local = {shapes: record["thread_bytes"] / 1024 for shapes, record in sizes.items() if record["thread_bytes"]}
    if local:
        panel.plot(list(local), list(local.values()), "s--", color="#333333", label="local memory of a thread")
    panel.set_title("KiB per world, by table")
    panel.set_xlabel("shapes per world")
