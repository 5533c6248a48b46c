"""The pair search of kernels of many shapes finds bitwise what testing every pair finds."""

from __future__ import annotations

import functools
from collections.abc import Callable

import jax
import numpy as np
import pytest

from jax2d import BuiltWorld, Capacity, Effects, Engine, SceneBuilder, effects_of, preset, stack_worlds
from jax2d.warp.ffi import WarpBackend
from jax2d.warp.source import constants
from jax2d.warp.variant import CompileOptions, KernelVariant

pytestmark = pytest.mark.also_gpu

CAPACITY = Capacity(polygons=20, circles=20, joints=0, thrusters=0)
STEPS = 240


@functools.cache
def engine_of(preset_name: str, *, sweeps: bool, effects: Effects | None = None) -> Engine:
    settings = preset(preset_name)
    effects = effects or Effects.full(CAPACITY)
    options = CompileOptions(sweep_above_shapes=0 if sweeps else CAPACITY.shapes)
    assert constants(KernelVariant.of(CAPACITY, settings, effects, options))["SWEEP"] == sweeps
    backend = functools.partial(WarpBackend, options=options)
    return Engine(CAPACITY, settings=settings, effects=effects, backend=backend)


def fill(
    b: SceneBuilder, place: Callable[[int], tuple[float, float]], *, count: int = 36, size: float = 0.5, **options
) -> BuiltWorld:
    """Balls and boxes in turns."""
    for i in range(count):
        if i % 2:
            b.add_box(width=size, height=size, position=place(i), restitution=0.3, **options)
        else:
            b.add_circle(radius=size / 2, position=place(i), restitution=0.3, **options)
    return b.build()


def boxed_in(b: SceneBuilder, x: float = 0.0, y: float = 0.0, width: float = 4.0) -> SceneBuilder:
    """Thin walls all around, 0.2 m thick, the floor at y."""
    for side in (-1, 1):
        b.add_box(width=0.2, height=width, position=(x + side * width / 2, y + width / 2), fixed=True)
    for level in (0, width):
        b.add_box(width=width, height=0.2, position=(x, y + level), fixed=True)
    return b


def grid(columns: int, spacing: float, x: float = 0.0, y: float = 0.0) -> Callable[[int], tuple[float, float]]:
    return lambda i: (x + (i % columns - (columns - 1) / 2) * spacing, y + (i // columns + 0.5) * spacing)


def at_speed(speed: float, spin: float) -> BuiltWorld:
    """A closed box in which every body flies and spins."""
    b, random = boxed_in(SceneBuilder(CAPACITY), width=8.0), np.random.default_rng(0)
    place = grid(6, 1.2, y=0.2)
    for i in range(30):
        angle = random.uniform(0, 2 * np.pi)
        velocity = (speed * np.cos(angle), speed * np.sin(angle))
        spinning = random.uniform(-spin, spin)
        if i % 2:
            b.add_box(width=0.9, height=0.1, position=place(i), velocity=velocity, angular_velocity=spinning)
        else:
            b.add_circle(radius=0.1, position=place(i), velocity=velocity, angular_velocity=spinning, restitution=0.9)
    return b.build()


def on_floor(width: float, x: float = 0.0, y: float = 0.0) -> SceneBuilder:
    b = SceneBuilder(CAPACITY)
    b.add_box(width=width, height=1.0, position=(x, y - 0.5), fixed=True)
    return b


def hovering() -> BuiltWorld:
    """Balls at rest about as far above a floor as contacts are prepared from (2 cm), a hundred kilometres away, where
    neighbouring numbers are 1/128 m apart."""
    b = SceneBuilder(CAPACITY, gravity=(0, 0))
    b.add_box(width=40, height=1, position=(1e5, 1e5 - 0.5), fixed=True)
    for i, gap in enumerate(np.linspace(0.018, 0.022, CAPACITY.circles)):
        height = (26 + i) / 128
        b.add_circle(radius=height - gap, position=(1e5 + i - 10, 1e5 + height))
    return b.build()


def with_nan(world: BuiltWorld) -> BuiltWorld:
    """World with two lost bodies: one in position, one in velocity."""
    world.position[CAPACITY.polygons + 3, 0] = np.nan
    world.velocity[5] = np.nan
    return world


WORLDS = {
    "heap": lambda: fill(boxed_in(SceneBuilder(CAPACITY)), grid(6, 0.55, y=0.2), count=32),
    "row on a floor of ten kilometres": lambda: fill(on_floor(1e4), grid(36, 1.0)),
    "tower": lambda: fill(on_floor(4.0), grid(1, 0.6)),
    "far from the origin": lambda: fill(on_floor(20.0, 1e4, -1e4), grid(9, 0.6, 1e4, -1e4)),
    "far from the origin, at the distance of preparation": hovering,
    "fast": lambda: at_speed(90.0, 45.0),
    "slow and spinning": lambda: at_speed(3.0, 20.0),
    "all in one place": lambda: fill(on_floor(20.0), lambda i: (0.0, 1.0 + 1e-3 * i)),
    "most slots unused": lambda: fill(on_floor(4.0), grid(3, 0.52), count=9),
    "no gravity, nothing touches": lambda: fill(SceneBuilder(CAPACITY, gravity=(0, 0)), grid(6, 2.0)),
    "two bodies lost": lambda: with_nan(fill(on_floor(20.0), grid(9, 0.6))),
}


@functools.cache
def motion(preset_name: str, *, sweeps: bool) -> dict[str, np.ndarray]:
    """Motion of all worlds as one batch, every field of state and touching after each of 240 steps: [step, world,
    ...]."""
    engine = engine_of(preset_name, sweeps=sweeps)
    worlds = [make() for make in WORLDS.values()]
    scene = stack_worlds([world.scene for world in worlds])
    state = stack_worlds([engine.initial_state(*world) for world in worlds])
    controls = engine.no_controls(len(worlds))

    @jax.jit
    def simulate(scene, state):
        packed_scene = engine.pack_scene(scene)

        def body(packed, _):
            packed, touching = engine.step_packed(packed_scene, packed, controls)
            return packed, (engine.unpack_state(packed), touching)

        return jax.lax.scan(body, engine.pack_state(state), length=STEPS)[1]

    state, touching = jax.device_get(simulate(scene, state))
    return {name: x for name, x in (vars(state) | vars(touching)).items() if x is not None}


@pytest.mark.parametrize("preset_name", ["standard", "paper"])
@pytest.mark.parametrize("name", WORLDS)
def test_sweep_is_bitwise_the_test_of_every_pair(name: str, preset_name: str) -> None:
    world = list(WORLDS).index(name)
    swept, tested = (motion(preset_name, sweeps=sweeps) for sweeps in (True, False))
    for field in tested:
        np.testing.assert_array_equal(swept[field][:, world], tested[field][:, world], err_msg=field)
    if preset_name == "standard":  # the other prepares no contact before shapes touch
        assert (swept["contact_key"][:, world] >= 0).any() == (name != "no gravity, nothing touches")


def test_several_steps_a_call_are_bitwise_single_steps() -> None:
    """The order of a sweep stays from step to step of a call; who touched is gathered over them."""
    engine = engine_of("standard", sweeps=True)
    worlds = [make() for make in WORLDS.values()]
    scene = stack_worlds([world.scene for world in worlds])
    state = stack_worlds([engine.initial_state(*world) for world in worlds])
    last, touching = jax.jit(lambda scene, state: engine.step(scene, state, num_steps=STEPS))(scene, state)
    single = motion("standard", sweeps=True)
    np.testing.assert_array_equal(last.position, single["position"][-1])
    np.testing.assert_array_equal(touching.at_end, single["at_end"][-1])
    np.testing.assert_array_equal(touching.during, np.bitwise_or.reduce(single["during"]))


def test_sweep_knows_shapes_by_slot_where_slots_are_left_out() -> None:
    """Circles keep their slots behind the polygons that an engine for these effects has no slots for."""
    world = WORLDS["most slots unused"]()
    effects = effects_of(world.scene)
    assert effects.polygon_slots < CAPACITY.polygons
    engine = engine_of("standard", sweeps=True, effects=effects)
    scene, state = stack_worlds([world.scene]), stack_worlds([engine.initial_state(*world)])
    last, touching = engine.step(scene, state, num_steps=STEPS)
    tested, index = motion("standard", sweeps=False), list(WORLDS).index("most slots unused")
    np.testing.assert_array_equal(last.position[0], tested["position"][-1, index])
    np.testing.assert_array_equal(last.contact_key[0], tested["contact_key"][-1, index])
    np.testing.assert_array_equal(touching.at_end[0], tested["at_end"][-1, index])
