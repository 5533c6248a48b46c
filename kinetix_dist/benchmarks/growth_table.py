"""The tables of `bench engine growth` in Markdown, as docs/engine.md shows them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from kinetix_dist.benchmarks.growth_fit import FITTED_FROM_SHAPES, exponents
from kinetix_dist.benchmarks.growth_scenes import SCENES
from kinetix_dist.benchmarks.results import Record

Records = Sequence[Record]
EMPTY = "left out"


def tables(records: Records) -> str:
    """Physics steps a second over worlds; time over shapes; memory."""
    over_worlds = [record for record in records if record["swept"] == "worlds"]
    over_shapes = [record for record in records if record["swept"] == "shapes"]
    return "\n\n".join([_over_worlds(over_worlds), _over_shapes(over_shapes), _memory(records)]) + "\n"


def _over_worlds(records: Records) -> str:
    sizes = list(dict.fromkeys(record["size"] for record in records))
    rows = [
        [f"{worlds:,}"] + [_first(records, _speed, worlds=worlds, size=size) for size in sizes]
        for worlds in dict.fromkeys(record["worlds"] for record in records)
    ]
    return _markdown(["worlds", *(f"{size.upper()}, physics steps/s" for size in sizes)], rows)


def _over_shapes(records: Records) -> str:
    rows = [
        [str(shapes), *(_first(records, _microseconds, shapes=shapes, scene=scene) for scene in SCENES)]
        for shapes in dict.fromkeys(record["shapes"] for record in records)
    ]
    powers = exponents(records)
    rows.append(
        [
            f"power from {FITTED_FROM_SHAPES} on",
            *(f"{powers[scene]:.2f}" if scene in powers else "" for scene in SCENES),
        ]
    )
    return _markdown(["shapes a world", *(f"{scene}, us a world-step (contacts)" for scene in SCENES)], rows)


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
    return _markdown(["shapes", "scene, KiB a world", "state", "out", "local memory of a GPU thread, KiB"], rows)


def _first(records: Records, cell: Any, **wanted: Any) -> str:
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
