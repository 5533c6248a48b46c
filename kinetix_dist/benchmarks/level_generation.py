"""`bench levels`: random levels per second, as they are drawn and without those that solve themselves.

    one run    = fresh levels as a curriculum asks for them for scoring: twice as many as it keeps are drawn and played
                 without acting for `NOOP_STEPS` environment steps; the first that are not solved are taken
    one record = levels taken / median seconds of `repeats` runs, after one run that compiles and is not timed

    {"size", "generator", "levels", "device", "levels_per_second", "drawn_per_second", "solved_without_actions"}

`drawn_per_second` is of the generator alone: levels of which none is played.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import jax

from jax2d.scene import Array
from kinetix_dist import prng
from kinetix_dist.benchmarks.measuring import Results, median_seconds
from kinetix_dist.curator.fresh_levels import fresh_levels
from kinetix_dist.env.environment import EnvConfig, Environment
from kinetix_dist.env.noop import noop_solved
from kinetix_dist.errors import one_line
from kinetix_dist.level.generator import OVERSAMPLING, generate_levels
from kinetix_dist.level.generator_config import generator
from kinetix_dist.level.level import SIZES, Level


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """Random levels per second, as they are drawn and without those that solve themselves."""

    sizes: tuple[str, ...] = tuple(SIZES)
    """Sizes of levels."""
    generators: tuple[str, ...] = ("default",)
    """Generators: "default", "kinetix" (the public package's), "locomotion", "tasks" or one of its families."""
    levels: tuple[int, ...] = (4096,)
    """Numbers of levels to keep in one run."""
    repeats: int = 7
    """Timed runs."""
    seed: int = 0
    """Seed of the levels."""
    json: Path | None = None
    """File for the records."""

    def __post_init__(self) -> None:
        if unknown := [size for size in self.sizes if size not in SIZES]:
            raise ValueError(f"--sizes {unknown[0]} is unknown; choose from {', '.join(SIZES)}")
        for name in self.generators:
            generator(name)
        for name, value in (("repeats", self.repeats), ("levels", min(self.levels, default=0))):
            if value < 1:
                raise ValueError(f"--{name} is {value}; it must be 1 or more")


def measure(options: Options, results: Results) -> None:
    """One record for each size, generator and number of levels."""
    for size in options.sizes:
        for name in options.generators:
            for levels in options.levels:
                try:
                    _measure(options, results, size, name, levels)
                except jax.errors.JaxRuntimeError as error:  # memory
                    results.fail(f"{name}, {size.upper()}, {levels} levels: {one_line(error)[:300]}")


def _measure(options: Options, results: Results, size: str, name: str, levels: int) -> None:
    env = Environment(EnvConfig(size=size))
    config = generator(name)
    key = prng.key(options.seed)

    def solves_itself(drawn: Level) -> Array:
        return noop_solved(env, drawn)

    @jax.jit
    def draw(key: Array) -> Level:
        return generate_levels(key, OVERSAMPLING * levels, env.capacity, config)

    @jax.jit
    def draw_and_filter(key: Array) -> Level:
        return fresh_levels(key[None], levels, capacity=env.capacity, generator=config, solves_itself=solves_itself)

    drawing = median_seconds(lambda: draw(key), options.repeats)
    filtering = median_seconds(lambda: draw_and_filter(key), options.repeats)
    share = float(jax.jit(lambda key: solves_itself(draw(key)).mean())(key))
    record = {
        "size": size,
        "generator": name,
        "levels": levels,
        "device": jax.devices()[0].device_kind,
        "levels_per_second": round(levels / filtering, 1),
        "drawn_per_second": round(OVERSAMPLING * levels / drawing, 1),
        "solved_without_actions": round(share, 4),
    }
    results.add(record)
    results.report(
        f"{name:<10} {size.upper()} {levels:>7} levels: {record['levels_per_second']:>11,.0f} filtered levels/s, "
        f"{record['drawn_per_second']:>12,.0f} drawn/s alone; {share:.1%} solve themselves"
    )
