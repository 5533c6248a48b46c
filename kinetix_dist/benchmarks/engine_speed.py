"""`bench engine speed`: physics steps per second of many worlds under random actions, next to the published engine.

    levels (public files, or drawn at random) -> worlds: world i plays level i modulo the number of levels
    one run    = `steps` physics steps of all worlds in a lax.scan; actions drawn in it, each held for 2 steps
    one record = worlds * steps / median seconds of `repeats` runs, after one run that compiles and is not timed
    orders     = "drawn", or "sorted" by structure (engine_worlds.py); the published engine has the drawn one

Worlds go on from run to run and start again after an episode (512 physics steps), so all engines are timed over
the same parts of an episode. Runs of the engines under comparison are interleaved, so that a busy moment of the
machine falls on all of them. A record has exactly these fields:

    {"engine": "ours"|"published", "backend", "preset", "size", "worlds", "order": "drawn"|"sorted", "device",
     "physics_steps_per_second"}
"""

from __future__ import annotations

import dataclasses
import os
import statistics
import time
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from typing import Any, Literal, Protocol

import jax
import jax.numpy as jnp

from jax2d import Engine, preset
from kinetix_dist import prng
from kinetix_dist.benchmarks.engine_worlds import (
    CHECKOUT,
    EPISODE_STEPS,
    EngineOptions,
    check_engine,
    check_steps,
    level_files,
    levels_of_worlds,
    load_levels,
    random_play,
    take_worlds,
)
from kinetix_dist.benchmarks.measuring import Record, Results
from kinetix_dist.benchmarks.peer_process import ProcessError, PublishedProcess
from kinetix_dist.errors import one_line
from kinetix_dist.level.level import SIZES, Level
from kinetix_dist.level.simulation import level_effects

# Over the range from bound by latency to bound by arithmetic. A core steps about as fast with 64 worlds as with more.
WORLDS_CPU = (64, 256, 1024)
WORLDS_GPU = (2048, 16384, 131072, 262144)
# Where the published engine stops by default: on a CPU one run would take minutes, on a GPU memory runs out.
PEER_MAX_WORLDS_CPU = {"s": 1024, "m": 1024, "l": 256}
PEER_MAX_WORLDS_GPU = {"s": 131072, "m": 131072, "l": 32768}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options(EngineOptions):
    """Physics steps per second of the engine alone, under random actions."""

    presets: tuple[str, ...] = ("standard", "paper")
    """Settings of our engine. The published engine has one solver, the paper's."""
    backend: str = "warp"
    """Backend of our engine."""
    steps: int = 128
    """Physics steps in one timed run; an even number, since actions are held for two."""
    orders: tuple[Literal["drawn", "sorted"], ...] = ("drawn",)
    """Orders of worlds: as they are drawn, or sorted by structure, so that like worlds stand side by side."""
    peers: bool = False
    """Also run the published jax2d, interleaved with ours (bench/peers/setup.sh installs it)."""
    peer_max_worlds: int | None = None
    """Leave the published engine out above this number of worlds. Default: by device and size."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_steps(self.steps)
        if not self.presets:
            raise ValueError("--presets is empty; give one or more, such as --presets standard")
        if not self.orders:
            raise ValueError("--orders is empty; give one or more, such as --orders drawn sorted")
        for name in self.presets:
            check_engine(name, self.backend)


class Runner(Protocol):
    """An engine with its worlds, ready to be timed."""

    @property
    def record(self) -> Record:
        """The fields of its record but for the speed."""
        ...

    def restart(self) -> None: ...

    def run(self) -> float:
        """Seconds of one run."""
        ...


def measure(options: Options, results: Results) -> None:
    """One record for each engine, size and number of worlds."""
    if options.peers:  # two processes share a GPU: neither may take all its memory (read when JAX looks for devices)
        os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    device = jax.devices()[0]
    on_gpu = device.platform == "gpu"
    with ExitStack() as stack:
        peer = stack.enter_context(PublishedProcess(CHECKOUT)) if options.peers else None
        if peer is not None:
            results.report(f"published jax2d {peer.description['version']} on {peer.description['device']}")
        for size in options.sizes:
            files, source = stack.enter_context(level_files(size, options.levels, options.seed))
            levels = load_levels(files, size)
            results.report(
                f"size {size.upper()}: {len(files)} levels, {source}; {device.device_kind}, jax {jax.__version__}"
            )
            peer_max = options.peer_max_worlds or (PEER_MAX_WORLDS_GPU if on_gpu else PEER_MAX_WORLDS_CPU)[size]
            for worlds in options.worlds or (WORLDS_GPU if on_gpu else WORLDS_CPU):
                makers: dict[str, Callable[[], Runner]] = {}
                for name in options.presets:
                    for order in options.orders:
                        makers[f"ours {name} {order}"] = partial(OurEngine, options, size, levels, worlds, name, order)
                if peer is not None and worlds <= peer_max:
                    makers["published"] = partial(peer.prepare, size, files, worlds, options.steps, options.seed)
                _measure_together(makers, f"{size.upper()}, {worlds} worlds", options, results)


def _measure_together(makers: dict[str, Callable[[], Runner]], where: str, options: Options, results: Results) -> None:
    runners: list[Runner] = []
    for name, make in makers.items():
        try:
            runners.append(make())
        except (ProcessError, jax.errors.JaxRuntimeError) as error:
            results.fail(f"{name}, {where}: {one_line(error)[:300]}")
    for runner, outcome in zip(runners, _interleaved(runners, options)):
        if isinstance(outcome, Exception):
            name = " ".join(str(runner.record[field]) for field in ("engine", "preset", "order"))
            results.fail(f"{name}: {one_line(outcome)[:300]}, {where}")
            continue
        speed = runner.record["worlds"] * options.steps / statistics.median(outcome)
        record = runner.record | {"physics_steps_per_second": round(speed, 1)}
        results.add(record)
        results.report(_row(record))


def _interleaved(runners: list[Runner], options: Options) -> list[list[float] | Exception]:
    """Runs every engine once, then again, `repeats` times; the seconds of each, or what ended it."""
    outcomes: list[list[float] | Exception] = [[] for _ in runners]
    for repeat in range(options.repeats):
        for index, runner in enumerate(runners):
            seconds = outcomes[index]
            if isinstance(seconds, Exception):
                continue
            try:
                if repeat * options.steps % EPISODE_STEPS < options.steps:
                    runner.restart()
                seconds.append(runner.run())
            except (ProcessError, jax.errors.JaxRuntimeError) as error:
                outcomes[index] = error
    return outcomes


class OurEngine:
    """Our engine with packed worlds and the compiled program that steps them."""

    def __init__(self, options: Options, size: str, levels: Level, worlds: int, preset_name: str, order: str) -> None:
        capacity, settings = SIZES[size], preset(preset_name)
        effects = level_effects(capacity, settings)
        engine = Engine(capacity, settings=settings, backend=options.backend, effects=effects)
        state = engine.initial_state(
            levels.scene, levels.position, levels.angle, levels.velocity, levels.angular_velocity
        )
        # The few levels are packed, then repeated.
        repeat = jax.jit(partial(take_worlds, order=levels_of_worlds(levels, worlds, order)))
        self._scene = repeat(engine.pack_scene(levels.scene))
        self._start = repeat(engine.pack_state(state))
        self._play = jax.jit(random_play(engine, worlds, options.steps), donate_argnums=1)
        self._key = prng.key(options.seed)
        self.record: Record = {
            "engine": "ours",
            "backend": options.backend,
            "preset": preset_name,
            "size": size,
            "worlds": worlds,
            "order": order,
            "device": jax.devices()[0].device_kind,
        }
        self.restart()
        self.run()  # compiles

    def restart(self) -> None:
        self._state: Any = jax.block_until_ready(jax.tree.map(jnp.copy, self._start))

    def run(self) -> float:
        self._key, key = prng.split(self._key)
        jax.block_until_ready(key)
        started = time.perf_counter()
        self._state = jax.block_until_ready(self._play(self._scene, self._state, key))
        return time.perf_counter() - started


def _row(record: Record) -> str:
    speed = record["physics_steps_per_second"]
    name = f"{record['engine']} {record['backend']} {record['preset']}"
    where = f"{record['size'].upper()} {record['worlds']:>8} worlds {record['order']:<6}"
    return f"  {name:<26} {where} {speed:>16,.0f} physics steps/s"
