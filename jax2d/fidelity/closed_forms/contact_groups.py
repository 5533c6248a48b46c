"""Contacts of several bodies at once: a stack at rest, Newton's cradle."""

from __future__ import annotations

import math

from jax2d.builder import SceneBuilder
from jax2d.fidelity.closed_forms.form import ClosedForms, distance, relative_error
from jax2d.fidelity.study_scene import Error
from jax2d.fidelity.trajectory import Trajectory, peak

FORMS = ClosedForms()


@FORMS.add("stack_rest", metric="farthest box from where it stood after 5 s / box width", seconds=5.0)
def stack_rest(b: SceneBuilder) -> Error:
    width = 0.5
    b.add_box(width=10, height=1, position=(0, -0.5), fixed=True)
    boxes = [b.add_box(width=width, height=width, position=(0, width * (i + 0.5))) for i in range(5)]
    return lambda trajectory: (
        max(distance(trajectory.position[-1, i], trajectory.position[0, i]) for i in boxes) / width
    )


@FORMS.add(
    "newtons_cradle", metric="highest angle of the last ball / first - 1 (approximate: gaps of 2 mm)", seconds=1.2
)
def newtons_cradle(b: SceneBuilder) -> Error:
    radius, gap, length, swing = 0.1, 0.002, 1.0, 0.5
    ceiling = b.add_box(width=3, height=0.2, position=(0, 0.1), fixed=True)
    balls = []
    for i, angle in enumerate((-swing, 0.0, 0.0)):
        x = i * (2 * radius + gap)
        at = (x + length * math.sin(angle), -length * math.cos(angle))
        ball = b.add_circle(radius=radius, position=at, restitution=1.0, friction=0.0)
        b.add_revolute_joint(ceiling, ball, at=(x, 0))
        balls.append(ball)

    def error(trajectory: Trajectory) -> float:
        return relative_error(peak(trajectory.angle[:, balls[-1]]), swing)

    return error
