"""The `kinetix-dist` command: finds the subcommand, parses its arguments, runs it, turns failures into one line.

Each subcommand is a module of this package with

    class Args            a dataclass, or a Union of dataclasses (nested subcommands); tyro makes the flags
    run(args) -> int      the exit status, 0 for success

and, only where the flags depend on what else is given (a recipe that sets defaults, the name of a benchmark),
`parse(argv) -> Args`, which calls `parsing.parse_args`. A module is imported when its command is called and not
before, so `kinetix-dist doctor` still answers on a machine where ray, warp or jax cannot be imported.

Every command takes `--trust-plugins`, with which plugins that a checkpoint names are imported.

Exit status: 0 done, 1 the command ran and the answer is no, 2 the command was given something wrong
(one line on stderr says what and what to do), 130 interrupted; 75 training was stopped by a signal and can go on.
"""

from __future__ import annotations

import functools
import os
import sys
import warnings
from collections.abc import Callable, Sequence
from typing import Any

from kinetix_dist import user_directories
from kinetix_dist.cli.parsing import EXIT_USER_ERROR, PROG, load_module, parse_args
from kinetix_dist.cli.streams import exit_now, exit_now_if_blocked, prepare_streams, say
from kinetix_dist.errors import UserError, one_line
from kinetix_dist.installation import engine_complaint
from kinetix_dist.level.structure import LevelNote
from kinetix_dist.near_names import did_you_mean
from kinetix_dist.registry import TRUST_PLUGINS, TRUST_VARIABLE
from kinetix_dist.renamed_settings import RenamedSettingError, refuse_old_words

__all__ = ["COMMANDS", "main", "parse_args"]

EXIT_INTERRUPTED = 130  # 128 + SIGINT, what shells report

COMMANDS: dict[str, tuple[str, str]] = {  # name: (module, what it does)
    "quickstart": ("kinetix_dist.cli.quickstart", "train, fine-tune and draw on two CPU cores, in minutes"),
    "train": ("kinetix_dist.cli.train", "pretrain a policy; writes a run directory, --resume goes on with it"),
    "sweep": ("kinetix_dist.cli.sweep", "train the arms of a design, and say what each factor is worth"),
    "study": ("kinetix_dist.cli.study", "answer a question by trained arms: table, figure and text with intervals"),
    "finetune": ("kinetix_dist.cli.finetune", "train on a level set from a policy, or one policy for each level"),
    "eval": ("kinetix_dist.cli.eval_command", "solve rates of a run or a checkpoint on a set of levels"),
    "collect": ("kinetix_dist.cli.collect", "play a policy and store its transitions as a data set"),
    "data": ("kinetix_dist.cli.data", "data sets from Kinetix' offline data, and for readers of Minari"),
    "clone-flow": ("kinetix_dist.cli.clone_flow", "a policy of action chunks from data sets, by flow matching"),
    "import-checkpoint": ("kinetix_dist.cli.import_checkpoint", "a policy of the public package as a checkpoint"),
    "dashboard": ("kinetix_dist.cli.dashboard", "pages over runs: curves, curriculum, levels, rollouts, comparison"),
    "edit": ("kinetix_dist.cli.edit", "make, change, check and play levels in a browser"),
    "replay": ("kinetix_dist.cli.replay", "turn a recording into an .rrd that rerun opens, or view it"),
    "levels": ("kinetix_dist.cli.levels", "list, show, play, check, render, convert, generate, solve and count levels"),
    "bench": ("kinetix_dist.cli.bench", "measure the speed of engine, training, learner, scaling and curator"),
    "doctor": ("kinetix_dist.cli.doctor", "what this machine can run, and what is missing"),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command and returns its exit status."""
    if argv is None:
        prepare_streams()
    status = _run(list(sys.argv[1:] if argv is None else argv))
    # Others may have more to say than a slow reader has taken so far.
    if argv is None and sys.argv[1:2] in (["quickstart"], ["train"], ["finetune"]):
        exit_now_if_blocked(status)
        from kinetix_dist.runtime import EXIT_STOPPED

        if status == EXIT_STOPPED:  # what it computed then is still being computed: Python would wait for it, or crash
            exit_now(status)
    return status


def _run(argv: list[str]) -> int:
    user_directories.settle()  # commands that compute say what it replaced
    others, trust = warnings.showwarning, os.environ.get(TRUST_VARIABLE)
    argv = _without_trust(argv)
    warnings.showwarning = functools.partial(_show_warning, others)
    try:
        return _dispatch(argv)
    except UserError as error:
        say(f"{PROG}: {one_line(error)}", sys.stderr)
        return EXIT_USER_ERROR
    except KeyboardInterrupt:
        say(f"{PROG}: interrupted", sys.stderr)
        return EXIT_INTERRUPTED
    finally:
        warnings.showwarning = others
        if trust is None:
            os.environ.pop(TRUST_VARIABLE, None)


def _without_trust(argv: list[str]) -> list[str]:
    """Take `--trust-plugins` out of the words after a command, and pass it on to all readers and child processes."""
    words = argv[:1] + [word for word in argv[1:] if word != TRUST_PLUGINS]
    if len(words) < len(argv):
        os.environ[TRUST_VARIABLE] = "1"
    return words


def _show_warning(others: Callable[..., None], message: Any, category: type[Warning], *position: Any) -> None:
    """A note about a level file as one line on stderr; `others` shows other warnings."""
    if issubclass(category, LevelNote):
        say(f"{PROG}: {one_line(message)}", sys.stderr)
    else:
        others(message, category, *position)


def _dispatch(argv: list[str]) -> int:
    if not argv or argv[0] in ("-h", "--help", "help"):
        print(_usage())
        return 0 if argv else EXIT_USER_ERROR
    if argv[0] == "--version":
        from kinetix_dist.installation import version_of

        print(f"{PROG} {version_of()}")
        return 0
    name, rest = argv[0], argv[1:]
    if name not in COMMANDS:
        hint = did_you_mean(name, COMMANDS, f"commands: {', '.join(COMMANDS)}")
        raise UserError(f"unknown command {name!r}; {hint}")
    _check_current_directory()
    if name != "doctor" and (complaint := engine_complaint()):
        raise UserError(complaint)
    try:
        refuse_old_words(name, rest)
    except RenamedSettingError as error:
        raise UserError(one_line(error)) from None
    module = load_module(COMMANDS[name][0], name)
    parse = getattr(module, "parse", None)
    args = parse(rest) if parse is not None else parse_args(module.Args, rest, prog=f"{PROG} {name}")
    return int(module.run(args) or 0)


def _check_current_directory() -> None:
    """Raises UserError where it was removed: names of files mean nothing, and libraries ask for it as they start."""
    try:
        os.getcwd()
    except FileNotFoundError:
        raise UserError("the current directory was removed; change to one that is there") from None


def _usage() -> str:
    width = max(map(len, COMMANDS))
    lines = [f"usage: {PROG} COMMAND [options]        {PROG} COMMAND --help shows the options", ""]
    lines += [f"  {name:<{width}}  {text}" for name, (_, text) in COMMANDS.items()]
    lines += ["", f"  {TRUST_PLUGINS}  of every command: import the modules that checkpoints and runs name as plugins"]
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
