"""Error against cost where it is used: settings of the accuracy study, timed on mixed levels.

    python -m jax2d.fidelity --json runs/fidelity/study.json
    python bench/mixed_cost.py --study runs/fidelity/study.json --levels FOLDER --json runs/mixed_cost.json

The study times batches of copies of one small scene. Here a batch is all levels of a size side by side, each under
random actions held for 1/30 s, from where it starts for `--seconds`; settings are timed interleaved, the median of
`--repeats` counts, on a CPU of processor time. Errors are the study's: geometric means over scenes, on the kernel.
Printed, written and drawn: us per world-second in the study and at each size, and which settings nothing beats in both
error and cost. Settings less accurate than preset `draft` by more than half are left out, unless they are presets.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
from rich.console import Console
from rich.table import Table

from bench.compare_revisions import write_worlds
from bench.program import exit_code, output_file, parser_of
from bench.revision_runner import effects_of_levels, packed_worlds, random_controls
from jax2d import Engine
from jax2d.fidelity.frontier import Point, pareto_set, points_of
from jax2d.fidelity.interleaved_timing import TimedRun, time_interleaved
from jax2d.fidelity.picture import COLOURS, OTHER_COLOUR
from jax2d.fidelity.records import setting_label
from jax2d.fidelity.sweep import sweep
from jax2d.scene import Capacity
from jax2d.settings import PRESETS, Settings
from kinetix_dist.benchmarks.engine_worlds import DRAWN
from kinetix_dist.errors import UserError

HOLD = 1 / 30  # s, of an action
LEAST_ACCURATE = 1.5  # times the error of `draft`
STUDY = "study"


class Candidate(NamedTuple):
    """A setting, its error, and its cost in the study, us per world-second."""

    name: str
    preset: str
    settings: Settings
    error: float
    study_cost: float

    @property
    def is_preset(self) -> bool:
        return self.settings == PRESETS.get(self.preset)


def candidates_of(study: Path) -> list[Candidate]:
    """Settings of the study with a mean error, from cheap to dear. Raises UserError if there are none."""
    try:
        points = points_of(json.loads(study.read_text()))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"{study} is no study of accuracy ({error}); write one by python -m jax2d.fidelity") from None
    settings = {
        (case.preset, setting_label(case.settings)): case.settings
        for case in sweep(list(PRESETS), ["warp"], quick=False)
    }
    kernel = [p for p in points if p.backend == "warp" and (p.preset, p.setting) in settings]
    draft = [p.error for p in kernel if settings[p.preset, p.setting] == PRESETS["draft"]]
    if not draft:
        raise UserError(f"{study} has no mean error of preset draft on the kernel; study it with --backends warp")

    def is_kept(point: Point) -> bool:
        return point.error < LEAST_ACCURATE * draft[0] or settings[point.preset, point.setting] == PRESETS[point.preset]

    found = [
        Candidate(f"{p.preset}: {p.setting}", p.preset, settings[p.preset, p.setting], p.error, p.cost)
        for p in kernel
        if is_kept(p)
    ]
    return sorted(found, key=lambda one: one.study_cost)


def player(worlds: Path, room: Capacity, settings: Settings, seconds: float) -> Callable[[], float]:
    """A run of all worlds of a file from where they start, which returns us per world-second."""
    engine = Engine(room, settings=settings, effects=effects_of_levels(room))
    packed, start, count = packed_worlds(engine, str(worlds))
    holds, steps = round(seconds / HOLD), round(HOLD / settings.dt)
    keys = jax.random.split(jax.random.key(0), holds)

    def hold(state: Any, key: jax.Array) -> tuple[Any, None]:
        return engine.step_packed(packed, state, random_controls(key, count, room), num_steps=steps)[0], None

    play = jax.jit(lambda state: jax.lax.scan(hold, state, keys)[0])
    clock = time.perf_counter if jax.default_backend() == "gpu" else time.process_time

    def run() -> float:
        began = clock()
        jax.block_until_ready(play(start))
        return (clock() - began) * 1e6 / (count * holds * HOLD)

    return run


def measure(args: argparse.Namespace, report: Callable[[str], None]) -> dict[str, Any]:
    candidates = candidates_of(args.study)
    timed: dict[tuple[str, str], TimedRun] = {}
    sources: list[str] = []
    with tempfile.TemporaryDirectory() as folder:
        for size in args.sizes:
            room, source = write_worlds(size, args.levels, args.worlds, DRAWN, Path(folder, f"{size}.npz"))
            sources.append(source)
            for one in candidates:
                run = player(Path(folder, f"{size}.npz"), room, one.settings, args.seconds)
                timed[one.name, size] = TimedRun(f"{one.name}, {size}", run)
        time_interleaved(list(timed.values()), repeats=args.repeats, report=report)
    if failed := next((run.failure for run in timed.values() if run.failure is not None), None):
        raise UserError(failed)
    records: list[dict[str, Any]] = [
        {
            "setting": one.name,
            "is_preset": one.is_preset,
            "error": one.error,
            "us_per_world_second": {STUDY: one.study_cost} | {size: timed[one.name, size].cost for size in args.sizes},
        }
        for one in candidates
    ]
    for where in (STUDY, *args.sizes):
        front = pareto_set([(r["us_per_world_second"][where], r["error"]) for r in records])
        for i, record in enumerate(records):
            record.setdefault("unbeaten", []).extend([where] if i in front else [])
    return {
        "device": jax.devices()[0].device_kind,
        "levels": ", ".join(dict.fromkeys(sources)),
        "worlds": args.worlds,
        "seconds": args.seconds,
        "records": records,
    }


def show(found: dict[str, Any], sizes: list[str], console: Console) -> None:
    table = Table(title=f"us per world-second, {found['worlds']} worlds on {found['device']}; * nothing beats it")
    table.add_column("setting")
    for name in ("error", STUDY, *sizes):
        table.add_column(name, justify="right")
    for record in found["records"]:
        costs = record["us_per_world_second"]
        cells = [f"{costs[where]:.4g}{'*' if where in record['unbeaten'] else ' '}" for where in (STUDY, *sizes)]
        table.add_row(record["setting"], f"{record['error']:.2e}", *cells)
    console.print(table)


def draw(found: dict[str, Any], sizes: list[str], file: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(
        1, 1 + len(sizes), figsize=(6 * (1 + len(sizes)), 5), sharey=True, layout="constrained"
    )
    for panel, where in zip(panels, (STUDY, *sizes)):
        for record in found["records"]:
            cost, name = record["us_per_world_second"][where], record["setting"].split(":")[0]
            panel.plot(
                cost,
                record["error"],
                "o",
                color=COLOURS.get(name, OTHER_COLOUR),
                markersize=9 if record["is_preset"] else 5,
            )
            if record["is_preset"]:
                panel.annotate(name, (cost, record["error"]), textcoords="offset points", xytext=(6, 5), fontsize=9)
        front = sorted(
            (r["us_per_world_second"][where], r["error"]) for r in found["records"] if where in r["unbeaten"]
        )
        panel.plot(*zip(*front), "-", color="black", linewidth=1, zorder=0)
        panel.set(xscale="log", yscale="log", xlabel="us per world-second")
        panel.set_title("scenes of the study" if where == STUDY else f"mixed levels, {where.upper()}", fontsize=11)
        panel.grid(True, which="both", alpha=0.2)
    panels[0].set_ylabel("error (geometric mean over the study's scenes)")
    figure.savefig(file, dpi=80)
    plt.close(figure)


def main() -> int:
    parser = parser_of(__doc__)
    add = parser.add_argument
    add("--study", type=Path, required=True, help="JSON of python -m jax2d.fidelity")
    add("--levels", type=Path, help="folder of levels in the public format; default: $KINETIX_LEVELS, or random ones")
    add("--sizes", nargs="+", choices=("s", "m", "l"), default=["m", "l"])
    add("--worlds", type=int, default=16384 if jax.default_backend() == "gpu" else 256)
    add("--seconds", type=float, default=2.0, help="of each world")
    add("--repeats", type=int, default=5)
    add("--json", type=output_file, default=Path("runs/mixed_cost.json"))
    args = parser.parse_args()
    if args.worlds < 1:
        parser.error(f"--worlds is {args.worlds}; give 1 or more")
    if not (math.isfinite(args.seconds) and args.seconds >= HOLD):
        parser.error(f"--seconds is {args.seconds}; give {HOLD:.3f} or more")
    if args.repeats < 1:
        parser.error(f"--repeats is {args.repeats}; give 1 or more")

    def work() -> int:
        console = Console(width=150)
        found = measure(args, lambda line: console.print(line, markup=False, highlight=False))
        args.json.write_text(json.dumps(found, indent=1) + "\n")
        draw(found, args.sizes, args.json.with_suffix(".png"))
        show(found, args.sizes, console)
        return 0

    return exit_code(parser, work)


if __name__ == "__main__":
    raise SystemExit(main())
