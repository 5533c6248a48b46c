"""Sizes of snapshots of a curriculum, and the cost of writing and reading them (docs/run_data.md).

    python -m bench.run_data_sizes --recipes quickstart sfl_s sfl_l --json runs/run_data_sizes.json

Levels of the recipe's generator, as many candidates and chosen levels as its curriculum has, through the code that
training writes them with. Counts of episodes are drawn, not played: two to eight a level, of a chance that is 0 for a
third of the levels and uniform for the others.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import time
from pathlib import Path

from bench.program import exit_code, output_file, parser_of, report_each
from kinetix_dist.errors import UserError

REPEATS = 5  # of writing and reading; the median counts


def measure(name: str) -> dict[str, object]:
    """A record of one recipe."""
    import jax
    import numpy as np

    from kinetix_dist.curator.level_buffer import refresh_log, scored
    from kinetix_dist.level.features import level_features
    from kinetix_dist.level.fit import capacity_of_size
    from kinetix_dist.level.generator import generate_levels
    from kinetix_dist.recipes import recipe
    from kinetix_dist.runtime.driver.snapshots import SnapshotSink, UnfinishedSnapshot
    from kinetix_dist.telemetry.curriculum_log import REFRESH, read_snapshot, snapshot_name, write_snapshot

    config = recipe(name)
    curriculum, rng = config.curriculum, np.random.default_rng(0)
    number = curriculum.num_candidates
    capacity = capacity_of_size(config.env.size)
    levels = jax.device_get(generate_levels(jax.random.key(0), number, capacity, curriculum.generator))
    finished = rng.integers(2, 9, number)
    solved = rng.binomial(finished, rng.random(number) * (rng.random(number) > 1 / 3))
    part = scored(
        lambda places: jax.tree.map(lambda x: x[places], levels),
        np.arange(number),
        solved,
        finished,
        features=level_features(levels),
        size=curriculum.buffer_size,
        policy_version=0,
    )
    with tempfile.TemporaryDirectory() as folder:
        directory = Path(folder) / "curriculum"
        sink = SnapshotSink(
            directory,
            curriculum=curriculum.name,
            size=config.env.size,
            max_snapshots=config.curriculum_log.max_snapshots,
            resume_at=0,
            tell=lambda kind, details: None,
        )
        snapshot = UnfinishedSnapshot(REFRESH, 0, lambda: refresh_log([part], curriculum.buffer_size))
        writing = [_seconds(lambda: sink.write(0, snapshot)) for _ in range(REPEATS)]
        path = directory / snapshot_name(REFRESH, 0)
        reading = [_seconds(lambda: read_snapshot(path)) for _ in range(REPEATS)]
        arrays = read_snapshot(path, with_levels=False).arrays
        size = path.stat().st_size
        counts = {key: value for key, value in arrays.items() if key not in ("format", "kind")}
        thinned = write_snapshot(directory, REFRESH, 1, counts).stat().st_size
    return {
        "benchmark": "run_data_sizes",
        "recipe": name,
        "size": config.env.size,
        "kept_levels": curriculum.buffer_size,
        "candidates": number,
        "bytes": size,
        "bytes_thinned": thinned,
        "write_milliseconds": round(1e3 * statistics.median(writing), 1),
        "read_milliseconds": round(1e3 * statistics.median(reading), 1),
    }


def _seconds(work) -> float:
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--recipes", nargs="+", default=["quickstart", "sfl_s", "sfl_l"])
    parser.add_argument("--json", type=output_file)
    arguments = parser.parse_args()
    return exit_code(parser, lambda: run(arguments))


def run(options: argparse.Namespace) -> int:
    from kinetix_dist.recipes import RECIPES

    for name in options.recipes:
        if name not in RECIPES or RECIPES[name]().curriculum.name != "sfl":
            raise UserError(f"--recipes has {name!r}; give recipes whose curriculum is sfl")
    report_each(map(measure, options.recipes), options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
