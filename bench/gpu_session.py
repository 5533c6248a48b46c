"""Every figure that the docs need from a GPU, in three parts that end within nine minutes each.

    python bench/gpu_session.py --part 1 --out runs/gpu --revision $(git rev-parse HEAD)
    python bench/gpu_session.py --part 1 --out runs/gpu --miniature              # the same steps, tiny, on any device

A part is a list of steps, the most important first; a step is one command, or several at the same time where nothing
is timed. Each has a time limit of its own and all together `--seconds`; a step that fails, or is not done by then,
costs only itself: the table at the end names it, and the exit code is 1. Needs neither git nor a package registry.

DIR gets few files: part_N.json, with the machine, the versions, the revision, and each step with its command, its time
and the records that it wrote; part_N.log, what the commands printed; tables and pictures that a step draws.
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib.metadata
import importlib.util
import json
import os
import platform
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

CHECKOUT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(CHECKOUT))  # run as a script where the project is not installed

from bench.program import exit_code, parser_of  # noqa: E402
from kinetix_dist.child_python import command_of  # noqa: E402
from kinetix_dist.errors import UserError  # noqa: E402

PART_SECONDS = 540.0
PEER_STEPS = 128  # of a timed run beside the published engine
SEED = 0  # of levels and actions, as `bench engine speed` has it by default
# Where each engine is at its best lies within these.
PEER_WORLDS = {"s": (65536, 131072), "m": (65536, 131072), "l": (8192, 32768, 65536)}
OUR_WORLDS = (2048, 16384, 131072, 262144)
SOAK_STEPS, SOAK_WORLDS = {"s": 4.5e9, "m": 3.5e9, "l": 2.1e9}, 131072  # 1e10 in all
VERSIONS = (
    "jax",
    "jaxlib",
    "warp-lang",
    "flax",
    "optax",
    "numpy",
    "orbax-checkpoint",
    "ray",
    "pytest",
    "jax-cuda13-plugin",
)
Record = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Step:
    """Commands that run at the same time. `{json}` in one is the file that it writes its records to."""

    name: str
    commands: dict[str, list[str]]
    limit: float  # s
    draws: tuple[str, ...] = ()  # what a command leaves beside its JSON that is kept too: endings


def bench(*arguments: Any) -> list[str]:
    """A benchmark of `kinetix-dist bench`."""
    return command_of("kinetix_dist.cli.main", "bench", *arguments, "--json", "{json}")


def steps_of(part: int, mini: bool) -> list[Step]:
    return (first_part, second_part, third_part)[part - 1](mini)


def first_part(mini: bool) -> list[Step]:
    tests = command_of("pytest", "-m", "gpu", "-v", "-p", "no:cacheprovider", "-rs", "--tb=short")
    # Alone on the GPU, so that what its processes take of it can be seen.
    smoke = [*tests, "tests/runtime/test_gpu_run.py", "-k", "colocated"] + (["--gpu-tests-on-cpu"] if mini else [])
    if mini:
        tests += ["tests/engine/test_inputs.py", "tests/learner", "--gpu-tests-on-cpu"]
    else:
        parallel = ["-n", "8", "--dist", "loadfile"] if importlib.util.find_spec("xdist") else []
        tests += [*parallel, "--continue-on-collection-errors", *files_with_gpu_tests()]
    # While tests run nothing is timed: what later steps compile is compiled then.
    warm = (
        {} if mini else {f"compile peer {size}": command_of(__file__, "--compile-peer", size) for size in PEER_WORLDS}
    )

    def beside(size: str) -> Step:
        worlds, steps = ((4, 8), 2) if mini else (PEER_WORLDS[size], PEER_STEPS)
        end = ("--steps", steps, "--peers", "--peer-max-worlds", max(worlds))
        limit = {"l": 190, "m": 130, "s": 90}[size]
        return Step(
            f"beside the published engine, {size.upper()}",
            {"": bench("engine", "speed", "--sizes", size, "--worlds", *worlds, *end)},
            limit,
        )

    return [
        Step("training on Ray", {"": smoke}, 120),
        Step("tests", {"tests": tests, **warm}, 245),
        *(beside(size) for size in ("l", "m", "s")),
    ]


def second_part(mini: bool) -> list[Step]:
    sizes = ("m", "l", "s")

    def soak(size: str) -> list[str]:
        worlds, steps, seconds = (4, 1, 60) if mini else (SOAK_WORLDS, SOAK_STEPS[size], 280)
        amount = ("--worlds", worlds, "--steps", steps, "--seconds", seconds)
        return command_of(
            "bench/soak.py", "--sizes", size, *amount, "--episodes-a-draw", 8, "--seed", 11, "--json", "{json}"
        )

    def effects(size: str, *amount: Any) -> list[str]:
        tiny = ("--worlds", 4) if mini else ()
        return bench("engine", "effects", "--sizes", size, "--steps", 2 if mini else 32, *tiny, *amount)

    # Nor does the soak time anything: the engines of the last steps are compiled beside it.
    warm = {} if mini else {f"compile effects {size}": effects(size)[:-2] for size in sizes}  # without --json FILE
    accuracy = command_of("jax2d.fidelity", "--backends", "warp", "--peers", "--json", "{json}")
    accuracy += ["--worlds", "65536"]
    if mini:
        accuracy += ["--quick", "--worlds", "4", "--scenes", "free_fall", "--presets", "standard"]
    return [
        Step("soak", {size: soak(size) for size in sizes} | warm, 310),
        Step("accuracy", {"": accuracy}, 420, draws=(".csv", ".png")),
        *(Step(f"effects, {size.upper()}", {"": effects(size, "--repeats", 15)}, 90) for size in sizes),
    ]


def third_part(mini: bool) -> list[Step]:
    compare = ("bench/compare_revisions.py", "run", "--json", "{json}")
    revisions = ("--worlds", 65536, 8192, "--sizes", "m", "l", "s", "--seconds", 150)
    variants = ("--worlds", 65536, "--sizes", "m", "l", "--seconds", 100)
    growth = ("--shapes", 4, 8, 16, 32, 64, 128, 256)
    profile: tuple[Any, ...] = ("--parts", "divergence", "speed", "--worlds", 65536)
    sizes = ["s", "m", "l"]
    if mini:
        tiny = ("--worlds", 4, "--sizes", "s", "--steps", 2, "--repeats", 1)
        revisions = (*tiny, "--only", "7f82489", "bf89792")
        variants = (*tiny, "--only", "blocks of 32", "fast_math")
        growth = ("--worlds", 1, 4, "--shapes", 4)
        profile = ("--parts", "divergence", "--worlds", 32, "--sizes", "s")
        sizes = ["s"]
    if levels := os.environ.get("KINETIX_LEVELS"):
        profile += ("--levels", levels)
    largest = ("--sizes", "s", "--worlds", 1, "--shapes", 4 if mini else 512)
    compiling = {size: command_of("bench/compile_time.py", "--sizes", size, "--json", "{json}") for size in sizes}
    alone = ("--worlds", 4, "--steps", 2) if mini else ("--worlds", *OUR_WORLDS)
    return [
        Step("revisions", {"": command_of(*compare, *revisions)}, 200),
        Step("variants", {"": command_of(*compare, "--variants", *variants)}, 140),
        Step("our engine by worlds", {"": bench("engine", "speed", "--presets", "standard", *alone)}, 100),
        Step("growth", {"": bench("engine", "growth", *growth)}, 240, draws=(".md", ".png")),
        Step("compiling", compiling, 60),
        Step("profile", {"": command_of("bench/kernel_profile.py", *profile, "--json", "{json}")}, 80),
        Step("512 shapes", {"": bench("engine", "growth", *largest)}, 60),
    ]


def files_with_gpu_tests() -> list[str]:
    """Only these are collected: others may import packages that a machine without a registry lacks."""
    files = sorted(CHECKOUT.glob("tests/**/test_*.py"))
    marks = ("mark.also_gpu", "mark.gpu")
    return [str(file.relative_to(CHECKOUT)) for file in files if any(mark in file.read_text() for mark in marks)]


def machine() -> Record:
    """What results are of."""
    versions = {}
    for name in VERSIONS:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            versions[name] = None
    gpus = "none"
    if shutil.which("nvidia-smi"):
        query = "name,memory.total,driver_version,clocks.max.sm,power.limit"
        done = subprocess.run(["nvidia-smi", f"--query-gpu={query}", "--format=csv"], capture_output=True, text=True)
        gpus = done.stdout.strip() or done.stderr.strip()
    return {
        "gpus": gpus,
        "cpus": os.cpu_count(),
        "memory_gib": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30),
        "system": platform.platform(),
        "python": platform.python_version(),
        "versions": versions,
    }


def revision_of(given: str | None) -> str:
    """The commit that is measured: as given, as git says, or from a file REVISION."""
    if given:
        return given
    git = ["git", "-C", str(CHECKOUT)]
    if (CHECKOUT / ".git").exists() and shutil.which("git"):
        head = subprocess.run([*git, "rev-parse", "HEAD"], capture_output=True, text=True, check=True).stdout.strip()
        status = subprocess.run([*git, "status", "--porcelain"], capture_output=True, text=True, check=True).stdout
        return head + (" with changes" if status.strip() else "")
    if (CHECKOUT / "REVISION").is_file():
        return (CHECKOUT / "REVISION").read_text().strip()
    raise UserError("no git here and no file REVISION; say what is measured with --revision COMMIT")


def environment() -> dict[str, str]:
    """Of every command: this checkout first, shared compile caches, no process takes all of the GPU's memory."""
    cache = CHECKOUT / ".cache"
    path = os.pathsep.join([str(CHECKOUT), *filter(None, [os.environ.get("PYTHONPATH")])])
    return {
        "WARP_CACHE_PATH": str(cache / "warp"),
        "JAX_COMPILATION_CACHE_DIR": str(cache / "jax"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        **os.environ,
        "PYTHONPATH": path,
        "PYTHONUNBUFFERED": "1",
        "XLA_PYTHON_CLIENT_PREALLOCATE": "false",
    }


def run_step(step: Step, seconds: float, folder: Path, log: Any) -> list[Record]:
    """One record a command. What is not done in time is killed with everything that it started."""
    started = time.perf_counter()
    running = []
    for number, (name, command) in enumerate(step.commands.items()):
        file = folder / f"{number}.json"
        command = [str(file) if word == "{json}" else word for word in command]
        printed = (folder / f"{number}.log").open("w+")
        process = subprocess.Popen(
            command,
            cwd=CHECKOUT,
            env=environment(),
            stdout=printed,
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
            start_new_session=True,
        )
        running.append((name, command, file, printed, process))
    ended: dict[str, float] = {}
    while len(ended) < len(running) and time.perf_counter() - started < seconds:
        for name, *_, process in running:
            if name not in ended and process.poll() is not None:
                ended[name] = time.perf_counter() - started
        time.sleep(0.2)
    records = []
    for name, command, file, printed, process in running:
        outcome = "done" if process.poll() == 0 else f"exit code {process.returncode}"
        if process.returncode is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            outcome = f"not done after {seconds:.0f} s"
        printed.seek(0)
        text = printed.read()
        printed.close()
        log.write(f"\n===== {step.name} {name}: {' '.join(command)}\n{text}===== {outcome}\n")
        log.flush()
        written = file.read_text() if file.exists() else ""
        records.append(
            {
                "step": step.name + (f", {name}" if name else ""),
                "outcome": outcome,
                "seconds": round(ended.get(name, time.perf_counter() - started), 1),
                "command": command,
                "last_line": (text.strip().splitlines() or [""])[-1][:200],
                "records": json.loads(written) if written.strip() else None,
            }
        )
    return records


def keep_drawings(step: Step, part: int, folder: Path, out: Path) -> None:
    for ending in step.draws:
        file = (folder / "0.json").with_suffix(ending)
        if file.exists() and file.stat().st_size:
            shutil.copy(file, out / f"part_{part}_{step.name}{ending}")


def run_part(args: argparse.Namespace) -> int:
    started = time.perf_counter()
    args.out.mkdir(parents=True, exist_ok=True)
    result: Record = {
        "part": args.part,
        "revision": revision_of(args.revision),
        "miniature": args.miniature,
        "machine": machine(),
        "steps": [],
    }
    steps = steps_of(args.part, args.miniature)
    if unknown := set(args.only or []) - {step.name for step in steps}:
        raise UserError(f"--only has {unknown.pop()!r}; part {args.part} has {', '.join(s.name for s in steps)}")
    with (args.out / f"part_{args.part}.log").open("w") as log:
        for step in steps:
            if args.only and step.name not in args.only:
                continue
            left = args.seconds - (time.perf_counter() - started)
            if left < min(20, step.limit):
                result["steps"].append({"step": step.name, "outcome": "not begun, no time left", "seconds": 0.0})
            else:
                print(f"{step.name}: at most {min(left, step.limit):.0f} s", flush=True)
                with tempfile.TemporaryDirectory() as folder:
                    new = run_step(step, min(left, step.limit), Path(folder), log)
                    keep_drawings(step, args.part, Path(folder), args.out)
                result["steps"] += new
                for one in new:
                    print(f"  {one['outcome']}, {one['seconds']} s: {one['last_line']}", flush=True)
            (args.out / f"part_{args.part}.json").write_text(json.dumps(result, indent=1) + "\n")
    return summary(result, time.perf_counter() - started)


def summary(result: Record, seconds: float) -> int:
    """Prints the table; 1 when a step is not done."""
    print(f"\nPart {result['part']} of {result['revision']}, {seconds:.0f} s")
    print(f"{result['machine']['gpus'].splitlines()[-1]}; {result['machine']['versions']}")
    for step in result["steps"]:
        print(f"  {step['step']:<34} {step['seconds']:>6} s  {step['outcome']}")
        for line in findings(step):
            print(f"      {line}")
    for line in at_their_best(result["steps"]):
        print(line)
    missing = [step["step"] for step in result["steps"] if step["outcome"] != "done"]
    if missing:
        print(f"not done: {'; '.join(missing)}")
    return 1 if missing else 0


def findings(step: Record) -> list[str]:
    """What matters most of a step's records, in a few lines."""
    records = step.get("records")
    if isinstance(records, dict) and "not_finite" in records:
        return [
            f"{records['physics_steps']:.3g} steps, {records['not_finite']} not finite, "
            f"fastest {row['fastest_m_s']} m/s, gain after 1 s at most {row['largest_gain_settled_J_kg']} J/kg"
            for row in records["sizes"]
        ]
    if isinstance(records, dict) and "left_out" in records:  # of compare_revisions.py
        lines = [
            f"{row['size'].upper()} {row['worlds']:>6} {row['physics_steps_per_second'] / 1e6:8.2f} M steps/s, "
            f"{row['of_working_tree']} of the working tree, {row['name']}: {row['label'][:40]}"
            for row in records["records"]
        ]
        return [*lines, *(f"failed: {line}" for line in records["failures"])]
    return [step["last_line"]] if step.get("last_line") else []


def at_their_best(steps: list[Record]) -> list[str]:
    """The fastest record of each engine and size over all steps of the part, and how many times the published one."""
    best: dict[tuple[str, str, str], Record] = {}
    for step in steps:
        for record in step.get("records") or [] if isinstance(step.get("records"), list) else []:
            if "engine" in record and "physics_steps_per_second" in record:
                key = (record["size"], record["engine"], record["preset"])
                if (
                    record["physics_steps_per_second"]
                    > best.get(key, record | {"physics_steps_per_second": 0})["physics_steps_per_second"]
                ):
                    best[key] = record
    lines = []
    for (size, engine, preset), record in sorted(best.items()):
        speed, peer = record["physics_steps_per_second"], best.get((size, "published", "paper"))
        line = f"{size.upper()} {engine} {preset}: {speed / 1e6:.3g} M steps/s at {record['worlds']} worlds"
        if peer and engine == "ours":
            line += f", {speed / peer['physics_steps_per_second']:.1f} times the published engine at its best"
        lines.append(line)
    return lines


def compile_peer(size: str) -> int:
    """Compiles the published engine's programs of one size into JAX's cache."""
    from kinetix_dist.benchmarks.level_files import level_files
    from kinetix_dist.benchmarks.published_engine import PublishedProcess

    with PublishedProcess(CHECKOUT) as peer, level_files(size, None, SEED) as (files, _):
        for worlds in PEER_WORLDS[size]:
            levels = [str(file) for file in files]
            told = peer.ask("compile", levels=levels, worlds=worlds, steps=PEER_STEPS, seed=SEED)
            print(f"{size.upper()}, {worlds} worlds: {told['seconds']:.1f} s", flush=True)
    return 0


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--part", type=int, choices=(1, 2, 3))
    parser.add_argument("--out", type=Path, default=Path("runs/gpu"))
    parser.add_argument("--revision", help="the commit measured; default: what git says, or the file REVISION")
    parser.add_argument("--seconds", type=float, default=PART_SECONDS, help="for the whole part")
    parser.add_argument("--only", nargs="+", metavar="STEP", help="these steps alone")
    parser.add_argument("--miniature", action="store_true", help="every step as small as it can be, on any device")
    parser.add_argument("--compile-peer", choices=tuple(PEER_WORLDS), help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.compile_peer:
        return exit_code(parser, lambda: compile_peer(args.compile_peer))
    if args.part is None:
        parser.error("give --part 1, 2 or 3")
    return exit_code(parser, lambda: run_part(args))


if __name__ == "__main__":
    sys.exit(main())
