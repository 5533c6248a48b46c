"""`bench engine growth`: growth of time and memory with the number of worlds and of shapes.

    worlds   levels of each size, 1, 10, ... 1 M worlds: world i goes on from a level at one of 16 moments of an episode
    shapes   4 ... 512 shapes per world, in a row on one floor, on many platforms, in a heap (growth_scenes.py), settled

One record (`Point`) is the median of `repeats` runs from the same start, after one that compiles. A run has as many
physics steps as fit a quarter of a second, 2 at least and 128 at most. A point that does not fit `point_seconds`, or
the memory that is free, is left out, and its record says so. On a CPU seconds are those of the processor. Tables and a
picture are written next to the JSON.
"""

from __future__ import annotations

import dataclasses
import math
import statistics
from collections.abc import Iterator, Sequence
from typing import Any, Literal

import jax
import psutil

from jax2d import Engine, preset
from jax2d.warp.memory import table_bytes, thread_bytes
from kinetix_dist import prng
from kinetix_dist.benchmarks.engine_worlds import (
    FRAME_SKIP,
    EngineOptions,
    check_engine,
    level_files,
    load_levels,
    random_play,
)
from kinetix_dist.benchmarks.growth_report import FITTED_FROM_SHAPES, draw, exponents, tables
from kinetix_dist.benchmarks.growth_scenes import SCENES, Start, capacity_of, levels_at_all_moments, settled_scene
from kinetix_dist.benchmarks.measuring import Results, compute_clock
from kinetix_dist.errors import one_line
from kinetix_dist.level.level import SIZES

WORLDS = (1, 10, 100, 1_000, 10_000, 100_000, 1_000_000)
# Of the sweep over shapes, whatever their number, since a GPU takes longer for each of few worlds. A core is as fast
# with more.
SHAPES_WORLDS_CPU, SHAPES_WORLDS_GPU = 64, 8192
RUN_SECONDS = 0.25
MAX_STEPS = 128
COPIES = {"scene": 1, "controls": 1, "state": 3, "out": 1}  # of tables, while a run makes a state from another


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options(EngineOptions):
    """Growth of time and memory with the number of worlds and shapes; with --json also tables and a picture."""

    preset: str = "standard"
    """Settings of the engine."""
    backend: str = "warp"
    """Backend of the engine."""
    shapes: tuple[int, ...] = (4, 8, 16, 32, 64, 128, 256, 512)
    """Numbers of shapes per world, of the sweep over shapes."""
    order: Literal["drawn", "sorted"] = "drawn"
    """Order of worlds: as they are drawn, or sorted by structure, so that like worlds stand side by side."""
    point_seconds: float = 60.0
    """Points that would take longer are left out."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_engine(self.preset, self.backend)
        for shapes in self.shapes:
            capacity_of(shapes)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Point:
    """One record. What was not measured is None, and `left_out` says why."""

    swept: str  # "worlds" or "shapes"
    scene: str  # "levels" or a name of growth_scenes.SCENES
    size: str | None  # s, m, l: of levels
    shapes: int  # slots for shapes
    worlds: int
    order: str  # of worlds: "drawn" or "sorted"
    backend: str
    preset: str
    device: str
    us_per_world_step: float | None = None  # of processor time on a CPU
    physics_steps_per_second: float | None = None
    steps_per_run: int | None = None
    contacts_per_world: float  # on average, at the start of a run
    bytes_per_world: dict[str, int]  # of the tables, by layout
    device_bytes_per_world: float | None = None  # in use for tables, where the device tells
    thread_bytes: int | None = None  # local memory a thread, on a GPU
    left_out: str | None = None


def measure(options: Options, results: Results) -> None:
    """All points, a line for each; then their slopes, the tables and the picture."""
    device = jax.devices()[0]
    results.report(
        f"{device.device_kind}, jax {jax.__version__}, preset {options.preset}, backend {options.backend}, "
        f"worlds {options.order}"
    )
    for point in _all_points(options, device):
        results.report(_row(point))
        results.add(dataclasses.asdict(point))
    for name, power in exponents(results.records).items():
        results.report(
            f"{name}: time per world-step grows as shapes to the power {power:.2f} from {FITTED_FROM_SHAPES} shapes on"
        )
    if results.file is not None:
        results.file.with_suffix(".md").write_text(tables(results.records))
        draw(results.records, results.file.with_suffix(".png"))
        results.report(f"tables and picture next to {results.file}, .md and .png")


def _all_points(options: Options, device: Any) -> Iterator[Point]:
    for size in options.sizes:
        with level_files(size, options.levels, options.seed) as (files, _):
            levels = load_levels(files, size)
        start = levels_at_all_moments(_engine(options, SIZES[size]), levels, options.seed)
        yield from _Sweep(options, device, start, "worlds", "levels", size).points(options.worlds or WORLDS)
    worlds = SHAPES_WORLDS_GPU if device.platform == "gpu" else SHAPES_WORLDS_CPU
    for name in SCENES:
        microseconds = None  # what a step of fewer shapes took
        for shapes in options.shapes:
            start = settled_scene(_engine(options, capacity_of(shapes)), name, options.seed)
            sweep = _Sweep(options, device, start, "shapes", name)
            for point in sweep.points((worlds,), expected=microseconds):
                microseconds = point.us_per_world_step or microseconds
                yield point


def _engine(options: Options, capacity: Any) -> Engine:
    return Engine(capacity, settings=preset(options.preset), backend=options.backend)


@dataclasses.dataclass(frozen=True)
class _Sweep:
    """Points of one engine from the same start."""

    options: Options
    device: Any
    start: Start
    swept: str
    scene: str
    size: str | None = None

    def points(self, numbers_of_worlds: Sequence[int], expected: float | None = None) -> Iterator[Point]:
        """Measures from few worlds to many; what a point took (us per world-step) tells how long the next may take."""
        unmeasured = self._unmeasured()
        for worlds in numbers_of_worlds:
            point = dataclasses.replace(unmeasured, worlds=worlds)
            why_not = self._why_not(worlds, point.bytes_per_world, expected)
            if why_not is None:
                try:
                    point = dataclasses.replace(point, **self._timed(worlds, expected))
                    expected = point.us_per_world_step
                except jax.errors.JaxRuntimeError as error:
                    why_not = one_line(error)[:200]
            yield dataclasses.replace(point, left_out=why_not)

    def _unmeasured(self) -> Point:
        engine, options = self.start.engine, self.options
        local = None
        if self.device.platform == "gpu" and options.backend == "warp":
            local = thread_bytes(engine.capacity, engine.settings, engine.effects, self.device.compute_capability)
        return Point(
            swept=self.swept,
            scene=self.scene,
            size=self.size,
            shapes=engine.capacity.shapes,
            worlds=0,
            order=options.order,
            backend=options.backend,
            preset=options.preset,
            device=self.device.device_kind,
            contacts_per_world=self.start.contacts_per_world,
            bytes_per_world=table_bytes(engine.capacity),
            thread_bytes=local,
        )

    def _why_not(self, worlds: int, tables: dict[str, int], expected: float | None) -> str | None:
        """Why this point is left out, or None."""
        needed = worlds * sum(COPIES[name] * size for name, size in tables.items())
        free = _free_bytes(self.device)
        if needed > free:
            return f"needs about {needed / 2**30:.1f} GiB of {free / 2**30:.1f} GiB that may be used"
        if expected is not None:
            seconds = 1e-6 * expected * worlds * FRAME_SKIP * (self.options.repeats + 1)
            if seconds > self.options.point_seconds:
                return f"would take about {seconds:.0f} s; --point-seconds is {self.options.point_seconds:g}"
        return None

    def _timed(self, worlds: int, expected: float | None) -> dict[str, Any]:
        """The measured fields of a point."""
        before = _bytes_in_use(self.device)
        scene, state = self.start.worlds(worlds, self.options.order)
        after = _bytes_in_use(self.device)
        fitting = MAX_STEPS if expected is None else int(RUN_SECONDS / (1e-6 * expected * worlds))
        steps = max(FRAME_SKIP, min(MAX_STEPS, fitting) // FRAME_SKIP * FRAME_SKIP)
        run = jax.jit(random_play(self.start.engine, worlds, steps))
        clock = compute_clock(self.device)
        seconds = []
        for key in prng.split(prng.key(self.options.seed), self.options.repeats + 1):
            started = clock()
            jax.block_until_ready(run(scene, state, key))
            seconds.append(clock() - started)
        median = statistics.median(seconds[1:])  # the first one compiles
        return {
            "us_per_world_step": 1e6 * median / (worlds * steps),
            "physics_steps_per_second": round(worlds * steps / median, 1),
            "steps_per_run": steps,
            "device_bytes_per_world": None if before is None or after is None else (after - before) / worlds,
        }


def _bytes_in_use(device: Any) -> int | None:
    return (device.memory_stats() or {}).get("bytes_in_use")


def _free_bytes(device: Any) -> float:
    """Bytes that tables may take: on a GPU nine tenths of what is free, on a CPU half, since others use it too."""
    stats = device.memory_stats()
    if stats is not None and "bytes_limit" in stats:
        return 0.9 * (stats["bytes_limit"] - stats["bytes_in_use"])
    return psutil.virtual_memory().available / 2


def _row(point: Point) -> str:
    name = f"{point.scene} {point.size.upper()}" if point.size else point.scene
    head = f"  {name:<10} {point.shapes:>4} shapes {point.worlds:>8} worlds "
    if point.left_out is not None:
        return f"{head} left out: {point.left_out}"
    assert point.us_per_world_step is not None and point.physics_steps_per_second is not None
    digits = max(0, 2 - math.floor(math.log10(point.us_per_world_step)))
    table = f"{sum(point.bytes_per_world.values()) / 1024:8.1f} KiB/world"
    local = f", {point.thread_bytes / 1024:.0f} KiB/thread" if point.thread_bytes else ""
    return (
        f"{head}{point.us_per_world_step:>10.{digits}f} us/world-step "
        f"{point.physics_steps_per_second:>14,.0f} steps/s {point.contacts_per_world:6.1f} contacts{table}{local}"
    )
