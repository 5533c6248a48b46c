"""`kinetix-dist bench engine --growth`: how time and memory grow with the number of worlds and of shapes.

    worlds   levels of each size, 1, 10, ... 1 M worlds: world i goes on from a level at one of 16 moments of an episode
    shapes   4 ... 512 shapes a world, in a row on one floor, on many platforms, in a heap (growth_scenes.py), settled

One record is the median of `repeats` runs from the same start, after one that compiles. A run has as many physics
steps as fit a quarter of a second, 2 at least and 128 at most. A point that does not fit `point_seconds`, or the memory
that is free, is left out, and its record says so. On a CPU seconds are those of the processor, which other jobs change
less: a launch uses one core, so this is what it would take with that core to itself. The JSON is a list of records with
exactly the fields of `Record`.
"""

from __future__ import annotations

import dataclasses
import math
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import psutil

from jax2d import Controls, Engine, preset
from jax2d.scene import stack_worlds
from jax2d.warp.memory import table_bytes, thread_bytes
from kinetix_dist.cli.bench import WORLDS_OF_GROWTH, Args
from kinetix_dist.cli.bench_engine import FRAME_SKIP, level_files
from kinetix_dist.cli.errors import one_line, user_errors
from kinetix_dist.cli.growth_scenes import SCENES, capacity_of
from kinetix_dist.level.fit import fit_level
from kinetix_dist.level.kinetix_format import load_kinetix
from kinetix_dist.level.level import SIZES

RUN_SECONDS = 0.25
MOST_STEPS = 128
MOMENTS = 16  # of an episode of 512 physics steps
STEPS_BETWEEN_MOMENTS = 32
SETTLING_STEPS = 180  # 3 s
FITTED_FROM_SHAPES = 64  # small heaps have fewer contacts a shape
# Of the sweep over shapes, whatever their number, since a GPU takes longer for each of few worlds. A core is as fast
# with more.
WORLDS_CPU, WORLDS_GPU = 64, 8192
COPIES = {"scene": 1, "controls": 1, "state": 3, "out": 1}  # of tables, while a run makes a state from another


@dataclasses.dataclass(frozen=True, kw_only=True)
class Record:
    """One point. What was not measured is None, and `left_out` says why."""

    swept: str  # "worlds" or "shapes"
    scene: str  # "levels" or a name of growth_scenes.SCENES
    size: str | None  # s, m, l: of levels
    shapes: int  # slots for shapes
    worlds: int
    backend: str
    preset: str
    device: str
    us_per_world_step: float | None = None  # of processor time on a CPU
    physics_steps_per_second: float | None = None
    steps_a_run: int | None = None
    contacts_per_world: float  # on average, at the start of a run
    bytes_per_world: dict[str, int]  # of the tables, by layout
    device_bytes_per_world: float | None = None  # in use for tables, where the device tells
    thread_bytes: int | None = None  # local memory a thread, on a GPU
    left_out: str | None = None


@dataclasses.dataclass(frozen=True)
class Start:
    """Packed worlds from which the worlds of a run are taken in turns; every leaf has the world axis last."""

    engine: Engine
    scene: Any
    state: Any
    seed: int

    def worlds(self, count: int) -> tuple[Any, Any]:
        """Scene and state of `count` worlds, in an order drawn at random."""
        available = jax.tree.leaves(self.state)[0].shape[-1]
        order = np.random.default_rng(self.seed).permutation(available)[np.arange(count) % available]
        repeat = jax.jit(partial(jax.tree.map, lambda x: jnp.take(x, order, axis=-1)))
        return jax.block_until_ready(repeat((self.scene, self.state)))


def measure(
    args: Args, report: Callable[[str], None], save: Callable[[list[dict[str, Any]]], None]
) -> list[dict[str, Any]]:
    """All records; `report` gets a line for each, `save` what there is after each."""
    device = jax.devices()[0]
    with user_errors(ValueError):
        for shapes in args.shapes:
            capacity_of(shapes)  # refuses before anything is measured
    report(f"{device.device_kind}, jax {jax.__version__}, preset {args.presets[0]}, backend {args.backend}")
    records = []
    for record in _all_points(args, device):
        report(_row(record))
        records.append(dataclasses.asdict(record))
        save(records)
    return records


def _all_points(args: Args, device: Any) -> Iterator[Record]:
    for size in args.sizes:
        with ExitStack() as stack, user_errors(ValueError, OSError):
            files, _ = stack.enter_context(level_files(args, size))
            start = _levels_at_all_moments(args, size, files)
        yield from _points(args, device, start, args.worlds or WORLDS_OF_GROWTH, swept="worlds", size=size)
    for name in SCENES:
        microseconds = None  # what a step of fewer shapes took
        for shapes in args.shapes:
            worlds = WORLDS_GPU if device.platform == "gpu" else WORLDS_CPU
            with user_errors(ValueError):
                start = _settled(args, name, shapes)
            for record in _points(
                args, device, start, (worlds,), swept="shapes", scene=name, shapes=shapes, expected=microseconds
            ):
                microseconds = record.us_per_world_step or microseconds
                yield record


def _points(
    args: Args,
    device: Any,
    start: Start,
    numbers_of_worlds: Sequence[int],
    *,
    swept: str,
    scene: str = "levels",
    size: str | None = None,
    shapes: int | None = None,
    expected: float | None = None,
) -> Iterator[Record]:
    """Measures from few worlds to many; what a point took tells how long the next may take."""
    engine, capacity = start.engine, start.engine.capacity
    tables = table_bytes(capacity)
    contacts = float((engine.unpack_state(start.state).contact_key >= 0).sum(-1).mean())
    compute_capability = getattr(device, "compute_capability", None)
    local = None
    if device.platform == "gpu" and args.backend == "warp":
        local = thread_bytes(capacity, engine.settings, engine.effects, compute_capability)
    for worlds in numbers_of_worlds:
        record = Record(
            swept=swept,
            scene=scene,
            size=size,
            shapes=shapes or capacity.shapes,
            worlds=worlds,
            backend=args.backend,
            preset=args.presets[0],
            device=device.device_kind,
            contacts_per_world=contacts,
            bytes_per_world=tables,
            thread_bytes=local,
        )
        why_not = _why_not(args, device, worlds, tables, expected)
        if why_not is None:
            try:
                record = dataclasses.replace(record, **_timed(args, device, start, worlds, expected))
                expected = record.us_per_world_step
            except jax.errors.JaxRuntimeError as error:
                why_not = one_line(error)[:200]
        yield dataclasses.replace(record, left_out=why_not)


def _why_not(args: Args, device: Any, worlds: int, tables: dict[str, int], expected: float | None) -> str | None:
    """Why this point is left out, or None."""
    needed = worlds * sum(COPIES[name] * size for name, size in tables.items())
    free = _free_bytes(device)
    if needed > free:
        return f"needs about {needed / 2**30:.1f} GiB of {free / 2**30:.1f} GiB that may be used"
    if expected is not None:
        seconds = 1e-6 * expected * worlds * FRAME_SKIP * (args.repeats + 1)
        if seconds > args.point_seconds:
            return f"would take about {seconds:.0f} s; --point-seconds is {args.point_seconds:g}"
    return None


def _free_bytes(device: Any) -> float:
    """What tables may take: on a GPU nine tenths of what is free, on a CPU half, since others use it too."""
    stats = device.memory_stats()
    if stats is not None and "bytes_limit" in stats:
        return 0.9 * (stats["bytes_limit"] - stats["bytes_in_use"])
    return psutil.virtual_memory().available / 2


def _timed(args: Args, device: Any, start: Start, worlds: int, expected: float | None) -> dict[str, Any]:
    """The measured fields of a record."""
    engine, capacity = start.engine, start.engine.capacity
    before = (device.memory_stats() or {}).get("bytes_in_use")
    scene, state = start.worlds(worlds)
    after = (device.memory_stats() or {}).get("bytes_in_use")
    fitting = MOST_STEPS if expected is None else int(RUN_SECONDS / (1e-6 * expected * worlds))
    steps = max(FRAME_SKIP, min(MOST_STEPS, fitting) // FRAME_SKIP * FRAME_SKIP)

    def env_step(packed: Any, key: jax.Array, packed_scene: Any) -> Any:
        motor_key, thruster_key = jax.random.split(key)
        motor = jax.random.randint(motor_key, (worlds, capacity.joints), -1, 2).astype(jnp.float32)
        thruster = jax.random.randint(thruster_key, (worlds, capacity.thrusters), 0, 2).astype(jnp.float32)
        controls = Controls(motor=motor, thruster=thruster)
        return engine.step_packed(packed_scene, packed, controls, num_steps=FRAME_SKIP)[0]

    @jax.jit
    def run(packed_scene: Any, packed: Any, key: jax.Array) -> Any:
        keys = jax.random.split(key, steps // FRAME_SKIP)
        return jax.lax.scan(lambda x, k: (env_step(x, k, packed_scene), None), packed, keys)[0]

    clock = time.perf_counter if device.platform == "gpu" else time.process_time
    seconds = []
    for key in jax.random.split(jax.random.key(args.seed), args.repeats + 1):
        started = clock()
        jax.block_until_ready(run(scene, state, key))
        seconds.append(clock() - started)
    median = statistics.median(seconds[1:])  # the first one compiles
    return {
        "us_per_world_step": 1e6 * median / (worlds * steps),
        "physics_steps_per_second": round(worlds * steps / median, 1),
        "steps_a_run": steps,
        "device_bytes_per_world": None if before is None or after is None else (after - before) / worlds,
    }


def _levels_at_all_moments(args: Args, size: str, files: list[Path]) -> Start:
    """Every level at 16 moments of an episode of random actions."""
    levels = stack_worlds([fit_level(load_kinetix(file), SIZES[size]) for file in files])
    engine = Engine(SIZES[size], settings=preset(args.presets[0]), backend=args.backend)
    scene = engine.pack_scene(levels.scene)
    state = engine.pack_state(
        engine.initial_state(levels.scene, levels.position, levels.angle, levels.velocity, levels.angular_velocity)
    )

    def until_next_moment(packed: Any, key: jax.Array) -> tuple[Any, Any]:
        motor_key, thruster_key = jax.random.split(key)
        motor = jax.random.uniform(motor_key, (len(files), engine.capacity.joints), minval=-1, maxval=1)
        thruster = jax.random.uniform(thruster_key, (len(files), engine.capacity.thrusters))
        controls = Controls(motor=motor, thruster=thruster)
        return engine.step_packed(scene, packed, controls, num_steps=STEPS_BETWEEN_MOMENTS)[0], packed

    keys = jax.random.split(jax.random.key(args.seed), MOMENTS)
    moments = jax.jit(lambda packed: jax.lax.scan(until_next_moment, packed, keys)[1])(state)
    joined = jax.tree.map(lambda x: jnp.moveaxis(x, 0, -2).reshape(*x.shape[1:-1], -1), moments)
    scenes = jax.tree.map(lambda x: jnp.tile(x, MOMENTS), scene)  # the world axis is the last one
    return Start(engine, scenes, joined, args.seed)


def _settled(args: Args, name: str, shapes: int) -> Start:
    """Four worlds of a growth scene, at rest or nearly so."""
    engine = Engine(capacity_of(shapes), settings=preset(args.presets[0]), backend=args.backend)
    worlds = [SCENES[name](shapes, seed=args.seed + i) for i in range(4)]
    scene = engine.pack_scene(stack_worlds([world.scene for world in worlds]))
    state = engine.pack_state(stack_worlds([engine.initial_state(*world) for world in worlds]))
    settle = jax.jit(partial(engine.step_packed, num_steps=SETTLING_STEPS))
    return Start(engine, scene, settle(scene, state, engine.no_controls(4))[0], args.seed)


def exponent(numbers: Sequence[float], costs: Sequence[float]) -> float:
    """k of cost = c number^k, by least squares in logarithms."""
    x, y = np.log(numbers), np.log(costs)
    return float(np.sum((x - x.mean()) * (y - y.mean())) / np.sum((x - x.mean()) ** 2))


def exponents(records: Sequence[dict[str, Any]], least: int = FITTED_FROM_SHAPES) -> dict[str, float]:
    """Of time a world-step over the number of shapes, from `least` shapes on, by scene."""
    found = {}
    for name in SCENES:
        points = [
            (record["shapes"], record["us_per_world_step"])
            for record in records
            if record["scene"] == name and record["shapes"] >= least and record["left_out"] is None
        ]
        if len(points) > 1:
            found[name] = exponent(*zip(*points))
    return found


def _row(record: Record) -> str:
    name = f"{record.scene} {record.size.upper()}" if record.size else record.scene
    head = f"  {name:<10} {record.shapes:>4} shapes {record.worlds:>8} worlds "
    if record.left_out is not None:
        return f"{head} left out: {record.left_out}"
    assert record.us_per_world_step is not None and record.physics_steps_per_second is not None
    digits = max(0, 2 - math.floor(math.log10(record.us_per_world_step)))
    table = f"{sum(record.bytes_per_world.values()) / 1024:8.1f} KiB/world"
    local = f", {record.thread_bytes / 1024:.0f} KiB/thread" if record.thread_bytes else ""
    return (
        f"{head}{record.us_per_world_step:>10.{digits}f} us/world-step "
        f"{record.physics_steps_per_second:>14,.0f} steps/s {record.contacts_per_world:6.1f} contacts{table}{local}"
    )
