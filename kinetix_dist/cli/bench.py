"""`kinetix-dist bench WHAT [options]`: finds the benchmark, parses its options, prints its measurements.

    kinetix-dist bench engine speed --sizes m --json runs/speed.json
    kinetix-dist bench train --recipe sfl_m

The benchmarks are modules of `kinetix_dist.benchmarks`, each with `Options` and `measure(options, results)`; their
docstrings say how they measure and what their records hold. `bench engine` alone is `bench engine speed`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

from kinetix_dist.cli.parsing import PROG, load_module, parse_args
from kinetix_dist.errors import UserError
from kinetix_dist.near_names import did_you_mean

BENCHMARKS: dict[str, tuple[str, str]] = {  # name: (module, what it measures)
    "engine speed": ("kinetix_dist.benchmarks.engine_speed", "physics steps per second, next to the published engine"),
    "engine effects": ("kinetix_dist.benchmarks.engine_effects", "what each effect (friction, joints, ...) costs"),
    "engine growth": ("kinetix_dist.benchmarks.engine_growth", "time and memory over numbers of worlds and shapes"),
    "env": ("kinetix_dist.benchmarks.env_speed", "environment steps per second of each observation and size"),
    "delay": ("kinetix_dist.benchmarks.delay_curve", "solve rates over inference delay, by method, with a picture"),
    "goals": ("kinetix_dist.benchmarks.goal_following", "how well a policy goes below a goal, by kind of body"),
    "levels": ("kinetix_dist.benchmarks.level_generation", "random levels per second, drawn and filtered"),
    "train": ("kinetix_dist.benchmarks.training_speed", "environment steps per second of a recipe, time by role"),
    "learner": ("kinetix_dist.benchmarks.learner_step", "milliseconds of a gradient step"),
    "scaling": ("kinetix_dist.benchmarks.scaling", "training over numbers of devices and placements"),
    "model": ("kinetix_dist.benchmarks.scaling_model", "seconds of an update on many GPUs, predicted; runs nothing"),
    "curator": ("kinetix_dist.benchmarks.curator_refresh", "seconds of a refresh of the level buffer"),
}
DEFAULT_OF_ENGINE = "engine speed"
HELP = ("-h", "--help")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Args:
    """Command line as `parse` has read it."""

    benchmark: Any  # a module of kinetix_dist.benchmarks
    options: Any  # its `Options`


def parse(argv: Sequence[str]) -> Args:
    """The name of a benchmark first; the rest are its options."""
    if argv and argv[0] in HELP:
        print(_usage(BENCHMARKS))
        raise SystemExit(0)
    name, rest = _split(list(argv))
    prog = f"{PROG} bench {name}"
    if argv[0] == "engine" and rest[:1] and rest[0] in HELP:
        print(_usage([known for known in BENCHMARKS if known.startswith("engine ")]) + "\n")
    benchmark = load_module(BENCHMARKS[name][0], f"bench {name}")
    return Args(benchmark=benchmark, options=parse_args(benchmark.Options, rest, prog=prog))


def run(args: Args) -> int:
    """Measures, prints lines while it goes, writes the JSON. 1 when any measurement failed, else 0."""
    from kinetix_dist.benchmarks.measuring import Results

    results = Results(args.options.json, report=_print)
    args.benchmark.measure(args.options, results)
    results.save()
    if results.file is not None:
        print(f"{len(results.records)} records in {results.file}")
    for failure in results.failures:
        print(f"failed: {failure}")
    return 1 if results.failures else 0


def _split(argv: list[str]) -> tuple[str, list[str]]:
    """(name of the benchmark, its options)."""
    if not argv or argv[0].startswith("-"):
        given = f"what to measure stands first, not {argv[0]}" if argv else "say what to measure"
        raise UserError(f"{given}: {', '.join(BENCHMARKS)}; see `{PROG} bench --help`")
    if argv[0] != "engine":
        return _known(argv[0]), argv[1:]
    if len(argv) > 1 and not argv[1].startswith("-"):
        return _known(f"engine {argv[1]}"), argv[2:]
    return DEFAULT_OF_ENGINE, argv[1:]


def _known(name: str) -> str:
    if name in BENCHMARKS:
        return name
    hint = did_you_mean(name, ["engine", *BENCHMARKS], f"benchmarks: {', '.join(BENCHMARKS)}")
    raise UserError(f"unknown benchmark {name!r}; {hint}")


def _usage(names: Sequence[str] | dict[str, Any]) -> str:
    width = max(map(len, names))
    lines = [f"usage: {PROG} bench WHAT [options]        {PROG} bench WHAT --help shows the options", ""]
    lines += [f"  {name:<{width}}  {BENCHMARKS[name][1]}" for name in names]
    return "\n".join([*lines, "", "`bench engine` alone is `bench engine speed`."])


def _print(line: str) -> None:
    print(line, flush=True)
