"""Engine speed of git revisions, or of variants of today's kernel, compared with the working tree in one run.

    python bench/compare_revisions.py export REVISION...     # where git is: jax2d/ of each into runs/revisions
    python bench/compare_revisions.py run --json runs/revisions.json      # anywhere
    python bench/compare_revisions.py run --variants --json runs/variants.json

Every engine has a process of its own; all get the same worlds, actions and settings, and their runs are interleaved.
Printed and written: physics steps/s (median of `--repeats` runs), the ratio to the working tree and to the one before
in the list, with the spread of the runs, and whether the first run led to the same bits as the working tree's.
Worlds: the public levels, for numbers of shapes (64) heaps of boxes and balls, as they are drawn or sorted by structure
(`--order`). On a CPU it is processor time.

A revision or variant that fails costs its own row; a line says why, and the exit code is 1.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import platform
import shutil
import statistics
import subprocess
import sys
import tarfile
import tempfile
import time
from contextlib import ExitStack
from io import BytesIO
from pathlib import Path
from typing import Any

import jax
import numpy as np

from bench.program import exit_code, output_file, parser_of
from bench.revision_runner import PLAYED, STARTS
from jax2d.fields import as_dict
from jax2d.scene import Capacity, stack_worlds
from jax2d.world_order import structure_of
from kinetix_dist.benchmarks.engine_worlds import DRAWN, ORDERS, in_order, level_files, load_levels
from kinetix_dist.benchmarks.growth_scenes import SCENES, capacity_of
from kinetix_dist.benchmarks.peer_process import LineProcess, ProcessError
from kinetix_dist.errors import UserError, one_line
from kinetix_dist.level.level import SIZES

CHECKOUT = Path(__file__).resolve().parent.parent
FOLDER = Path("runs/revisions")
NOW = "working tree"
VARIANTS: dict[str, dict[str, Any]] = {  # fields of `jax2d.warp.variant.CompileOptions`
    "blocks of 32": {"block_dim": 32},
    "blocks of 128": {"block_dim": 128},
    "32 worlds a warp": {"warp_worlds": 32},
    "16 worlds a warp": {"warp_worlds": 16},
    "8 worlds a warp": {"warp_worlds": 8},
    "4 worlds a warp": {"warp_worlds": 4},
    "8 blocks a multiprocessor": {"min_blocks": 8},
    "no shared memory": {"shared_bytes": 0},
    "all that solving uses of a body in shared memory": {"shared_bytes": 49152},
    "at most 80 registers": {"max_registers": 80},
    "at most 64 registers": {"max_registers": 64},
    "12 blocks a multiprocessor": {"min_blocks": 12},
    "16 blocks a multiprocessor": {"min_blocks": 16},
    "16 blocks, spills in shared memory": {"min_blocks": 16, "spills_in_shared": True},
    "fast_math": {"fast_math": True},
    "fused multiply-add": {"fuse_fp": True},
    "sweep at any size": {"sweep_above_shapes": 0},
    "every pair tested": {"sweep_above_shapes": 512},
}
WORLDS_CPU, WORLDS_GPU = (256,), (8192, 65536)
Record = dict[str, Any]


def export(folder: Path, revisions: list[str]) -> int:
    """Writes FOLDER/<number>_<revision>/jax2d and FOLDER/revisions.json."""
    shutil.rmtree(folder, ignore_errors=True)
    listed = []
    for number, revision in enumerate(revisions):
        done = subprocess.run(["git", "archive", revision, "jax2d"], cwd=CHECKOUT, capture_output=True)
        if done.returncode != 0:
            raise UserError(f"git archive {revision}: {one_line(done.stderr.decode())}")
        name = f"{number:02}_{revision}"
        with tarfile.open(fileobj=BytesIO(done.stdout)) as archive:
            archive.extractall(folder / name, filter="data")
        listed.append({"folder": name, "revision": revision})
    (folder / "revisions.json").write_text(json.dumps(listed, indent=1) + "\n")
    print(f"{len(listed)} revisions in {folder}")
    return 0


@dataclasses.dataclass
class Engine:
    """One that takes part."""

    name: str
    label: str
    process: LineProcess
    seconds: list[float] = dataclasses.field(default_factory=list)
    prepared: Record = dataclasses.field(default_factory=dict)
    failed: str | None = None


def start(stack: ExitStack, name: str, label: str, folder: Path, variant: dict[str, Any]) -> Engine:
    """A process whose `jax2d` is that in `folder`."""
    path = [str(folder), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(path), "XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
    # Not by its path in the checkout: the folder of a script comes first on sys.path, and there jax2d is this tree's.
    code = f"import runpy; runpy.run_path({str(CHECKOUT / 'bench/revision_runner.py')!r}, run_name='__main__')"
    command = [sys.executable, "-P", "-c", code, json.dumps(variant)]
    return Engine(name, label, stack.enter_context(LineProcess(name, command, environment)))


def entrants(stack: ExitStack, folder: Path, variants: bool, only: list[str] | None) -> list[Engine]:
    """The revisions of the folder or all variants, then the working tree."""
    if variants:
        chosen = [(name, json.dumps(variant), CHECKOUT, variant) for name, variant in VARIANTS.items()]
    else:
        index = folder / "revisions.json"
        if not index.is_file():
            raise UserError(
                f"{index} does not exist; run `python bench/compare_revisions.py export REVISION...` where git is"
            )
        listed = json.loads(index.read_text())
        chosen = [(one["revision"], "", folder / one["folder"], {}) for one in listed]
    names = [name for name, *_ in chosen]
    if unknown := sorted(set(only or []) - set(names)):
        raise UserError(f"--only has {unknown[0]!r}; there are {', '.join(names)}")
    chosen = [one for one in chosen if only is None or one[0] in only]
    return [start(stack, *one) for one in [*chosen, (NOW, "this checkout", CHECKOUT, {})]]


def write_worlds(size: str, levels: Path | None, count: int, order: str, file: Path) -> tuple[Capacity, str]:
    """Worlds of a size as one .npz of the fields of Scene, of where bodies start, and of which ones `count` worlds
    play."""
    if size in SIZES:
        capacity = SIZES[size]
        with level_files(size, levels, seed=0) as (files, source):
            batch = load_levels(files, size)
        scene, starts = batch.scene, [getattr(batch, name) for name in STARTS]
    else:
        capacity, source = capacity_of(int(size)), "heaps"
        heaps = [SCENES["heap"](int(size), seed=seed) for seed in range(4)]
        scene = stack_worlds([world.scene for world in heaps])
        starts = [np.stack([getattr(world, name) for world in heaps]) for name in STARTS]
    fields = {name: np.asarray(values) for name, values in as_dict(scene).items()}
    fields |= {name: np.asarray(x) for name, x in zip(STARTS, starts)}
    played = in_order(np.arange(count) % len(starts[0]), structure_of(scene), order)
    np.savez(file, allow_pickle=False, **fields, **{PLAYED: np.asarray(played)})
    return capacity, source


def time_interleaved(engines: list[Engine], request: Record, repeats: int, at_once: int) -> None:
    """Prepares all, some at the same time since most of it is compiling; then times them, interleaved."""
    for engine in engines:
        engine.seconds, engine.prepared, engine.failed = [], {}, None
    for first in range(0, len(engines), at_once):
        group = engines[first : first + at_once]
        for engine in group:
            engine.process.send("prepare", request)
        for engine in group:
            try:
                engine.prepared = engine.process.receive()
            except ProcessError as error:
                engine.failed = str(error)
    for _ in range(repeats):
        for engine in engines:
            if engine.failed is None:
                try:
                    engine.seconds.append(engine.process.call("run")["seconds"])
                except ProcessError as error:
                    engine.failed = str(error)


def records_of(engines: list[Engine], request: Record, size: str, order: str) -> list[Record]:
    """One for each engine that ran; the working tree is the last one."""
    steps = request["count"] * request["steps"]
    now = engines[-1]
    records, before = [], None
    for engine in engines:
        if engine.failed is not None:
            continue
        speeds = [steps / seconds for seconds in engine.seconds]
        speed = statistics.median(speeds)
        record = {
            "name": engine.name,
            "label": engine.label,
            "size": size,
            "worlds": request["count"],
            "order": order,
            "preset": request["preset"],
            "physics_steps_per_second": round(speed),
            "slowest": round(min(speeds)),
            "fastest": round(max(speeds)),
            "of_working_tree": None,
            "of_the_one_before": round(speed / before, 4) if before else None,
            "bits_of_working_tree": engine.prepared["bits"] == now.prepared.get("bits"),
            "first_run_seconds": round(engine.prepared["seconds"], 2),
        }
        if now.failed is None:
            record["of_working_tree"] = round(speed / (steps / statistics.median(now.seconds)), 4)
        records.append(record)
        before = speed
    return records


def row(record: Record) -> str:
    def ratio(value: float | None) -> str:
        return f"{value:8.3f}" if value is not None else f"{'-':>8}"

    low, high = (record[name] / record["physics_steps_per_second"] for name in ("slowest", "fastest"))
    return (
        f"  {record['name'][:34]:<34} {record['size'].upper():>3} {record['worlds']:>7} "
        f"{record['order']:<6} "
        f"{record['physics_steps_per_second']:>13,} ({low:.2f}-{high:.2f}) {ratio(record['of_working_tree'])} "
        f"{ratio(record['of_the_one_before'])} {'same' if record['bits_of_working_tree'] else 'other':>6}  "
        f"{record['label'][:60]}"
    )


def run(args: argparse.Namespace) -> int:
    started = time.perf_counter()
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # many processes share the GPU
    on_gpu = jax.default_backend() == "gpu"
    points = [(size, count) for size in args.sizes for count in args.worlds or (WORLDS_GPU if on_gpu else WORLDS_CPU)]
    result: Record = {"python": platform.python_version(), "records": [], "failures": [], "left_out": []}
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        engines = entrants(stack, args.folder, args.variants, args.only)
        for engine in engines:
            engine.process.send("describe")
        for engine in list(engines):
            try:
                told = engine.process.receive()
            except ProcessError as error:
                result["failures"].append(f"{engine.name}: {error}")
                engines.remove(engine)
                continue
            result |= {name: told[name] for name in ("device", "jax", "warp")}
            where = CHECKOUT if args.variants or engine.name == NOW else args.folder
            if not Path(told["jax2d"]).is_relative_to(where.resolve()):
                raise UserError(f"{engine.name} took its jax2d from {told['jax2d']}, not from {where}")
        if not engines or engines[-1].name != NOW:
            raise UserError(result["failures"][-1])
        print(f"{len(engines)} engines on {result['device']}, jax {result['jax']}, warp {result['warp']}")
        print("  name, size, worlds, order, physics steps/s (spread), of working tree, of the one before, bits")
        for size, count in points:
            if args.seconds and time.perf_counter() - started > args.seconds:
                result["left_out"].append({"size": size, "worlds": count})
                print(f"  {size.upper()}, {count} worlds: left out, {args.seconds:g} s are over")
                continue
            capacity, source = write_worlds(size, args.levels, count, args.order, folder / f"{size}.npz")
            request = {
                "worlds": str(folder / f"{size}.npz"),
                "capacity": dataclasses.asdict(capacity),
                "preset": args.preset,
                "count": count,
                "steps": args.steps,
                "seed": 0,
            }
            time_interleaved(engines, request, args.repeats, args.at_once)
            new = records_of(engines, request, size, args.order)
            result["records"] += [record | {"levels": source} for record in new]
            failed = [f"{one.name}, {size.upper()}, {count} worlds: {one.failed}" for one in engines if one.failed]
            result["failures"] += failed
            print("\n".join([*map(row, new), *(f"  failed: {line}" for line in failed)]), flush=True)
            if args.json:
                args.json.write_text(json.dumps(result, indent=1) + "\n")
    return 1 if result["failures"] or result["left_out"] else 0


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("do", choices=("export", "run"))
    parser.add_argument("revisions", nargs="*", help="export: git revisions, oldest first")
    parser.add_argument("--folder", type=Path, default=FOLDER, help="of the exported revisions")
    parser.add_argument("--variants", action="store_true", help="run: variants of the working tree, not revisions")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="run: these revisions or variants alone")
    parser.add_argument("--sizes", nargs="+", default=["s", "m", "l"], help="s, m, l, or numbers of shapes")
    parser.add_argument("--worlds", type=int, nargs="+", help="default: by device")
    parser.add_argument("--order", choices=ORDERS, default=DRAWN, help="of worlds: drawn, or sorted by structure")
    parser.add_argument("--preset", default="standard")
    parser.add_argument("--levels", type=Path, help="folder with s/, m/ and l/; default as in `bench engine speed`")
    parser.add_argument("--steps", type=int, default=128, help="physics steps of a timed run, an even number")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--at-once", type=int, default=max(1, (os.cpu_count() or 1) // 2), help="that compile at once")
    parser.add_argument("--seconds", type=float, help="begin no further size or number of worlds after this time")
    parser.add_argument("--json", type=output_file, help="write the records here")
    args = parser.parse_args()
    if args.steps < 2 or args.steps % 2 or args.repeats < 1 or any(count < 1 for count in args.worlds or []):
        parser.error("--steps must be even and 2 or more, --repeats and --worlds 1 or more")
    for size in args.sizes:
        if size not in SIZES and not (size.isdigit() and 4 <= int(size) <= 512):
            parser.error(f"--sizes has {size!r}; give s, m, l, or a number of shapes from 4 to 512")
    if args.do == "export" and not args.revisions:
        parser.error("export: give one git revision or more")
    if args.do == "export":
        return exit_code(parser, lambda: export(args.folder, args.revisions))
    return exit_code(parser, lambda: run(args))


if __name__ == "__main__":
    sys.exit(main())
