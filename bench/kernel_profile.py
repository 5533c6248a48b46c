"""Profile of the levels' step kernel: its machine code, and its speed on a GPU.

    python bench/kernel_profile.py                      # no GPU needed: compiles for sm_90 and reads the machine code
    python bench/kernel_profile.py --worlds 131072      # on a GPU also: speed by block size, bytes of tables a second

Four parts, each a list of records in `--json`:

    code        registers, stack, spills, instructions; how many warps of 32 worlds the registers allow
    phases      instructions by what `World::soft_step` calls, by kind: what is executed once, or once a contact
    divergence  lanes of a warp run in lockstep, so a loop over contacts takes as long as the fullest world of the warp:
                from states that the levels reach under random actions, contacts of a world and of the fullest of 32
    speed       (GPU) physics steps/s and bytes/s of the tables that a launch reads and writes, with worlds as
                they are drawn and sorted by structure; block sizes and other variants: bench/compare_revisions.py
                --variants

The first two take `ptxas` and `nvdisasm` from $PATH or from the wheels nvidia-cuda-nvcc and nvidia-cuda-nvdisasm, which
must be at least as new as the compiler inside Warp. `--parts` leaves parts out.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import warp as wp

from bench.program import exit_code, output_file, parser_of
from jax2d import Engine, preset
from jax2d.scene import stack_worlds
from jax2d.settings import PRESETS
from jax2d.warp.kernel import make_kernel
from jax2d.warp.variant import CompileOptions, KernelVariant
from jax2d.world_order import order_by_structure
from kinetix_dist.benchmarks.engine_worlds import FRAME_SKIP, ORDERS, SORTED, Play, random_play
from kinetix_dist.errors import UserError
from kinetix_dist.level.fit import fit_level
from kinetix_dist.level.generator import GeneratorConfig, generate_levels
from kinetix_dist.level.kinetix_format import load_kinetix
from kinetix_dist.level.level import SIZES, Level
from kinetix_dist.level.simulation import level_effects

BLOCK = CompileOptions().block_dim
ARCH = 90  # H100 and H200
WARP = 32  # lanes that run in lockstep
REGISTERS_PER_SM, WARPS_PER_SM, REGISTER_UNIT = 65536, 64, 256  # sm_90; registers are given to a warp in units of 256
STEPS = 128  # physics steps before contacts are counted, and in a timed run

KINDS = {
    "local": "LDL STL LD ST",  # generic loads and stores reach local arrays through references
    "global": "LDG STG LDC ULDC ATOMG",
    "shared": "LDS STS ATOMS",
    "float": "FADD FMUL FFMA FSETP FSEL FMNMX FSET FCHK HFMA2 DADD DMUL DFMA DSETP",
    "special": "MUFU I2F F2I F2F I2FP",
    "control": "BRA BRX BSSY BSYNC BREAK CALL RET EXIT WARPSYNC NOP BMOV",
}
KIND_OF = {name: kind for kind, names in KINDS.items() for name in names.split()}
PARTS = ("code", "divergence", "speed")
Record = dict[str, Any]


# Machine code


def find_tool(name: str) -> str:
    """A tool of the CUDA toolkit, from $PATH or from the nvidia wheels of this Python."""
    found = shutil.which(name)
    spec = importlib.util.find_spec("nvidia")
    for folder in list(spec.submodule_search_locations or []) if spec and not found else []:
        found = next((str(p) for p in sorted(Path(folder).glob(f"*/bin/{name}"))), found)
    if not found:
        raise UserError(
            f"{name} is neither on $PATH nor in an nvidia wheel; install nvidia-cuda-nvcc and nvidia-cuda-nvdisasm "
            "(13.x), or leave the machine code out: --parts divergence speed"
        )
    return found


def tool_output(*command: str) -> str:
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{Path(command[0]).name} failed: {(done.stderr + done.stdout).strip().splitlines()[0]}")
    return done.stdout + done.stderr


def kernel_of(engine: Engine, worlds: int) -> wp.Kernel:
    return make_kernel(KernelVariant.of(engine.capacity, engine.settings, engine.effects).for_worlds(worlds))


def compile_kernel(engine: Engine, worlds: int, folder: Path) -> tuple[Path, Path, Path]:
    """(C++ source, machine code, PTX) of an engine's kernel for so many worlds, with line numbers."""
    kernel = kernel_of(engine, worlds)
    kernel.module.options |= {"lineinfo": True, "block_dim": BLOCK}
    for use_ptx in (False, True):
        wp.compile_aot_module(kernel.module, arch=ARCH, module_dir=folder, use_ptx=use_ptx)
    (source,), (cubin,), (ptx,) = (sorted(folder.glob(f"*.{end}")) for end in ("cu", "cubin", "ptx"))
    ptx.write_bytes(ptx.read_bytes().rstrip(b"\0"))  # Warp writes the terminator too, ptxas does not read it
    return source, cubin, ptx


def code_record(size: str, ptx: Path, instructions: list[Record]) -> Record:
    text = tool_output(find_tool("ptxas"), "-v", f"-arch=sm_{ARCH}", str(ptx), "-o", str(ptx.with_suffix(".out")))

    def number(pattern: str) -> int:
        return max(int(x) for x in re.findall(pattern, text))

    registers = number(r"Used (\d+) registers")
    a_warp = -(-registers * WARP // REGISTER_UNIT) * REGISTER_UNIT
    warps = min(WARPS_PER_SM, REGISTERS_PER_SM // a_warp)
    warps -= warps % (BLOCK // WARP)  # whole blocks
    return {
        "size": size,
        "registers": registers,
        "stack_bytes": number(r"(\d+) bytes stack frame"),
        "spill_store_bytes": number(r"(\d+) bytes spill stores"),
        "spill_load_bytes": number(r"(\d+) bytes spill loads"),
        "shared_bytes": number(r"(\d+) bytes smem"),
        "instructions": len(instructions),
        "code_kB": round(16e-3 * len(instructions), 1),
        "warps_per_sm": warps,
        "occupancy": warps / WARPS_PER_SM,
    }


def disassemble(source: Path, cubin: Path) -> list[Record]:
    """One record an instruction: its name, and the source lines it comes from, innermost first."""
    instructions: list[Record] = []
    lines: list[int] = []
    fresh = False
    for row in tool_output(find_tool("nvdisasm"), "-gi", "-c", str(cubin)).splitlines():
        if "//## File" in row:
            lines = lines if fresh else []
            fresh = True
            place = re.search(r'File "([^"]*)", line (\d+)', row)
            if place and place[1].endswith(source.name):
                lines = [*lines, int(place[2])]
        elif match := re.match(r"\s+/\*[0-9a-f]{4,}\*/\s+(?:@!?U?P\w+ )?\s*([A-Z][A-Z0-9]*)", row):
            instructions.append({"name": match[1], "lines": lines})
            fresh = False
    return instructions


def phase_records(size: str, source: Path, instructions: list[Record]) -> list[Record]:
    """Instructions by the line of struct World that they come from: what a step does, in order."""
    text = source.read_text().splitlines()
    start = next(i for i, row in enumerate(text, 1) if row.startswith("struct World"))
    end = next(i for i, row in enumerate(text, 1) if i > start and row.startswith("};"))
    counts: dict[int, Counter[str]] = {}
    for one in instructions:
        inside = [line for line in one["lines"] if start <= line <= end]
        line = inside[0] if inside else 0
        counts.setdefault(line, Counter())[KIND_OF.get(one["name"], "integer")] += 1
    rows = []
    for line, kinds in sorted(counts.items()):
        call = text[line - 1].split("//")[0].strip() if line else "outside (slow paths of divisions and roots, launch)"
        rows.append({"size": size, "line": call[:70], "instructions": sum(kinds.values()), **dict(kinds)})
    return rows


# Divergence


def load_levels(size: str, folder: Path | None, count: int, seed: int) -> Level:
    """Public levels from a folder with s/, m/ and l/, in order as in `bench engine speed`; else random levels."""
    capacity = SIZES[size]
    if folder is None:
        return generate_levels(jax.random.key(seed), count, capacity, GeneratorConfig())
    files = sorted(Path(folder, size).glob("*.json"))
    if not files:
        raise UserError(f"no level files in {Path(folder, size)}; give --levels a folder with s/, m/ and l/")
    levels = stack_worlds([fit_level(load_kinetix(file), capacity) for file in files])
    return jax.tree.map(lambda x: jnp.take(jnp.asarray(x), jnp.arange(count) % len(files), axis=0), levels)


def packed(engine: Engine, levels: Level) -> tuple[Any, Any]:
    state = engine.initial_state(levels.scene, levels.position, levels.angle, levels.velocity, levels.angular_velocity)
    return engine.pack_scene(levels.scene), engine.pack_state(state)


def stepper(engine: Engine, worlds: int) -> Play:
    """f(scene, state, key) -> state: STEPS steps under random actions."""
    return jax.jit(random_play(engine, worlds, STEPS))


def divergence_record(size: str, engine: Engine, levels: Level, runs: int) -> Record:
    """Contacts of a world, of the fullest of each warp, and how many bodies a warp names at once in one slot."""
    worlds = levels.position.shape[0]
    scene, state = packed(engine, levels)
    run = stepper(engine, worlds)
    counts, fullest, active, bodies = [], [], [], []
    for key in jax.random.split(jax.random.key(1), runs):
        state = run(scene, state, key)
        keys = np.asarray(state.keys).reshape(state.keys.shape[0], -1, WARP)  # [K, warps, 32]
        used = keys >= 0
        counts.append(used.sum(0).mean())
        fullest.append(used.sum(0).max(-1).mean())
        busy = used.any(-1)
        active.append(used.sum(-1)[busy].mean())
        second = np.where(used, (keys >> 12) & 0x3FF, -1)  # shape b of the pair
        named = np.sort(second, -1)
        distinct = (np.diff(named, axis=-1) != 0).sum(-1) + (named[..., 0] >= 0)
        bodies.append(distinct[busy].mean())
    mean, most = float(np.mean(counts)), float(np.mean(fullest))
    return {
        "size": size,
        "worlds": worlds,
        "contacts_per_world": round(mean, 2),
        "contacts_of_fullest_in_warp": round(most, 2),
        "lanes_at_work": round(mean / most, 3) if most else None,
        "lanes_in_a_used_slot": round(float(np.mean(active)), 1),
        "bodies_named_in_a_slot": round(float(np.mean(bodies)), 1),
    }


# Speed


def speed_record(size: str, engine: Engine, levels: Level, repeats: int, order: str) -> Record:
    levels = order_by_structure(levels.scene).sort(levels) if order == SORTED else levels
    worlds = levels.position.shape[0]
    scene, start = packed(engine, levels)
    run = stepper(engine, worlds)
    state = jax.block_until_ready(run(scene, start, jax.random.key(0)))  # compiles
    seconds = []
    for repeat in range(repeats):
        started = time.perf_counter()
        state = jax.block_until_ready(run(scene, state, jax.random.key(repeat)))
        seconds.append(time.perf_counter() - started)
    per_second = worlds * STEPS / statistics.median(seconds)
    words = sum(x.size for x in jax.tree.leaves((scene, state))) + sum(x.size for x in jax.tree.leaves(state))
    return {
        "size": size,
        "worlds": worlds,
        "order": order,
        "device": jax.devices()[0].device_kind,
        "physics_steps_per_second": round(per_second),
        # An upper bound: rows of empty slots are not read.
        "table_gigabytes_per_second": round(4e-9 * words / worlds * per_second / FRAME_SKIP, 1),
    }


def show(title: str, rows: list[Record]) -> None:
    if not rows:
        return
    names = list(dict.fromkeys(name for row in rows for name in row))
    table = [names, *[[str(row.get(name, "")) for name in names] for row in rows]]
    widths = [max(len(row[i]) for row in table) for i in range(len(names))]
    print(f"\n{title}")
    for row in table:
        print("  ".join(cell.ljust(width) for cell, width in zip(row, widths)).rstrip())


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--parts", nargs="+", choices=PARTS, help="default: all; speed where there is a GPU")
    parser.add_argument("--sizes", nargs="+", choices=sorted(SIZES), default=["s", "m", "l"])
    parser.add_argument("--preset", choices=sorted(PRESETS), default="standard")
    parser.add_argument("--levels", type=Path, help="folder of public levels (s/, m/, l/); default: random levels")
    parser.add_argument("--worlds", type=int, default=2048, help="a multiple of 32")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--json", type=output_file, help="write the records here")
    args = parser.parse_args()
    if args.worlds < WARP or args.worlds % WARP:
        parser.error(f"--worlds is {args.worlds}; give a multiple of {WARP}")
    if args.repeats < 1:
        parser.error(f"--repeats is {args.repeats}; give 1 or more")
    return exit_code(parser, lambda: run(args))


def run(args: argparse.Namespace) -> int:
    chosen = args.parts or (PARTS if jax.default_backend() == "gpu" else PARTS[:2])
    results: dict[str, list[Record]] = {"code": [], "phases": [], "divergence": [], "speed": []}
    for size in args.sizes:
        settings = preset(args.preset)
        engine = Engine(SIZES[size], settings=settings, effects=level_effects(SIZES[size], settings))
        if "code" in chosen:
            with tempfile.TemporaryDirectory() as folder:
                source, cubin, ptx = compile_kernel(engine, args.worlds, Path(folder))
                instructions = disassemble(source, cubin)
                results["code"].append(code_record(size, ptx, instructions))
                results["phases"] += phase_records(size, source, instructions)
        if "divergence" not in chosen and "speed" not in chosen:
            continue
        levels = load_levels(size, args.levels, args.worlds, seed=0)
        if "divergence" in chosen:
            results["divergence"].append(divergence_record(size, engine, levels, runs=4))
        if "speed" in chosen:
            results["speed"] += [speed_record(size, engine, levels, args.repeats, order) for order in ORDERS]
    for title, rows in results.items():
        show(title, rows)
    if args.json:
        args.json.write_text(json.dumps(results, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
