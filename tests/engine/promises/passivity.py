"""Passivity: what nothing drives has no more energy, at any later time, than it had.

Chains of boxes whose hinges have limits that lock them, or nearly, are what limits that are solved one after another
feed: without gravity their kinetic energy may only fall.
"""

from __future__ import annotations

import functools
from pathlib import Path

from jax2d import BuiltWorld, Capacity
from kinetix_dist.level.level import SIZES
from kinetix_dist.level.schema import load_level
from tests.engine.promises.plan import Body, Joint, Plan, box
from tests.engine.promises.promise import Promise, Solver, everywhere
from tests.helpers import REPOSITORY

POLES = REPOSITORY.parent / "shared" / "cases" / "levels"
CHAIN = Capacity(polygons=8, circles=0, joints=7, thrusters=0)
LINKS, LINK_M = 6, 0.5
SECONDS, LEVEL_SECONDS, STEPS_PER_SECOND = 20, 10, 60
SETTLED = 2 * STEPS_PER_SECOND
LIMITS_RAD = (0.0, 0.001, 0.01, 0.05)
SPINS_RAD_S = (0.001, 6.0)  # of the last link at the start


def chain(limit: float, spin: float) -> Plan:
    """Six links of half a metre upright on a fixed box, hinged with limits of +-`limit` rad, no gravity."""
    bodies: list[Body] = [box(0.4, 0.4, fixed=True)]
    bodies += [
        box(0.2, LINK_M, (0, 0.2 + LINK_M * (k + 0.5)), spin=spin if k == LINKS - 1 else 0.0) for k in range(LINKS)
    ]
    joints = [Joint(a=k, b=k + 1, at=(0, 0.2 + LINK_M * k), limits=(-limit, limit)) for k in range(LINKS)]
    return Plan(tuple(bodies), tuple(joints), gravity=(0.0, 0.0))


def chain_gain(limit: float, spin: float, solver: Solver) -> float:
    """J/kg, the most by which its energy is above that at the start, or after two seconds above that at two."""
    world = chain(limit, spin).build(CHAIN)
    (found,) = solver.trajectories([world], CHAIN, SECONDS * STEPS_PER_SECOND)
    energy = found.kinetic_energy() / found.masses()[0].sum()
    return float(max(energy.max() - energy[0], energy[SETTLED:].max() - energy[SETTLED]))


def level_gain(file: Path, solver: Solver) -> float:
    """J/kg, the most by which the energy of a level of size L is above that at its start, with no action."""
    level, _ = load_level(file, "l")
    world = BuiltWorld(level.scene, level.position, level.angle, level.velocity, level.angular_velocity)
    (found,) = solver.trajectories([world], SIZES["l"], LEVEL_SECONDS * STEPS_PER_SECOND, motor=0.0)
    energy = found.energy(zero_at=found.position[0]) / found.masses()[0].sum()
    return float(energy.max() - energy[0])


def promises() -> list[Promise]:
    chains = [
        Promise(
            name=f"passivity: chain with limits of {limit:g} rad, last link at {spin:g} rad/s",
            unit="J/kg",
            limits=everywhere(1e-4),
            measure=functools.partial(chain_gain, limit, spin),
        )
        for limit in LIMITS_RAD
        for spin in SPINS_RAD_S
    ]
    poles = [
        Promise(
            name=f"passivity: level {name}, no action",
            unit="J/kg",
            limits=everywhere(0.01),
            measure=functools.partial(level_gain, POLES / f"{name}.json"),
            data=POLES / f"{name}.json",
        )
        for name in ("pole_a", "pole_b")
    ]
    return [*chains, *poles]
