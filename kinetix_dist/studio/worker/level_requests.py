"""Requests about levels and recordings: checks, pictures, documents, changes."""

from __future__ import annotations

import dataclasses
import functools
import json
from typing import Any

import jax
import numpy as np

from jax2d.display_list import DisplayList, display_list
from jax2d.scene import Array, Capacity
from kinetix_dist import prng
from kinetix_dist.level.document import LevelInfo, level_to_json
from kinetix_dist.level.fit import capacity_of, smallest_size
from kinetix_dist.level.generator import generate_filtered
from kinetix_dist.level.generator_config import GENERATORS, GeneratorConfig, generator
from kinetix_dist.level.kinetix_format import export_kinetix
from kinetix_dist.level.level import SIZES, Level
from kinetix_dist.level.mechanisms.ready_made import READY_MADE, ready_made_level
from kinetix_dist.level.mutators import MUTATORS, apply, mutate
from kinetix_dist.level.simulation import noop_solved
from kinetix_dist.level.start_warnings import noop_warning
from kinetix_dist.level.validate import LevelFormatError, RoleError
from kinetix_dist.studio.worker import programs
from kinetix_dist.studio.worker.attempts import steps_until_noop_solves
from kinetix_dist.studio.worker.document_check import check_document
from kinetix_dist.studio.worker.evaluated_sets import check_names, evaluated_set, features_of_set
from kinetix_dist.studio.worker.levels import (
    LevelsLeftOutError,
    RequestedLevel,
    check_index,
    document_of,
    level_of,
    level_of_document,
    level_of_set,
    recording_of,
    rollout_of,
    snapshot_levels,
    snapshot_path,
)
from kinetix_dist.studio.worker.request import Request, env_of
from kinetix_dist.studio.worker.wire import BAD_REQUEST, FAILED, RequestError
from kinetix_dist.telemetry.curriculum_log import KINDS
from kinetix_dist.telemetry.recording import Rollout

MAX_LISTED = 200  # problems of a document
MAX_THUMBNAILS = 4096
MAX_CHANGES = 100
MAX_GENERATED = 16  # always this many are generated: one program
MAX_SEED = 2**31 - 1
FORMATS = ("kinetix-dist", "public")

Answer = tuple[dict[str, Any], bytes]


def check(request: Request) -> Answer:
    """Checks a document: all problems at once; without any: warnings, facts and a picture."""
    plays = request.flag("play", default=True)
    checked = check_document(request.fields.get("document"))
    problems = [_problem(problem) for problem in checked.problems[:MAX_LISTED]]
    answer: dict[str, Any] = {"problems": problems, "num_problems": len(checked.problems)}
    if checked.level is None:
        return answer | {"warnings": [], "facts": None, "display": None, "poses": None}, b""
    warnings, facts = list(checked.warnings), dict(checked.facts)
    if plays:
        env = programs.environment(env_of(request.fields.get("env"), request.fields["document"]["size"]))
        request.check_cancelled()
        solved_at = steps_until_noop_solves(env, checked.level)
        facts["noop_solved_at"] = solved_at
        warnings += noop_warning(solved_at)
    listed = [dataclasses.asdict(warning) for warning in warnings]
    return answer | {"warnings": listed, "facts": facts} | _picture(checked.level), b""


def _problem(problem: LevelFormatError) -> dict[str, Any]:
    is_of_role = isinstance(problem, RoleError)
    return {
        "path": problem.path,
        "paths": problem.holders if is_of_role else [problem.path],
        "problem": problem.problem,
        "remedy": problem.remedy,
        "missing_role": problem.role if is_of_role and not problem.holders else None,
    }


def display(request: Request) -> Answer:
    given = level_of(request.fields.get("level"))
    return {"size": given.info.size, "name": given.info.name, **_picture(given.level)}, b""


def document(request: Request) -> Answer:
    return {"document": document_of(level_of(request.fields.get("level")))}, b""


def thumbnails(request: Request) -> Answer:
    """Pictures of levels of a snapshot, none where it stores no levels, or of an evaluation set of a run.

    The JSON is the body, to be forwarded.
    """
    indices = _indices(request)
    if "set" in request.fields:
        found = evaluated_set(str(request.path("run")), request.fields["set"])
        levels, where = found.levels, f"set {found.name} has levels"
    else:
        kind = next((kind for kind in KINDS if kind in request.fields), None)
        if kind is None:
            raise RequestError(BAD_REQUEST, f"thumbnails: give set, {' or '.join(KINDS)}")
        path = snapshot_path(request.path("run"), kind, request.number(kind, low=0, high=10**8 - 1))
        try:
            levels, where = snapshot_levels(path), f"{path} has levels"
        except LevelsLeftOutError:
            return {"count": 0}, b"[]"
    entries = []
    for index in indices:
        request.check_cancelled()
        check_index(index, len(levels.angle), where)
        level = jax.tree.map(lambda x: x[index], levels)  # noqa: B023 (called at once)
        # Text at once: a hundred thousand lists at a time would keep Python's collector busy.
        entries.append(json.dumps({"index": index, **_picture(level)}, allow_nan=False, separators=(",", ":")))
    return {"count": len(entries)}, f"[{','.join(entries)}]".encode()


def evaluation_set(request: Request) -> Answer:
    """Names, size and features of the levels of a set that a run is evaluated on."""
    request.progress("building the set")
    found = evaluated_set(str(request.path("run")), request.fields.get("set"))
    return {"size": found.size, "names": list(found.level_names), "features": features_of_set(found.levels)}, b""


def documents(request: Request) -> Answer:
    """Names and documents of levels of an evaluation set. The JSON is the body: a list of [name, document]."""
    found = evaluated_set(str(request.path("run")), request.fields.get("set"))
    entries = []
    for index in _indices(request):
        request.check_cancelled()
        check_names(found, index, None)
        entries.append([found.level_names[index], document_of(level_of_set(found, index))])
    return {"count": len(entries)}, json.dumps(entries, allow_nan=False).encode()


def is_of_set(fields: dict[str, Any]) -> bool:
    """True for a request about levels of an evaluation set, which may have to be drawn first."""
    level = fields.get("level")
    return "set" in fields or (isinstance(level, dict) and "set" in level)


def _indices(request: Request) -> list[int]:
    indices = request.fields.get("indices")
    if not isinstance(indices, list) or len(indices) > MAX_THUMBNAILS or any(type(i) is not int for i in indices):
        text = f"indices is no list of at most {MAX_THUMBNAILS} whole numbers"
        raise RequestError(BAD_REQUEST, f"{request.fields['type']}: {text}")
    return indices


def recordings(request: Request) -> Answer:
    found = recording_of(request.path("file"))
    rollouts = [_about(i, rollout) for i, rollout in enumerate(found.rollouts)]
    return {"rollouts": rollouts, "problems": list(found.problems)}, b""


def recording(request: Request) -> Answer:
    """Rollout as it was stored, never simulated again."""
    index = request.number("index", low=0, high=MAX_SEED)
    rollout = rollout_of(request.path("file"), index)
    arrays = {
        "poses": np.concatenate([rollout.position, rollout.angle[..., None]], axis=-1),
        **{
            name: getattr(rollout, name)
            for name in ("velocity", "angular_velocity", "actions", "motor", "thruster", "reward")
        },
    }
    level = rollout.level
    assert isinstance(level, Level)  # recordings are read with our decoder
    listed = [[name, list(array.shape)] for name, array in arrays.items()]
    body = b"".join(np.ascontiguousarray(array, "<f4").tobytes() for array in arrays.values())
    return {**_about(index, rollout), "arrays": listed, "display": _display(level).to_json()}, body


def rrd(request: Request) -> Answer:
    """Writes a rollout to a file that rerun opens."""
    from kinetix_dist.telemetry.sinks.rerun import rollout_to_rrd

    rollout = rollout_of(request.path("file"), request.number("index", low=0, high=MAX_SEED))
    target = request.path("to")
    try:
        rollout_to_rrd(rollout, target)
    except (OSError, ImportError) as error:
        raise RequestError(FAILED, f"the rollout cannot be made into an .rrd: {error}") from error
    return {"bytes": target.stat().st_size}, b""


def convert(request: Request) -> Answer:
    to = request.choice("to", FORMATS)
    given = level_of_document(request.fields.get("document"))
    return {
        "document": document_of(given) if to == FORMATS[0] else export_kinetix(given.level, given.info.public_walls)
    }, b""


def mutate_level(request: Request) -> Answer:
    """Document after random changes. Shapes are named by their slots afterwards."""
    given = level_of_document(request.fields.get("document"))
    seed = request.number("seed", low=0, high=MAX_SEED, default=0)
    changes = request.number("changes", low=1, high=MAX_CHANGES, default=1)
    name = request.fields.get("mutator")
    if name is not None:
        request.choice("mutator", MUTATORS)
    level, changed = given.level, False
    keys = prng.split(prng.key(seed), changes)
    for key in keys:
        request.check_cancelled()
        level, has_changed = _change(name, key, level, capacity_of(given.level))
        changed |= bool(has_changed)
    return {"document": level_to_json(level, given.info) if changed else document_of(given), "changed": changed}, b""


def generate(request: Request) -> Answer:
    """Random levels of a size that are not solved by doing nothing."""
    size, name = request.choice("size", SIZES), request.choice("generator", GENERATORS, "default")
    seed = request.number("seed", low=0, high=MAX_SEED, default=0)
    count = request.number("count", low=1, high=MAX_GENERATED, default=1)
    request.progress("compiling")
    levels = jax.device_get(generate_filtered(prng.key(seed), MAX_GENERATED, size, generator(name), noop_solved))
    documents = [
        level_to_json(
            jax.tree.map(lambda x: x[i], levels),  # noqa: B023 (called at once)
            LevelInfo(name=f"{name}_{size}_{seed}_{i}", size=size, source=f"generator {name}, seed {seed}"),
        )
        for i in range(count)
    ]
    return {"documents": documents}, b""


def mechanism(request: Request) -> Answer:
    """Shapes, joints and thrusters of a ready-made mechanism, where it stands in an empty level."""
    name, size = request.choice("mechanism", READY_MADE), request.choice("size", SIZES)
    level = ready_made_level(name, size)
    document = level_to_json(level, LevelInfo(name=name, size=smallest_size(level)))
    return {part: document[part] for part in ("shapes", "joints", "thrusters")}, b""


@functools.partial(jax.jit, static_argnames=("name", "capacity", "config"))
def _change(
    name: str | None, key: Array, level: Level, capacity: Capacity, config: GeneratorConfig = GENERATORS["default"]
) -> tuple[Level, Array]:
    if name is None:
        return mutate(key, level, capacity, config)
    return apply(name, key, level, capacity, config)


def _display(level: Level) -> DisplayList:
    return display_list(
        level.scene, level.shape_role, motor_colours=level.motor_colour, thruster_colours=level.thruster_colour
    )


def display_of(given: RequestedLevel) -> dict[str, Any]:
    return _display(given.level).to_json()


def _picture(level: Level) -> dict[str, Any]:
    """Display list and poses at the start."""
    poses = np.concatenate([level.position, np.asarray(level.angle)[:, None]], axis=-1)
    return {"display": _display(level).to_json(), "poses": poses.tolist()}


def _about(index: int, rollout: Rollout) -> dict[str, Any]:
    return {
        "index": index,
        "name": rollout.level_name,
        "outcome": rollout.outcome,
        "num_steps": rollout.num_steps,
        "return": float(rollout.reward.sum()),
        "policy_version": rollout.policy_version,
        "seed": rollout.seed,
        "step_seconds": rollout.step_seconds,
    }
