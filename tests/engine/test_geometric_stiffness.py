"""What joints pull tight: links between heavy bodies, whose swing a sub-step is too long for, gain no energy."""

from __future__ import annotations

import math

import jax
import numpy as np
import pytest

from jax2d import BuiltWorld, Capacity, Engine, SceneBuilder, Settings, measure, preset

NUM_LINKS = 10
LINK_M, BALL_M = 0.5, 0.5  # length of a link, radius of the ball
LINK_KG = 0.05
LENGTH_M = NUM_LINKS * LINK_M + BALL_M
CAPACITY = Capacity(polygons=NUM_LINKS + 1, circles=1, joints=NUM_LINKS + 1, thrusters=0)


def ball_on_a_chain(ratio: float) -> tuple[BuiltWorld, int]:
    """A chain of ten links that is let go level, with a ball of `ratio` times a link's mass at its end."""
    builder = SceneBuilder(CAPACITY)
    before = builder.add_box(width=0.2, height=0.2, fixed=True, mask=0)
    for k in range(NUM_LINKS):
        link = builder.add_box(width=LINK_M, height=0.1, position=((k + 0.5) * LINK_M, 0), mask=0)
        builder.add_revolute_joint(before, link, at=(k * LINK_M, 0))
        before = link
    density = ratio * LINK_KG / (math.pi * BALL_M**2)
    ball = builder.add_circle(radius=BALL_M, position=(LENGTH_M, 0), density=density, mask=0)
    builder.add_revolute_joint(before, ball, at=(NUM_LINKS * LINK_M, 0))
    return builder.build(), ball


def falls(ratio: float, settings: Settings, samples: int, every: int, backend: str = "warp"):
    """(energy [samples], of what the ball falls with; largest gap [samples] m; position of the ball [samples, 2] m)."""
    world, ball = ball_on_a_chain(ratio)
    engine = Engine(CAPACITY, settings=settings, backend=backend)
    unit = ratio * LINK_KG * 9.81 * LENGTH_M

    def step(state, _):
        state, _ = engine.step(world.scene, state, num_steps=every)
        energy = measure.kinetic_energy(world.scene, state) + measure.potential_energy(world.scene, state)
        return state, (energy / unit, measure.joint_gaps(world.scene, state).max(), state.position[ball])

    start = engine.initial_state(*world)
    return [np.asarray(x) for x in jax.jit(lambda s: jax.lax.scan(step, s, length=samples))(start)[1]]


@pytest.mark.parametrize("ratio", [50, 150, 400, 1000, 3000, 10000])
@pytest.mark.parametrize("name", ["draft", "standard", "fine"])
def test_a_ball_on_a_chain_of_light_links_gains_no_energy(name: str, ratio: float) -> None:
    """The chain began with none. Without geometric stiffness it gains 0.21 (standard, 50) to 5 (draft, 50)."""
    energy, gap, _ = falls(ratio, preset(name), samples=100, every=6)
    assert energy.max() < 0.01
    assert gap.max() < (0.1 if ratio <= 3000 else 0.5)


@pytest.mark.long
def test_the_reference_gains_none_either() -> None:
    energy, gap, _ = falls(400, preset("draft"), samples=50, every=6, backend="xla")
    assert energy.max() < 0.01 and gap.max() < 0.1


def test_it_falls_as_shorter_steps_have_it() -> None:
    """A thousand times a link's mass, 3 s: 7 cm of 5.5 m; without geometric stiffness 85."""
    _, _, exact = falls(1000, preset("fine").replace(dt=1 / 960), samples=6, every=480)
    energy, _, ball = falls(1000, preset("standard"), samples=6, every=30)
    assert np.linalg.norm(ball - exact, axis=-1).max() < 0.2
    assert energy.min() > -0.03  # what it loses
