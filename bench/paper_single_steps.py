"""Preset `paper` beside the published jax2d: one physics step from the same states, on the public levels.

    python -m bench.paper_single_steps --levels FOLDER --json runs/paper_single_steps.json

The published engine (in its own environment) plays each level with random actions; from the states it reaches at
MOMENTS, and from these states stirred so that shapes overlap in every way, both engines take one step with the same
masses, coefficients and actions. Compared are `paper` as it is, and
with every detail of bench/published_solver.py and the package's batches of 16; then each detail is left out in turn,
which says in how many states it matters. "cold" steps start without warm-start contact impulses, "warm" ones with those
of the published engine. States that differ with all details on are listed by name.
"""

from __future__ import annotations

import importlib.metadata
import json
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from bench import published_solver
from bench.peer_process import PeerMissing
from bench.program import output_file, parser_of
from bench.published_order import Published
from bench.published_solver import DETAILS
from bench.published_steps import Steps, differences, load, run_published, warm
from jax2d import Engine, State, preset

MOMENTS = (2, 16, 40, 80, 140, 220, 340, 480)  # physics steps; an episode has 512

# Largest difference that is rounding, in units of 1 + the largest value of that field in the world. Ten iterations over
# contacts multiply the rounding of a velocity by 10 to 100.
TOLERANCE = {
    "float64": {"position": 1e-13, "angle": 1e-13, "velocity": 1e-12, "angular_velocity": 1e-12},
    "float32": {"position": 1e-6, "angle": 2e-6, "velocity": 2e-5, "angular_velocity": 1e-4},
}
PAPER = preset("paper")
PUBLISHED = Published(frozenset(DETAILS))


def main(arguments: Sequence[str] | None = None) -> int:
    parser = parser_of(__doc__)
    parser.add_argument(
        "--levels",
        default=os.environ.get("KINETIX_LEVELS"),
        help="public levels (s/, m/, l/); default: $KINETIX_LEVELS",
    )
    parser.add_argument("--sizes", nargs="+", choices=("s", "m", "l"), default=["s", "m", "l"])
    parser.add_argument("--seed", type=int, default=0, help="of the random actions")
    parser.add_argument(
        "--steps", type=Path, default=Path("runs/published_steps"), help="the published engine's steps; made if absent"
    )
    parser.add_argument("--json", type=output_file)
    args = parser.parse_args(arguments)
    if not args.levels:
        parser.error("where are the public levels? name their folder with --levels or $KINETIX_LEVELS")
    levels = {size: sorted(Path(args.levels, size).glob("*.json")) for size in args.sizes}
    if missing := [size for size, files in levels.items() if not files]:
        parser.error(f"no public levels in {Path(args.levels, missing[0])}; name their folder with --levels")
    jax.config.update("jax_enable_x64", True)
    sizes = []
    for size, files in levels.items():
        recorded = args.steps / f"{size}-seed{args.seed}.npz"
        if not recorded.is_file():
            print(f"{size}: the published engine plays {len(files)} levels")
            recorded.parent.mkdir(parents=True, exist_ok=True)
            try:
                run_published(files, MOMENTS, args.seed, recorded)
            except PeerMissing as error:
                parser.error(str(error))
        played = [f"{size}/{file.stem}@{moment}" for file in files for moment in MOMENTS]
        names = played + [f"{name} stirred" for name in played]
        report = compare(size, load(recorded), names)
        show(report)
        sizes.append(report)
    if args.json:
        versions = {name: importlib.metadata.version(name) for name in ("jax", "numpy")}
        document = {"moments": MOMENTS, "seed": args.seed, "versions": versions, "tolerance": TOLERANCE, "sizes": sizes}
        args.json.write_text(json.dumps(document, indent=1) + "\n")
    return 0


def compare(size: str, steps: Steps, names: list[str]) -> dict[str, Any]:
    """A row for each way of stepping, and for each detail the states in which leaving it out matters."""
    rows = []
    for label, published, starts in (("paper", None, ("cold",)), ("all details", PUBLISHED, ("cold", "warm"))):
        for dtype in ("float64", "float32"):
            for start in starts:
                agrees, apart = agreement(step(steps, published, dtype, start), steps, dtype, start)
                for kind, part in parts(names):
                    of_part = {field: x[part] for field, x in apart.items()}
                    what = {"states": kind, "setting": label, "dtype": dtype, "start": start}
                    rows.append(what | row(agrees[part], of_part, names[part]))
    matters = {}
    for name, published in left_out():
        agrees, _ = agreement(step(steps, published, "float64", "warm"), steps, "float64", "warm")
        matters[name] = [names[i] for i in np.flatnonzero(~agrees)]
    different = {name for r in rows[:2] for name in r["different"]}
    return {
        "size": size,
        "rows": rows,
        "matters": matters,
        "unexplained": sorted(different.difference(*matters.values())),
    }


def parts(names: list[str]) -> tuple[tuple[str, slice], tuple[str, slice]]:
    half = len(names) // 2
    return ("played", slice(0, half)), ("stirred", slice(half, None))


def level_of(name: str) -> str:
    return name.split("@")[0]


def left_out() -> Iterator[tuple[str, Published]]:
    everything = PUBLISHED.details
    for name in DETAILS:
        yield name, Published(everything - {name})
    # One contact at a time: no batch is less than full, so `last_pair` cannot act.
    yield "batches", Published(everything - {"last_pair"}, batch_size=1)
    # Batches and the order of kinds can each stand in for the other.
    yield "batches, solve_order", Published(everything - {"last_pair", "solve_order"}, batch_size=1)


def step(steps: Steps, published: Published | None, dtype: str, start: str) -> State:
    """States after one step with these details of the published package; None: preset `paper` as it is."""
    state = warm(steps) if start == "warm" else steps.state
    state = jax.tree.map(lambda x: x.astype(dtype) if x.dtype.kind == "f" else x, state)
    if published is None:
        engine = Engine(steps.capacity, settings=PAPER, backend="xla", dtype=dtype)
        after, touching = engine.step(steps.scene, state, steps.controls)
        overflow = touching.overflow
    else:
        after, overflow = published_solver.step(steps.capacity, PAPER, published, steps.scene, state, steps.controls)
    if dropped := int(np.sum(overflow)):
        raise RuntimeError(f"{dropped} contacts found no slot; the comparison needs all of them")
    return after


def agreement(after: State, steps: Steps, dtype: str, start: str) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Returns which states agree, [S] bool, and by how much their fields differ."""
    apart = differences(after, steps.after[dtype, start], steps.scene.shapes.active)
    return np.all([apart[field] <= most for field, most in TOLERANCE[dtype].items()], axis=0), apart


def row(agrees: np.ndarray, apart: dict[str, np.ndarray], names: list[str]) -> dict[str, Any]:
    different = [names[i] for i in np.flatnonzero(~agrees)]
    levels = {level_of(name) for name in names}
    return {
        "count": len(names),
        "agree": int(agrees.sum()),
        "levels": len(levels),
        "levels_agree": len(levels) - len({level_of(name) for name in different}),
        "quantiles": {
            field: {q: float(np.quantile(x, q / 100)) for q in (50, 90, 99, 100)} for field, x in apart.items()
        },
        "different": different,
    }


def show(report: dict[str, Any]) -> None:
    print(f"\n{report['size']}: states, setting, precision, start | states that agree | levels all of whose states do")
    for r in report["rows"]:
        largest = ", ".join(f"{field} {quantiles[100]:.1e}" for field, quantiles in r["quantiles"].items())
        print(
            f"  {r['states']:7} {r['setting']:11} {r['dtype']} {r['start']} | {r['agree']:3} of {r['count']} | "
            f"{r['levels_agree']:2} of {r['levels']} | largest: {largest}"
        )
    print("  without these, states that differ: played (of so many levels), stirred (levels)")
    for name, states in report["matters"].items():
        played = [state for state in states if not state.endswith(" stirred")]
        stirred = [state for state in states if state.endswith(" stirred")]
        counts = (f"{len(part):4} ({len({level_of(state) for state in part}):2})" for part in (played, stirred))
        print(f"  {name:20}", *counts)
    print(f"  of `paper`, explained by none of these: {', '.join(report['unexplained']) or 'none'}")
    remainder = {name for r in report["rows"] if r["setting"] != "paper" for name in r["different"]}
    print(f"  different with all details on: {', '.join(sorted(remainder)) or 'none'}")


if __name__ == "__main__":
    sys.exit(main())
