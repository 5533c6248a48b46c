"""Fingerprints of drawn sets: a set whose levels differ from the published ones is refused.

    structure   the discrete part of a draw: active slots, roles, kinds, ends, colours                 4 hex digits
    coarse      mean position, speed, density and friction, with gravity and powers, in steps of 0.01  whole number

A level's code is both, "3fa2.412". Rounding in the last bits, which differs between processors and versions of XLA,
moves neither (0 of 24,576 levels between a CPU and an H100); other random numbers or another generator change almost
all codes.
`python -m bench.set_fingerprints` writes the file.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Sequence

import jax
import numpy as np

from kinetix_dist.level.level import NUM_WALLS, Level
from kinetix_dist.level.level_data import levels_root

FINGERPRINT_FILE = "fingerprints.json"
NUM_CHECKED = 256  # levels at the start of a set
COARSE_STEP = 0.01  # of the mean below, in mixed units
# Of the codes drawn. Where the last bits differ, a level may just solve itself and be left out: all after it move up,
# and one is unknown.
MAX_SHARE_UNKNOWN = 0.02


class OtherLevelsError(ValueError):
    """The levels drawn are not those that the name of the set stands for."""


def known_fingerprints() -> dict[str, str]:
    """Fingerprints in the level data, by name of a set."""
    file = levels_root() / FINGERPRINT_FILE
    return json.loads(file.read_text()) if file.is_file() else {}


def fingerprint(levels: Level) -> str:
    """Codes of the first levels of a set, in arrays of its own size."""
    return " ".join(f"{structure:04x}.{coarse}" for structure, coarse in _codes(levels))


def check_fingerprint(name: str, levels: Level, expected: str) -> None:
    """Raises `OtherLevelsError`, one line, where levels are not those of the set `name`, or of its beginning."""
    codes = expected.split()
    known = {code for text in codes for code in _alike(*_parsed(text))}
    drawn = _codes(levels)[: len(codes)]
    unknown = [number for number, code in enumerate(drawn) if code not in known]
    if len(unknown) > MAX_SHARE_UNKNOWN * len(drawn):
        raise OtherLevelsError(
            f"level set {name!r} comes out as other levels than those it stands for: {len(unknown)} of the first "
            f"{len(drawn)}, {name}_{unknown[0]} among them (JAX {jax.__version__} on {jax.default_backend()}); results "
            "on it could not be compared; use the packages of requirements.lock"
        )


def is_in_order(levels: Level, expected: str) -> bool:
    """Each of the first levels is the one of its place in a fingerprint, to rounding."""
    drawn, known = _codes(levels), [_parsed(code) for code in expected.split()]
    return len(drawn) == len(known) and all(code in _alike(*other) for code, other in zip(drawn, known))


def _codes(levels: Level) -> list[tuple[int, int]]:
    first = jax.tree.map(lambda x: np.asarray(x)[:NUM_CHECKED], levels)
    return list(zip(_structures(first), np.rint(_coarse(first) / COARSE_STEP).astype(int).tolist(), strict=True))


def _structures(levels: Level) -> list[int]:
    shapes, joints, thrusters = levels.scene.shapes, levels.scene.joints, levels.scene.thrusters
    num_polygons = shapes.num_vertices.shape[1]
    parts: Sequence[tuple[np.ndarray, np.ndarray]] = [
        *((shapes.active, x) for x in (shapes.active, levels.shape_role, levels.collision_mode)),
        (shapes.active, shapes.inverse_mass == 0),
        (shapes.active[:, :num_polygons], shapes.num_vertices),
        *((joints.active, x) for x in (joints.active, joints.a, joints.b, joints.kind, joints.has_limits)),
        *((joints.active, x) for x in (joints.motor_on, levels.motor_colour, levels.motor_auto)),
        *((thrusters.active, x) for x in (thrusters.active, thrusters.body, levels.thruster_colour)),
    ]
    rows = np.concatenate([np.where(is_there, x, 0).astype("<i2") for is_there, x in parts], axis=1)
    return [zlib.crc32(row.tobytes()) & 0xFFFF for row in rows]


def _coarse(levels: Level) -> np.ndarray:
    """[N] float64. All terms are sums over active slots, of order one."""
    scene, is_there = levels.scene, levels.scene.shapes.active.copy()
    is_there[:, :NUM_WALLS] = False
    of_shapes = levels.position.sum(-1) + levels.velocity.sum(-1) + scene.shapes.density + scene.shapes.friction
    powers = [(scene.joints.active, scene.joints.motor_power), (scene.thrusters.active, scene.thrusters.power)]
    mean = np.where(is_there, of_shapes, 0).sum(-1, dtype=float) / np.maximum(is_there.sum(-1), 1)
    return mean + scene.gravity[:, 1] + sum(np.where(active, x, 0).sum(-1, dtype=float) for active, x in powers)


def _parsed(code: str) -> tuple[int, int]:
    structure, coarse = code.split(".")
    return int(structure, 16), int(coarse)


def _alike(structure: int, coarse: int) -> list[tuple[int, int]]:
    """Codes of the same level: its mean may be rounded up or down."""
    return [(structure, coarse + step) for step in (-1, 0, 1)]
