"""Worlds that engines are measured on: levels of a size, and random actions, each held for two physics steps.

Levels are the public Kinetix levels, or else drawn at random. Actions are drawn inside the compiled program.

Order of worlds: "drawn", world i plays level i modulo the number of levels, so that the 32 worlds of a warp play as
many levels; or "sorted", the same worlds with those of one structure side by side (`jax2d/world_order.py`).
"""

from __future__ import annotations

import dataclasses
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

import jax2d
import kinetix_dist
from jax2d import Controls, Engine
from jax2d.engine import BACKENDS
from jax2d.scene import stack_worlds
from jax2d.world_order import sorting, structure_of
from kinetix_dist import prng
from kinetix_dist.benchmarks.measuring import BenchmarkOptions
from kinetix_dist.errors import UserError, user_errors
from kinetix_dist.json_text import json_text
from kinetix_dist.level.fit import fit_level
from kinetix_dist.level.generator import GeneratorConfig, generate_level
from kinetix_dist.level.kinetix_format import export_kinetix, load_kinetix
from kinetix_dist.level.level import SIZES, Level
from kinetix_dist.level.sets import data_files

CHECKOUT = Path(kinetix_dist.__file__).resolve().parent.parent
ORDERS = DRAWN, SORTED = "drawn", "sorted"  # of worlds
NUM_RANDOM_LEVELS = 32  # a size, where the public ones are absent


@dataclasses.dataclass(frozen=True, kw_only=True)
class EngineOptions(BenchmarkOptions):
    """Options of every benchmark of the engine."""

    sizes: tuple[Literal["s", "m", "l"], ...] = ("s", "m", "l")
    """Level sizes."""
    worlds: tuple[int, ...] = ()
    """Numbers of worlds. Default: a range that fits the device."""
    repeats: int = 5
    """Timed runs of which the median counts, after one that is not timed; at least 5."""
    levels: Path | None = None
    """Folder of the public Kinetix levels (s/, m/, l/). Default: $KINETIX_LEVELS, else levels drawn at random."""
    seed: int = 0
    """Seed of the actions, and of the levels where they are drawn."""

    def __post_init__(self) -> None:
        if not self.sizes:
            raise ValueError("--sizes is empty; give one or more, such as --sizes s")
        if self.repeats < 5:
            raise ValueError(f"--repeats is {self.repeats}; give 5 or more, since a median of fewer says little")
        for worlds in self.worlds:
            if worlds < 1:
                raise ValueError(f"--worlds has {worlds}; give 1 or more")
        if self.levels is not None and not self.levels.is_dir():
            raise ValueError(f"--levels {self.levels} is not a folder; give one with s/, m/ and l/ of level files")


def check_engine(preset: str, backend: str = "warp") -> None:
    """Raises ValueError for settings or a backend that the engine does not have."""
    jax2d.preset(preset)
    if backend not in BACKENDS:
        raise ValueError(f"--backend is {backend!r}; backends are {', '.join(BACKENDS)}")


def check_steps(steps: int) -> None:
    """Raises ValueError for a number of physics steps that actions of two cannot fill."""
    if steps < 2 or steps % 2:
        raise ValueError(f"--steps is {steps}; give an even number of physics steps, 2 or more")


@contextmanager
def level_files(size: str, levels: Path | None, seed: int) -> Iterator[tuple[list[Path], str]]:
    """Level files of one size in the public format, and a phrase that says where they are from.

    `levels`: the folder to take them from, with s/, m/ and l/; None: that of $KINETIX_LEVELS, if it has some.
    """
    directory = levels or os.environ.get("KINETIX_LEVELS")
    if directory and (files := data_files(Path(directory, size), "*.json")):
        yield files, "the public Kinetix levels"
        return
    if levels is not None:
        raise UserError(f"no level files in {levels / size}; give --levels a folder with s/, m/ and l/")
    with tempfile.TemporaryDirectory() as folder:
        yield _random_level_files(Path(folder), size, seed), f"drawn at random with seed {seed}"


def load_levels(files: list[Path], size: str) -> Level:
    """The levels of these files as one batch; raises UserError for one that is not a level of this size."""
    with user_errors(ValueError, OSError):
        return stack_worlds([fit_level(load_kinetix(file), SIZES[size]) for file in files])


def levels_of_worlds(levels: Level, worlds: int, order: str) -> jax.Array:
    """[worlds] number of the level that each world plays, in an order of worlds."""
    return in_order(jnp.arange(worlds) % len(levels.position), structure_of(levels.scene), order)


def in_order(numbers: Any, structure: jax.Array, order: str) -> jax.Array:
    """`numbers` of levels as they are ("drawn"), or sorted by their structure [levels, counts]."""
    numbers = jnp.asarray(numbers)
    return numbers if order == DRAWN else numbers[sorting(structure[numbers]).worlds]


def _random_level_files(folder: Path, size: str, seed: int) -> list[Path]:
    keys = prng.split(prng.key(seed), NUM_RANDOM_LEVELS)
    draw = partial(generate_level, capacity=SIZES[size], config=GeneratorConfig())
    levels = jax.device_get(jax.jit(jax.vmap(draw))(keys))
    files = []
    for index in range(NUM_RANDOM_LEVELS):
        files.append(folder / f"{index:03}.json")
        document = export_kinetix(jax.tree.map(lambda x, i=index: np.asarray(x)[i], levels))
        files[-1].write_text(json_text(document))
    return files


EPISODE_STEPS = 512  # physics steps: 256 environment steps of 2
FRAME_SKIP = 2  # physics steps that an action is held for, and of one launch

# (packed scene, packed state, key) -> packed state
Play = Callable[[Any, Any, jax.Array], Any]


def random_controls(engine: Engine, shape: tuple[int, ...], key: jax.Array) -> Controls:
    """Motors from -1, 0, 1 and thrusters from 0, 1; `shape` is that of the batch, [..., W]."""
    motor_key, thruster_key = prng.split(key)
    return Controls(
        motor=prng.randint(motor_key, (*shape, engine.capacity.joints), -1, 2).astype(jnp.float32),
        thruster=prng.randint(thruster_key, (*shape, engine.capacity.thrusters), 0, 2).astype(jnp.float32),
    )


def random_play(engine: Engine, worlds: int, steps: int) -> Play:
    """The program that plays `steps` physics steps of `worlds` packed worlds; not compiled yet."""

    def launch(scene: Any, state: Any, key: jax.Array) -> tuple[Any, None]:
        controls = random_controls(engine, (worlds,), key)
        return engine.step_packed(scene, state, controls, num_steps=FRAME_SKIP)[0], None

    def play(scene: Any, state: Any, key: jax.Array) -> Any:
        return jax.lax.scan(partial(launch, scene), state, prng.split(key, steps // FRAME_SKIP))[0]

    return play


def take_worlds(packed: Any, order: jax.Array) -> Any:
    """Packed worlds in this order, some several times: packed arrays have the world axis last."""
    return jax.tree.map(lambda x: jnp.take(x, order, axis=-1), packed)
