"""`kinetix-dist bench engine`: physics steps a second on this machine, next to the published engine if asked.

The JSON is a list of records, one a measurement that succeeded, with exactly these fields:

    {"engine": "ours"|"published", "backend", "preset", "size", "worlds", "device", "physics_steps_per_second"}

How it is measured stands in `bench_engine.py`; what it takes to compare, in bench/README.md. With `--effects` the
question is what each effect costs; `bench_effects.py` says how that is measured. Its records:

    {"size", "effect", "engine": "full"|"without"|"specialised", "worlds", "device", "us_per_world_step",
     "relative_to_full"}
"""

from __future__ import annotations

import dataclasses
import json
import os
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from kinetix_dist.cli.errors import UserError, user_errors

SIZES = ("s", "m", "l")
# Over the range from bound by latency to bound by arithmetic. A core steps about as fast with 64 worlds as with more.
WORLDS_CPU = (64, 256, 1024)
WORLDS_GPU = (2048, 16384, 131072, 262144)
WORLDS_OF_GROWTH = (1, 10, 100, 1_000, 10_000, 100_000, 1_000_000)
# For effects: enough for a launch not to count.
EFFECTS_WORLDS_CPU, EFFECTS_WORLDS_GPU = (1000,), (131072,)
# Where the published engine stops by default: on a CPU one run would take minutes, on a GPU memory runs out.
PEER_MAX_WORLDS_CPU = {"s": 1024, "m": 1024, "l": 256}
PEER_MAX_WORLDS_GPU = {"s": 131072, "m": 131072, "l": 32768}


@dataclasses.dataclass(frozen=True)
class Args:
    """Measure speed. `engine`: physics steps a second of the engine alone, under random actions."""

    what: Annotated[Literal["engine"], tyro.conf.Positional]
    """What to measure."""
    json: Path | None = None
    """Write the records here."""
    sizes: tuple[Literal["s", "m", "l"], ...] = SIZES
    """Level sizes."""
    worlds: tuple[int, ...] = ()
    """Numbers of worlds. Default: a range that fits the device."""
    presets: tuple[str, ...] = ("standard", "paper")
    """Settings of our engine. The published engine has one solver, the paper's."""
    backend: str = "warp"
    """Backend of our engine."""
    steps: int = 128
    """Physics steps in one timed run; an even number, since actions are held for two."""
    repeats: int = 5
    """Timed runs of which the median counts, after one that is not timed; at least 5."""
    levels: Path | None = None
    """Folder of the public Kinetix levels (s/, m/, l/). Default: $KINETIX_LEVELS, else beside the checkout, else
    levels drawn at random."""
    effects: bool = False
    """What each effect (friction, joints, ...) costs, instead of how fast the engine is; with the first preset."""
    peers: bool = False
    """Also run the published jax2d, turn by turn with ours (bench/peers/setup.sh installs it)."""
    growth: bool = False
    """Measure how time and memory grow with the number of worlds and shapes instead, with the first of --presets; with
    --json also tables and a picture beside it (bench_growth.py says what the records hold)."""
    shapes: tuple[int, ...] = (4, 8, 16, 32, 64, 128, 256, 512)
    """Numbers of shapes a world of --growth."""
    point_seconds: float = 60.0
    """Points of --growth that would take longer are left out."""
    peer_max_worlds: int | None = None
    """Leave the published engine out above this number of worlds. Default: by device and size."""
    seed: int = 0
    """Seed of the actions, and of the levels where they are drawn."""


def run(args: Args) -> int:
    """Measures, prints a table while it goes, writes the JSON. 1 when any measurement failed, else 0."""
    _validate(args)
    if args.peers:  # two processes share a GPU in turns: neither may take all its memory (read when jax starts)
        os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    with user_errors(ImportError):
        from kinetix_dist.cli import bench_effects, bench_engine

    if args.json is not None:
        with user_errors(OSError):
            args.json.parent.mkdir(parents=True, exist_ok=True)
            args.json.touch()
    if args.growth:
        return _growth(args)
    measure = (bench_effects if args.effects else bench_engine).measure
    records, failures = measure(args, report=print, save=partial(_save, args))
    _save(args, records)
    if args.json is not None:
        print(f"{len(records)} records in {args.json}")
    for failure in failures:
        print(f"failed: {failure}")
    return 1 if failures else 0


def _save(args: Args, records: list[dict[str, Any]]) -> None:
    """What there is so far: long measurements may be cut short."""
    if args.json is not None:
        args.json.write_text(json.dumps(records, indent=1) + "\n")


def _growth(args: Args) -> int:
    from kinetix_dist.cli import bench_growth, growth_picture, growth_table

    records = bench_growth.measure(args, report=print, save=partial(_save, args))
    least = bench_growth.FITTED_FROM_SHAPES
    for name, power in bench_growth.exponents(records).items():
        print(f"{name}: time a world-step grows as shapes to the power {power:.2f} from {least} shapes on")
    if args.json is not None:
        args.json.with_suffix(".md").write_text(growth_table.tables(records))
        growth_picture.draw(records, args.json.with_suffix(".png"))
        print(f"{len(records)} records in {args.json}; tables and picture beside it, .md and .png")
    return 0


def _validate(args: Args) -> None:
    if args.growth and (args.peers or args.effects):
        raise UserError("--growth measures our engine alone and as a whole; run --peers and --effects by themselves")
    if args.steps < 2 or args.steps % 2:
        raise UserError(f"--steps is {args.steps}; give an even number of physics steps, 2 or more")
    if args.repeats < 5:
        raise UserError(f"--repeats is {args.repeats}; give 5 or more, since a median of fewer says little")
    for worlds in args.worlds:
        if worlds < 1:
            raise UserError(f"--worlds has {worlds}; give 1 or more")
    if args.levels is not None and not args.levels.is_dir():
        raise UserError(f"--levels {args.levels} is not a folder; give one with s/, m/ and l/ of level files")
    if args.effects and args.peers:
        raise UserError("--effects compares our engine with itself; leave --peers out")
    if args.effects and args.backend != "warp":
        raise UserError(f"--effects with --backend {args.backend}: only backend 'warp' leaves effects out")
    if not args.sizes or not args.presets:
        raise UserError("--sizes or --presets is empty; give one or more, such as --sizes s --presets standard")
