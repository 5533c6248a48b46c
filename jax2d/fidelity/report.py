"""The study in words: tables for a terminal, and what they come to."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table

from jax2d.fidelity.closed_forms import CLOSED_FORMS
from jax2d.fidelity.frontier import Point, accepted, bounded, pareto_set, points_of, scenes_of_means, setting_key, slope
from jax2d.fidelity.peers import PEER_NAMES
from jax2d.fidelity.records import Record, is_preset_itself, setting_label
from jax2d.fidelity.sweep import RATES
from jax2d.settings import preset


def write_csv(records: Sequence[Record], file: Path) -> None:
    with file.open("w", newline="") as out:
        writer = csv.DictWriter(out, list(Record.__annotations__))
        writer.writeheader()
        writer.writerows(records)


def columns_of(records: Sequence[Record]) -> list[tuple[str, str, str, str]]:
    """Settings that the table of scenes shows: the presets, and each peer's first."""
    keys = list(dict.fromkeys(setting_key(r) for r in records if is_preset_itself(r)))
    for name in PEER_NAMES:
        keys += list(dict.fromkeys(setting_key(r) for r in records if r["preset"] == name))[:1]
    return keys


def slope_along_dt(records: Sequence[Record], scene: str) -> float:
    """Slope of a scene's error over its cost where `standard` is given smaller steps and nothing else."""
    base = preset("standard")
    rows = [
        record
        for record in records
        if record["scene"] == scene
        and accepted(record)
        and (record["preset"], record["backend"]) == ("standard", "warp")
        and record["setting"] in {setting_label(base.replace(dt=1 / rate)) for rate in RATES}
    ]
    return slope([row["us_per_world_second"] for row in rows], [bounded(row["error"]) for row in rows])


def beaten_scenes(records: Sequence[Record], ours: str, theirs: str) -> list[str]:
    """Scenes in which a setting of theirs is as fast and as accurate as our preset itself, and better in one. Pairs of
    which neither error is accepted are not compared."""
    beaten = []
    for own in records:
        if own["preset"] != ours or own["backend"] != "warp" or not is_preset_itself(own):
            continue
        mine = own["us_per_world_second"], bounded(own["error"])
        for other in records:
            if other["preset"] == theirs and other["scene"] == own["scene"]:
                cost, error = point = other["us_per_world_second"], bounded(other["error"])
                is_compared = accepted(own) or accepted(other)
                if is_compared and point != mine and cost <= mine[0] and error <= mine[1]:
                    beaten.append(own["scene"])
                    break
    return beaten


def not_accepted(records: Sequence[Record]) -> dict[str, tuple[int, int]]:
    """Scene: (records not accepted, all its records), where there are any."""
    counts = {}
    for scene in dict.fromkeys(record["scene"] for record in records):
        these = [record for record in records if record["scene"] == scene]
        refused = sum(not accepted(record) for record in these)
        if refused:
            counts[scene] = refused, len(these)
    return counts


def print_report(records: Sequence[Record], console: Console) -> None:
    console.print(_scene_table(records))
    console.print(_point_table(records))
    points = points_of(records)
    ours = [point for point in points if point.preset not in PEER_NAMES]
    front = [ours[i] for i in pareto_set([(point.cost, point.error) for point in ours])]
    steepness = slope([point.cost for point in front], [point.error for point in front])
    if math.isfinite(steepness):
        console.print(
            f"Pareto set of our settings: slope {steepness:.2f}; twice the time leaves {2**steepness:.2f} of the error"
        )
    for scene, (refused, count) in not_accepted(records).items():
        console.print(f"{scene}: {refused} of {count} records not accepted, the reference solution is not that good")
    left_out = sorted({record["scene"] for record in records} - set(scenes_of_means(records)))
    console.print(f"scenes left out of the means: {', '.join(left_out) or 'none'}")
    for name in PEER_NAMES:
        if any(record["preset"] == name for record in records):
            beaten = beaten_scenes(records, "standard", name)
            console.print(f"scenes in which {name} dominates standard: {', '.join(beaten) or 'none'}")


def _scene_table(records: Sequence[Record]) -> Table:
    keys = columns_of(records)
    table = Table(title="error (us per world-second), ?: not accepted; slope: of standard when only dt shrinks")
    table.add_column("scene")
    for name, backend, dtype, setting in keys:
        where = "" if (backend, dtype) == ("warp", "float32") or name in PEER_NAMES else f"\n{backend} {dtype}"
        table.add_column(f"{name}{where}\n{setting}", justify="right")
    table.add_column("slope", justify="right")
    cells = {(record["scene"], setting_key(record)): record for record in records}
    for scene in dict.fromkeys(record["scene"] for record in records):
        row = [_cell(cells.get((scene, key))) for key in keys]
        table.add_row(scene, *row, f"{slope_along_dt(records, scene):.2f}")
    return table


def _cell(record: Record | None) -> str:
    if record is None:
        return "-"
    error = "not finite" if record["error"] is None else f"{record['error']:.1e}"
    mark = "" if accepted(record) else "?"
    return f"{error}{mark} ({record['us_per_world_second']:.3g})"


def _point_table(records: Sequence[Record]) -> Table:
    scenes = scenes_of_means(records)
    closed = [scene for scene in scenes if scene in CLOSED_FORMS]
    kinds = {"all": scenes, "closed forms": closed, "references": [scene for scene in scenes if scene not in closed]}
    points = {kind: {point[:4]: point for point in points_of(records, chosen)} for kind, chosen in kinds.items()}
    by_cost = sorted(points["all"].values(), key=lambda point: point.cost)
    front = {by_cost[i][:4] for i in pareto_set([(point.cost, point.error) for point in by_cost])}
    # Without a mean over all: those finer than some reference solution can tell.
    by_cost += [point for key, point in points["closed forms"].items() if key not in points["all"]]
    table = Table(title="geometric means over scenes; * nothing is both faster and more accurate")
    for name in ("", "preset", "backend", "setting"):
        table.add_column(name)
    for name in ("us per world-second", *(f"error, {kind} ({len(chosen)})" for kind, chosen in kinds.items())):
        table.add_column(name, justify="right")
    for point in by_cost:
        errors = [_error(points[kind].get(point[:4])) for kind in kinds]
        where = f"{point.backend} {point.dtype}"
        mark = "*" if point[:4] in front else ""
        table.add_row(mark, point.preset, where, point.setting, f"{point.cost:.1f}", *errors)
    return table


def _error(point: Point | None) -> str:
    return "-" if point is None else f"{point.error:.2e}"
