"""Settings that had another name before, or are gone: fields, sections and values by dotted path.

A person who writes an old spelling is refused by a line that names the new one: `refuse_old_options` (a table of
options) and `refuse_old_words` (a command line). Configurations that were stored are translated as they are read:
`translated`. A path that is here no longer exists, so old -> new is one step, never a chain.

To rename a setting: rename the field, add a line to `RENAMED` (or `RENAMED_VALUES`, `MOVED_VALUES`, `REMOVED`). A
section's line moves all fields in it; a field's own line comes first. Options of a phase are settings by their full
names.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

# Path of a field or section before -> path now.
RENAMED: dict[str, str] = {
    "curriculum.generator.locomotion_share": "curriculum.generator.mechanism_share",
    "curriculum.generator.locomotion_kinds": "curriculum.generator.mechanism_families",
    "curriculum.generator.locomotion_weights": "curriculum.generator.mechanism_weights",
    "env.physics.blow_passes": "env.physics.impact_passes",
    "env.physics.joint_hertz": "env.physics.spring_hertz",
    "env.physics.joint_hertz_share": "env.physics.spring_hertz_share",
    "env.physics.joint_damping_ratio": "env.physics.spring_damping_ratio",
}

# (path now, value before) -> value now; also of the entries of a list.
RENAMED_VALUES: dict[tuple[str, Any], Any] = {
    ("policy.kernels", "mosaic"): "fused",
}

# (path now, value before) -> (path now, value now) of the setting that says it today.
MOVED_VALUES: dict[tuple[str, Any], tuple[str, Any]] = {
    ("env.dense_reward_scale", 0.0): ("env.reward", "sparse"),
}

# Field of a phase before -> setting, in `options` of a phase now; None there changed nothing.
PHASE_NAMES: dict[str, str] = {
    "num_envs": "rollout.num_envs",
    "minibatches": "ppo.minibatches",
    "epochs": "ppo.epochs",
    "learning_rate": "ppo.learning_rate",
    "clip": "ppo.clip",
    "entropy_coefficient": "ppo.entropy_coefficient",
    "reward": "env.reward",
    "dense_reward_scale": "env.dense_reward_scale",
    "failure_penalty": "env.failure_penalty",
    "sizes": "curriculum.sizes",
}

# Options of commands that are no settings: (command, option before) -> option now, ("sweep", "--places") -> "--slots".
RENAMED_OPTIONS: dict[tuple[str, str], str] = {
    ("levels", "--beside"): "--reference",
    ("sweep", "--lanes"): "--slots",
}

# Recipe before -> recipe now.
RENAMED_RECIPES: dict[str, str] = {}


@dataclasses.dataclass(frozen=True)
class Removed:
    """A field without a successor, or a section of them."""

    why: str  # a clause: "plain SFL is as good"
    off: tuple[Any, ...] | None = None  # values, as JSON, that changed no number; None: all of them


_NO_SOFT_JOINTS = Removed(why="joints are solved as one system, none of them softer than others")
# Path before -> why it is gone. Stored values that are off are left out.
REMOVED: dict[str, Removed] = {
    "env.physics.softened_hertz_share": _NO_SOFT_JOINTS,
    "env.physics.softened_damping_ratio": _NO_SOFT_JOINTS,
    "env.physics.yielding_hertz_share": _NO_SOFT_JOINTS,
    "env.physics.yielding_damping_ratio": _NO_SOFT_JOINTS,
    "env.physics.published_details": Removed(why="details of the published package are for its tests", off=([], ())),
    "curriculum.learnable_only": Removed(why="it gained nothing", off=(False,)),
    "env.effect_groups": Removed(
        why="one engine for all worlds is as fast on a CPU, and no GPU figure was in favour of groups"
    ),
    "rollout.random_start_share": Removed(why="exploring starts gave nothing", off=(0.0,)),
    "rollout.random_start_steps": Removed(why="exploring starts gave nothing"),
    "curriculum.generator.edited_share": Removed(why="half of the levels edited gave nothing", off=(0.0,)),
    "curriculum.generator.num_changes": Removed(why="half of the levels edited gave nothing"),
}

# (path now, value before) -> (value with which a stored policy is played, why it is gone).
REMOVED_VALUES: dict[tuple[str, Any], tuple[Any, str]] = {}


class RenamedSettingError(ValueError):
    """A setting's old spelling, with the new one in the line; or a stored setting that is gone and was in use."""


def translated(data: Mapping[str, Any], *, for_playing: bool = False) -> dict[str, Any]:
    """Stored configuration with today's names. for_playing: without settings of training that are gone.

    Raises:
        RenamedSettingError: A setting of training is gone, was in use, and `for_playing` is False.
        ValueError: A field is within a value that is no section.
    """
    nested: dict[str, Any] = {}
    for path, value in _translated_leaves(data, "", "", for_playing):
        *sections, field = path.split(".")
        place = nested
        for section in sections:
            place = place.setdefault(section, {})
            if not isinstance(place, dict):
                raise ValueError(f"config field {path!r} is within {section!r}, which is no section")
        place[field] = value
    return nested


def refuse_old_options(options: Mapping[str, Any]) -> None:
    """Raises RenamedSettingError for an option {"policy.kernels": ...} whose path or value is an old spelling."""
    for name, value in options.items():
        path = ".".join(part for part in name.split(".") if not part.isdecimal())  # phases.0.options.ppo.clip
        if (field := path.removeprefix("phases.")) != path and field in PHASE_NAMES:
            raise RenamedSettingError(f"{path} is now called phases.options.{PHASE_NAMES[field]}; use that")
        path = path.removeprefix("phases.options.")
        if (new := new_path(path)) != path:
            raise RenamedSettingError(f"{path} is now called {new}; use that")
        if removed := _removed(path):
            raise RenamedSettingError(f"{path} is gone: {removed.why}; leave it out")
        for entry in value if isinstance(value, list | tuple) else (value,):
            if isinstance(entry, Mapping):
                refuse_old_options({f"{path}.{name}": inner for name, inner in entry.items()})
            elif _is_key((path, entry), RENAMED_VALUES):
                new_value = RENAMED_VALUES[path, entry]
                raise RenamedSettingError(f"{path} {entry!r} is now called {new_value!r}; use that")
            elif _is_key((path, entry), MOVED_VALUES):
                new, new_value = MOVED_VALUES[path, entry]
                raise RenamedSettingError(f"{path} {entry!r} is now called {new} {new_value!r}; use that")
            elif _is_key((path, entry), REMOVED_VALUES):
                instead, why = REMOVED_VALUES[path, entry]
                raise RenamedSettingError(f"{path} {entry!r} is gone: {why}; use {instead!r}")


def refuse_old_words(command: str, words: Sequence[str]) -> None:
    """The same for the words after a command, --section.field VALUE ... or --section.field=VALUE."""
    for name, values in _options_in(words):
        if new := RENAMED_OPTIONS.get((command, f"--{name.replace('_', '-')}")):
            raise RenamedSettingError(f"--{name} is now called {new}; use that")
        refuse_old_options({name.replace("-", "_"): values})


def new_path(path: str) -> str:
    """Today's path of a field or section; the path itself where it was not renamed."""
    parts = path.split(".")
    for length in range(len(parts), 0, -1):
        if new := RENAMED.get(".".join(parts[:length])):
            return ".".join([new, *parts[length:]])
    return path


def _translated_leaves(data: Mapping[str, Any], before: str, now: str, for_playing: bool) -> Iterator[tuple[str, Any]]:
    """Fields of a section by today's full path. before, now: the section's own paths, "" of the whole."""
    for name, value in data.items():
        old, path = _join(before, name), RENAMED.get(_join(before, name), _join(now, name))
        if removed := REMOVED.get(old):
            if not for_playing and removed.off is not None and value not in removed.off:
                raise RenamedSettingError(f"{old} is {value!r}, but this setting is gone: {removed.why}; {_NEW_RUN}")
        elif isinstance(value, Mapping) and value:
            yield from _translated_leaves(value, old, path, for_playing)
        elif path == "phases" and isinstance(value, list | tuple):
            yield path, [_translated_phase(phase, for_playing) for phase in value]
        elif isinstance(value, list | tuple):
            yield path, [_translated_value(path, entry, for_playing) for entry in value]
        elif _is_key((path, value), MOVED_VALUES):
            yield MOVED_VALUES[path, value]
        else:
            yield path, _translated_value(path, value, for_playing)


def _translated_phase(phase: Any, for_playing: bool) -> Any:
    """Return a phase whose options have today's names; one of another form as it is, which `build` refuses."""
    if not isinstance(phase, Mapping) or not isinstance(phase.get("options", {}), Mapping):
        return phase
    named = {PHASE_NAMES[name]: value for name, value in phase.items() if name in PHASE_NAMES and value is not None}
    options = {new_path(name): value for name, value in {**named, **phase.get("options", {})}.items()}
    others = {name: value for name, value in phase.items() if name not in (*PHASE_NAMES, "options")}
    return {**others, "options": dict(_translated_leaves(options, "", "", for_playing))}


def _translated_value(path: str, value: Any, for_playing: bool) -> Any:
    if _is_key((path, value), REMOVED_VALUES):
        instead, why = REMOVED_VALUES[path, value]
        if not for_playing:
            raise RenamedSettingError(f"{path} is {value!r}, which is gone: {why}; {_NEW_RUN}")
        return instead
    return RENAMED_VALUES[path, value] if _is_key((path, value), RENAMED_VALUES) else value


_NEW_RUN = "start a new run (`kinetix-dist eval` still plays the old policy)"


def _is_key(key: tuple[str, Any], table: Mapping[tuple[str, Any], Any]) -> bool:
    return isinstance(key[1], str | int | float) and key in table


def _removed(path: str) -> Removed | None:
    parts = path.split(".")
    sections = (".".join(parts[:length]) for length in range(len(parts), 0, -1))
    return next((REMOVED[section] for section in sections if section in REMOVED), None)


def _options_in(words: Sequence[str]) -> Iterator[tuple[str, list[str]]]:
    """Each option of a command line with the words after it."""
    name, values = "", []
    for word in [*words, "--"]:
        if not word.startswith("--"):
            values.append(word)
            continue
        if name:
            yield name, values
        name, _, value = word.removeprefix("--").partition("=")
        values = [value] if value else []


def _join(section: str, name: str) -> str:
    return f"{section}.{name}" if section else name
