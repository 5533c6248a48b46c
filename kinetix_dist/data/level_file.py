"""Levels of a data set, `levels.npz`: each level once, with the part of an observation that it fixes.

level/...        arrays of the levels, [L, ...]
static_obs/...   static part of the observation, [L, ...], see the manifest
robot_mask       [L, n] bool, shapes that the actions move, see `robot_mask`
bound_heads      [L, dimensions] bool, dimensions of the action that drive something in the level
names            [L] text
"""

from __future__ import annotations

import hashlib
import io
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from kinetix_dist.atomic_files import replace_file
from kinetix_dist.checkpoint import ArrayMismatchError, flatten_arrays, select_arrays, unflatten_arrays
from kinetix_dist.data.manifest import DatasetError, observation_shapes
from kinetix_dist.env.environment import Environment
from kinetix_dist.level.fingerprints import is_in_order
from kinetix_dist.level.level import Level, obeying_motors
from kinetix_dist.level.walls import empty_level

FILE = "levels.npz"


class Levels(NamedTuple):
    """L levels, and the part of an observation that each fixes."""

    levels: Level  # [L, ...]
    names: list[str]
    static_obs: Any  # [L, ...]
    robot_mask: np.ndarray  # [L, n] bool
    bound_heads: np.ndarray  # [L, dimensions] bool


def describe_levels(env: Environment, levels: Level, names: list[str]) -> Levels:
    prepared = env.prepare(levels)
    num_levels = len(names)
    every = np.ones((num_levels, env.action_space.num_dimensions), bool)
    bound = every if prepared.bound_heads is None else np.asarray(prepared.bound_heads)
    return Levels(
        levels=jax.tree.map(np.asarray, levels),
        names=names,
        static_obs=jax.tree.map(np.asarray, prepared.static_obs),
        robot_mask=robot_mask(levels),
        bound_heads=bound,
    )


def robot_mask(levels: Level) -> np.ndarray:
    """Return the shapes of the robot, [L, n] bool.

    They move, and a chain of joints between moving shapes connects them to a thruster or to a motor that obeys an
    action. Two shapes that share only a fixed body are not connected.
    """
    shapes, joints, thrusters = levels.scene.shapes, levels.scene.joints, levels.scene.thrusters
    moves = np.asarray(shapes.active & (shapes.inverse_mass > 0))
    a, b, active = (np.asarray(x) for x in (joints.a, joints.b, joints.active))
    world = np.arange(len(moves))[:, None]
    robot = np.zeros_like(moves)
    obeys = np.asarray(obeying_motors(levels))
    for ends, is_driven in ((a, obeys), (b, obeys), (thrusters.body, thrusters.active)):
        ends, is_driven = np.asarray(ends), np.asarray(is_driven)
        np.logical_or.at(robot, (np.broadcast_to(world, ends.shape), ends), is_driven)
    robot &= moves
    for _ in range(a.shape[1]):  # the longest chain has all joints
        seen_from_a, seen_from_b = (np.take_along_axis(robot, ends, axis=1) & active for ends in (a, b))
        where = np.broadcast_to(world, a.shape)
        np.logical_or.at(robot, (where, b), seen_from_a)
        np.logical_or.at(robot, (where, a), seen_from_b)
        robot &= moves
    return robot


def encode_levels(levels: Levels) -> bytes:
    """Return the content of the file. The same levels give the same bytes."""
    arrays = {f"level/{name}": array for name, array in flatten_arrays(levels.levels).items()}
    arrays |= {f"static_obs/{name}": array for name, array in flatten_arrays(levels.static_obs).items()}
    arrays |= {"robot_mask": levels.robot_mask, "bound_heads": levels.bound_heads, "names": np.array(levels.names)}
    content = io.BytesIO()
    np.savez_compressed(content, allow_pickle=False, **arrays)
    return content.getvalue()


def write_levels(folder: Path, content: bytes) -> None:
    replace_file(folder / FILE, content)


def read_levels(folder: Path, env: Environment, described: Mapping[str, Any]) -> Levels:
    """Read the levels.

    Args:
        folder: the data set.
        env: its environment.
        described: table "levels" of the manifest.

    Raises:
        DatasetError: the file is missing or damaged, or holds the levels of another environment or manifest.
    """
    path = folder / FILE
    try:
        content = path.read_bytes()
    except OSError as error:
        raise DatasetError(f"{path} cannot be read: {error.strerror}") from None
    if hashlib.sha256(content).hexdigest() != described["sha256"]:
        raise DatasetError(f"{path} is damaged: its SHA-256 is not that of the manifest; copy or collect it again")
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        num_levels = _check_tables(arrays, env)
        shapes = jax.tree.map(
            lambda x: jax.ShapeDtypeStruct((num_levels, *np.shape(x)), np.asarray(x).dtype), empty_level(env.capacity)
        )
        levels = Levels(
            levels=unflatten_arrays(shapes, select_arrays(arrays, "level")),
            names=arrays["names"].tolist(),
            static_obs=unflatten_arrays(observation_shapes(env, num_levels)[0], select_arrays(arrays, "static_obs")),
            robot_mask=arrays["robot_mask"],
            bound_heads=arrays["bound_heads"],
        )
    except (ArrayMismatchError, KeyError, ValueError, OSError, EOFError, zlib.error, zipfile.BadZipFile) as error:
        raise DatasetError(f"{path} is not of this environment, or of another version: {error}") from None
    if num_levels != described["number"]:
        raise DatasetError(
            f"{path} has {num_levels:,} levels, and the manifest {described['number']:,}; copy or collect it again"
        )
    if not is_in_order(levels.levels, described["fingerprint"]):
        raise DatasetError(f"{path} has other levels than the fingerprint of the manifest; copy or collect it again")
    return levels


def _check_tables(arrays: dict[str, np.ndarray], env: Environment) -> int:
    """Return the number of levels. Raise KeyError or ValueError if an array of the levels has another shape."""
    names = arrays["names"]
    if names.dtype.kind != "U" or names.ndim != 1 or not len(names):
        raise ValueError("names has no text a level")
    for name, width in (("robot_mask", env.capacity.shapes), ("bound_heads", env.action_space.num_dimensions)):
        array, shape = arrays[name], (len(names), width)
        if array.dtype != bool or array.shape != shape:
            raise ValueError(f"{name} is {array.dtype} {list(array.shape)}, not bool {list(shape)}")
    return len(names)
