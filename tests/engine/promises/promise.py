"""Promises: figures of scenes that must stay below a limit, for any preset and backend.

`bench/engine_promises.py` prints them all; the tests of each family assert them.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jax2d import BuiltWorld, Capacity, Engine, Trajectory, preset, record
from jax2d.fidelity.trajectory import start_of
from tests.engine.promises.plan import Plan, Point

PRESETS = ("draft", "standard", "fine")  # `paper` promises none of this: it is the published solver


class Solver(NamedTuple):
    """A preset on a backend, with what is changed in it."""

    preset: str = "standard"
    backend: str = "warp"
    changes: tuple[tuple[str, object], ...] = ()

    def engine(self, capacity: Capacity) -> Engine:
        return _engine(self, capacity)

    def trajectories(
        self,
        worlds: Sequence[BuiltWorld],
        capacity: Capacity,
        steps: int,
        *,
        motor: float = 1.0,
        forces: np.ndarray | None = None,
    ) -> list[Trajectory]:
        """Motion of worlds that are stepped as one batch, motors at `motor`. `forces` [n, 2] N, the same in all."""
        engine = self.engine(capacity)
        scene, state = start_of(engine, worlds)
        controls = engine.no_controls(len(worlds))
        controls = dataclasses.replace(controls, motor=jnp.full_like(controls.motor, motor))
        if forces is not None:
            force = jnp.broadcast_to(jnp.asarray(forces, jnp.float32), (len(worlds), *forces.shape))
            controls = dataclasses.replace(controls, force=force)
        found, _ = record(engine, scene, state, controls, num_samples=steps)
        return [found.world(i) for i in range(len(worlds))]


class Motion(NamedTuple):
    """Motion of a plan's bodies, in the plan's order, at every step."""

    position: np.ndarray  # [T, n, 2] m
    angle: np.ndarray  # [T, n] rad
    velocity: np.ndarray  # [T, n, 2] m/s
    spin: np.ndarray  # [T, n] rad/s


@dataclasses.dataclass(frozen=True, kw_only=True)
class Promise:
    """One scene's figure and the most that it may be."""

    name: str
    unit: str
    limits: Mapping[str, float]  # by preset
    measure: Callable[[Solver], float]
    data: Path | None = None  # a file that it reads, which may be absent


def motions(solver: Solver, plans: Sequence[Plan], capacity: Capacity, steps: int) -> list[Motion]:
    """Motion of each plan, all stepped as one batch."""
    found = solver.trajectories([plan.build(capacity) for plan in plans], capacity, steps)
    return [motion_of(plan, t, capacity) for plan, t in zip(plans, found, strict=True)]


def motion_under(solver: Solver, plan: Plan, forces: Mapping[int, Point], capacity: Capacity, steps: int) -> Motion:
    """Motion of one plan whose bodies are pushed at their centres, N in the world frame."""
    newtons = np.zeros((capacity.shapes, 2))
    slots = plan.slots(capacity)
    for body, force in forces.items():
        newtons[slots[body]] = force
    (found,) = solver.trajectories([plan.build(capacity)], capacity, steps, forces=newtons)
    return motion_of(plan, found, capacity)


def motion_of(plan: Plan, t: Trajectory, capacity: Capacity) -> Motion:
    slots = plan.slots(capacity)
    return Motion(t.position[:, slots], t.angle[:, slots], t.velocity[:, slots], t.angular_velocity[:, slots])


def everywhere(limit: float) -> dict[str, float]:
    """One limit for all presets."""
    return dict.fromkeys(PRESETS, limit)


@functools.cache
def _engine(solver: Solver, capacity: Capacity) -> Engine:
    settings = preset(solver.preset).replace(**dict(solver.changes))
    return Engine(capacity, settings=settings, backend=solver.backend)
