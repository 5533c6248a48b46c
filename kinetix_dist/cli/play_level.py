"""`kinetix-dist levels play LEVEL`: the level in a browser, played at once by keys or by a policy.

    kinetix-dist levels play s/hop_home --open                  by keys
    kinetix-dist levels play mine.json --policy generalist      by the bundled policy, `random` or `noop`
    kinetix-dist levels play l/walker --policy runs/sfl_l       by that of a run
    kinetix-dist levels play 'LINK'                             the level of a link of any editor; in quotes

The pages are those of `kinetix-dist edit`: stopped, the level can be changed, and a level file be saved.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import tyro

from kinetix_dist.cli.checks import check_output_directory
from kinetix_dist.cli.dashboard import ServerArgs, serve_pages
from kinetix_dist.cli.edit import PAGE, RESULTS, editor_of
from kinetix_dist.errors import UserError, user_errors
from kinetix_dist.near_names import did_you_mean
from kinetix_dist.studio.server.app import ServerConfig
from kinetix_dist.studio.server.level_links import linked_level, read_link

WITHOUT_A_NETWORK = ("keys", "random", "noop")


@dataclasses.dataclass(kw_only=True)
class Play(ServerArgs):
    """Play one level in a browser, by keys or by a policy."""

    level: tyro.conf.Positional[str]
    """A level file, a designed level such as s/hop_home, or the link of a level."""
    policy: str = "keys"
    """Player: "keys", "random", "noop", a pretrained policy such as generalist, or a run directory."""
    results: Path = RESULTS
    """The directory for levels, runs and proofs of `teach it` and `solve it`; made when it is needed."""


def run_play(args: Play) -> int:
    """Serves the pages until Ctrl-C."""
    if not args.play:
        raise UserError("--no-play starts no engine, which playing needs; leave it out")
    if args.results != RESULTS:
        check_output_directory(args.results, "--results")
    plays, runs = _player(args.policy)
    editor = dataclasses.replace(editor_of(_level_to_open(args.level)), plays=plays, results=args.results)
    return serve_pages("play", args, ServerConfig(paths=runs, editor=editor, first_page=PAGE))


def _level_to_open(given: str) -> str:
    """Level that the editor opens: of a directory of one level its file. Raises UserError for what is no level."""
    from kinetix_dist.level.schema import level_from_json
    from kinetix_dist.level.sets import file_of_level, read_level

    if (packed := linked_level(given)) is not None:
        document = read_link(packed)
        with user_errors(ValueError, prefix="the level of this link: "):
            level_from_json(document)
        return given
    with user_errors(ValueError, OSError):
        file = file_of_level(given)
        read_level(file)
    return str(file) if Path(given).is_dir() else given


def _player(policy: str) -> tuple[str, tuple[Path, ...]]:
    """Name of a policy on pages, and the runs that are served for it."""
    from kinetix_dist.checkpoint.store import pretrained_names
    from kinetix_dist.studio.runs.address_names import address_name
    from kinetix_dist.studio.runs.run_files import is_run

    if policy in WITHOUT_A_NETWORK:
        return policy, ()
    if policy in pretrained_names():
        return f"checkpoint:{policy}", ()
    run = Path(policy)
    if is_run(run):
        return f"run:{address_name(run.resolve().name)}", (run.resolve(),)
    known = [*WITHOUT_A_NETWORK, *pretrained_names()]
    hint = did_you_mean(policy, known, f"there are {', '.join(known)}")
    raise UserError(f"--policy {policy} is no run directory and no policy; {hint}")
