"""Runs exported steps of an engine, as another process wrote them, and prints what they gave.

    python tests/engine/exported_steps_program.py FILE

Another kernel is made first: programs have to find theirs whatever else there is in a process.
"""

from __future__ import annotations

import pickle
import sys
from pathlib import Path

import jax
import numpy as np
from jax import export

from jax2d import Capacity, Engine, SceneBuilder, effects_of, stack_worlds
from jax2d.engine import PackedScene
from jax2d.warp import ffi

CAPACITY = Capacity(polygons=2, circles=2, joints=1, thrusters=0)
NUM_WORLDS = 3


def worlds() -> tuple:
    """A ball that falls on a floor from different heights."""
    found = []
    for number in range(NUM_WORLDS):
        b = SceneBuilder(CAPACITY)
        b.add_box(width=10, height=1, position=(0, -0.5), fixed=True)
        b.add_circle(radius=0.2, position=(0, 0.3 + 0.05 * number), velocity=(1, -1))
        found.append(b.build())
    return tuple(found)


def engine(*, is_full: bool) -> Engine:
    """Engine of all effects, or of those that these worlds call for."""
    scenes = stack_worlds([world.scene for world in worlds()])
    return Engine(CAPACITY, effects=None if is_full else effects_of(scenes))


def packed(one: Engine) -> tuple:
    """(scene, state) as the engine's tables."""
    scenes = stack_worlds([world.scene for world in worlds()])
    states = stack_worlds([one.initial_state(*world) for world in worlds()])
    return one.pack_scene(scenes), one.pack_state(states)


def step(one: Engine, scene: PackedScene, state: ffi.StateTables) -> ffi.StateTables:
    """Three steps of physics."""
    return one.step_packed(scene, state, one.no_controls(NUM_WORLDS), num_steps=3)[0]


def main(path: Path) -> None:
    other = engine(is_full=True)
    step(other, *packed(other))
    program, launches = pickle.loads(path.read_bytes())
    for launch in launches:
        launch.register()
    tables = jax.tree.leaves(packed(engine(is_full=False)))
    for table in export.deserialize(bytearray(program)).call(*tables):
        print(np.asarray(table).tobytes().hex())


if __name__ == "__main__":
    main(Path(sys.argv[1]))
