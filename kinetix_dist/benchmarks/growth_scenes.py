"""Worlds of the growth benchmark: scenes with any number of shapes, and starts of levels and of settled scenes.

All shapes of a scene are active. Bodies alternate between boxes and balls, about 0.6 m large, dropped from up to half a
metre so that no two land at the same moment.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jax2d import BuiltWorld, Capacity, Controls, Engine, SceneBuilder
from jax2d.scene import stack_worlds
from jax2d.world_order import structure_of
from kinetix_dist import prng
from kinetix_dist.benchmarks.engine_worlds import in_order, take_worlds
from kinetix_dist.level.level import Level

BODY_M = 0.6
SPACING_M = 1.5  # from centre to centre of bodies that are to stay apart
BODIES_PER_PLATFORM = 15
MIN_SHAPES = 4


def capacity_of(num_shapes: int) -> Capacity:
    """Polygons and circles by halves, two polygons more for floors and walls; no joints or thrusters."""
    if num_shapes < MIN_SHAPES:
        raise ValueError(f"a world of {num_shapes} shapes was requested; these worlds have {MIN_SHAPES} or more")
    return Capacity(polygons=num_shapes // 2 + 1, circles=(num_shapes + 1) // 2 - 1, joints=0, thrusters=0)


def row(num_shapes: int, seed: int = 0) -> BuiltWorld:
    """Bodies in one row on one floor under all of them."""
    layout = _Layout(num_shapes, seed)
    bodies = num_shapes - 1
    layout.add_floor(0.0, 0.0, width=SPACING_M * (bodies + 1))
    for i in range(bodies):
        layout.add_body((i - 0.5 * (bodies - 1)) * SPACING_M, 0.0)
    return layout.builder.build()


def platforms(num_shapes: int, seed: int = 0) -> BuiltWorld:
    """Floors above each other, 15 bodies on each."""
    layout = _Layout(num_shapes, seed)
    left = num_shapes
    storey = 0
    while left > 1:
        bodies = min(BODIES_PER_PLATFORM, left - 1)
        layout.add_floor(0.0, 2.0 * storey, width=SPACING_M * (BODIES_PER_PLATFORM + 1))
        for i in range(bodies):
            layout.add_body((i - 0.5 * (bodies - 1)) * SPACING_M, 2.0 * storey)
        left -= bodies + 1
        storey += 1
    if left:
        layout.add_body(0.0, 2.0 * storey)
    return layout.builder.build()


def heap(num_shapes: int, seed: int = 0) -> BuiltWorld:
    """Bodies that fall into a box and pile up there, about twice as wide as high."""
    layout = _Layout(num_shapes, seed)
    bodies = num_shapes - 3
    columns = max(2, round((2 * bodies) ** 0.5))
    width = columns * BODY_M * 1.2
    layout.add_floor(0.0, 0.0, width=width + 2)
    for side in (-1, 1):
        layout.add_wall(side * (0.5 * width + 0.5), height=2 * width + 4)
    for i in range(bodies):
        layout.add_body((i % columns - 0.5 * (columns - 1)) * BODY_M * 1.15, (i // columns) * BODY_M * 1.3)
    return layout.builder.build()


SCENES: dict[str, Callable[..., BuiltWorld]] = {"row": row, "platforms": platforms, "heap": heap}


class _Layout:
    """Places floors, walls and bodies until a world of `num_shapes` shapes is full."""

    def __init__(self, num_shapes: int, seed: int) -> None:
        self.builder = SceneBuilder(capacity_of(num_shapes))
        self._random = np.random.default_rng(seed)
        self._boxes = self._balls = 0

    def add_floor(self, x: float, y: float, *, width: float) -> None:
        """A fixed box whose upper side is at y."""
        self._boxes += 1
        self.builder.add_box(width=width, height=0.5, position=(x, y - 0.25), fixed=True)

    def add_wall(self, x: float, *, height: float) -> None:
        self._boxes += 1
        self.builder.add_box(width=1.0, height=height, position=(x, 0.5 * height), fixed=True)

    def add_body(self, x: float, y: float) -> None:
        """A body whose lower end is up to half a metre above y."""
        size = BODY_M * self._random.uniform(0.8, 1.0)
        position = (x, y + 0.5 * BODY_M + self._random.uniform(0.0, 0.5))
        if self._is_ball_next():
            self._balls += 1
            self.builder.add_circle(radius=0.5 * size, position=position, restitution=0.2)
        else:
            self._boxes += 1
            self.builder.add_box(width=size, height=size, position=position, restitution=0.2)

    def _is_ball_next(self) -> bool:
        """Boxes and balls alternate while slots of both are free."""
        capacity = self.builder.capacity
        if self._balls < capacity.circles and self._balls <= self._boxes:
            return True
        return self._boxes >= capacity.polygons


MOMENTS = 16  # of an episode of 512 physics steps
STEPS_BETWEEN_MOMENTS = 32
SETTLING_STEPS = 180  # 3 s
SETTLED_WORLDS = 4  # of one growth scene, with other seeds


@dataclasses.dataclass(frozen=True)
class Start:
    """Packed worlds from which the worlds of a run are taken in order; every leaf has the world axis last."""

    engine: Engine
    scene: Any
    state: Any
    structure: jax.Array  # [worlds, counts], `structure_of` each
    seed: int

    def worlds(self, count: int, order: str) -> tuple[Any, Any]:
        """Scene and state of `count` worlds: drawn at random, and as they were drawn or sorted by structure."""
        available = self.structure.shape[0]
        drawn = np.random.default_rng(self.seed).permutation(available)[np.arange(count) % available]
        numbers = in_order(drawn, self.structure, order)
        return jax.block_until_ready(jax.jit(take_worlds)((self.scene, self.state), numbers))

    @property
    def contacts_per_world(self) -> float:
        """Contacts on average."""
        return float((self.engine.unpack_state(self.state).contact_key >= 0).sum(-1).mean())


def levels_at_all_moments(engine: Engine, levels: Level, seed: int) -> Start:
    """Every level at 16 moments of an episode of random actions."""
    num_levels = len(levels.position)
    scene = engine.pack_scene(levels.scene)
    state = engine.pack_state(
        engine.initial_state(levels.scene, levels.position, levels.angle, levels.velocity, levels.angular_velocity)
    )

    def until_next_moment(packed: Any, key: jax.Array) -> tuple[Any, Any]:
        motor_key, thruster_key = prng.split(key)
        motor = prng.uniform(motor_key, (num_levels, engine.capacity.joints), minval=-1, maxval=1)
        thruster = prng.uniform(thruster_key, (num_levels, engine.capacity.thrusters))
        controls = Controls(motor=motor, thruster=thruster)
        return engine.step_packed(scene, packed, controls, num_steps=STEPS_BETWEEN_MOMENTS)[0], packed

    keys = prng.split(prng.key(seed), MOMENTS)
    moments = jax.jit(lambda packed: jax.lax.scan(until_next_moment, packed, keys)[1])(state)
    joined = jax.tree.map(lambda x: jnp.moveaxis(x, 0, -2).reshape(*x.shape[1:-1], -1), moments)
    scenes = jax.tree.map(lambda x: jnp.tile(x, MOMENTS), scene)  # the world axis is the last one
    return Start(engine, scenes, joined, jnp.tile(structure_of(levels.scene), (MOMENTS, 1)), seed)


def settled_scene(engine: Engine, name: str, seed: int) -> Start:
    """Worlds of a growth scene that fills the engine's capacity, at rest or nearly so."""
    worlds = [SCENES[name](engine.capacity.shapes, seed=seed + i) for i in range(SETTLED_WORLDS)]
    scenes = stack_worlds([world.scene for world in worlds])
    scene = engine.pack_scene(scenes)
    state = engine.pack_state(stack_worlds([engine.initial_state(*world) for world in worlds]))
    settle = jax.jit(partial(engine.step_packed, num_steps=SETTLING_STEPS))
    settled, _ = settle(scene, state, engine.no_controls(SETTLED_WORLDS))
    return Start(engine, scene, settled, structure_of(scenes), seed)
