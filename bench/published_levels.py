"""Random levels of the public Kinetix package: draws them there, and describes them in numbers here.

    PEER/bin/python bench/peers/kinetix_levels.py levels_s.npz s 10000 0         # in the package's own environment
    python -m bench.published_levels levels_s.npz levels_m.npz levels_l.npz --to tests/level/data/published_levels.json

The second writes `kinetix_dist.level.statistics` of each file; tests compare our generator "kinetix" with it.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import jax
import numpy as np

from bench.program import exit_code, output_file, parser_of
from jax2d.scene import JointKind
from kinetix_dist.errors import UserError
from kinetix_dist.level import statistics
from kinetix_dist.level.derive import centre_on_mass, derive
from kinetix_dist.level.level import SIZES, Level
from kinetix_dist.level.walls import empty_level

PACKAGE = "kinetix-env 3.0.2 with jax2d 1.0.2"


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("files", nargs="+", type=Path, help="levels_SIZE.npz of the public package")
    parser.add_argument("--to", type=output_file, required=True, help="JSON file to write")
    args = parser.parse_args()
    return exit_code(parser, lambda: describe(args))


def describe(args: argparse.Namespace) -> int:
    described = {}
    for file in args.files:
        if not file.is_file():
            raise UserError(f"{file} does not exist; draw it with bench/peers/kinetix_levels.py")
        size, levels = read_levels(file)
        described[size] = statistics.describe(statistics.statistics(levels))
        print(f"{file}: {len(levels.position)} levels of size {size}, {len(described[size])} statistics")
    args.to.write_text(json.dumps({"package": PACKAGE, "sizes": described}, indent=0) + "\n")
    return 0


def read_levels(file: Path) -> tuple[str, Level]:
    """Size and levels of a file: the same shapes, joints and thrusters in our conventions and canonical form."""
    data = np.load(file)
    num_levels, num_polygons = data["polygon_active"].shape
    size = next(name for name, capacity in SIZES.items() if capacity.polygons == num_polygons)
    level = jax.tree.map(lambda x: np.repeat(x[None], num_levels, axis=0), empty_level(SIZES[size]))
    shapes, joints, thrusters = level.scene.shapes, level.scene.joints, level.scene.thrusters

    def both(name: str) -> np.ndarray:
        return np.concatenate([data[f"polygon_{name}"], data[f"circle_{name}"]], axis=1)

    shapes.active[:] = both("active")
    active = shapes.active
    for ours, theirs in (
        (level.position, "position"),
        (level.angle, "rotation"),
        (level.shape_role, "role"),
        (level.collision_mode, "collision_mode"),
        (shapes.density, "density"),
        (shapes.friction, "friction"),
        (shapes.restitution, "restitution"),
    ):
        ours[active] = both(theirs)[active]
    is_fixed = both("inverse_mass") == 0.0
    corners = np.roll(data["polygon_vertices"][:, :, ::-1], 1, axis=2)  # clockwise there
    is_polygon = data["polygon_active"]
    shapes.vertices[is_polygon] = corners[is_polygon]
    shapes.num_vertices[is_polygon] = data["polygon_n_vertices"][is_polygon]
    shapes.radius[data["circle_active"]] = data["circle_radius"][data["circle_active"]]
    held = data["joint_active"]
    joints.active[:] = held
    joints.kind[held] = np.where(data["joint_is_fixed_joint"], JointKind.FIXED, JointKind.REVOLUTE)[held]
    for ours, theirs in (
        (joints.a, "a_index"),
        (joints.b, "b_index"),
        (joints.anchor_a, "a_relative_pos"),
        (joints.anchor_b, "b_relative_pos"),
        (joints.rest_angle, "rotation"),
        (joints.motor_on, "motor_on"),
        (joints.motor_speed, "motor_speed"),
        (joints.motor_power, "motor_power"),
        (joints.has_limits, "motor_has_joint_limits"),
        (joints.lower_limit, "min_rotation"),
        (joints.upper_limit, "max_rotation"),
        (level.motor_colour, "motor_binding"),
    ):
        ours[held] = data[f"joint_{theirs}"][held]
    pushes = data["thruster_active"]
    thrusters.active[:] = pushes
    for ours, theirs in (
        (thrusters.body, "object_index"),
        (thrusters.position, "relative_position"),
        (thrusters.angle, "rotation"),
        (thrusters.power, "power"),
        (level.thruster_colour, "binding"),
    ):
        ours[pushes] = data[f"thruster_{theirs}"][pushes]
    completed = jax.jit(jax.vmap(lambda one, fixed: derive(centre_on_mass(one), fixed)))(level, is_fixed)
    return size, jax.tree.map(np.asarray, completed)


if __name__ == "__main__":
    sys.exit(main())
