"""Arguments of a command: parsed by tyro, with every complaint in one line; and modules imported when needed."""

from __future__ import annotations

import contextlib
import importlib
import io
import re
from collections.abc import Sequence
from typing import Any

from kinetix_dist.errors import UserError, one_line
from kinetix_dist.setting import ConfigError, check_finite

PROG = "kinetix-dist"
EXIT_USER_ERROR = 2  # a command that fails because of what it was given: one line on stderr (`UserError`)
OWN_PACKAGES = ("kinetix_dist", "jax2d")


def parse_args(args_type: Any, argv: Sequence[str], *, prog: str, default: Any = None) -> Any:
    """`tyro.cli` whose complaints are one line each: an unknown flag or a bad value raises `UserError`.

    `default` is an instance of `args_type` that replaces the defaults of its fields. `--help` prints
    and raises `SystemExit(0)` as usual.
    """
    import tyro

    complaint = io.StringIO()
    keywords = {} if default is None else {"default": default}
    try:
        with contextlib.redirect_stderr(complaint):
            args = tyro.cli(args_type, prog=prog, args=list(argv), **keywords)
        check_finite(args, "Args")
        return args
    except ConfigError as error:  # of a group of options: names of its class and fields
        option = re.sub(r"\b[A-Z]\w*\.(\w+)", lambda found: f"--{found[1].replace('_', '-')}", one_line(error))
        raise UserError(f"{option}; see `{prog} --help`") from None
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        raise UserError(_flatten(complaint.getvalue(), prog)) from None


def load_module(module_name: str, command: str) -> Any:
    """Imports the module of a command; raises `UserError` where a package that it needs is not installed."""
    try:
        return importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        if error.name is not None and error.name.split(".")[0] in OWN_PACKAGES:
            raise
        raise UserError(
            f"{command!r} needs the package {error.name!r}, which is not installed; "
            f"run `make install` in the repository, then `{PROG} doctor`"
        ) from error


def _flatten(text: str, prog: str) -> str:
    """One line out of the box that tyro draws around a complaint."""
    text = re.sub(r"\x1b\[[0-9;]*m", "", text)
    text = re.sub(r"[╭╮╰╯│─┌┐└┘├┤━┃]+|-{3,}", " ", text)
    text = one_line(text)
    text = re.sub(r"For full helptext, (run|see):? (\S+ )*?--help\.?", " ", text)
    text = re.sub(r"^(Parsing error|Value error|Missing argument|Required options:?|Invalid choice:?) ", "", text)
    text = re.sub(r"^Error parsing \w+: ", "", text)
    text = re.sub(r"^(Unrecognized options:?) \1", r"\1", one_line(text))
    text = text.replace(" Argument helptext:", ";")
    return f"{text.rstrip(' .')}; see `{prog} --help`"
