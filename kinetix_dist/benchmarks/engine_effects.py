"""`bench engine effects`: what each effect (friction, joints, ...) costs; effect_cases.py lists what is stepped.

The difference of the full engine on the levels as they are and of an effect's row "without" is what a user saves who
does without it: its own work, the work it makes for others (without gravity few things touch) and its code. The
difference of the effect's rows "full" and "without" is its code alone: both worlds move bit for bit alike.

Worlds start where the full engine is at a random moment of their episodes, and every run starts there again: in
`steps` physics steps the absence of an effect hardly moves the bodies. Actions are drawn before. Runs of
the engines are interleaved, in random order. A time includes the launches, one for every 2 physics steps. On a CPU it
is processor time. A record has exactly these fields:

    {"size", "effect", "engine": "full"|"without"|"specialised"|"larger", "worlds", "order": "drawn"|"sorted",
     "device", "us_per_world_step", "relative_to_full"}
"""

from __future__ import annotations

import dataclasses
import random
import statistics
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from typing import Any, Literal

import jax
import numpy as np

from jax2d import Controls, Engine, preset
from jax2d.effects import EFFECTS, called_for
from kinetix_dist import prng
from kinetix_dist.benchmarks.effect_cases import ADDED, AS_THEY_ARE, BOUNCING, EMPTY, FALLING_BOX, Case, cases_of
from kinetix_dist.benchmarks.engine_worlds import (
    EPISODE_STEPS,
    FRAME_SKIP,
    EngineOptions,
    check_engine,
    check_steps,
    level_files,
    levels_of_worlds,
    load_levels,
    random_controls,
)
from kinetix_dist.benchmarks.measuring import Record, Results, compute_clock
from kinetix_dist.errors import one_line
from kinetix_dist.level.level import SIZES, Level

WORLDS_CPU, WORLDS_GPU = (1000,), (131072,)  # enough for a launch not to count


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options(EngineOptions):
    """Cost of each effect (friction, joints, ...), with it and without."""

    preset: str = "standard"
    """Settings of the engine."""
    steps: int = 128
    """Physics steps in one timed run; an even number, since actions are held for two."""
    order: Literal["drawn", "sorted"] = "drawn"
    """Order of worlds: as they are drawn, or sorted by structure, so that like worlds stand side by side."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_steps(self.steps)
        check_engine(self.preset)


def measure(options: Options, results: Results) -> None:
    """Records of every size and number of worlds, with a table for each."""
    device = jax.devices()[0]
    with ExitStack() as stack:
        for size in options.sizes:
            files, source = stack.enter_context(level_files(size, options.levels, options.seed))
            levels = load_levels(files, size)
            for worlds in options.worlds or (WORLDS_GPU if device.platform == "gpu" else WORLDS_CPU):
                results.report(
                    f"size {size.upper()}: {len(files)} levels, {source}; {worlds} worlds {options.order}, "
                    f"preset {options.preset}, {device.device_kind}, jax {jax.__version__}"
                )
                records, of_others = [], list(results.records)
                try:
                    for records in _rounds(options, size, levels, worlds, device, results.report):
                        results.replace(of_others + records)
                except jax.errors.JaxRuntimeError as error:
                    results.fail(f"{size.upper()}, {worlds} worlds: {one_line(error)[:300]}")
                    continue
                for line in table(records, called_for(levels.scene).flags):
                    results.report(line)


def table(records: list[Record], flags: Any) -> list[str]:
    """Lines to print. flags: [levels, effects] bool, which level calls for what."""
    full = next(r["us_per_world_step"] for r in records if (r["effect"], r["engine"]) == (AS_THEY_ARE, "full"))
    found = {(r["effect"], r["engine"]): r["relative_to_full"] for r in records}
    shares = np.asarray(flags).mean(axis=0)
    lines = [f"  {'full engine, levels as they are':<36} {full:7.3f} us per world and step"]
    lines += [
        f"  {what:<36} {found[key]:7.1%}"
        for what, key in {
            "engine for what these levels call for": (AS_THEY_ARE, "specialised"),
            "full engine, every shape bounces": (BOUNCING, "full"),
            "full engine, empty scene": (EMPTY, "full"),
            "full engine, one falling box": (FALLING_BOX, "full"),
        }.items()
    ]
    lines.append(
        f"  {'effect':<22} {'levels':>7} {'without it':>11} {'and engine too':>15} {'costs':>8} {'its code':>9}"
    )
    for effect, share in zip(EFFECTS, shares, strict=True):
        if (effect, "without") not in found:  # these levels have no slots for it
            continue
        worlds, engine = found.get((effect, "full"), 1.0), found[effect, "without"]
        lines.append(
            f"  {effect:<22} {share:7.0%} {worlds:11.1%} {engine:15.1%} {1 - engine:8.1%} {worlds - engine:9.1%}"
        )
    lines.append(f"  {'engine of a larger capacity, levels as they are':<46} {found[AS_THEY_ARE, 'larger']:7.1%}")
    lines += [f"  {f'{effect} wherever it can be':<46} {found[effect, 'larger']:7.1%}" for effect in ADDED]
    return lines


def _rounds(
    options: Options, size: str, levels: Level, worlds: int, device: Any, report: Callable[[str], None]
) -> Iterator[list[Record]]:
    """Records of a size after every round of timed runs, with the medians so far."""
    capacity = SIZES[size]
    settings = preset(options.preset)
    full = Engine(capacity, settings=settings)
    key = prng.key(options.seed)
    controls = random_controls(full, (options.steps // FRAME_SKIP, worlds), key)
    episode = random_controls(full, (EPISODE_STEPS // FRAME_SKIP, worlds), key)
    cases = cases_of(full, levels, levels_of_worlds(levels, worlds, options.order), episode, options.seed)
    # One program an engine: cases of the same engine differ in what they are given.
    programs = {
        (capacity, effects): _program(Engine(capacity, settings=settings, effects=effects))
        for capacity, effects in {(c.capacity, c.effects) for c in cases}
    }
    clock = compute_clock(device)
    seconds: list[list[float]] = [[] for _ in cases]
    order = random.Random(options.seed)
    report(f"  {len(cases)} cases, {len(programs)} engines to compile")
    for repeat in range(1 + options.repeats):
        # In another order each time: caches are warm or cold by what ran before.
        for case, times in order.sample(list(zip(cases, seconds, strict=True)), len(cases)):
            started = clock()
            jax.block_until_ready(programs[case.capacity, case.effects](case.scene, case.start, controls))
            if repeat:  # the first run compiles
                times.append(clock() - started)
        if repeat:
            yield _records(cases, seconds, size, worlds, options, device)


def _records(
    cases: Sequence[Case], seconds: list[list[float]], size: str, worlds: int, options: Options, device: Any
) -> list[Record]:
    """Records by the medians of the times so far, [cases][runs]."""
    reference = statistics.median(seconds[0])
    return [
        {
            "size": size,
            "effect": case.effect,
            "engine": case.engine,
            "worlds": worlds,
            "order": options.order,
            "device": device.device_kind,
            "us_per_world_step": round(1e6 * statistics.median(times) / (worlds * options.steps), 5),
            "relative_to_full": round(statistics.median(times) / reference, 4),
        }
        for case, times in zip(cases, seconds, strict=True)
    ]


def _program(engine: Engine) -> Callable[[Any, Any, Controls], Any]:
    @jax.jit
    def run_steps(scene: Any, state: Any, controls: Controls) -> Any:
        def advance(state: Any, now: Controls) -> tuple[Any, None]:
            return engine.step_packed(scene, state, now, num_steps=FRAME_SKIP)[0], None

        return jax.lax.scan(advance, state, controls)[0]

    return run_steps
