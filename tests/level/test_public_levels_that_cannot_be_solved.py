"""Five public levels that docs/levels.md says cannot be solved: thrust below weight, over a red floor.

Green hangs in free air, and its two thrusters push through its centre, one up and one to a side. So it moves to the
side by f g and sinks with (1 - f) g at least, and is too low before it touches anything that it may touch.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from kinetix_dist.level.kinetix_format import load_kinetix
from kinetix_dist.level.level import Role
from kinetix_dist.level.walls import FLOOR_TOP_M

GRAVITY_M_S2, THRUST_N = 9.81, 10.0  # of power 1


@pytest.mark.parametrize(
    ("name", "share", "way_m", "room_m"),
    [
        ("h16_thruster_goal", 0.54, 3.73, 1.98),
        ("h11_obstacle_avoidance", 0.36, 2.12, 1.21),
        ("h8_maze_2", 0.49, 3.93, 0.81),
        ("h12_platformer_1", 0.51, 0.60, 0.19),
        ("h13_platformer_2", 0.51, 0.60, 0.19),
    ],
)
def test_green_is_too_low_before_it_touches_anything(
    public_levels: Path, name: str, share: float, way_m: float, room_m: float
) -> None:
    """share: thrust over weight; way_m: to the first shape that is not red; room_m: above the floor or that shape."""
    level = load_kinetix(public_levels / "l" / f"{name}.json")
    shapes, thrusters = level.scene.shapes, level.scene.thrusters
    (green,) = np.flatnonzero(shapes.active & (level.shape_role == Role.GREEN)).tolist()
    assert level.shape_role[0] == Role.RED and not np.any(level.velocity) and not level.scene.joints.active.any()
    weight = GRAVITY_M_S2 / shapes.inverse_mass[green]
    directions = []
    for k in np.flatnonzero(thrusters.active):
        assert thrusters.body[k] == green and thrusters.power[k] * THRUST_N / weight == pytest.approx(share, abs=0.005)
        angle = thrusters.angle[k] + level.angle[green]
        directions.append((np.cos(angle), np.sin(angle)))
        x, y = thrusters.position[k]
        assert abs(x * np.sin(thrusters.angle[k]) - y * np.cos(thrusters.angle[k])) < 0.01  # m, lever about the centre
    (to_the_side,) = [x for x, y in directions if abs(y) < 0.01]
    assert sum(abs(x) < 0.01 and y > 0.99 for x, y in directions) == 1

    reach = _half_width(level, green)
    x, bottom = level.position[green][0] + np.sign(to_the_side) * reach, level.position[green][1] - reach
    way, top = _first_ahead(level, green, float(x), np.sign(to_the_side))
    assert way == pytest.approx(way_m, abs=0.02) and bottom - top == pytest.approx(room_m, abs=0.02)
    assert way * (1.0 - share) / share > bottom - top + 0.2


def _half_width(level: object, shape: int) -> float:
    shapes = level.scene.shapes  # type: ignore[attr-defined]
    num_polygons = len(shapes.num_vertices)
    return float(shapes.radius[shape - num_polygons] if shape >= num_polygons else shapes.vertices[shape][:, 0].max())


def _first_ahead(level: object, green: int, x: float, direction: float) -> tuple[float, float]:
    """m to the nearest shape beside green that it may touch, and how high green has to be then: the top of a platform
    that ends below it, or the floor."""
    shapes = level.scene.shapes  # type: ignore[attr-defined]
    way, top = (5.0 - x if direction > 0 else x), FLOOR_TOP_M
    for slot in np.flatnonzero(shapes.active)[4:]:
        if slot == green or level.shape_role[slot] in (Role.RED, Role.BLUE):  # type: ignore[attr-defined]
            continue
        vertices = shapes.vertices[slot] + level.position[slot]  # type: ignore[attr-defined]
        ahead = float(np.min(direction * (vertices[:, 0] - x)))
        if 0 < ahead < way:
            way, top = ahead, float(vertices[:, 1].max())
    return way, top
