"""Form of a checkpoint's description (checkpoint.json): the parts that readers use, and the type of each.

A checkpoint may come from anybody, so `description_fault` is asked before a reader sees the description. Sections that
a config dataclass describes (`config.env`, `config.policy`, ...) are checked when they are built.
"""

from __future__ import annotations

from typing import Any

from kinetix_dist.errors import quoted

_WORDS = {dict: "an object", list: "a list", str: "a text", int: "a whole number", float: "a number"}

# Path of a part -> (its type, whether it must be there if the object that holds it is).
_PARTS: dict[str, tuple[type, bool]] = {
    "num_updates": (int, True),
    "env_steps": (int, False),
    "training_seconds": (float, False),
    "config_hash": (str, False),
    "config": (dict, False),
    "config.run": (dict, False),
    "config.run.name": (str, True),
    "config.run.start_from": (str, False),
    "lineage": (list, False),
    "chunk_policy": (dict, False),
    "chunk_policy.flow": (dict, True),
    "chunk_policy.env": (dict, True),
}


def description_fault(description: Any) -> str | None:
    """Return the first fault of the form of a description, in words; None for a good one."""
    if not isinstance(description, dict):
        return "it is no object"
    for path, (kind, is_needed) in _PARTS.items():
        *sections, name = path.split(".")
        section: dict[str, Any] | None = description
        for part in sections:
            section = None if section is None else section.get(part)
        if section is None:
            continue
        if name not in section:
            if is_needed:
                return f"it has no {path}"
        elif not _has_type(section[name], kind):
            return f"its {path} is {quoted(section[name])} instead of {_WORDS[kind]}"
    if not all(isinstance(ancestor, dict) for ancestor in description.get("lineage", [])):
        return "its lineage is not a list of objects"
    return None


def _has_type(value: Any, kind: type) -> bool:
    return type(value) in (int, float) if kind is float else type(value) is kind
