"""Stepping the engine alone: a scene, a thousand worlds that differ, one compiled loop, a picture.

    python examples/step_engine.py --to pendulum.png

A pendulum swings from 1,024 starting angles. The engine knows nothing of levels, roles or policies.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import jax
import numpy as np

from jax2d import Capacity, Engine, SceneBuilder
from jax2d.draw import draw
from jax2d.images import write_png
from jax2d.scene import index_worlds

LENGTH_M, RADIUS_M = 1.0, 0.15
CAPACITY = Capacity(polygons=1, circles=1, joints=1, thrusters=0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--to", type=Path, default=Path("pendulum.png"))
    parser.add_argument("--worlds", type=int, default=1024)
    args = parser.parse_args()

    # A scene says what exists: a fixed block, a ball below it, a joint at the block's centre.
    builder = SceneBuilder(CAPACITY)
    block = builder.add_box(width=0.2, height=0.2, position=(0, 0), fixed=True)
    ball = builder.add_circle(radius=RADIUS_M, position=(0, -LENGTH_M))
    builder.add_revolute_joint(block, ball, at=(0, 0))
    scene, position, *_ = builder.build()

    # A state says how it moves. Every world has the same scene and another starting angle.
    angles = np.linspace(0.05, 1.5, args.worlds)
    scenes = jax.tree.map(lambda x: np.broadcast_to(x, (args.worlds, *x.shape)), scene)
    positions = np.repeat(position[None], args.worlds, axis=0)
    positions[:, ball] = LENGTH_M * np.stack([np.sin(angles), -np.cos(angles)], axis=-1)
    engine = Engine(CAPACITY)
    rotations = np.zeros(positions.shape[:2])
    rotations[:, ball] = angles
    state = engine.initial_state(scenes, positions, rotations)

    # All worlds step together, 3 seconds of 60 steps, in one loop.
    packed_scene, controls = engine.pack_scene(scenes), engine.no_controls(args.worlds)

    @jax.jit
    def simulate(packed):
        def step(packed, _):
            packed, _ = engine.step_packed(packed_scene, packed, controls)
            return packed, engine.bodies(packed)[0][:, ball]

        return jax.lax.scan(step, packed, length=180)

    packed, path = simulate(engine.pack_state(state))
    # A quarter of a period ends where the ball passes its lowest point.
    quarter_s = np.argmax(np.asarray(path)[:, :, 0] <= 0, axis=0) * engine.settings.dt
    gravity = float(np.abs(scene.gravity[1]))
    small_s = 2 * math.pi * math.sqrt((LENGTH_M**2 + RADIUS_M**2 / 2) / (gravity * LENGTH_M))
    print(f"{args.worlds} pendulums; small-angle formula: {small_s:.2f} s")
    for world in (0, -1):
        print(f"period from {angles[world]:.2f} rad: {4 * quarter_s[world]:.2f} s")

    write_png(args.to, draw(scene, index_worlds(engine.unpack_state(packed), -1), view=(-1.5, -1.4, 1.5, 0.4)))
    print(f"wrote {args.to}")


if __name__ == "__main__":
    main()
