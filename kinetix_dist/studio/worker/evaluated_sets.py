"""Level sets that a run is evaluated on, built again: read from their files, or drawn from their seed.

    config.json of the run (evaluation.sets, env.size) --load_evaluation_set--> levels in the arrays they were played in

Only sets that the run names are built. A drawn set takes seconds the first time; a few sets are cached.
"""

from __future__ import annotations

import functools
import os
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from kinetix_dist.env.outcome import goal_distance, role_masks
from kinetix_dist.errors import one_line
from kinetix_dist.evaluation.evaluation_sets import EvaluationSet, load_evaluation_set
from kinetix_dist.level.features import FEATURES, level_features
from kinetix_dist.level.kinetix_format import is_kinetix_document
from kinetix_dist.level.level import Level
from kinetix_dist.level.sets import files_of_set, read_level_file, size_of_drawn_set
from kinetix_dist.studio.worker.run_config import config_of_run
from kinetix_dist.studio.worker.wire import BAD_REQUEST, NOT_FOUND, RequestError

MAX_CACHED_SETS = 4
DISTANCE = "distance"  # column of features: between green and blue at the start, m
_building = threading.Lock()  # two threads would draw the same set twice


def evaluated_set(run: Any, name: Any) -> EvaluationSet:
    """A set that a run is evaluated on, in the arrays in which it was played.

    Raises RequestError: no such run, a set that it does not name, or levels that are not there (any more).
    """
    path, config = config_of_run(run, "run")
    sets, size = _section(config, "evaluation").get("sets"), _section(config, "env").get("size")
    if not isinstance(sets, list) or name not in sets:
        raise RequestError(NOT_FOUND, f"{path} names no evaluation set {name!r}; it names {sets}")
    with _building:
        try:
            return _built(name, str(size), _stamps(name))
        except FileNotFoundError as error:
            where = "" if Path(name).is_absolute() else f"; it is looked for from {Path.cwd()}"
            raise RequestError(NOT_FOUND, f"{one_line(error)}{where}") from error
        except OSError as error:
            raise RequestError(NOT_FOUND, f"level set {name} cannot be read ({error.strerror})") from error
        except ValueError as error:
            raise RequestError(BAD_REQUEST, one_line(error)) from error


def features_of_set(levels: Level) -> dict[str, list[float]]:
    """Columns by name: counts of FEATURES, and DISTANCE."""
    counts = np.asarray(level_features(levels)).astype(int)
    masks = role_masks(np.asarray(levels.shape_role), np.asarray(levels.scene.shapes.active))
    distance = np.asarray(goal_distance(np.asarray(levels.position), masks), float)
    columns = {feature: counts[:, column].tolist() for column, feature in enumerate(FEATURES)}
    return {**columns, DISTANCE: distance.round(3).tolist()}


def document_of_file(name: str, index: int) -> dict[str, Any] | None:
    """Document of our format of a level of a set, as its file has it; None: the set is drawn, or in another format."""
    if size_of_drawn_set(name) is not None:
        return None
    document = read_level_file(files_of_set(name)[index]).document
    return None if is_kinetix_document(document) else document


def check_names(found: EvaluationSet, index: int, name: Any) -> None:
    """Raises RequestError where a level of the set has another name than when it was evaluated."""
    if not 0 <= index < len(found.level_names):
        raise RequestError(NOT_FOUND, f"set {found.name} has levels 0 to {len(found.level_names) - 1}, no {index}")
    if name is not None and found.level_names[index] != name:
        raise RequestError(NOT_FOUND, f"set {found.name} has other levels now: number {index} is no {name!r} any more")


@functools.lru_cache(maxsize=MAX_CACHED_SETS)
def _built(name: str, size: str, stamps: tuple[tuple[str, int], ...]) -> EvaluationSet:
    return load_evaluation_set(name, size)


def _stamps(name: str) -> tuple[tuple[str, int], ...]:
    """Files of a set with their times, part of the key of the cache; none of a drawn set."""
    if size_of_drawn_set(name) is not None:
        return ()
    return tuple((str(file), os.stat(file).st_mtime_ns) for file in files_of_set(name))


def _section(config: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    section = config.get(name)
    return section if isinstance(section, Mapping) else {}
