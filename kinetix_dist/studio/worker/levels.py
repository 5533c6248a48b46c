"""Levels of requests: documents, levels of a run's buffer and of its evaluation sets, states of recordings."""

from __future__ import annotations

import dataclasses
import functools
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jax2d.fields import tree_like
from kinetix_dist.checkpoint import ArrayMismatchError, unflatten_arrays
from kinetix_dist.errors import one_line
from kinetix_dist.evaluation.evaluation_sets import EvaluationSet
from kinetix_dist.evaluation.recordings import read_rollouts
from kinetix_dist.level.document import level_to_json
from kinetix_dist.level.fit import capacity_of, fit_level, smallest_size
from kinetix_dist.level.kinetix_format import is_kinetix_document, read_kinetix
from kinetix_dist.level.level import SIZES, Level
from kinetix_dist.level.schema import LevelInfo, document_info, level_from_json
from kinetix_dist.studio.worker.evaluated_sets import check_names, document_of_file, evaluated_set
from kinetix_dist.studio.worker.wire import BAD_REQUEST, NOT_FOUND, RequestError
from kinetix_dist.telemetry.curriculum_log import DIRECTORY, KINDS, SnapshotError, read_snapshot, snapshot_name
from kinetix_dist.telemetry.recording import Recording, RecordingError, Rollout


class LevelsLeftOutError(RequestError):
    """A snapshot that stores counts only (`curriculum_log.max_snapshots`)."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RequestedLevel:
    """Level of a request."""

    level: Level  # numpy, in arrays of `info.size`
    info: LevelInfo
    document: dict[str, Any] | None = None  # where the request has one of ours
    is_exact: bool = True  # False: a state in the middle of a rollout, without the impulses of its contacts


def level_of(given: Any) -> RequestedLevel:
    """Level by `level` of a request. Raises RequestError."""
    if not isinstance(given, Mapping):
        raise RequestError(BAD_REQUEST, f"level is {type(given).__name__}; give an object, see docs/play_protocol.md")
    if "document" in given:
        return level_of_document(given["document"])
    if "recording" in given:
        return _of_recording(Path(_text(given, "recording")), _number(given, "index"), _number(given, "step", 0))
    if "set" in given:
        return _of_set(given)
    for kind in KINDS:
        if kind in given:
            path = snapshot_path(Path(_text(given, "run")), kind, _number(given, kind))
            return _of_snapshot(path, _number(given, "index"))
    known = ", ".join(f'"{name}"' for name in ("document", "recording", "set", *KINDS))
    raise RequestError(BAD_REQUEST, f"level has none of {known}; give one")


def level_of_document(document: Any) -> RequestedLevel:
    """Level of a document of either format. Raises RequestError with its first problem."""
    try:
        if is_kinetix_document(document):
            public = read_kinetix(document)
            size = smallest_size(public.level)
            info = LevelInfo(name="public", size=size, source="public Kinetix level file", public_walls=public.walls)
            return RequestedLevel(level=fit_level(public.level, SIZES[size]), info=info)
        return RequestedLevel(level=level_from_json(document), info=document_info(document), document=document)
    except ValueError as error:  # LevelFormatError, LevelSizeError
        raise RequestError(BAD_REQUEST, one_line(error)) from error


def document_of(given: RequestedLevel) -> dict[str, Any]:
    """Document of our format of a level."""
    return given.document if given.document is not None else level_to_json(given.level, given.info)


def snapshot_path(run: Path, kind: str, number: int) -> Path:
    return run / DIRECTORY / snapshot_name(kind, number)


def snapshot_levels(path: Path) -> Level:
    """Levels of a snapshot, [n, ...], bit for bit those of training.

    Raises RequestError; LevelsLeftOutError where the snapshot stores counts only.
    """
    try:
        about = os.stat(path)
        return _read_snapshot(path, about.st_mtime_ns, about.st_size)
    except OSError as error:
        raise RequestError(NOT_FOUND, f"the snapshot {path} cannot be read ({error.strerror})") from error
    except (SnapshotError, ArrayMismatchError) as error:
        raise RequestError(BAD_REQUEST, one_line(error)) from error


@functools.lru_cache(maxsize=4)
def _read_snapshot(path: Path, modified_ns: int, size: int) -> Level:
    """Levels of a snapshot, cached by modification time and size of its file."""
    snapshot = read_snapshot(path)
    if snapshot.levels is None:
        raise LevelsLeftOutError(NOT_FOUND, f"{path} holds no levels: old snapshots store counts only")
    size_name = str(snapshot.arrays.get("size"))
    if size_name not in SIZES or "angle" not in snapshot.levels:
        raise RequestError(BAD_REQUEST, f"{path} has levels of size {size_name!r}; sizes are {', '.join(SIZES)}")
    template = tree_like(Level, SIZES[size_name].sizes, np.float32, (len(snapshot.levels["angle"]),))
    return unflatten_arrays(template, snapshot.levels)


def _of_snapshot(path: Path, index: int) -> RequestedLevel:
    levels = snapshot_levels(path)
    check_index(index, len(levels.angle), f"{path} has levels")
    level = jax.tree.map(lambda x: x[index], levels)
    return RequestedLevel(level=level, info=LevelInfo(name=f"{path.stem}_{index}", size=size_of(level)))


def _of_set(given: Mapping[str, Any]) -> RequestedLevel:
    """Level of a set that a run is evaluated on; it is drawn where it was not requested before."""
    found, index = evaluated_set(_text(given, "run"), given["set"]), _number(given, "index")
    check_names(found, index, given.get("name"))
    return level_of_set(found, index)


def level_of_set(found: EvaluationSet, index: int) -> RequestedLevel:
    """Level in the arrays that it was played in, with the document of its file where it has one."""
    level = jax.tree.map(lambda x: x[index], found.levels)
    info = LevelInfo(name=found.level_names[index], size=found.size, source=f"level set {found.name}")
    return RequestedLevel(level=level, info=info, document=document_of_file(found.name, index))


def size_of(levels: Level) -> str:
    """Name of the size whose arrays these are. Raises RequestError for arrays of no size."""
    capacity = capacity_of(levels)
    for name, known in SIZES.items():
        if known == capacity:
            return name
    raise RequestError(BAD_REQUEST, f"the level has arrays of no known size: {capacity}")


def recording_of(path: Path) -> Recording:
    """Rollouts of an MCAP file. Raises RequestError."""
    try:
        about = os.stat(path)
        return _read_recording(path, about.st_mtime_ns, about.st_size)
    except RecordingError as error:
        raise RequestError(BAD_REQUEST, one_line(error)) from error
    except OSError as error:
        raise RequestError(NOT_FOUND, f"the recording {path} cannot be read ({one_line(error)})") from error


@functools.lru_cache(maxsize=2)
def _read_recording(path: Path, modified_ns: int, size: int) -> Recording:
    return read_rollouts(path)


def rollout_of(path: Path, index: int) -> Rollout:
    rollouts = recording_of(path).rollouts
    check_index(index, len(rollouts), f"{path} has rollouts")
    return rollouts[index]


def _of_recording(path: Path, index: int, step: int) -> RequestedLevel:
    """Level of a rollout with the positions and velocities after `step` steps."""
    rollout = rollout_of(path, index)
    check_index(step, rollout.num_steps + 1, f"rollout {index} of {path} has states")
    level = rollout.level
    assert isinstance(level, Level)  # read_rollouts decodes levels
    if step:
        names = ("position", "angle", "velocity", "angular_velocity")
        level = dataclasses.replace(level, **{name: getattr(rollout, name)[step] for name in names})
    info = LevelInfo(name=rollout.level_name, size=size_of(level))
    return RequestedLevel(level=level, info=info, is_exact=step == 0)


def check_index(index: int, count: int, what: str) -> None:
    if not 0 <= index < count:
        found = f"{what} 0 to {count - 1}" if count else f"{what}: none"
        raise RequestError(NOT_FOUND, f"{found}; there is no {index}")


def _text(given: Mapping[str, Any], name: str) -> str:
    value = given.get(name)
    if not isinstance(value, str) or not os.path.isabs(value):
        raise RequestError(BAD_REQUEST, f"level.{name} is {value!r}; give an absolute path")
    return value


def _number(given: Mapping[str, Any], name: str, default: int | None = None) -> int:
    value = given.get(name, default)
    if type(value) is not int or value < 0:
        raise RequestError(BAD_REQUEST, f"level.{name} is {value!r}; give a whole number, 0 or more")
    return value
