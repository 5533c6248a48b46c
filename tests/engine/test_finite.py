"""Joints that cannot be satisfied, between bodies of any mass, leave a state of finite numbers."""

from __future__ import annotations

import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jax2d import BuiltWorld, Capacity, Engine, SceneBuilder, preset
from jax2d.builder_options import BodyKeywords, RevoluteKeywords
from jax2d.fidelity import record_worlds
from jax2d.fidelity.trajectory import start_of

TANGLE = Capacity(polygons=6, circles=3, joints=8, thrusters=0)
LINKS = 24
DRUM = Capacity(polygons=LINKS + 2, circles=1, joints=LINKS + 1, thrusters=0)


def tangle(seed: int) -> BuiltWorld:
    """Bodies of 1e-4 to 1e4 kg/m^2, some of them thin, jointed at points far from them, driven, limited, in loops."""
    rng = np.random.default_rng(seed)
    b = SceneBuilder(TANGLE, gravity=(0, -9.81 * 10 ** rng.uniform(-1, 0.5)))
    shapes = []
    for i in range(int(rng.integers(3, 7))):
        width, height = 10 ** rng.uniform(-1.5, 0.3, 2)
        options: BodyKeywords = {"position": tuple(rng.uniform(-2, 2, 2)), "density": 10 ** rng.uniform(-4, 4)}
        if i and rng.random() < 0.3:
            options["velocity"] = tuple(rng.uniform(-30, 30, 2))
            options["angular_velocity"] = rng.uniform(-49, 49)
        shapes.append(b.add_box(width=width, height=height, angle=rng.uniform(-3, 3), fixed=i == 0, **options))
    for _ in range(int(rng.integers(0, 4))):
        at = tuple(rng.uniform(-2, 2, 2))
        shapes.append(b.add_circle(radius=10 ** rng.uniform(-1.5, 0), position=at, density=10 ** rng.uniform(-4, 4)))
    jointed = set()
    for _ in range(int(rng.integers(2, 9))):
        pair = tuple(sorted(rng.choice(len(shapes), 2, replace=False).tolist()))
        if pair in jointed:
            continue
        jointed.add(pair)
        ends, at = (shapes[pair[0]], shapes[pair[1]]), tuple(rng.uniform(-3, 3, 2))
        if rng.random() < 0.3:
            b.add_fixed_joint(*ends, at=at)
            continue
        drive: RevoluteKeywords = {"motor_speed": rng.uniform(-2, 2), "motor_power": 10 ** rng.uniform(-2, 2)}
        limits: RevoluteKeywords = {"limits": (-rng.uniform(0, 1), rng.uniform(0, 1))}
        none: RevoluteKeywords = {}
        motor, bounds = drive if rng.random() < 0.5 else none, limits if rng.random() < 0.3 else none
        b.add_revolute_joint(*ends, at=at, **motor, **bounds)
    return b.build()


@pytest.mark.also_gpu
@pytest.mark.parametrize("name", ["standard", "draft", "fine"])
def test_tangles_stay_finite(name: str):
    """Impulses that a speed limit took back were requested again: they grew to 1e24 N s, and the state was NaN."""
    engine = Engine(TANGLE, settings=preset(name))
    worlds = [tangle(seed) for seed in range(512)]
    scene, state = start_of(engine, worlds)
    controls = jax.tree.map(jnp.ones_like, engine.no_controls(len(worlds)))
    for _ in range(3):
        state, _ = engine.step(scene, state, controls, num_steps=60)
        for field in ("position", "angle", "velocity", "angular_velocity", "joint_impulse"):
            assert np.isfinite(getattr(state, field)).sum() == getattr(state, field).size, field
    # The heaviest tangle weighs 2e5 kg, and falls at 100 m/s at most.
    assert np.abs(state.joint_impulse).max() < 1e9


def loaded_chain() -> BuiltWorld:
    """A chain of links of 0.8 g over a drum, with 1 kg on either end."""
    b = SceneBuilder(DRUM)
    b.add_circle(radius=1.0, fixed=True, friction_coefficient=0.3)
    radius, on_drum = 1.021, 15
    half_turn = math.pi / on_drum
    length = 2 * radius * math.sin(half_turn / 2)
    left = (LINKS - on_drum) // 2
    points = [(-radius, -i * length) for i in range(left, 0, -1)]
    points += [(-radius * math.cos(i * half_turn), radius * math.sin(i * half_turn)) for i in range(on_drum + 1)]
    points += [(radius, -i * length) for i in range(1, LINKS - on_drum - left + 1)]
    links = []
    for (x0, y0), (x1, y1) in itertools.pairwise(points):
        middle, angle = ((x0 + x1) / 2, (y0 + y1) / 2), math.atan2(y1 - y0, x1 - x0)
        links.append(b.add_box(width=0.98 * length, height=0.04, position=middle, angle=angle, density=0.1))
    for one, other, at in zip(links[:-1], links[1:], points[1:]):
        b.add_revolute_joint(one, other, at=at)
    for link, (x, y) in ((links[0], points[0]), (links[-1], points[-1])):
        load = b.add_box(width=0.4, height=0.4, position=(x, y - 0.2), density=1 / 0.16)
        b.add_revolute_joint(link, load, at=(x, y))
    return b.build()


@pytest.mark.also_gpu
@pytest.mark.parametrize("name", ["standard", "draft", "fine"])
def test_chain_of_links_a_thousandth_of_its_load_stays_finite(name: str):
    """Links that spin fast in the middle of a pass had to hold their anchors on ever larger circles: NaN after
    19 steps of `standard`. There it breaks; `fine` holds it."""
    (m,) = record_worlds(Engine(DRUM, settings=preset(name)), [loaded_chain()], seconds=2.0)
    for motion in (m.position, m.angle, m.velocity, m.angular_velocity):
        assert np.isfinite(motion).sum() == motion.size
    if name == "fine":
        assert np.abs(m.position[-1, -2:] - m.position[0, -2:]).max() < 0.2
