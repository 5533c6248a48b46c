"""`kinetix-dist levels import|export`: files of the public Kinetix package, one or many, in and out.

    kinetix-dist levels import public.json mine.json          one file
    kinetix-dist levels import public_levels/ mine/           every .json below a directory, in the same folders
    kinetix-dist levels export all_designed_m public/         a set, or a directory of levels

Of many files each one that is wrong is a line on stderr, the others are converted, and the exit status is 1.
"""

from __future__ import annotations

import contextlib
import dataclasses
import sys
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Literal

import tyro

from kinetix_dist.atomic_directories import new_directory
from kinetix_dist.atomic_files import replace_file
from kinetix_dist.cli.checks import check_output_directory, check_output_file
from kinetix_dist.cli.streams import say
from kinetix_dist.errors import UserError, one_line, user_errors
from kinetix_dist.json_text import json_text

_EXPECTED = (ValueError, OSError)  # LevelFormatError, LevelSizeError, missing and unreadable files


@dataclasses.dataclass(frozen=True)
class Import:
    """Turn level files of the public Kinetix package into the format of this one."""

    source: tyro.conf.Positional[Path]
    """A public level file, or a directory; files of its folders are taken too."""
    out: tyro.conf.Positional[Path]
    """The level file to write; of a directory the directory to write into."""
    name: str | None = None
    """Name of the level; left out: that of the file. Not for a directory."""


@dataclasses.dataclass(frozen=True)
class Export:
    """Turn levels into files of the public Kinetix package."""

    levels: tyro.conf.Positional[str]
    """A level file, a designed level such as s/hop_home, a set, or a directory of level files."""
    out: tyro.conf.Positional[Path]
    """The public level file to write; of several levels the directory to write into."""
    size: Literal["s", "m", "l"] | None = None
    """Write arrays of this size; left out: of the size of each level."""


def run_import(args: Import) -> int:
    """0; of a directory 1 where a file could not be imported."""
    if not args.source.is_dir():
        check_output_file(args.out)
        with user_errors(*_EXPECTED):
            size = _import_file(args.source, args.out, args.name)
        print(f"wrote {args.out} (size {size})")
        return 0
    if args.name is not None:
        raise UserError("--name is for one file; levels of a directory are named after their files")
    from kinetix_dist.level.sets import level_files
    from kinetix_dist.level.structure import foreign_files

    with user_errors(*_EXPECTED):
        files = level_files(args.source, "**/*.json")
    if not files:
        found = foreign_files(args.source)
        raise UserError(f"no .json files in {args.source}; give a directory of public level files{found}")
    check_output_directory(args.out)
    outputs = {file: file.relative_to(args.source) for file in files}
    return _convert_all(outputs, lambda file, out: _import_file(file, out, None), args.out, "imported")


def run_export(args: Export) -> int:
    """0; of several levels 1 where one could not be exported."""
    from kinetix_dist.level.sets import files_of_set, level_names

    with user_errors(*_EXPECTED):
        files = files_of_set(args.levels)
    if len(files) == 1 and not Path(args.levels).is_dir():
        check_output_file(args.out)
        with user_errors(*_EXPECTED):
            size = _export_file(files[0], args.out, args.size)
        print(f"wrote {args.out} (size {size})")
        return 0
    check_output_directory(args.out)
    outputs = {file: Path(f"{name}.json") for file, name in zip(files, level_names(files), strict=True)}
    return _convert_all(outputs, lambda file, out: _export_file(file, out, args.size), args.out, "exported")


def _convert_all(outputs: Mapping[Path, Path], convert: Callable[[Path, Path], str], out: Path, done: str) -> int:
    """Convert each file to its path below `out`.

    A new directory appears when all files are converted; a directory that exists gets one file after another.
    """
    sizes: Counter[str] = Counter()
    with user_errors(OSError), new_directory(out) if not out.is_dir() else contextlib.nullcontext(out) as folder:
        for file, below in outputs.items():
            try:
                (folder / below).parent.mkdir(parents=True, exist_ok=True)
                sizes[convert(file, folder / below)] += 1
            except _EXPECTED as error:
                text = one_line(error)
                say(text if str(file) in text else f"{file}: {text}", sys.stderr)
    counts = ", ".join(f"{sizes[size]} of size {size}" for size in sorted(sizes, key="sml".index))
    print(f"{done} {sizes.total()} of {len(outputs)} files into {out}{f' ({counts})' if counts else ''}")
    return 0 if sizes.total() == len(outputs) else 1


def _import_file(file: Path, out: Path, name: str | None) -> str:
    """Writes one level in our format; its size. Nothing is written of a file that is wrong."""
    from kinetix_dist.level.schema import save_level
    from kinetix_dist.level.sets import read_public_level

    level, info = read_public_level(file)
    _refuse_same(file, out)
    try:
        save_level(level, out, dataclasses.replace(info, name=name or info.name))
    except ValueError as error:
        raise ValueError(f"{file}: {one_line(error)}") from error
    return info.size


def _export_file(file: Path, out: Path, size: str | None) -> str:
    """Writes one level in the public format; the size of its arrays."""
    from kinetix_dist.level.fit import capacity_of_size, fit_level
    from kinetix_dist.level.kinetix_format import export_kinetix
    from kinetix_dist.level.sets import read_level

    level, info = read_level(file)
    _refuse_same(file, out)
    size = size or info.size
    try:
        document = export_kinetix(fit_level(level, capacity_of_size(size)), info.public_walls)
    except ValueError as error:
        raise ValueError(f"{file}: {one_line(error)}") from error
    replace_file(out, json_text(document).encode())
    return size


def _refuse_same(file: Path, out: Path) -> None:
    if out.exists() and out.samefile(file):
        raise ValueError(f"{file} would be written over by what is made of it; name another path")
