"""`python -m jax2d.fidelity`: what accuracy costs in time, as a table, CSV, JSON and a picture.

    python -m jax2d.fidelity --quick --json FILE

The JSON is a list of records with exactly these fields (`frontier.Record`):

    {"scene", "preset", "backend", "dtype", "device", "setting", "metric", "error", "us_per_world_second"}
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from jax2d.fidelity.arguments import OneLineParser
from jax2d.fidelity.closed_forms import CLOSED_FORMS
from jax2d.fidelity.peers import PEERS
from jax2d.fidelity.reference_scenes import REFERENCE_SCENES
from jax2d.settings import PRESETS

SCENES = [*CLOSED_FORMS, *REFERENCE_SCENES]
WORLDS_CPU = 512
WORLDS_CPU_QUICK = 256  # a core steps as fast with 64 worlds as with more
WORLDS_GPU = 65536
WORLDS_GPU_QUICK = 16384
STEPS_CPU, STEPS_GPU = 32, 16  # physics steps of a timed run


def parse(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    parser = OneLineParser(prog="python -m jax2d.fidelity", description=(__doc__ or "").splitlines()[0])
    add = parser.add_argument
    add("--quick", action="store_true", help="fewer settings and worlds: three minutes instead of twelve on two cores")
    add("--json", type=Path, default=Path("runs/fidelity/study.json"), help="where the records go")
    add("--csv", type=Path, help="the same as a table; default: beside the JSON")
    add("--picture", type=Path, help="the log-log picture; default: beside the JSON, .png")
    add("--scenes", nargs="+", choices=SCENES, default=SCENES, metavar="SCENE")
    add("--presets", nargs="+", choices=list(PRESETS), default=list(PRESETS), metavar="PRESET")
    add("--backends", nargs="+", choices=("warp", "xla"), help="default: warp, and xla too unless --quick")
    add("--peers", nargs="*", choices=list(PEERS), help="default: box2d, and the published jax2d too unless --quick")
    add("--worlds", type=int, help="worlds of a timed batch; default: by device")
    add("--repeats", type=int, default=5, help="timed runs of which the median counts, 5 or more")
    args = parser.parse_args(arguments)
    if args.worlds is not None and args.worlds < 1:
        parser.error(f"--worlds is {args.worlds}; give 1 or more")
    if args.repeats < 5:
        parser.error(f"--repeats is {args.repeats}; give 5 or more, since a median of fewer says little")
    args.csv = args.csv or args.json.with_suffix(".csv")
    args.picture = args.picture or args.json.with_suffix(".png")
    args.backends = args.backends or (["warp"] if args.quick else ["warp", "xla"])
    args.peers = args.peers if args.peers is not None else (["box2d"] if args.quick else list(PEERS))
    for file in (args.json, args.csv, args.picture):
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            file.touch()
        except OSError as error:
            parser.error(f"cannot write {file}: {error.strerror}; name a file in a folder you may write to")
    return args


def main(arguments: Sequence[str] | None = None) -> int:
    args = parse(arguments)
    started = time.perf_counter()
    if "published" in args.peers:
        os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # it shares the device
    import jax
    from rich.console import Console

    from jax2d.fidelity.picture import draw
    from jax2d.fidelity.records import Record
    from jax2d.fidelity.references import StaleReference, study_scenes
    from jax2d.fidelity.report import print_report, write_csv
    from jax2d.fidelity.study import Measurement, run_study
    from jax2d.fidelity.sweep import TOO_SLOW, sweep

    on_gpu = jax.default_backend() == "gpu"
    by_device = (WORLDS_GPU_QUICK, WORLDS_GPU) if on_gpu else (WORLDS_CPU_QUICK, WORLDS_CPU)
    worlds = args.worlds or by_device[0 if args.quick else 1]
    console = Console(width=None if sys.stdout.isatty() else 180)
    device = jax.devices()[0].device_kind
    console.print(f"{len(args.scenes)} scenes on {device}, {worlds} worlds, median of {args.repeats} runs")
    for name in set(args.presets) & set(TOO_SLOW):
        console.print(f"{name} left out: {TOO_SLOW[name]}")
    try:
        references = study_scenes([name for name in args.scenes if name in REFERENCE_SCENES])
    except StaleReference as stale:
        print(stale, file=sys.stderr)
        return 1

    def keep(records: list[Record]) -> None:
        args.json.write_text(json.dumps(records, indent=1, allow_nan=False) + "\n")
        write_csv(records, args.csv)

    records, failures = run_study(
        [references[name] if name in references else CLOSED_FORMS[name] for name in args.scenes],
        sweep(args.presets, args.backends, quick=args.quick),
        args.peers,
        Measurement(worlds=worlds, steps=STEPS_GPU if on_gpu else STEPS_CPU, repeats=args.repeats),
        quick=args.quick,
        report=lambda line: console.print(line, markup=False, highlight=False),
        keep=keep,
    )
    if not records:
        print(
            failures[0] if failures else "nothing was measured: no preset runs on the requested backends",
            file=sys.stderr,
        )
        return 1
    draw(records, args.picture, title=f"What accuracy costs: {device}, {worlds} worlds, {len(args.scenes)} scenes")
    print_report(records, console)
    seconds = time.perf_counter() - started
    console.print(f"{len(records)} records in {args.json}, {args.csv}, {args.picture}; {seconds:.0f} s", markup=False)
    if failures:
        count = f"{len(failures)} measurement{'s' if len(failures) > 1 else ''} failed"
        print(f"{count}, without records in {args.json}; the first: {failures[0]}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
