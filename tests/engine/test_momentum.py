"""Momentum of isolated worlds: nothing pushes from outside, so neither linear nor angular momentum may change.

What is compared is plain mechanics on positions and velocities, sums in float64; no code of the engine is used."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from jax2d import BuiltWorld, Capacity, Engine, SceneBuilder, preset
from jax2d.builder_options import RevoluteKeywords
from jax2d.fidelity import Trajectory, record_worlds

CAPACITY = Capacity(polygons=6, circles=6, joints=5, thrusters=1)
NUM_WORLDS = 32
WORST_ERROR = 1e-4  # of what bodies exchanged; in float64 it is 1e-10 (test_follows_float64.py)
Build = Callable[[SceneBuilder, np.random.Generator], None]


def body(b: SceneBuilder, rng: np.random.Generator, is_box: bool, **options: object) -> int:
    size, shape = rng.uniform(0.2, 0.6), rng.uniform(0.5, 1.5)
    options |= {"angle": rng.uniform(0, 3), "friction": rng.uniform(0.3, 2), "density": rng.uniform(0.5, 5)}
    if is_box:
        return b.add_box(width=size, height=size * shape, **options)  # type: ignore[arg-type]
    return b.add_circle(radius=size / 2, **options)  # type: ignore[arg-type]


def rub(first_is_box: bool, second_is_box: bool, restitution: float) -> Build:
    """A spinning body meets another off its centre."""

    def build(b: SceneBuilder, rng: np.random.Generator) -> None:
        side = {"angular_velocity": rng.uniform(-8, 8), "restitution": restitution}
        at = (-1, rng.uniform(-0.3, 0.3))
        body(b, rng, first_is_box, position=at, velocity=(rng.uniform(1, 8), rng.uniform(-3, 3)), **side)
        body(b, rng, second_is_box, position=(0.2, 0), velocity=(0, rng.uniform(-3, 3)), **side)

    return build


def crowd(b: SceneBuilder, rng: np.random.Generator) -> None:
    """Ten bodies that fall into one another, overlapping at first."""
    for is_box in [True] * 5 + [False] * 5:
        at = rng.uniform(-1.5, 1.5, 2)
        body(b, rng, is_box, position=at, velocity=-at * rng.uniform(1, 6), restitution=rng.choice([0.0, 0.7]))


def jointed(kind: str, links: int = 2) -> Build:
    """A row of bars, the first of which spins fast."""

    def build(b: SceneBuilder, rng: np.random.Generator) -> None:
        bars = [
            b.add_box(
                width=0.6,
                height=0.2,
                position=(0.6 * k, 0),
                velocity=rng.uniform(-3, 3, 2),
                angular_velocity=rng.uniform(20, 40) if k == 0 else rng.uniform(-5, 5),
                density=rng.uniform(0.5, 5),
            )
            for k in range(links)
        ]
        for k in range(links - 1):
            ends, at = bars[k : k + 2], (0.6 * k + 0.3, 0)
            if kind == "fixed":
                b.add_fixed_joint(*ends, at=at)
            elif kind == "prismatic":
                b.add_prismatic_joint(*ends, at=at, axis_angle=rng.uniform(0, 3), limits=(-0.2, 0.2), motor_speed=1.0)
            else:
                limits = (-0.5, 0.5) if kind == "limits" else None
                speed = 1.0 if kind == "motor" else None
                motor: RevoluteKeywords = {} if speed is None else {"motor_speed": speed, "motor_power": 2.0}
                b.add_revolute_joint(*ends, at=at, limits=limits, **motor)

    return build


FAMILIES: dict[str, Build] = {
    **{
        f"{'box' if a else 'disc'} and {'box' if b else 'disc'}, e {e:g}": rub(a, b, e)
        for a, b in ((False, False), (True, False), (True, True))
        for e in (0.0, 0.5, 1.0)
    },
    "crowd": crowd,
    "hinge": jointed("revolute"),
    "hinge against limits": jointed("limits"),
    "hinge with motor": jointed("motor"),
    "weld": jointed("fixed"),
    "slider with motor and limits": jointed("prismatic"),
    "chain": jointed("revolute", links=5),
}


def worlds_of(family: str, capacity: Capacity = CAPACITY) -> list[BuiltWorld]:
    rng = np.random.default_rng(0)
    worlds = []
    for _ in range(NUM_WORLDS):
        b = SceneBuilder(capacity, gravity=(0, 0))
        FAMILIES[family](b, rng)
        worlds.append(b.build())
    return worlds


def errors(trajectory: Trajectory, world: BuiltWorld) -> tuple[float, float]:
    """Largest change of linear and of angular momentum, each as a share of what single bodies gained or lost, at least
    of a tenth of what is rounded: mass x speed, and that x distance."""
    shapes = world.scene.shapes
    moves = shapes.inverse_mass > 0
    mass, inertia = (1 / x[moves].astype(np.float64) for x in (shapes.inverse_mass, shapes.inverse_inertia))
    position, velocity, spin = (
        x[:, moves].astype(np.float64) for x in (trajectory.position, trajectory.velocity, trajectory.angular_velocity)
    )
    linear = mass[:, None] * velocity  # [T, bodies, 2]
    orbital = mass * (position[..., 0] * velocity[..., 1] - position[..., 1] * velocity[..., 0])
    angular = orbital + inertia * spin  # [T, bodies]
    moving = mass * np.linalg.norm(velocity, axis=-1)
    return share(linear, moving), share(angular, moving * np.linalg.norm(position, axis=-1))


def share(momentum: np.ndarray, rounded: np.ndarray) -> float:
    total = momentum.sum(1)
    exchanged = np.ptp(momentum, axis=0).max()
    return float(np.abs(total - total[0]).max() / max(exchanged, 0.1 * rounded.max()))


def unlimited(trajectories: list[Trajectory]) -> list[int]:
    """Worlds in which no speed limit acted: it pushes from outside. Most of them."""
    indices = [i for i, trajectory in enumerate(trajectories) if trajectory.limited.sum() == 0]  # type: ignore
    assert len(indices) >= 0.6 * len(trajectories)
    return indices


@pytest.mark.also_gpu
@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("name", ["standard", "fine", "draft"])
def test_momentum_of_an_isolated_world_does_not_change(name: str, family: str):
    worlds = worlds_of(family)
    trajectories = record_worlds(Engine(CAPACITY, settings=preset(name)), worlds, seconds=1.0)
    for i in unlimited(trajectories):
        linear, angular = errors(trajectories[i], worlds[i])
        assert linear < WORST_ERROR and angular < WORST_ERROR, i
