"""Description of a data set, `dataset.json`: environment, levels and policy of its transitions, and comparisons.

The index of shards counts the transitions. `shards` is the number of shards that the command was to make, so that a
reader can tell a data set whose command was killed; `collect` may add more later.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from kinetix_dist.atomic_files import replace_file
from kinetix_dist.checkpoint import flatten_arrays
from kinetix_dist.config import build, differing, to_dict
from kinetix_dist.env.env_config import EnvConfig, describe
from kinetix_dist.env.environment import Environment
from kinetix_dist.errors import one_line, shortened
from kinetix_dist.installation import version_of
from kinetix_dist.json_text import json_text
from kinetix_dist.level.walls import empty_level
from kinetix_dist.text_files import read_json

FILE = "dataset.json"
FORMAT = "kinetix-dist-dataset"
VERSION = 1
SHARDS = "shards"
ABOUT_ONLY = ("package", SHARDS)  # entries that may differ between two runs of one collection
# Names of contents: entries that may differ if the other entries of their table are equal.
LABELS = {"levels": "set", "policy": "name"}
HASH = "sha256"  # of the contents of such a table; a policy without parameters has "", and only its name
_CODE = r"[0-9a-f]{4}\.-?[0-9]{1,19}"
PATTERNS = {HASH: re.compile(r"[0-9a-f]{64}"), "fingerprint": re.compile(rf"{_CODE}( {_CODE})*")}
MAX_TEXT = 120  # characters of a difference
_REMEDY = "copy the data set again, or make it again in another folder"
MAX_QUOTED = 60  # characters of a value in a message
UNKNOWN_POLICY = "kinetix-offline"  # policy of imported data, which have no log-probabilities


class DatasetError(ValueError):
    """A data set cannot be used; the message gives the reason in one printable line."""

    def __init__(self, message: str) -> None:
        super().__init__(one_line(message))


def make_manifest(env: Environment, levels: Mapping[str, Any], behaviour: Mapping[str, Any]) -> dict[str, Any]:
    """Return the description of a data set.

    Args:
        env: the environment that was played.
        levels: "set", "number", "fingerprint" and "sha256" of the file.
        behaviour: policy, noise, seed and sizes.
    """
    return {
        "format": FORMAT,
        "version": VERSION,
        "package": version_of(),
        "env": to_dict(env.config),
        "physics": describe(env.config.physics),
        "observation": describe_observation(env),
        "action_space": describe_actions(env),
        "levels": dict(levels),
        **behaviour,
    }


def observation_shapes(env: Environment, num_levels: int = 1) -> tuple[Any, Any]:
    """Return the (static, dynamic) observation of `num_levels` worlds as `jax.ShapeDtypeStruct`s."""
    one = empty_level(env.capacity)
    levels = jax.tree.map(lambda x: jax.ShapeDtypeStruct((num_levels, *np.shape(x)), np.asarray(x).dtype), one)
    prepared = jax.eval_shape(env.prepare, levels)
    return prepared.static_obs, prepared.initial_obs


def describe_observation(env: Environment) -> dict[str, Any]:
    """Return the fields of an observation by the names of their columns, with the shapes of one transition."""
    fields = {}
    for name, leaf in named_shapes(observation_shapes(env)[1]).items():
        fields[column_of(name)] = {"shape": list(leaf.shape[1:]), "dtype": str(leaf.dtype)}
        if name in env.observation.entries:
            fields[column_of(name)]["entries"] = list(env.observation.entries[name])
        if name in env.observation.masks:  # rows of the first axis are shapes
            fields[column_of(name)] |= {"used": f"static_obs/{env.observation.masks[name]}", "robot": "robot_mask"}
    return {
        "name": env.config.observation,
        "gives": env.observation.gives,
        "fields": fields,
    }


def describe_actions(env: Environment) -> dict[str, Any]:
    space = env.action_space
    names = [name.name for name in space.action_names]
    return {"name": space.name, "low": list(space.low), "high": list(space.high), "names": names}


def column_of(name: str) -> str:
    """Return the column of a field of the dynamic observation: "bodies" -> "observation.bodies"."""
    return ".".join(["observation", *filter(None, name.split("/"))])


def named_shapes(shapes: Any) -> dict[str, jax.ShapeDtypeStruct]:
    """Return the leaves by the names that `flatten_arrays` gives them."""
    names = flatten_arrays(jax.tree.map(lambda leaf: np.zeros((1,)), shapes))
    return dict(zip(names, jax.tree.leaves(shapes), strict=True))


def write_manifest(folder: Path, manifest: Mapping[str, Any]) -> None:
    replace_file(folder / FILE, json_text(manifest, indent=1).encode() + b"\n")


def read_manifest(folder: Path) -> dict[str, Any]:
    """Read the description. Raise DatasetError if it is missing, damaged, or of another format or version."""
    path = folder / FILE
    try:
        manifest = read_json(path)
    except (FileNotFoundError, NotADirectoryError):
        raise DatasetError(f"{folder} is no data set: it has no {FILE}; `kinetix-dist collect` makes one") from None
    except (OSError, ValueError) as error:
        raise DatasetError(f"{path} cannot be read ({error}); {_REMEDY}") from None
    if not isinstance(manifest, dict):
        raise DatasetError(f"{path} holds no JSON object; {_REMEDY}")
    kind, number = manifest.get("format"), manifest.get("version")
    if kind != FORMAT:
        raise DatasetError(f"{path} is of format {quoted(kind)}, not {FORMAT!r}")
    if type(number) is not int or number != VERSION:
        raise DatasetError(
            f"{path} has format version {quoted(number)}, and this version of kinetix-dist reads {VERSION}; "
            f"it was written by kinetix-dist {shortened(str(manifest.get('package')), MAX_QUOTED)}"
        )
    if fault := _fault(manifest):
        raise DatasetError(f"{path} is damaged: {fault}; {_REMEDY}")
    return manifest


def _fault(manifest: Mapping[str, Any]) -> str | None:
    """Return the first entry that a reader needs and a manifest lacks, in words; `None` if all are there."""
    for name, kind in (("env", dict), ("physics", str), ("levels", dict), ("policy", dict), ("shard_transitions", int)):
        if type(manifest.get(name)) is not kind:
            return f"{name} is missing or of another type"
    if type(manifest.get(SHARDS, 0)) is not int:  # earlier versions lack it
        return f"{SHARDS} is of another type"
    levels = manifest["levels"]
    for table, name, kind in (
        ("levels", "set", str),
        ("levels", "number", int),
        *(("levels", name, str) for name in PATTERNS),
        ("policy", "name", str),
    ):
        if type(manifest[table].get(name)) is not kind:
            return f"{table}.{name} is missing or of another type"
    if levels["number"] < 1 or manifest["shard_transitions"] < 1:
        return "a data set has at least one level and one transition a shard"
    if wrong := [name for name, pattern in PATTERNS.items() if not pattern.fullmatch(levels[name])]:
        return f"levels.{wrong[0]} is malformed"
    return None


def quoted(value: Any) -> str:
    """Return a value of a file for a message: printable and short."""
    return shortened(repr(value), MAX_QUOTED)


def knows_policy(manifest: Mapping[str, Any]) -> bool:
    """Return whether the policy is known, so that its actions have log-probabilities."""
    policy = manifest["policy"]
    return policy["name"] != UNKNOWN_POLICY or bool(policy.get(HASH))  # a run may have that name, and has parameters


def env_config_of(manifest: Mapping[str, Any], folder: Path) -> EnvConfig:
    """Return the environment of the data set. Raise DatasetError if this version does not have it."""
    try:
        return build(EnvConfig, manifest["env"])
    except (ValueError, KeyError, TypeError) as error:
        raise DatasetError(f"{folder / FILE}: env: {error}") from None


def check_same_collection(found: Mapping[str, Any], wanted: Mapping[str, Any], folder: Path) -> None:
    """Raise DatasetError if the data set of a folder differs from the data set that a command would write.

    Contents are compared by their hashes: equal levels or parameters may have another path.
    """
    theirs, ours = ({k: v for k, v in content.items() if k not in ABOUT_ONLY} for content in (found, wanted))
    for table, label in LABELS.items():
        if theirs[table].get(HASH) and theirs[table] | {label: ""} == ours[table] | {label: ""}:
            ours[table] = theirs[table]
    if names := [text[:MAX_TEXT] for text in differing(ours, theirs)]:
        more = f" and {len(names) - 2} more" if len(names) > 2 else ""
        raise DatasetError(
            f"{folder} holds another data set: {'; '.join(names[:2])}{more}; give --out another folder, or the options "
            "of that one"
        )


def check_env(manifest: Mapping[str, Any], config: EnvConfig, folder: Path) -> None:
    """Raise DatasetError, which names the first difference, if the transitions are of another environment."""
    theirs, ours = (dataclasses.asdict(each) for each in (env_config_of(manifest, folder), config))
    for name in ("size", "observation", "action_space", "frame_skip"):
        if theirs[name] != ours[name]:
            raise DatasetError(
                f"data set {folder} is of env.{name} {theirs[name]!r}, not {ours[name]!r}; set env.{name} to that, or "
                "give another data set"
            )
    if manifest["physics"] != describe(config.physics):
        raise DatasetError(
            f"data set {folder} is of physics {quoted(manifest['physics'])}, not {describe(config.physics)!r}; give "
            "--env.preset or another data set"
        )
