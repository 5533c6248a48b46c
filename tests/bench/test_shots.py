"""Shots are judged by geometry: what flies through a wall is found, what stops at it is not."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from bench.shots import CAPACITY, TARGETS, Shots, fly, judge
from jax2d import Engine, preset


@pytest.fixture(scope="module")
def engine() -> Engine:
    return Engine(CAPACITY, settings=preset("standard"))


def unstopped(shots: Shots) -> Shots:
    """The same shots and walls, if neither touched the other: what they did in the first step they do in all."""
    seconds = 1 / 60 * np.arange(len(shots.position))[:, None, None]
    return dataclasses.replace(
        shots,
        position=shots.position[0] + seconds[..., None] * shots.velocity[0],
        angle=shots.angle[0] + seconds * shots.spin[0],
        velocity=np.broadcast_to(shots.velocity[0], shots.velocity.shape),
        spin=np.broadcast_to(shots.spin[0], shots.spin.shape),
    )


@pytest.mark.parametrize("target", TARGETS)
def test_most_shots_would_pass_were_they_not_stopped(engine, target: str):
    shots = fly(engine, target, 0.1, is_box=False, number=100, seed=0)
    counts, passed = judge(unstopped(shots))
    assert counts.mean() > 0.7 and passed.sum() > (0.4 if target == "gap" else 0.5) * counts.sum()


@pytest.mark.also_gpu
@pytest.mark.parametrize(
    ("target", "size", "is_box"),
    [
        ("gap", 0.1, False),  # half as wide as the disc: 4 of 5,000 passed before grazing its corner led onto the face
        ("free wall", 0.1, False),
        ("hinged wall", 0.03, False),
        ("turning bar", 0.03, False),  # 4 % passed before its turning was foreseen
        ("turning bar", 0.03, True),  # 5 %
    ],
)
def test_nothing_passes(engine, target: str, size: float, is_box: bool):
    counts, passed = judge(fly(engine, target, size, is_box=is_box, number=1500, seed=0))
    assert counts.sum() > 1000 and passed.sum() == 0
