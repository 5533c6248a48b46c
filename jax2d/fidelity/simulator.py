"""Simulates scenarios of one capacity under any settings: trajectories, and what a simulated second of them costs.

    simulator = Simulator(capacity=capacity, backend="warp", dtype="float32")
    results = simulator.run(scenarios, settings)
    simulator.microseconds_per_world_second(results[0].timing, settings, worlds=1024)    # of one timed run

Programs are compiled once for each kernel variant and batch size, not for each dt or number of sub-steps
(`engine_argument`): dt changes how often a program is called, never the program.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.builder import BuiltWorld
from jax2d.engine import Engine
from jax2d.engine_argument import VariantEngine
from jax2d.fidelity.trajectory import Trajectory, start_of, trajectory_of
from jax2d.sampling import Run, Sampling, take_samples
from jax2d.scene import Capacity, Controls, stack_worlds
from jax2d.settings import Settings

STEPS_PER_CALL = 4  # a compromise between calls and the grain at which states to time are stored
TIMING_STATES = 32  # states of a trajectory that a timed batch holds


@dataclasses.dataclass(frozen=True, kw_only=True)
class Scenario:
    """A world, how long it is followed, and its constant controls."""

    world: BuiltWorld
    seconds: float
    control: float = 0.0  # of every motor and thruster


@dataclasses.dataclass(frozen=True, kw_only=True)
class TimingBatch:
    """Input for timing a trajectory: one world at many times of it. Host arrays."""

    scene: Any  # packed, [rows, 1]
    states: Any  # packed, [rows, TIMING_STATES]; a trajectory of few steps has some of them several times
    controls: Controls  # of one world


class Simulated(NamedTuple):
    trajectory: Trajectory
    timing: TimingBatch


@dataclasses.dataclass(frozen=True, kw_only=True)
class Simulator:
    """One capacity on one backend in one precision. float64 runs in JAX's 64-bit mode, which is on in here alone."""

    capacity: Capacity
    backend: str = "warp"
    dtype: str = "float32"

    def engine(self, settings: Settings) -> Engine:
        """Raises ValueError where the backend cannot run these settings."""
        with self._precision():
            return Engine(self.capacity, settings=settings, backend=self.backend, dtype=self.dtype)

    def run(self, scenarios: Sequence[Scenario], settings: Settings) -> list[Simulated]:
        """Runs all scenarios in one batch; each trajectory ends after its own seconds."""
        num_steps = [round(scenario.seconds / settings.dt) for scenario in scenarios]
        num_calls = -(-max(num_steps) // STEPS_PER_CALL)
        wanted = [_timing_calls(steps) for steps in num_steps]
        engine = self.engine(settings)
        with self._precision():
            run = _run_of(engine, scenarios)
            stored = {0: jax.device_get(run.state)}

            def keep(taken: int, packed: Any) -> None:
                call = taken // STEPS_PER_CALL
                if any(call in calls for calls in wanted):
                    stored[call] = jax.device_get(packed)

            sampling = Sampling(num_samples=num_calls * STEPS_PER_CALL, per_call=STEPS_PER_CALL, joint_impulse=True)
            samples, _ = take_samples(VariantEngine.of(engine, self.backend), run, sampling, keep)
            scene, controls = jax.device_get((run.scene, run.controls))
        # Scenes as built, in float32: errors of energy and momentum are relative to masses of that precision.
        batch = trajectory_of(samples, stack_worlds([scenario.world.scene for scenario in scenarios]), settings)
        results = []
        for i, scenario in enumerate(scenarios):
            one = functools.partial(jax.tree.map, lambda x, i=i: x[..., i : i + 1])
            timing = TimingBatch(
                scene=one(scene),
                states=jax.tree.map(lambda *xs: np.concatenate(xs, -1), *[one(stored[call]) for call in wanted[i]]),
                controls=jax.tree.map(lambda x, i=i: x[i], controls),
            )
            results.append(Simulated(batch.world(i).until(scenario.seconds), timing))
        return results

    def positions(self, scenario: Scenario, settings: Settings, *, every: int) -> np.ndarray:
        """[samples, n, 2] m, of every `every`-th step after the start, in the simulator's precision."""
        engine = self.engine(settings)
        num_samples = round(scenario.seconds / settings.dt) // every
        with self._precision():
            run = _run_of(engine, [scenario])
            sampling = Sampling(num_samples=num_samples, every=every, per_call=min(num_samples, 256))
            samples, _ = take_samples(VariantEngine.of(engine, self.backend), run, sampling)
        return samples.position[1:, 0]

    def microseconds_per_world_second(
        self, timing: TimingBatch, settings: Settings, *, worlds: int, steps: int = 32
    ) -> float:
        """Time of one run, after those that compile. It starts from a batch in which the trajectory stands at many
        different times: contacts and flights are timed in the share in which they occur."""
        engine = VariantEngine.of(self.engine(settings), self.backend)
        with self._precision():
            run = jax.block_until_ready(_batch(timing.scene, timing.states, timing.controls, worlds=worlds))
            started = time.perf_counter()
            jax.block_until_ready(_advance(engine, run, steps=steps))
            seconds = time.perf_counter() - started
        return 1e6 * seconds / (worlds * steps * settings.dt)

    def _precision(self) -> contextlib.AbstractContextManager:
        return jax.enable_x64(True) if self.dtype == "float64" else contextlib.nullcontext()


def _run_of(engine: Engine, scenarios: Sequence[Scenario]) -> Run:
    scene, state = start_of(engine, [scenario.world for scenario in scenarios])
    level = jnp.asarray([scenario.control for scenario in scenarios], engine.dtype)[:, None]
    controls = Controls(
        motor=jnp.repeat(level, engine.capacity.joints, 1), thruster=jnp.repeat(level, engine.capacity.thrusters, 1)
    )
    return Run(scene=engine.pack_scene(scene), state=engine.pack_state(state), controls=controls)


def _timing_calls(num_steps: int) -> list[int]:
    """Calls before which states are stored for timing: spread over a trajectory, its start included."""
    return np.linspace(0, max(0, num_steps // STEPS_PER_CALL - 1), TIMING_STATES).round().astype(int).tolist()


@functools.partial(jax.jit, static_argnames="worlds")
def _batch(scene: Any, states: Any, controls: Controls, *, worlds: int) -> Run:
    """A batch of one scene at its many times."""
    which = jnp.arange(worlds) % TIMING_STATES
    return Run(
        scene=jax.tree.map(lambda x: jnp.repeat(x, worlds, -1), scene),
        state=jax.tree.map(lambda x: x[..., which], states),
        controls=jax.tree.map(lambda x: jnp.repeat(x[None], worlds, 0), controls),
    )


@functools.partial(jax.jit, static_argnames="steps")
def _advance(engine: VariantEngine, run: Run, *, steps: int) -> Any:
    """The packed state after so many physics steps, a call of the backend each."""
    stepper = engine.engine()

    def one_step(packed: Any, _: None) -> tuple[Any, None]:
        return stepper.step_packed(run.scene, packed, run.controls)[0], None

    return jax.lax.scan(one_step, run.state, length=steps)[0]
