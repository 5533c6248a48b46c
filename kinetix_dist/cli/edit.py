"""`kinetix-dist edit [LEVEL|FILE|DIR|LINK]`: draws, checks and plays levels in a browser.

    kinetix-dist edit                   the gallery of designed levels; what is made is downloaded
    kinetix-dist edit s/hop_home        a designed level, likewise
    kinetix-dist edit mine.json         this file, which need not be there yet; it is saved there
    kinetix-dist edit my_levels/        the level files of this directory and its folders; they are saved there
    kinetix-dist edit 'LINK'            the level of a link that any installation's editor gave; in quotes

Nothing is written but the file, or files of the directory, that was named, and what `teach it` and `solve it` make in
the directory of --results; a file that was changed elsewhere is left as it is until you say so. Buffers and policies
of the runs below runs/ can be opened too, if there are some.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro

from kinetix_dist.cli.checks import check_output_directory
from kinetix_dist.cli.dashboard import RUNS, ServerArgs, serve_pages
from kinetix_dist.errors import UserError
from kinetix_dist.level.level_data import designed_files, designed_names, levels_root
from kinetix_dist.near_names import did_you_mean
from kinetix_dist.studio.server.app import ServerConfig
from kinetix_dist.studio.server.editor_pages import EditorConfig
from kinetix_dist.studio.server.level_files import SUFFIX, LevelFiles
from kinetix_dist.studio.server.level_links import linked_level, read_link

PAGE = "#/edit"
RESULTS = EditorConfig().results


@dataclasses.dataclass
class Args(ServerArgs):
    """Make, change, check and play levels in a browser."""

    level: Annotated[str | None, tyro.conf.Positional] = None
    """A designed level, a level file (it may be new), a directory of them, or a link; default: the gallery."""
    results: Path = RESULTS
    """The directory for levels, runs and proofs of `teach it` and `solve it`; made when it is needed."""


def run(args: Args) -> int:
    if args.results != RESULTS:  # else it is made when it is needed, and the working directory may be read-only
        check_output_directory(args.results, "--results")
    editor = dataclasses.replace(editor_of(args.level), results=args.results)
    return serve_pages("editor", args, ServerConfig(paths=(), optional_paths=(RUNS,), editor=editor, first_page=PAGE))


def editor_of(given: str | None) -> EditorConfig:
    """Raises UserError for a damaged link, and for what is no link, level, file or directory."""
    if given is None:
        return EditorConfig()
    if (packed := linked_level(given)) is not None:
        read_link(packed)  # what is wrong with it is said here
        return EditorConfig(opens=f"link/{packed}")
    path = Path(given)
    if path.is_dir():
        return EditorConfig(files=LevelFiles(directory=path))
    if path.is_file() or (path.suffix == SUFFIX and path.parent.is_dir()):
        if path.suffix != SUFFIX or path.name.startswith("."):
            raise UserError(f"{given} is not named as a level file; its name has to end in {SUFFIX}")
        return EditorConfig(files=LevelFiles(directory=path.parent, only=path.name), opens=f"file/{path.name}")
    designed = designed_files(given)
    if len(designed) > 1:
        raise UserError(f"level {given!r} is in more than one size; name one of {', '.join(map(str, designed))}")
    if not designed:
        help_text = (
            "`kinetix-dist levels list` names "
            f"levels, and a new file has a name that ends in {SUFFIX}, in a directory that is there"
        )
        hint = did_you_mean(given, designed_names(), help_text)
        raise UserError(f"{given!r} is no designed level, level file, directory of them or link; {hint}")
    name = designed[0].relative_to(levels_root()).with_suffix("").as_posix()
    return EditorConfig(opens=f"designed/{name}")
