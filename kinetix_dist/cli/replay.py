"""`kinetix-dist replay`: a recorded rollout as an .rrd for rerun, in the viewer, or as a picture.

    kinetix-dist replay runs/quickstart                       the last rollout recorded there
    kinetix-dist replay runs/quickstart --list                what is recorded
    kinetix-dist replay a.mcap --solved --picture out.png     the last solved one, without a display
    kinetix-dist replay a.mcap --gif out.gif                  a moving picture

Recordings hold their levels: a file replays anywhere, without its run. What is wrong with a file (its writer was
killed, a byte is damaged) is said in one line on stderr, and what is whole is replayed.
"""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
from pathlib import Path
from typing import Annotated

import tyro

from kinetix_dist.child_python import command_of
from kinetix_dist.cli.checks import check_output_file
from kinetix_dist.cli.streams import say
from kinetix_dist.errors import UserError, user_errors
from kinetix_dist.telemetry.recording import RecordingError, Rollout
from kinetix_dist.text_files import is_hidden


@dataclasses.dataclass
class Args:
    """Turn a recording into an .rrd that rerun opens, view it, or make a picture of it."""

    source: Annotated[Path, tyro.conf.Positional]
    """A recording (*.mcap) or a run directory."""
    to: Path | None = None
    """Path of the .rrd; next to the recording by default."""
    view: bool = False
    """Open the .rrd in rerun."""
    connect: str | None = None
    """Show it in a rerun viewer that is running: its address, as `rerun --bind 127.0.0.1` prints it."""
    picture: Path | None = None
    """Write a PNG of moments from start to end; needs no display."""
    gif: Path | None = None
    """Write it as a moving picture (GIF); needs no display."""
    index: int | None = None
    """Which rollout, counted from 0 (-1: the last); default: the last one."""
    solved: bool = False
    """The last rollout that was solved."""
    failed: bool = False
    """The last rollout that failed: green touched red, or out of time."""
    list: bool = False
    """Only list what is recorded."""


def run(args: Args) -> int:
    if sum((args.index is not None, args.solved, args.failed)) > 1:
        raise UserError("--index, --solved and --failed exclude each other; give one of them")
    for name in ("to", "picture", "gif"):
        if (file := getattr(args, name)) is not None:
            check_output_file(file, f"--{name}")
    files = recording_files(args.source)
    rollouts = _read(files)
    if args.list:
        _print_list(rollouts)
        return 0
    file, index, rollout = _select(args, rollouts)
    print(f"{file} rollout {index}: {describe(rollout)}")
    _write_pictures(args, rollout)
    if args.connect is not None:
        from kinetix_dist.telemetry.sinks.rerun import rollout_to_viewer

        with user_errors(ConnectionError):
            rollout_to_viewer(rollout, args.connect)
        print(f"shown    {args.connect}")
    if args.to is not None or args.view or not (args.picture or args.gif or args.connect):
        target = args.to or file.with_name(f"{file.stem}_{index:03d}.rrd")
        _write_rrd(target, rollout)
        print(f"rerun    {target}")
        if args.view:
            return _view(target)
        if args.to is None:
            print(f"next     rerun {target}")
    return 0


def _write_pictures(args: Args, rollout: Rollout) -> None:
    from kinetix_dist.telemetry.pictures import write_rollout_gif, write_rollout_picture

    with user_errors(OSError, prefix="the picture cannot be written: "):
        if args.picture is not None:
            write_rollout_picture(args.picture, rollout)
            print(f"picture  {args.picture}")
        if args.gif is not None:
            write_rollout_gif(args.gif, rollout)
            print(f"gif      {args.gif}")


def recording_files(source: Path) -> list[Path]:
    """The recordings that `source` names, oldest first."""
    if source.is_file():
        return [source]
    if not source.is_dir():
        raise UserError(f"{source} does not exist; give a recording (*.mcap) or a run directory")
    folder = source / "recordings"
    files = sorted(_recordings(folder if folder.is_dir() else source), key=lambda file: file.stat().st_mtime_ns)
    if not files:
        raise UserError(f"{source} holds no recordings (recordings/*.mcap); train with recording on, or give a file")
    return files


def _recordings(folder: Path) -> list[Path]:
    return [path for path in folder.glob("*.mcap") if not is_hidden(path, folder)]


def describe(rollout: Rollout) -> str:
    """One line: level, outcome, length, return, who played."""
    policy = "random actions" if rollout.policy_version < 0 else f"policy version {rollout.policy_version}"
    return (
        f"{rollout.level_name}, {rollout.outcome} after {rollout.num_steps} steps "
        f"({rollout.num_steps * rollout.step_seconds:.1f} s), return {rollout.reward.sum():.3f}, {policy}"
    )


def _read(files: list[Path]) -> list[tuple[Path, int, Rollout]]:
    """Every rollout with its file and its index there; says on stderr what cannot be read."""
    from kinetix_dist.evaluation.recordings import read_rollouts

    rollouts: list[tuple[Path, int, Rollout]] = []
    for file in files:
        with user_errors(RecordingError, OSError):
            recording = read_rollouts(file)
        for problem in recording.problems:
            say(f"kinetix-dist: {problem}", sys.stderr)
        rollouts += [(file, index, rollout) for index, rollout in enumerate(recording.rollouts)]
    if not rollouts:
        raise UserError(f"{files[0]} holds no whole rollout; nothing to replay")
    return rollouts


def _select(args: Args, rollouts: list[tuple[Path, int, Rollout]]) -> tuple[Path, int, Rollout]:
    if args.index is not None:
        if not -len(rollouts) <= args.index < len(rollouts):
            raise UserError(f"--index is {args.index}; {args.source} has rollouts 0 to {len(rollouts) - 1}")
        return rollouts[args.index]
    if not (args.solved or args.failed):
        return rollouts[-1]
    wanted = [entry for entry in rollouts if entry[2].is_complete and entry[2].solved == args.solved]
    if not wanted:
        what = "solved" if args.solved else "failed"
        raise UserError(f"none of the {len(rollouts)} rollouts of {args.source} is {what}; --list shows them")
    return wanted[-1]


def _print_list(rollouts: list[tuple[Path, int, Rollout]]) -> None:
    for number, (file, _, rollout) in enumerate(rollouts):
        print(f"{number:4d}  {file.name}  {describe(rollout)}")


def _write_rrd(target: Path, rollout: Rollout) -> None:
    from kinetix_dist.telemetry.sinks.rerun import rollout_to_rrd

    with user_errors(OSError):
        rollout_to_rrd(rollout, target)


def _view(target: Path) -> int:
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise UserError(
            f"no display to open rerun on; {target} is written: open it elsewhere, "
            f"or `rerun {target} --serve-web --bind 127.0.0.1` and a browser"
        )
    # rerun listens on all interfaces by default.
    return subprocess.run(command_of("rerun", target, "--bind", "127.0.0.1"), check=False).returncode
