"""Reading of JSON documents, and complaints about their numbers, types and ranges by a JSON schema.

Every complaint is one line: field, problem, remedy. `validate.py` checks the meaning of the fields. Level files of the
public package's ecosystem that are no JSON (pickles of its editor and training, arrays) are recognised, named, and
never loaded: loading a pickle runs the code in it.
"""

from __future__ import annotations

import functools
import json
import math
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from kinetix_dist.text_files import decode_text, read_json

MAX_NUMBER = 1e6  # of any field, in its unit; float32 positions beyond it are 6 cm apart and coarser
_BOUNDS = {
    "minimum": "at least",
    "maximum": "at most",
    "exclusiveMinimum": "more than",
    "exclusiveMaximum": "less than",
}


class LevelFormatError(ValueError):
    """A level document is wrong; the message names the field and the remedy in one line."""

    def __init__(self, path: str, problem: str, remedy: str) -> None:
        super().__init__(f"{path}: {problem}; {remedy}" if path else f"{problem}; {remedy}")
        self.path, self.problem, self.remedy = path, problem, remedy

    def in_file(self, file: object) -> LevelFormatError:
        """The same complaint with the file before the field."""
        return LevelFormatError(f"{file}: {self.path}" if self.path else str(file), self.problem, self.remedy)


class LevelNote(UserWarning):
    """A level differs from its file in one respect; one line says in which."""


def raise_first(problems: Iterator[LevelFormatError]) -> None:
    """Raises the first complaint, if there is one."""
    for problem in problems:
        raise problem


def read_document(path: Path) -> Any:
    """The JSON document of a level file of either format; raises `LevelFormatError` naming the file."""
    content = path.read_bytes()
    if kind := kind_of_bytes(content):
        raise LevelFormatError(str(path), f"is {kind}", REMEDY)
    try:
        return json.loads(decode_text(content))
    except (ValueError, RecursionError) as error:  # also text that is not UTF-8, whole numbers of 4,300 digits
        raise LevelFormatError(str(path), f"is not JSON ({error})", "correct it at that place") from error


def number_problems(value: Any, path: str = "") -> Iterator[LevelFormatError]:
    """Complaints about numbers in a JSON value that are not finite or beyond MAX_NUMBER."""
    if isinstance(value, float) and not math.isfinite(value):
        yield LevelFormatError(path, f"is {value}", "give a finite number")
    elif isinstance(value, int | float) and abs(value) > MAX_NUMBER:
        yield LevelFormatError(path, f"is {_short(value)}", f"give a number between -{MAX_NUMBER:g} and {MAX_NUMBER:g}")
    elif isinstance(value, dict):
        for key, inner in value.items():
            yield from number_problems(inner, f"{path}.{key}" if path else str(key))
    elif isinstance(value, list):
        for i, inner in enumerate(value):
            yield from number_problems(inner, f"{path}[{i}]")


def structure_problems(document: Any, schema_file: Path, *, see: str) -> Iterator[LevelFormatError]:
    """Complaints about violations of a JSON schema, by path; `see` describes the fields."""
    errors = _structure_validator(schema_file).iter_errors(document)
    seen = set()
    for error in sorted(errors, key=lambda error: list(map(str, error.absolute_path))):
        for problem in _problems_of_error(error, see):
            if (text := str(problem)) not in seen:  # one error for each missing field, which all name them all
                seen.add(text)
                yield problem


def check_structure(document: Any, schema_file: Path, *, see: str) -> None:
    """Raises `LevelFormatError` for the first violation of a JSON schema; `see` describes the fields."""
    raise_first(structure_problems(document, schema_file, see=see))


@functools.cache
def _structure_validator(schema_file: Path) -> Any:
    import jsonschema

    return jsonschema.Draft202012Validator(read_json(schema_file))


def _problems_of_error(error: Any, see: str) -> Iterator[LevelFormatError]:
    path, limit, given = _path_text(error.absolute_path), error.validator_value, error.instance
    if error.validator == "required":
        if "then" in error.absolute_schema_path and "type" not in given:
            return  # the fields of a shape depend on its type: the missing type is reported
        for missing in (name for name in limit if name not in given):
            yield LevelFormatError(f"{path}.{missing}".lstrip("."), "is missing", f"add {missing!r}")
    elif error.validator == "additionalProperties":
        known = sorted(error.schema.get("properties", {}))
        for unknown in (name for name in given if name not in known):
            yield LevelFormatError(
                f"{path}.{unknown}".lstrip("."), "is not a field of the format", f"fields here: {', '.join(known)}"
            )
    elif path == "size" and error.validator == "enum":
        yield LevelFormatError(path, f"unknown size {given!r}", f"use one of {', '.join(limit)}")
    elif error.validator in ("enum", "const"):
        allowed = ", ".join(map(repr, limit)) if error.validator == "enum" else repr(limit)
        yield LevelFormatError(path, f"is {_short(given)}", f"use {allowed}")
    elif error.validator == "type":
        yield LevelFormatError(path, f"is {_short(given)}", f"give a value of type {limit}")
    elif error.validator in ("minItems", "maxItems"):
        bound = "at least" if error.validator == "minItems" else "at most"
        yield LevelFormatError(path, f"has {len(given)} entries", f"give {bound} {limit}")
    elif error.validator in _BOUNDS:
        yield LevelFormatError(path, f"is {given}", f"give {_BOUNDS[error.validator]} {limit}")
    else:
        yield LevelFormatError(path, " ".join(error.message.split()), f"see {see}")


def _path_text(parts: Any) -> str:
    text = ""
    for part in parts:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else str(part)
    return text


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 40 else text[:37] + "..."


REMEDY = "write each level as JSON, in the public package with `export_env_state_to_json`"
_KINDS = {
    b"\x80": "a Python pickle, which is never loaded because that would run the code in it",
    b"BZh": "a bzip2 archive, as which the public package saves pickles, which are never loaded",
    b"\x1f\x8b": "a gzip archive",
    b"PK": "a zip archive, as NumPy's .npz is",
    b"\x93NUMPY": "a NumPy array",
    b"\x89HDF": "an HDF5 file",
}  # by their first bytes, none of which begins a JSON text
_ZARR_FILES = (".zgroup", ".zarray", ".zmetadata", "zarr.json")
_SUFFIXES = (".pkl", ".pickle", ".pbz2", ".npz", ".npy", ".zarr", ".h5", ".hdf5", ".zip", ".gz", ".msgpack")


def kind_of_bytes(content: bytes) -> str | None:
    """Format of a file that begins with these bytes, if it is a known archive; None if it may be text."""
    return next((kind for begins, kind in _KINDS.items() if content.startswith(begins)), None)


def is_zarr_store(directory: Path) -> bool:
    """True of a directory that is a store of arrays, whose JSON files are no levels."""
    return any((directory / name).is_file() for name in _ZARR_FILES)


def foreign_files(directory: Path) -> str:
    """Counts of known other files in a directory without levels, to end a complaint with; empty if there are none."""
    found = Counter(path.suffix for path in directory.rglob("*") if path.suffix in _SUFFIXES)
    counts = ", ".join(f"{count} {suffix}" for suffix, count in sorted(found.items()))
    return f"; {counts} cannot be read here: {REMEDY}" if found else ""
