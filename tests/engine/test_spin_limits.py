"""Limits of speeds and joints together: what a light link cannot follow gives way, and nothing gains energy."""

from __future__ import annotations

import numpy as np
import pytest

from jax2d import BuiltWorld, Capacity, Engine, SceneBuilder, preset
from jax2d.fidelity import record_worlds

CAPACITY = Capacity(polygons=3, circles=1, joints=3, thrusters=0)
LINK, DENSITY = 0.085, 5.0  # m; a bar of 13 g
LIMIT = 50.0  # rad/s


def whirled(speed: float, links: int, angle: float = 0.0) -> BuiltWorld:
    """A disc of 0.3 kg that goes around a pivot at so many m/s, on links too short for that."""
    b = SceneBuilder(CAPACITY, gravity=(0, 0))
    along, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    last = b.add_box(width=0.05, height=0.05, fixed=True)
    shapes, end = [last], np.zeros(2)
    for i in range(links):
        share = (i + 0.5) / links
        link = b.add_box(
            width=LINK, height=0.03, angle=angle, position=tuple(end + along * LINK / 2), density=DENSITY,
            velocity=tuple(across * speed * share),
        )  # fmt: skip
        b.add_revolute_joint(last, link, at=tuple(end))
        end, last = end + along * LINK, link
        shapes.append(link)
    disc = b.add_circle(radius=0.1, position=tuple(end), density=0.3 / (np.pi * 0.01), velocity=tuple(across * speed))
    b.add_revolute_joint(last, disc, at=tuple(end))
    shapes.append(disc)
    for i in range(len(shapes)):
        for j in range(i):
            b.keep_apart(shapes[i], shapes[j])
    return b.build()


@pytest.mark.also_gpu
@pytest.mark.parametrize("backend", ["warp", "xla"])
@pytest.mark.parametrize("links", [1, 2])
@pytest.mark.parametrize("name", ["standard", "fine", "draft"])
def test_a_load_that_a_link_cannot_follow_is_slowed_and_gains_nothing(name: str, links: int, backend: str) -> None:
    """In the soak such an arm got 100 J/kg: its link stayed behind, and the joint pulled the load after it."""
    worlds = [whirled(speed, links, angle) for speed in (6.0, 12.0, 25.0) for angle in (0.0, 1.0)]
    engine = Engine(CAPACITY, settings=preset(name), backend=backend)
    for m in record_worlds(engine, worlds, seconds=1.0):
        energy = np.asarray(m.energy(), np.float64)
        assert energy.max() <= energy[0] * 1.01, energy.max() / energy[0]
        disc = np.asarray(m.velocity)[10:, -1]  # once the limit has acted
        assert np.linalg.norm(disc, axis=-1).max() < 1.2 * LIMIT * LINK * links
