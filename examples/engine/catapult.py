"""A scene of one's own in 10,000 variations: how far does a falling box throw a ball with a lever?

    python examples/engine/catapult.py --to catapult.png

One world is built by hand; the batch varies where the box falls from and where it hits the lever. All variations are
simulated in one call, and two pictures are drawn: the distance over the two parameters, and the best throw.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from jax2d import BuiltWorld, Capacity, Engine, Scene, SceneBuilder, State
from jax2d.draw import draw
from jax2d.images import film_strip, write_png

CAPACITY = Capacity(polygons=5, circles=1, joints=1, thrusters=0)
SECONDS, STEPS_A_SECOND = 4.0, 60
LEVER_HALF_LENGTH_M = 2.0


def build() -> tuple[BuiltWorld, int, int]:
    """(world, index of the box, index of the ball); the box hangs 2 m above the left end of the lever."""
    b = SceneBuilder(CAPACITY)
    b.add_box(width=60, height=1, position=(20, -0.5), fixed=True)
    pivot = b.add_polygon([(-0.3, 0), (0.3, 0), (0, 0.5)], fixed=True)
    lever = b.add_box(width=2 * LEVER_HALF_LENGTH_M, height=0.1, position=(0, 0.55))
    b.add_revolute_joint(pivot, lever, at=(0, 0.5), limits=(-0.22, 0.22))
    box = b.add_box(width=0.6, height=0.6, position=(-1.5, 2.9), density=4.0)
    b.add_box(width=0.1, height=0.2, position=(LEVER_HALF_LENGTH_M - 0.05, 0.7), fixed=False)  # keeps the ball on
    ball = b.add_circle(radius=0.15, position=(LEVER_HALF_LENGTH_M - 0.35, 0.75), density=1.0)
    return b.build(), box, ball


def vary(world: BuiltWorld, box: int, engine: Engine, per_axis: int) -> tuple[Scene, State, np.ndarray]:
    """A batch of per_axis^2 worlds: (scenes, states, [num_worlds, 2] height of fall and distance from the pivot, m)."""
    heights, offsets = np.meshgrid(np.linspace(0.3, 5.0, per_axis), np.linspace(0.5, 1.9, per_axis), indexing="ij")
    num_worlds = per_axis**2
    scene = jax.tree.map(lambda x: np.broadcast_to(x, (num_worlds, *x.shape)), world.scene)
    position = np.repeat(world.position[None], num_worlds, axis=0)
    position[:, box, 0] = -offsets.ravel()
    position[:, box, 1] = 0.9 + heights.ravel()
    return scene, engine.initial_state(scene, position), np.stack([heights.ravel(), offsets.ravel()], axis=1)


def simulate(engine: Engine, scene: Scene, state: State, ball: int) -> tuple[jax.Array, jax.Array]:
    """(farthest x of the ball in flight [num_worlds], positions and angles of all shapes [steps, num_worlds, n, 3])."""
    packed_scene = engine.pack_scene(scene)
    controls = engine.no_controls(state.position.shape[0])

    def step(packed, _):
        packed, touching = engine.step_packed(packed_scene, packed, controls)
        position, angle, _, _ = engine.bodies(packed)
        on_ground = (touching.at_end[:, ball, 0] & 1) > 0  # bit 0: the ground
        return packed, (jnp.concatenate([position, angle[..., None]], axis=-1), on_ground)

    steps = round(SECONDS * STEPS_A_SECOND)
    _, (path, on_ground) = jax.lax.scan(step, engine.pack_state(state), length=steps)
    landed = jnp.cumsum(on_ground, axis=0) > 0
    in_flight = jnp.where(landed, -jnp.inf, path[:, :, ball, 0])
    return in_flight.max(axis=0), path


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--to", type=Path, default=Path("catapult.png"))
    parser.add_argument("--per-axis", type=int, default=100, help="variations of each of the two parameters")
    args = parser.parse_args()
    world, box, ball = build()
    engine = Engine(CAPACITY)
    scene, state, parameters = vary(world, box, engine, args.per_axis)
    run = jax.jit(lambda scene, state: simulate(engine, scene, state, ball))
    jax.block_until_ready(run(scene, state))  # compiles
    start = time.perf_counter()
    distance, path = jax.block_until_ready(run(scene, state))
    seconds = time.perf_counter() - start
    distance, path = np.asarray(distance), np.asarray(path)
    best = int(np.argmax(distance))
    steps = len(distance) * path.shape[0]
    print(f"{len(distance):,} variations, {steps:,} physics steps in {seconds:.2f} s ({steps / seconds:,.0f} a second)")
    print(
        f"farthest {distance[best]:.2f} m: fall {parameters[best, 0]:.2f} m, {parameters[best, 1]:.2f} m from the pivot"
    )
    write_png(args.to, strip(world.scene, path[:, best], ball))
    chart(args.to.with_name(args.to.stem + "_map.png"), distance.reshape(args.per_axis, -1))


def strip(scene: Scene, path: np.ndarray, ball: int) -> np.ndarray:
    """Five moments of one throw."""
    roles = np.zeros(CAPACITY.shapes, np.int32)
    roles[ball] = 1
    images, captions = [], []
    for step in np.linspace(0, 150, 5).astype(int):
        pose = dataclasses.make_dataclass("Pose", ["position", "angle"])(path[step, :, :2], path[step, :, 2])
        trails = [path[: step + 1, ball, :2]]
        images.append(draw(scene, pose, roles, view=(-3, -0.3, 9, 10), pixels_per_metre=26, trails=trails))
        captions.append(f"{step / STEPS_A_SECOND:.2f} s")
    return film_strip(images, captions)


def chart(path: Path, distance: np.ndarray) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(6, 4), layout="constrained")
    image = axes.imshow(distance, origin="lower", aspect="auto", extent=(0.5, 1.9, 0.3, 5.0))
    axes.set(
        xlabel="distance of the box from the pivot, m", ylabel="height of fall, m", title="how far the ball flies, m"
    )
    figure.colorbar(image)
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
