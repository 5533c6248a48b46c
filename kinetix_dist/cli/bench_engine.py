"""The engine benchmark: many worlds of the same levels under random actions, stepped inside one compiled program.

    levels (public files, or drawn at random) -> worlds: world i plays level i modulo the number of levels
    one run    = `steps` physics steps of all worlds in a lax.scan; actions drawn in it, each held for 2 steps
    one record = worlds * steps / median seconds of `repeats` runs, after one run that compiles and is not timed

Worlds go on from run to run and start anew after an episode (512 physics steps), so all engines are timed over
the same parts of an episode. Engines under comparison take turns run by run, so that a busy moment of the
machine falls on all of them.
"""

from __future__ import annotations

import json
import os
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

import kinetix_dist
from jax2d import Controls, Engine, preset
from jax2d.scene import stack_worlds
from kinetix_dist.cli.bench import PEER_MAX_WORLDS_CPU, PEER_MAX_WORLDS_GPU, WORLDS_CPU, WORLDS_GPU, Args
from kinetix_dist.cli.bench_peer import Peer, PeerError
from kinetix_dist.cli.errors import UserError, one_line, user_errors
from kinetix_dist.level.fit import fit_level
from kinetix_dist.level.kinetix_format import export_kinetix, load_kinetix
from kinetix_dist.level.level import SIZES, Level

EPISODE_STEPS = 512  # physics steps: 256 environment steps of 2
FRAME_SKIP = 2
NUM_RANDOM_LEVELS = 32  # a size, where the public ones are absent
_CHECKOUT = Path(kinetix_dist.__file__).resolve().parent.parent

Record = dict[str, Any]


class Runner(Protocol):
    """An engine with its worlds, ready to be timed."""

    record: Record  # the fields of its record but for the speed

    def restart(self) -> None: ...

    def run(self) -> float:
        """Seconds for one run."""
        ...


def measure(
    args: Args, report: Callable[[str], None], save: Callable[[list[Record]], None]
) -> tuple[list[Record], list[str]]:
    """All records that `args` ask for, and one line for each measurement that failed."""
    device = jax.devices()[0]
    on_gpu = device.platform == "gpu"
    records: list[Record] = []
    failures: list[str] = []
    with ExitStack() as stack:
        peer = stack.enter_context(Peer(_CHECKOUT)) if args.peers else None
        if peer is not None:
            report(f"published jax2d {peer.description['version']} on {peer.description['device']}")
        for size in args.sizes:
            files, source = stack.enter_context(level_files(args, size))
            report(f"size {size.upper()}: {len(files)} levels, {source}; {device.device_kind}, jax {jax.__version__}")
            peer_max = args.peer_max_worlds or (PEER_MAX_WORLDS_GPU if on_gpu else PEER_MAX_WORLDS_CPU)[size]
            for worlds in args.worlds or (WORLDS_GPU if on_gpu else WORLDS_CPU):
                makers = {
                    f"ours {name}": partial(OurEngine, args, size, files, worlds, name, device) for name in args.presets
                }
                if peer is not None and worlds <= peer_max:
                    makers["published"] = partial(peer.prepare, size, files, worlds, args.steps, args.seed)
                runners: list[Runner] = []
                for name, make in makers.items():
                    try:
                        runners.append(make())
                    except (PeerError, jax.errors.JaxRuntimeError) as error:
                        failures.append(f"{name}, {size.upper()}, {worlds} worlds: {one_line(error)[:300]}")
                new, broken = _take_turns(runners, args)
                records += new
                save(records)
                failures += [f"{line}, {size.upper()}, {worlds} worlds" for line in broken]
                for record in new:
                    report(_row(record))
    return records, failures


def _take_turns(runners: list[Runner], args: Args) -> tuple[list[Record], list[str]]:
    """Runs the engines one after another, `repeats` times; the records, and what failed."""
    seconds: list[list[float]] = [[] for _ in runners]
    failures: dict[int, str] = {}
    for repeat in range(args.repeats):
        for index, runner in enumerate(runners):
            if index in failures:
                continue
            try:
                if repeat * args.steps % EPISODE_STEPS < args.steps:
                    runner.restart()
                seconds[index].append(runner.run())
            except (PeerError, jax.errors.JaxRuntimeError) as error:
                failures[index] = f"{runner.record['engine']} {runner.record['preset']}: {one_line(error)[:300]}"
    records = []
    for index, runner in enumerate(runners):
        if index not in failures:
            speed = runner.record["worlds"] * args.steps / statistics.median(seconds[index])
            records.append(runner.record | {"physics_steps_per_second": round(speed, 1)})
    return records, list(failures.values())


class OurEngine:
    """Our engine with packed worlds and the compiled program that steps them."""

    def __init__(self, args: Args, size: str, files: list[Path], worlds: int, preset_name: str, device: Any) -> None:
        with user_errors(ValueError):
            engine = Engine(SIZES[size], settings=preset(preset_name), backend=args.backend)
        levels = load_levels(files, size)
        num_levels = len(files)
        num_joints, num_thrusters = SIZES[size].joints, SIZES[size].thrusters
        order = jnp.arange(worlds) % num_levels
        state = engine.initial_state(
            levels.scene, levels.position, levels.angle, levels.velocity, levels.angular_velocity
        )
        # Packed arrays have the world axis last: the few levels are packed, then repeated.
        repeat = partial(jax.tree.map, lambda x: jnp.take(x, order, axis=-1))
        self._scene = jax.jit(repeat)(engine.pack_scene(levels.scene))
        self._start = jax.jit(repeat)(engine.pack_state(state))

        def env_step(packed_scene: Any, packed_state: Any, key: jax.Array) -> Any:
            motor_key, thruster_key = jax.random.split(key)
            motor = jax.random.randint(motor_key, (worlds, num_joints), -1, 2).astype(jnp.float32)
            thruster = jax.random.randint(thruster_key, (worlds, num_thrusters), 0, 2).astype(jnp.float32)
            controls = Controls(motor=motor, thruster=thruster)
            return engine.step_packed(packed_scene, packed_state, controls, num_steps=FRAME_SKIP)[0]

        @partial(jax.jit, donate_argnums=1)
        def run_steps(packed_scene: Any, packed_state: Any, key: jax.Array) -> Any:
            keys = jax.random.split(key, args.steps // FRAME_SKIP)
            return jax.lax.scan(lambda state, k: (env_step(packed_scene, state, k), None), packed_state, keys)[0]

        self._run_steps = run_steps
        self._key = jax.random.key(args.seed)
        self.record: Record = {
            "engine": "ours",
            "backend": args.backend,
            "preset": preset_name,
            "size": size,
            "worlds": worlds,
            "device": device.device_kind,
        }
        self.restart()
        self.run()  # compiles

    def restart(self) -> None:
        self._state = jax.block_until_ready(jax.tree.map(jnp.copy, self._start))

    def run(self) -> float:
        self._key, key = jax.random.split(self._key)
        jax.block_until_ready(key)
        started = time.perf_counter()
        self._state = jax.block_until_ready(self._run_steps(self._scene, self._state, key))
        return time.perf_counter() - started


def load_levels(files: list[Path], size: str) -> Level:
    """The levels of these files as one batch."""
    with user_errors(ValueError, OSError):
        return stack_worlds([fit_level(load_kinetix(file), SIZES[size]) for file in files])


@contextmanager
def level_files(args: Args, size: str) -> Iterator[tuple[list[Path], str]]:
    """Level files of one size in the public format, and where they are from."""
    for directory in (args.levels, os.environ.get("KINETIX_LEVELS"), _CHECKOUT.parent / "shared" / "kinetix_levels"):
        files = sorted(Path(directory, size).glob("*.json")) if directory else []
        if files:
            yield files, "the public Kinetix levels"
            return
        if directory is not None and directory == args.levels:
            raise UserError(f"no level files in {Path(directory, size)}; give --levels a folder with s/, m/ and l/")
    with tempfile.TemporaryDirectory() as folder:
        yield _random_level_files(Path(folder), size, args.seed), f"drawn at random with seed {args.seed}"


def _random_level_files(folder: Path, size: str, seed: int) -> list[Path]:
    from kinetix_dist.level.generator import GeneratorConfig, generate_level

    keys = jax.random.split(jax.random.key(seed), NUM_RANDOM_LEVELS)
    draw = partial(generate_level, capacity=SIZES[size], config=GeneratorConfig())
    levels = jax.device_get(jax.jit(jax.vmap(draw))(keys))
    files = []
    for index in range(NUM_RANDOM_LEVELS):
        files.append(folder / f"{index:03}.json")
        document = export_kinetix(jax.tree.map(lambda x, i=index: np.asarray(x)[i], levels))
        files[-1].write_text(json.dumps(document))
    return files


def _row(record: Record) -> str:
    speed = record["physics_steps_per_second"]
    name = f"{record['engine']} {record['backend']} {record['preset']}"
    return f"  {name:<26} {record['size'].upper()} {record['worlds']:>8} worlds {speed:>16,.0f} physics steps/s"
