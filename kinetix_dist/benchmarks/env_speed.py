"""`bench env`: environment steps per second of each observation and size, under random actions.

    levels (designed ones of the size) -> worlds: world i plays level i modulo the number of levels
    one run    = `steps` environment steps of all worlds in a lax.scan: actions drawn at random, `Environment.step` with
                 rewards and restarts, and the input of a policy, written to memory at every step
    one record = worlds * steps / median seconds of `repeats` runs, after one run that compiles and is not timed

Observation "none" is the same without the input of a policy. Runs of the observations of a size take turns in
random order, so that a busy moment of the machine falls on all of them, each after a run of its own that is not timed;
`relative_to_none` is the median of ratios of one round, on a CPU of processor time, which other jobs change less.

    {"observation", "size", "worlds", "device", "env_steps_per_second", "relative_to_none"}
"""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import Array
from kinetix_dist import prng
from kinetix_dist.benchmarks.measuring import Record, Results, compute_clock
from kinetix_dist.env.device_memory import DeviceMemoryError
from kinetix_dist.env.environment import EnvConfig, Environment
from kinetix_dist.env.observations import OBSERVATIONS
from kinetix_dist.errors import one_line
from kinetix_dist.level.level import SIZES
from kinetix_dist.level.sets import load_level_set

NONE = "none"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """Environment steps per second of each observation and size, under random actions."""

    sizes: tuple[str, ...] = tuple(SIZES)
    """Sizes of levels."""
    observations: tuple[str, ...] = tuple(OBSERVATIONS)
    """Observations; each is compared with the same environment without any."""
    worlds: tuple[int, ...] = (2048,)
    """Numbers of worlds."""
    steps: int = 8
    """Environment steps in one timed run."""
    repeats: int = 7
    """Timed runs."""
    seed: int = 0
    """Seed of the actions."""
    json: Path | None = None
    """File for the records."""

    def __post_init__(self) -> None:
        for name, known in (("sizes", SIZES), ("observations", OBSERVATIONS)):
            if unknown := [value for value in getattr(self, name) if value not in known]:
                raise ValueError(f"--{name} {unknown[0]} is unknown; choose from {', '.join(known)}")
        for name, value in (("steps", self.steps), ("repeats", self.repeats), ("worlds", min(self.worlds, default=0))):
            if value < 1:
                raise ValueError(f"--{name} is {value}; it must be 1 or more")


class Seconds(NamedTuple):
    """Seconds of one run."""

    wall: float
    computed: float  # as `timing.compute_clock` has it


def measure(options: Options, results: Results) -> None:
    """One record for each observation, size and number of worlds."""
    shuffle = np.random.default_rng(options.seed)
    for size in options.sizes:
        levels, names = load_level_set(f"designed_{size}", size)
        results.report(f"size {size.upper()}: {len(names)} designed levels; {jax.devices()[0].device_kind}")
        for worlds in options.worlds:
            order = np.arange(worlds) % len(names)
            batch = jax.tree.map(lambda x: jnp.asarray(x)[order], levels)  # noqa: B023 (called at once)
            runs: dict[str, Callable[[], Seconds]] = {}
            for name in (NONE, *options.observations):
                try:
                    runs[name] = _runner(options, size, batch, name)
                except (DeviceMemoryError, jax.errors.JaxRuntimeError) as error:
                    results.fail(f"{name}, {size.upper()}, {worlds} worlds: {one_line(error)[:300]}")
            seconds: dict[str, list[Seconds]] = {name: [] for name in runs}
            for _ in range(options.repeats):
                for name in shuffle.permutation(list(runs)):
                    runs[name]()
                    seconds[name].append(runs[name]())
            for name, found in seconds.items():
                ratios = [none.computed / one.computed for none, one in zip(seconds[NONE], found)]
                wall = statistics.median(one.wall for one in found)
                record: Record = {
                    "observation": name,
                    "size": size,
                    "worlds": worlds,
                    "device": jax.devices()[0].device_kind,
                    "env_steps_per_second": round(worlds * options.steps / wall, 1),
                    "relative_to_none": round(statistics.median(ratios), 4),
                }
                results.add(record)
                results.report(
                    f"  {name:<8} {size.upper()} {worlds:>8} worlds {record['env_steps_per_second']:>14,.0f} "
                    f"environment steps/s  {record['relative_to_none']:.2f} of none"
                )


def _runner(options: Options, size: str, levels: Any, observation: str) -> Callable[[], Seconds]:
    """A function that plays once, compiled."""
    is_seen = observation != NONE
    env = Environment(EnvConfig(size=size, observation=observation if is_seen else "entity"))
    prepared = env.prepare(levels)
    num_worlds = levels.angle.shape[0]

    def observe(obs: Any) -> Any:
        return env.observe(prepared, obs) if is_seen else obs

    @jax.jit
    def play(state: Any, obs: Any, key: Array) -> tuple[Any, Any, Any]:
        def step(carry: tuple[Any, Any, Any], step_key: Array) -> tuple[tuple[Any, Any, Any], Array]:
            state, obs, _ = carry
            actions = env.action_space.sample(step_key, num_worlds)
            state, obs, reward, *_ = env.step(prepared, state, actions)
            return (state, obs, observe(obs)), reward  # what a loop carries is in memory after each turn

        return jax.lax.scan(step, (state, obs, observe(obs)), prng.split(key, options.steps))[0]

    state, obs = env.reset(prepared)
    key = prng.key(options.seed)

    compute_time = compute_clock(jax.devices()[0])

    def run() -> Seconds:
        nonlocal state, obs, key
        key, play_key = prng.split(key)
        jax.block_until_ready(play_key)
        started, computed = time.perf_counter(), compute_time()
        state, obs, _ = jax.block_until_ready(play(state, obs, play_key))
        return Seconds(time.perf_counter() - started, compute_time() - computed)

    run()  # compiles
    return run
