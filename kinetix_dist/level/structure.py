"""Reads JSON documents and reports faults of their size, numbers, texts, types and ranges, the latter by a JSON schema.

Every complaint is one printable line: field, problem, remedy. `validate.py` checks the meaning of the fields. Other
files of the public package's ecosystem (pickles of its editor and training, arrays) are recognised, named, and never
loaded: loading a pickle runs the code in it.

Size comes first (`size_problem`): a schema needs 0.6 ms a shape, and names are compared with each other.
"""

from __future__ import annotations

import functools
import math
import unicodedata
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from kinetix_dist.errors import printable, shortened
from kinetix_dist.text_files import MAX_DEPTH, FileTooLargeError, loads_json, read_bytes, read_json

MAX_LEVEL_BYTES = 4 << 20  # of a file of a level or a proof; the largest public one has 60 kB
MAX_ENTRIES = 1000  # of a list of shapes, joints, thrusters or tags; the largest size has room for 16 shapes
MAX_VALUES = 100_000  # numbers, texts, lists and objects of a document
MAX_TEXT = 10_000  # characters of a text
MAX_NUMBER = 1e6  # of any field, in its unit; float32 positions beyond it are 6 cm apart and coarser
_MULTILINE = ("description",)  # fields whose text may have line breaks and tabs
_SHOWN = 300  # characters of each part of a complaint
_BOUNDS = {
    "minimum": "at least",
    "maximum": "at most",
    "exclusiveMinimum": "more than",
    "exclusiveMaximum": "less than",
}


class LevelFormatError(ValueError):
    """A level document is wrong; the message names the field and the remedy in one line.

    Its parts quote the document: they are shortened, and control characters in them are escaped.
    """

    def __init__(self, path: str, problem: str, remedy: str) -> None:
        self.path, self.problem, self.remedy = (_shown(part) for part in (path, problem, remedy))
        what = f"{self.problem}; {self.remedy}"
        super().__init__(f"{self.path}: {what}" if self.path else what)

    def in_file(self, file: object) -> LevelFormatError:
        """Return the same complaint with the file before the field."""
        path = f"{file}: {self.path}" if self.path else str(file)
        error = LevelFormatError("", self.problem, self.remedy)
        error.path = printable(path)  # not shortened: callers look for the name of the file in it
        error.args = (f"{error.path}: {self.problem}; {self.remedy}",)
        return error


def _shown(text: str) -> str:
    return printable(shortened(text, _SHOWN))


class LevelNote(UserWarning):
    """A level differs from its file in one respect, which one line names."""


def raise_first(problems: Iterator[LevelFormatError]) -> None:
    """Raises the first complaint, if there is one."""
    for problem in problems:
        raise problem


def read_document(path: Path) -> Any:
    """Return the JSON document of a level file of either format. Raises `LevelFormatError` naming the file."""
    try:
        content = read_bytes(path, MAX_LEVEL_BYTES)
    except FileTooLargeError as error:
        raise LevelFormatError("", str(error), "a level file has a few kB").in_file(path) from error
    if kind := kind_of_bytes(content):
        raise LevelFormatError("", f"is {kind}", REMEDY).in_file(path)
    try:
        return loads_json(content)
    except ValueError as error:  # also text that is not UTF-8, and NaN
        raise LevelFormatError("", f"is not JSON ({error})", "correct it at that place").in_file(path) from error


def size_problem(document: Any) -> LevelFormatError | None:
    """Return the first complaint that a document is too large or too deep to be checked, in time linear in the limits.

    Lists of a level have at most MAX_ENTRIES entries. Only MAX_VALUES bounds the caches of a public document.
    """
    num_values = 0
    waiting: list[tuple[Any, str, int]] = [(document, "", 0)]
    while waiting:
        value, path, depth = waiting.pop()
        if isinstance(value, str) and len(value) > MAX_TEXT:
            return LevelFormatError(path, f"has {len(value):,} characters", f"give at most {MAX_TEXT:,}")
        if not isinstance(value, dict | list):
            continue
        if depth == MAX_DEPTH:
            return LevelFormatError(path, "is nested too deeply", f"nest at most {MAX_DEPTH} lists and objects")
        if isinstance(value, list) and len(value) > MAX_ENTRIES and path.rpartition(".")[2] not in _CACHES:
            return LevelFormatError(path, f"has {len(value):,} entries", f"give at most {MAX_ENTRIES:,}")
        num_values += len(value)
        if num_values > MAX_VALUES:
            return LevelFormatError("", f"has more than {MAX_VALUES:,} values", "a level has a few hundred")
        entries = value.items() if isinstance(value, dict) else enumerate(value)
        waiting += [(inner, _below(path, name), depth + 1) for name, inner in entries]
    return None


def value_problems(value: Any, path: str = "") -> Iterator[LevelFormatError]:
    """Complain about numbers that are not finite or beyond MAX_NUMBER, and about control characters in texts and keys.

    A control character in a name would reach every terminal that shows the name.
    """
    if isinstance(value, float) and not math.isfinite(value):
        yield LevelFormatError(path, f"is {value}", "give a finite number")
    elif isinstance(value, int | float) and abs(value) > MAX_NUMBER:
        yield LevelFormatError(path, f"is {_short(value)}", f"give a number between -{MAX_NUMBER:g} and {MAX_NUMBER:g}")
    elif isinstance(value, str):
        yield from _text_problems(value, path)
    elif isinstance(value, dict):
        for key, inner in value.items():
            yield from _text_problems(str(key), path)
            yield from value_problems(inner, _below(path, key))
    elif isinstance(value, list):
        for i, inner in enumerate(value):
            yield from value_problems(inner, _below(path, i))


def _below(path: str, name: str | int) -> str:
    """Return the path of an entry. Its middle is cut: a hundred thousand entries may have paths of long keys."""
    if isinstance(name, int):
        return shortened(f"{path}[{name}]", _SHOWN)
    return shortened(f"{path}.{name}" if path else name, _SHOWN)


def _text_problems(text: str, path: str) -> Iterator[LevelFormatError]:
    if text.isprintable():
        return
    allowed = "\n\r\t" if path in _MULTILINE else ""
    for char in text:
        if unicodedata.category(char) in ("Cc", "Cs") and char not in allowed:
            yield LevelFormatError(path, f"has the control character {char!r}", "remove it")
            return


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
        yield LevelFormatError(path, f"unknown size {_short(given)}", f"use one of {', '.join(limit)}")
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
    return shortened(repr(value), 40)


REMEDY = "write each level as JSON, in the public package with `export_env_state_to_json`"
_KINDS = {
    b"\x80": "a Python pickle, which is never loaded because that would run the code in it",
    b"BZh": "a bzip2 archive, as which the public package saves pickles, which are never loaded",
    b"\x1f\x8b": "a gzip archive",
    b"PK": "a zip archive, as NumPy's .npz is",
    b"\x93NUMPY": "a NumPy array",
    b"\x89HDF": "an HDF5 file",
}  # by their first bytes, none of which begins a JSON text
_CACHES = ("acc_rr_manifolds", "acc_cr_manifolds", "acc_cc_manifolds")  # of a public document: entries for pairs
_ZARR_FILES = (".zgroup", ".zarray", ".zmetadata", "zarr.json")
_SUFFIXES = (".pkl", ".pickle", ".pbz2", ".npz", ".npy", ".zarr", ".h5", ".hdf5", ".zip", ".gz", ".msgpack")


def kind_of_bytes(content: bytes) -> str | None:
    """Format of a file that begins with these bytes, if it is a known archive; None if it may be text."""
    return next((kind for begins, kind in _KINDS.items() if content.startswith(begins)), None)


def is_zarr_store(directory: Path) -> bool:
    """Return True for a store of arrays, whose JSON files hold no levels."""
    return any((directory / name).is_file() for name in _ZARR_FILES)


def foreign_files(directory: Path) -> str:
    """Counts of known other files in a directory without levels, to end a complaint with; may be empty."""
    found = Counter(path.suffix for path in directory.rglob("*") if path.suffix in _SUFFIXES)
    counts = ", ".join(f"{count} {suffix}" for suffix, count in sorted(found.items()))
    return f"; {counts} cannot be read here: {REMEDY}" if found else ""
