"""Runs worlds of one capacity under any settings: their paths, and what a simulated second of them costs.

    group = Group(capacity, backend, dtype)    compiles once for each solver and batch size, not for each dt or substeps
    runs = group.paths(worlds, settings, seconds, control) -> one Run a world
    group.microseconds_per_world_second(runs[i].moments, settings, worlds=1024) -> of one run, timed

Numbers of the settings are arguments of the compiled programs (the backend's `parameters`); dt changes how often a
program is called, never the program.
"""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import functools
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.builder import BuiltWorld
from jax2d.engine import Engine
from jax2d.fidelity.path import Path
from jax2d.scene import Capacity, Controls, stack_worlds
from jax2d.settings import Settings

CHUNK_STEPS = 4  # physics steps a call: a compromise between calls and the grain at which states are kept
MOMENTS = 32  # states of a motion that a timed batch holds


@dataclasses.dataclass(frozen=True, kw_only=True)
class Moments:
    """What it takes to time a motion: one world at many times of it. Host arrays."""

    scene: Any  # packed, [rows, 1]
    states: Any  # packed, [rows, MOMENTS]; a motion of few steps has some of them several times
    controls: Controls  # of one world


class Run(NamedTuple):
    """One world's motion."""

    path: Path
    moments: Moments


def compiled_in(settings: Settings, backend: str) -> Settings:
    """What of the settings a program is compiled for: all but numbers and switches; in plain JAX loop counts too."""
    loops = {"solver_batch_size"} | ({"substeps", "bounce_rounds"} if backend == "xla" else set())
    defaults = Settings()
    numbers = {
        field.name: getattr(defaults, field.name)
        for field in dataclasses.fields(Settings)
        if type(getattr(defaults, field.name)) in (int, float, bool) and field.name not in loops
    }
    return settings.replace(**numbers)


class Group:
    """One backend and precision, with its compiled programs. float64 runs in JAX's 64-bit mode, which it scopes."""

    def __init__(self, capacity: Capacity, backend: str = "warp", dtype: str = "float32"):
        self.capacity = capacity
        self.backend = backend
        self.dtype = dtype
        self._precision: Callable[[], Any] = (
            functools.partial(jax.enable_x64, True) if dtype == "float64" else contextlib.nullcontext
        )
        self._programs: dict[tuple[Settings, int], Callable] = {}

    def engine(self, settings: Settings) -> Engine:
        """Raises ValueError where the backend cannot run these settings."""
        with self._precision():
            return Engine(self.capacity, settings=settings, backend=self.backend, dtype=self.dtype)

    def paths(
        self, worlds: Sequence[BuiltWorld], settings: Settings, seconds: Sequence[float], control: Sequence[float]
    ) -> list[Run]:
        """All worlds in one batch; each path ends after its own seconds."""
        engine = self.engine(settings)
        advance = self._program(settings, CHUNK_STEPS, record=True)
        num_steps = [round(s / settings.dt) for s in seconds]
        with self._precision():
            scene = engine.pack_scene(stack_worlds([world.scene for world in worlds]))
            packed = engine.pack_state(stack_worlds([engine.initial_state(*world) for world in worlds]))
            level = jnp.asarray(control, self.dtype)[:, None]
            controls = Controls(
                motor=jnp.repeat(level, self.capacity.joints, 1), thruster=jnp.repeat(level, self.capacity.thrusters, 1)
            )
            wanted = [_moments_of(steps) for steps in num_steps]
            recorded = [jax.device_get(_visible(engine, packed, add_axis=True))]
            kept = {0: jax.device_get(packed)}
            for chunk in range(1, 1 + -(-max(num_steps) // CHUNK_STEPS)):
                packed, states = advance(engine.backend.parameters, scene, packed, controls)
                recorded.append(jax.device_get(states))
                if any(chunk in chunks for chunks in wanted):
                    kept[chunk] = jax.device_get(packed)
            scene, controls = jax.device_get((scene, controls))
        fields = [np.concatenate(parts).astype(np.float64) for parts in zip(*recorded)]
        runs = []
        for i, (world, steps) in enumerate(zip(worlds, num_steps)):
            position, angle, velocity, angular_velocity, impulse = (x[: steps + 1, i] for x in fields)
            path = Path(
                scene=world.scene,
                dt=settings.dt,
                position=position,
                angle=angle,
                velocity=velocity,
                angular_velocity=angular_velocity,
                joint_force=impulse[..., :2] / settings.substep_seconds,
            )
            one = functools.partial(jax.tree.map, lambda x, i=i: x[..., i : i + 1])
            moments = Moments(
                scene=one(scene),
                states=jax.tree.map(lambda *xs: np.concatenate(xs, -1), *[one(kept[chunk]) for chunk in wanted[i]]),
                controls=jax.tree.map(lambda x, i=i: x[i], controls),
            )
            runs.append(Run(path, moments))
        return runs

    def positions(
        self, world: BuiltWorld, settings: Settings, *, control: float, moments: int, steps_between: int
    ) -> np.ndarray:
        """[moments, n, 2] of one world, every `steps_between` steps (a multiple of 96) after the start."""
        engine = self.engine(settings)
        chunk = 96
        if steps_between % chunk:
            raise ValueError(f"steps_between is {steps_between}; use a multiple of {chunk}")
        advance = self._program(settings, chunk, record=False)
        seen = []
        with self._precision():
            scene = engine.pack_scene(stack_worlds([world.scene]))
            packed = engine.pack_state(stack_worlds([engine.initial_state(*world)]))
            controls = jax.tree.map(lambda x: jnp.full_like(x, control), engine.no_controls(1))
            for _ in range(moments):
                for _ in range(steps_between // chunk):
                    packed, _ = advance(engine.backend.parameters, scene, packed, controls)
                seen.append(np.asarray(engine.bodies(packed)[0][0]))
        return np.array(seen)

    def microseconds_per_world_second(
        self, moments: Moments, settings: Settings, *, worlds: int, steps: int = 32
    ) -> float:
        """Of one timed run, after those that compile. It starts from a batch in which the motion stands at many
        different times: contacts and flights are timed in the share in which they occur."""
        engine = self.engine(settings)
        advance = self._program(settings, steps, record=False)
        with self._precision():
            arguments = jax.block_until_ready(_batch(moments.scene, moments.states, moments.controls, worlds=worlds))
            started = time.perf_counter()
            jax.block_until_ready(advance(engine.backend.parameters, *arguments))
            seconds = time.perf_counter() - started
        return 1e6 * seconds / (worlds * steps * settings.dt)

    def _program(self, settings: Settings, steps: int, *, record: bool) -> Callable:
        """(parameters, packed scene, packed state, controls) -> (packed state, visible states [steps, W, ...] or None).
        jit compiles it again for another number of worlds."""
        key = (compiled_in(settings, self.backend), steps)
        if key in self._programs:
            return self._programs[key]
        engine = self.engine(key[0])

        @jax.jit
        def advance(parameters: Any, scene: Any, packed: Any, controls: Controls) -> tuple[Any, Any]:
            tuned = copy.copy(engine)
            tuned.backend = copy.copy(engine.backend)
            tuned.backend.parameters = parameters

            def one_step(state: Any, _: None) -> tuple[Any, Any]:
                state, _ = tuned.step_packed(scene, state, controls)
                return state, _visible(tuned, state) if record else None

            return jax.lax.scan(one_step, packed, length=steps)

        self._programs[key] = advance
        return advance


def _moments_of(num_steps: int) -> list[int]:
    """Chunks before which a motion's states are kept: spread over it, the first included."""
    return np.linspace(0, max(0, num_steps // CHUNK_STEPS - 1), MOMENTS).round().astype(int).tolist()


@functools.partial(jax.jit, static_argnames="worlds")
def _batch(scene: Any, states: Any, controls: Controls, *, worlds: int) -> tuple[Any, Any, Controls]:
    """(packed scene, packed states, controls) of a batch of one scene at its many moments."""
    which = jnp.arange(worlds) % MOMENTS
    return (
        jax.tree.map(lambda x: jnp.repeat(x, worlds, -1), scene),
        jax.tree.map(lambda x: x[..., which], states),
        jax.tree.map(lambda x: jnp.repeat(x[None], worlds, 0), controls),
    )


def _visible(engine: Engine, packed: Any, add_axis: bool = False) -> tuple[jax.Array, ...]:
    """(position, angle, velocity, angular velocity, joint impulse) of a packed batch, worlds first."""
    state = engine.unpack_state(packed)
    parts = (state.position, state.angle, state.velocity, state.angular_velocity, state.joint_impulse)
    return tuple(x[None] for x in parts) if add_axis else parts
