"""Impacts of one body on the ground and of two bodies."""

from __future__ import annotations

import math

import numpy as np

from jax2d.builder import SceneBuilder
from jax2d.fidelity.closed_forms.form import ClosedForms, distance, relative_error
from jax2d.fidelity.study_scene import Error
from jax2d.fidelity.trajectory import Trajectory, bounce_heights, peak, vertex

FORMS = ClosedForms()


def _bounce(b: SceneBuilder, restitution: float) -> int:
    """A ball of 0.1 m radius that falls 1 m."""
    b.add_box(width=10, height=1, position=(0, -0.5), fixed=True, restitution=restitution)
    return b.add_circle(radius=0.1, position=(0, 1.0 + 0.1), restitution=restitution)


def _heights(trajectory: Trajectory, ball: int) -> list[float]:
    """Heights of the ball after each bounce, m."""
    return bounce_heights(trajectory.position[:, ball, 1] - 0.1, trajectory.velocity[:, ball, 1])


@FORMS.add("bounce_e0.8", metric="largest error of three heights / e^2n h0", seconds=2.1)
def bounce(b: SceneBuilder) -> Error:
    e = 0.8
    ball = _bounce(b, e)

    def error(trajectory: Trajectory) -> float:
        heights = [*_heights(trajectory, ball), 0.0, 0.0, 0.0]
        return max(relative_error(heights[n], e ** (2 * n + 2)) for n in range(3))

    return error


@FORMS.add("bounce_e0.5", metric="height error / e^2 h0", seconds=1.0)
def bounce_half(b: SceneBuilder) -> Error:
    ball = _bounce(b, 0.5)

    def error(trajectory: Trajectory) -> float:
        heights = [*_heights(trajectory, ball), 0.0]
        return relative_error(heights[0], 0.25)

    return error


@FORMS.add("bounce_elastic", metric="largest height error in 10 s / h0 (e = 1)", seconds=10.0)
def bounce_elastic(b: SceneBuilder) -> Error:
    ball = _bounce(b, 1.0)

    def error(trajectory: Trajectory) -> float:
        return max((abs(height - 1.0) for height in _heights(trajectory, ball)), default=1.0)

    return error


@FORMS.add("flat_bounce", metric="height error / e^2 h0, plus turn / 1 rad (a box that lands flat)", seconds=0.9)
def flat_bounce(b: SceneBuilder) -> Error:
    e, height = 0.5, 1.0
    b.add_box(width=10, height=1, position=(0, -0.5), fixed=True, restitution=e)
    box = b.add_box(width=0.4, height=0.2, position=(0, height + 0.1), restitution=e)

    def error(trajectory: Trajectory) -> float:
        after = trajectory.time > 0.5  # it falls until 0.45 s and is down again at 0.9 s
        height_after = trajectory.position[after, box, 1] - 0.1
        top = int(np.argmax(height_after))
        return relative_error(vertex(height_after, top), e**2 * height) + abs(trajectory.angle[after, box][top])

    return error


@FORMS.add("welded_bounce", metric="height error / e^2 h0 (a disc with a box welded on it)", seconds=0.9)
def welded_bounce(b: SceneBuilder) -> Error:
    e, height, radius = 0.5, 1.0, 0.1
    b.add_box(width=10, height=1, position=(0, -0.5), fixed=True, restitution=e)
    disc = b.add_circle(radius=radius, position=(0, height + radius), restitution=e)
    box = b.add_box(width=0.4, height=0.2, position=(0, height + 3 * radius), restitution=e)
    b.add_fixed_joint(disc, box, at=(0, height + 2 * radius))

    def error(trajectory: Trajectory) -> float:
        # It falls until 0.45 s and is down again at 0.9 s.
        after = trajectory.position[trajectory.time > 0.5, disc, 1] - radius
        return relative_error(peak(after), e**2 * height)

    return error


@FORMS.add("collision", metric="largest position error / relative distance travelled", seconds=0.6, gravity=0.0)
def collision(b: SceneBuilder) -> Error:
    e, radius, mass_ratio = 0.5, 0.2, 3.0
    light = b.add_circle(radius=radius, position=(-0.5, 0), velocity=(2, 0), restitution=e, friction=0)
    heavy = b.add_circle(
        radius=radius, position=(0.5, 0), velocity=(-1, 0), density=mass_ratio, restitution=e, friction=0
    )
    impact = (1.0 - 2 * radius) / 3.0  # s: the gap over the approach speed
    common = (2.0 - mass_ratio) / (1 + mass_ratio)
    light_after = common - mass_ratio * e * 3.0 / (1 + mass_ratio)
    heavy_after = common + e * 3.0 / (1 + mass_ratio)

    def error(trajectory: Trajectory) -> float:
        t = trajectory.time[-1]
        at_light = -0.5 + 2.0 * impact + light_after * (t - impact)
        at_heavy = 0.5 - 1.0 * impact + heavy_after * (t - impact)
        end = trajectory.position[-1]
        return max(distance(end[light], (at_light, 0.0)), distance(end[heavy], (at_heavy, 0.0))) / (3.0 * t)

    return error


@FORMS.add("collision_off_centre", metric="largest velocity error / approach speed", seconds=0.8, gravity=0.0)
def collision_off_centre(b: SceneBuilder) -> Error:
    e, radius, speed = 0.5, 0.2, 2.0
    mover = b.add_circle(radius=radius, position=(-0.8, 0), velocity=(speed, 0), restitution=e, friction=0)
    rester = b.add_circle(radius=radius, position=(0, radius), restitution=e, friction=0)
    normal = np.array([math.cos(math.pi / 6), math.sin(math.pi / 6)])  # offset r between centres 2 r apart
    given = (1 + e) / 2 * speed * normal[0] * normal

    def error(trajectory: Trajectory) -> float:
        stayed = distance(trajectory.velocity[-1, mover], np.array([speed, 0.0]) - given)
        return max(stayed, distance(trajectory.velocity[-1, rester], given)) / speed

    return error


@FORMS.add("bounce_oblique", metric="error of (vx, vy, w r) / speed", seconds=0.6, gravity=0.0)
def bounce_oblique(b: SceneBuilder) -> Error:
    e, mu, radius = 0.8, 0.2, 0.2
    b.add_box(width=20, height=1, position=(0, -0.5), fixed=True, restitution=e, friction=mu)
    disc = b.add_circle(radius=radius, position=(0, radius + 0.5), velocity=(3, -2), restitution=e, friction=mu)
    lost = mu * (1 + e) * 2.0  # m/s, to friction; the contact slides throughout since 3 x this < 3 m/s

    def error(trajectory: Trajectory) -> float:
        after = np.array([*trajectory.velocity[-1, disc], trajectory.angular_velocity[-1, disc] * radius])
        return distance(after, (3.0 - lost, e * 2.0, -2 * lost)) / math.hypot(3, 2)

    return error
