"""`kinetix-dist levels stats`: what a generator draws, as shares and distributions, next to what another one draws.

kinetix-dist levels stats --size m                                   10,000 levels of the default generator
kinetix-dist levels stats --size m --generator kinetix --json m.json
kinetix-dist levels stats --size m --reference tests/level/data/published_levels.json
"""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any, Literal

from kinetix_dist import prng
from kinetix_dist.cli.checks import check_output_file, check_seed
from kinetix_dist.errors import UserError, user_errors
from kinetix_dist.json_text import json_text
from kinetix_dist.text_files import read_json

_FAR = 4.5  # standard errors; 80 statistics exceed it by chance once in 1,500 reports


@dataclasses.dataclass(frozen=True)
class Stats:
    """Describe random levels in numbers: counts, sizes, positions, joints, motors, thrusters, overlaps."""

    size: Literal["s", "m", "l"] = "m"
    """Size of the levels."""
    generator: str = "default"
    """Which distribution: "default", "kinetix" (the public package's), "locomotion", "tasks" or one of its families."""
    levels: int = 10_000
    """How many to draw, unfiltered."""
    seed: int = 0
    """Seed of the draw."""
    json: Path | None = None
    """Also write the statistics here."""
    reference: Path | None = None
    """A file that --json (of this size) or bench/published_levels.py wrote: shown next to these, with how far apart."""


def run_stats(args: Stats) -> int:
    import numpy as np

    from kinetix_dist.level.fit import capacity_of_size
    from kinetix_dist.level.generator import generate_levels
    from kinetix_dist.level.generator_config import generator
    from kinetix_dist.level.simulation import NOOP_STEPS, noop_solved
    from kinetix_dist.level.statistics import Share, describe, statistics

    if args.levels < 1:
        raise UserError(f"--levels is {args.levels}; draw 1 or more")
    check_seed(args.seed)
    if args.json is not None:
        check_output_file(args.json, "--json")
    with user_errors(ValueError, OSError):
        config = generator(args.generator)
        reference = None if args.reference is None else read_described(args.reference, args.size)
        levels = generate_levels(prng.key(args.seed), args.levels, capacity_of_size(args.size), config)
    found = statistics(levels)
    is_solved = np.asarray(noop_solved(levels))
    found[f"solved in {NOOP_STEPS} steps without actions"] = Share(hits=int(is_solved.sum()), total=args.levels)
    _show(args, found, reference)
    if args.json is not None:
        drawn = {"generator": args.generator, "levels": args.levels, "seed": args.seed}
        document = drawn | {"sizes": {args.size: describe(found)}}
        args.json.write_text(json_text(document, indent=0) + "\n", encoding="utf-8")
    return 0


def read_described(file: Path, size: str) -> dict[str, Any]:
    """Statistics of a size from a JSON file. Raises ValueError for a file without them."""
    from kinetix_dist.level.statistics import read

    document = read_json(file)
    sizes = document.get("sizes") if isinstance(document, dict) else None
    if not isinstance(sizes, dict) or size not in sizes:
        raise ValueError(f"{file} has no statistics of size {size}; `levels stats --size {size} --json` writes them")
    return dict(read(sizes[size]))


def _show(args: Stats, found: dict[str, Any], reference: dict[str, Any] | None) -> None:
    from rich.console import Console
    from rich.table import Table

    from kinetix_dist.level.statistics import compare

    table = Table(
        title=f"{args.levels:,} levels of size {args.size.upper()}, generator {args.generator}, seed {args.seed}",
        caption="shares with how many they are of; numbers as median (5 % to 95 %)",
    )
    table.add_column("statistic")
    table.add_column("here", justify="right")
    rows = {}
    if reference is not None:
        table.add_column("reference", justify="right")
        table.add_column("standard errors apart", justify="right")
        shared = {name: value for name, value in found.items() if name in reference and _has(value)}
        rows = {row.name: row for row in compare(shared, {name: reference[name] for name in shared})}
    for name, value in found.items():
        cells = [name, summary(value)]
        row = rows.get(name)
        if reference is not None:
            cells.append(summary(reference[name]) if name in reference else "")
            cells.append("" if row is None else f"{row.deviation:.1f}")
        table.add_row(*cells, style="bold" if row is not None and row.deviation > _FAR else None)
    console = Console(width=None if Console().is_terminal else 140)
    console.print(table)
    if rows:
        far = sum(row.deviation > _FAR for row in rows.values())
        console.print(f"{far} of {len(rows)} statistics are more than {_FAR} standard errors apart")


def _has(value: Any) -> bool:
    """True where there is anything to compare: a sample of numbers may be empty."""
    from kinetix_dist.level.statistics import Share

    return isinstance(value, Share) or len(value) > 0


def summary(value: Any) -> str:
    """ "35.1 % of 10,000", or "0.42 (0.11 to 0.93)" of numbers or of a described distribution of them."""
    import numpy as np

    from kinetix_dist.level.statistics import Distribution, Share

    if isinstance(value, Share):
        return "none" if math.isnan(value.value) else f"{value.value:.1%} of {value.total:,}"
    shown = (0.05, 0.5, 0.95)
    if isinstance(value, Distribution):
        of_share = [*zip(value.shares, value.points, strict=True), (1.0, value.points[-1])]
        at = [next(point for share, point in of_share if share >= wanted) for wanted in shown]
    elif len(value):
        at = np.quantile(value, shown).tolist()
    else:
        return "none"
    return f"{at[1]:.3g} ({at[0]:.3g} to {at[2]:.3g})"
