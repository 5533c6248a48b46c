"""`kinetix-dist levels list|show|play|validate|render|import|export|generate|solve|stats`: what is done with levels."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import tyro

from kinetix_dist.cli.convert_levels import Export, Import, run_export, run_import
from kinetix_dist.cli.generate_levels import Generate, run_generate
from kinetix_dist.cli.level_stats import Stats, run_stats
from kinetix_dist.cli.play_level import Play, run_play
from kinetix_dist.cli.render_levels import Render, run_render
from kinetix_dist.cli.solve_levels import Solve, run_solve
from kinetix_dist.errors import UserError, one_line, user_errors
from kinetix_dist.json_text import json_text

_EXPECTED = (ValueError, OSError)  # LevelFormatError, LevelSizeError, missing and unreadable files


@dataclasses.dataclass(frozen=True)
class List:
    """List the level sets, or the levels of one set, file or directory."""

    set: tyro.conf.Positional[str | None] = None
    """A set, a directory of level files, or a file; left out: all sets."""
    json: bool = False
    """Print JSON instead of a table."""


@dataclasses.dataclass(frozen=True)
class Show:
    """Describe one level: shapes, joints, thrusters, what is controlled by what; or show it."""

    level: tyro.conf.Positional[str]
    """A level file, or a designed level such as s/hop_home."""
    picture: Path | None = None
    """Also draw how it starts, to this PNG."""


@dataclasses.dataclass(frozen=True)
class Validate:
    """Check files of levels and of proofs; exit status 1 when one is wrong, with one line for each. What is odd about
    the start of a valid level is a warning, by the same rules as in the editor."""

    files: tyro.conf.Positional[tuple[Path, ...]]
    """Files of levels or proofs, or directories of them."""
    strict: bool = False
    """A level with a warning is wrong too."""
    play: bool = True
    """Also play each level without actions: that it solves itself is a warning."""


Args = (
    Annotated[List, tyro.conf.subcommand("list")]
    | Annotated[Show, tyro.conf.subcommand("show")]
    | Annotated[Play, tyro.conf.subcommand("play")]
    | Annotated[Validate, tyro.conf.subcommand("validate")]
    | Annotated[Render, tyro.conf.subcommand("render")]
    | Annotated[Import, tyro.conf.subcommand("import")]
    | Annotated[Export, tyro.conf.subcommand("export")]
    | Annotated[Generate, tyro.conf.subcommand("generate")]
    | Annotated[Solve, tyro.conf.subcommand("solve")]
    | Annotated[Stats, tyro.conf.subcommand("stats")]
)


def run(args: Any) -> int:
    """Runs the chosen subcommand; 0, or 1 where one of several files was wrong or `solve` found no proof."""
    with_status: dict[type, Callable[[Any], int]] = {
        Play: run_play,
        Generate: run_generate,
        Validate: _validate,
        Solve: run_solve,
        Render: run_render,
        Stats: run_stats,
        Import: run_import,
        Export: run_export,
    }
    if type(args) in with_status:
        return with_status[type(args)](args)
    actions: dict[type, Callable[[Any], None]] = {List: _list, Show: _show}
    with user_errors(*_EXPECTED):
        actions[type(args)](args)
    return 0


def _list(args: List) -> None:
    from kinetix_dist.level.sets import RANDOM_SETS, designed_sets, files_of_set, level_names

    if args.set is None:
        rows = [
            {"set": name, "levels": len(entry["levels"]), "description": entry["description"]}
            for name, entry in designed_sets().items()
        ]
        rows += [
            {
                "set": name,
                "levels": drawn.num_levels,
                "description": f"Random levels of size {drawn.size.upper()} that training never draws, generator "
                f"{drawn.generator!r}",
            }
            for name, drawn in RANDOM_SETS.items()
        ]
    else:
        files = files_of_set(args.set)
        rows = [_row(name, file) for name, file in zip(level_names(files), files, strict=True)]
    if args.json:
        print(json_text(rows, indent=2))
        return
    columns = list(rows[0])
    widths = {key: max(len(key), *(len(str(row[key])) for row in rows)) for key in columns[:-1]}
    for row in [dict(zip(columns, columns)), *rows]:
        cells = [f"{row[key]!s:<{width}}" for key, width in widths.items()]
        print("  ".join([*cells, str(row[columns[-1]])]).rstrip())


def _row(name: str, file: Path) -> dict[str, Any]:
    """Return what the list shows of a level: its name in results, its size, and the file that commands accept."""
    from kinetix_dist.level.fit import smallest_size, usage

    level, info = _read(file)
    return {
        "level": name,
        "size": smallest_size(level),
        **usage(level),
        "file": str(file),
        "description": info.description,
    }


def _show(args: Show) -> None:
    from kinetix_dist.level.document import level_to_json
    from kinetix_dist.level.kinetix_format import is_kinetix_document
    from kinetix_dist.level.sets import file_of_level
    from kinetix_dist.level.structure import read_document

    path = file_of_level(args.level)
    level, info = _read(path)
    document = read_document(path)
    if is_kinetix_document(document):
        document = level_to_json(level, info)
    about = [info.title, f"size {info.size}", info.difficulty, ", ".join(info.tags)]
    print("  ".join([info.name, *filter(None, about)]))
    if info.description:
        print(info.description)
    for wall, surface in document.get("walls", {}).items():
        print(f"  wall      {wall}: {_fields(surface)}")
    for shape in document["shapes"]:
        print(f"  shape     {shape['id']}: {_fields(shape, without=('id', 'vertices'))}")
    for joint in document.get("joints", []):
        motor = joint.pop("motor", {"on": False})
        drive = f"; motor {_fields(motor)}" if motor.get("on", True) else ""
        print(f"  joint     {joint['a']} - {joint['b']}: {_fields(joint, without=('a', 'b'))}{drive}")
    for thruster in document.get("thrusters", []):
        print(f"  thruster  {thruster['shape']}: {_fields(thruster, without=('shape',))}")
    if args.picture is not None:
        run_render(Render(levels=str(path), out=args.picture))


def _fields(entry: dict[str, Any], without: tuple[str, ...] = ()) -> str:
    return ", ".join(f"{key} {_text(value)}" for key, value in entry.items() if key not in without)


def _text(value: Any) -> str:
    if isinstance(value, list):
        return "(" + ", ".join(_text(item) for item in value) + ")"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _validate(args: Validate) -> int:
    from kinetix_dist.level.sets import data_files
    from kinetix_dist.level.structure import foreign_files

    files: list[Path] = []
    foreign = ""
    for given in args.files:
        if not given.exists():
            raise UserError(f"there is no {given}; give files of levels or proofs, or directories of them")
        with user_errors(*_EXPECTED):
            files += data_files(given, "**/*.json") if given.is_dir() else [given]
        foreign = foreign or (foreign_files(given) if given.is_dir() else "")
    if not files:
        raise UserError(f"no level files to check; give files or directories that hold .json files{foreign}")
    num_wrong = num_warned = 0
    for path in files:
        try:
            warnings = _warnings_of(path, plays=args.play)
        except _EXPECTED as error:
            num_wrong += 1
            text = one_line(error)
            print(text if str(path) in text else f"{path}: {text}", flush=True)
            continue
        num_warned += bool(warnings)
        num_wrong += bool(warnings) and args.strict
        for warning in warnings:
            print(f"{path}: {'' if args.strict else 'warning: '}{warning}", flush=True)
    also = f", {num_warned} with warnings" if num_warned and not args.strict else ""
    print(f"{len(files) - num_wrong} of {len(files)} files are valid{also}")
    return 1 if num_wrong else 0


def _warnings_of(path: Path, *, plays: bool) -> list[str]:
    """Warnings about a valid level; says what was mended of a public file. Raises _EXPECTED for an invalid one."""
    from kinetix_dist.env.env_config import EnvConfig
    from kinetix_dist.level.fit import capacity_of_size, fit_level
    from kinetix_dist.level.proof import is_proof_document, read_proof
    from kinetix_dist.level.sets import read_level_file
    from kinetix_dist.level.start_warnings import noop_warning, start_warnings
    from kinetix_dist.level.structure import read_document
    from kinetix_dist.studio.worker.attempts import steps_until_noop_solves
    from kinetix_dist.studio.worker.programs import environment

    if is_proof_document(read_document(path)):
        read_proof(path)
        return []
    file = read_level_file(path)
    if file.notes:
        print(f"{path}: {'; '.join(file.notes)}")
    found = start_warnings(file.level, file.document)
    if plays:
        size = file.info.size
        in_its_arrays = fit_level(file.level, capacity_of_size(size))
        found += noop_warning(steps_until_noop_solves(environment(EnvConfig(size=size)), in_its_arrays))
    return [warning.text for warning in found]


def _read(path: Path) -> tuple[Any, Any]:
    """The level of a file in either format, and what is known about it."""
    from kinetix_dist.level.sets import read_level

    return read_level(path)
