"""A belt brings boxes to a lift, and the lift brings them to a platform that drives away.

    python examples/engine/platforms.py --to platforms.png

The belt and the lift's floor have a surface speed; lift and platform are kinematic: they move with the velocity of the
state, which is set between steps here, and nothing pushes them.
"""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from jax2d import BuiltWorld, Capacity, Engine, SceneBuilder, State
from jax2d.draw import draw
from jax2d.images import film_strip, write_png

CAPACITY = Capacity(polygons=6, circles=0, joints=0, thrusters=0, extended_shapes=True)
SECONDS, STEPS_A_SECOND = 7, 60
TOP_M = 1.6  # where the platform waits
LEAVES_S, ARRIVES_S, AWAY_S = 2.2, 3.85, 5.0  # the lift at 1 m/s, then the platform


def build() -> tuple[BuiltWorld, int, int, list[int]]:
    """(world, index of the lift, of the platform, of the boxes)."""
    b = SceneBuilder(CAPACITY)
    b.add_box(width=4, height=0.3, position=(-2, -0.15), fixed=True, surface_speed=1.2)
    b.add_box(width=0.1, height=TOP_M, position=(1.31, TOP_M / 2 - 0.15), fixed=True)
    lift = b.add_box(width=1.2, height=0.3, position=(0.63, -0.15), kinematic=True, surface_speed=1.0)
    platform = b.add_box(width=2.5, height=0.2, position=(2.63, TOP_M - 0.15), kinematic=True)
    boxes = [b.add_box(width=0.35, height=0.35, position=(x, 0.18)) for x in (-1.2, -1.8)]
    return b.build(), lift, platform, boxes


def simulate(engine: Engine, world: BuiltWorld, lift: int, platform: int) -> State:
    """States after every step, [steps, ...] on every field."""

    @jax.jit
    def run(state: State) -> State:
        def step(state: State, seconds: jax.Array) -> tuple[State, State]:
            rises = (seconds >= LEAVES_S) & (seconds < ARRIVES_S)
            velocity = state.velocity.at[lift].set(jnp.array([0.0, 1.0]) * rises)
            velocity = velocity.at[platform].set(jnp.array([0.7, 0.0]) * (seconds >= AWAY_S))
            state, _ = engine.step(world.scene, dataclasses.replace(state, velocity=velocity))
            return state, state

        times = jnp.arange(SECONDS * STEPS_A_SECOND) / STEPS_A_SECOND
        return jax.lax.scan(step, state, times)[1]

    return jax.device_get(run(engine.initial_state(*world)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--to", type=Path, default=Path("platforms.png"))
    args = parser.parse_args()
    world, lift, platform, boxes = build()
    states = simulate(Engine(CAPACITY), world, lift, platform)
    roles = np.zeros(CAPACITY.shapes, np.int32)
    roles[boxes] = [1, 2]
    images, captions = [], []
    for seconds in (0.0, 2.0, 3.2, 6.5):
        index = max(0, round(seconds * STEPS_A_SECOND) - 1)
        state = jax.tree.map(lambda x, index=index: x[index], states)
        images.append(draw(world.scene, state, roles, view=(-4.2, -0.6, 5.6, 2.6), pixels_per_metre=40))
        captions.append(f"{seconds:.1f} s")
    write_png(args.to, film_strip(images, captions, columns=2))
    last = jax.tree.map(lambda x: x[-1], states)
    rides = [box for box in boxes if abs(last.position[box] - last.position[platform])[0] < 1.25]
    print(f"{len(rides)} boxes ride on the platform at {last.velocity[rides, 0].mean():.2f} m/s")


if __name__ == "__main__":
    main()
