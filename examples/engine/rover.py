"""A rover with two driven wheels on hilly terrain, and what its lidar sees.

    python examples/engine/rover.py --to docs/images/rover.png

Terrain from a line of points, wheels on motors, a policy that drives until 6 m, rays cast from a mast, contact report.
"""

from __future__ import annotations

import argparse
import math

import jax.numpy as jnp
import numpy as np

from jax2d import Capacity, Controls, Engine, SceneBuilder, cast_rays, record
from jax2d.draw import draw
from jax2d.images import write_png

CAPACITY = Capacity(polygons=42, circles=3, joints=2, thrusters=0, vertices=6)
LIDAR_RAYS, LIDAR_RANGE_M = 40, 3.0
GOAL_M = 6.0


def build():
    """(world, index of the rover's body)."""
    builder = SceneBuilder(CAPACITY)
    x = np.arange(0, 10.01, 0.25)
    heights = 0.25 * np.sin(1.1 * x) + 0.08 * np.sin(3.1 * x + 1)
    builder.add_terrain(np.stack([x, heights], -1), thickness=0.6)
    body = builder.add_box(width=0.9, height=0.2, position=(1.2, 0.95), density=2)
    for dx in (-0.35, 0.35):
        wheel = builder.add_circle(radius=0.18, position=(1.2 + dx, 0.75))
        builder.add_revolute_joint(body, wheel, at=(1.2 + dx, 0.75), motor_speed=-1.5, motor_power=0.4)
    builder.add_circle(radius=0.25, position=(7.6, 0.7), density=0.3)
    return builder.build(), body


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--to", default="rover.png", help="where the picture goes")
    path = parser.parse_args().to
    world, body = build()
    engine = Engine(CAPACITY, report_contacts=True)

    def drive(state, time):
        forward = jnp.where(state.position[body, 0] < GOAL_M, 1.0, 0.0)
        return Controls(motor=jnp.full(CAPACITY.joints, forward), thruster=jnp.zeros(0))

    trajectory, state = record(
        engine, world.scene, engine.initial_state(*world), drive, num_samples=240, every=1, contacts=True
    )
    mast = state.position[body] + 0.5 * jnp.stack([-jnp.sin(state.angle[body]), jnp.cos(state.angle[body])])
    angles = jnp.linspace(-math.pi, 0, LIDAR_RAYS)
    ways = LIDAR_RANGE_M * jnp.stack([jnp.cos(angles), jnp.sin(angles)], -1)
    is_own = jnp.zeros(CAPACITY.shapes, bool).at[jnp.array([body, CAPACITY.polygons, CAPACITY.polygons + 1])].set(True)
    hits = cast_rays(world.scene, state, jnp.broadcast_to(mast, ways.shape), ways, ignore=is_own)

    rays = [np.stack([mast, point]) for point in np.asarray(hits.point)]
    way = trajectory.position[:, body]
    image = draw(world.scene, state, view=(1.0, -1.0, 9.0, 2.0), pixels_per_metre=110, trails=[*rays, way])
    write_png(path, image)
    wheels = CAPACITY.polygons + np.arange(2)
    assert trajectory.contacts is not None
    touches = trajectory.contacts.impulse_on(CAPACITY.shapes)[-1, wheels, 1] / engine.settings.dt
    print(f"the rover is at x = {way[-1, 0]:.2f} m after {trajectory.time[-1]:.0f} s; wheels bear {touches.round(1)} N")
    print(
        f"{int(hits.hit.sum())} of {LIDAR_RAYS} rays meet something, the nearest at {float(hits.distance.min()):.2f} m"
    )
    print(f"wrote {path}")


if __name__ == "__main__":
    main()
