"""What the programs of bench/ share: help is the module's docstring, what was wrong is one line and exit code 2."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from jax2d.fidelity.arguments import OneLineParser
from kinetix_dist.errors import UserError


def parser_of(doc: str | None, prog: str | None = None) -> OneLineParser:
    """A parser whose description is a module's docstring, as it is written."""
    return OneLineParser(prog=prog, description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)


def exit_code(parser: OneLineParser, work: Callable[[], int]) -> int:
    """What `work()` returns; a `UserError` in it is one line and exit code 2."""
    try:
        return work()
    except UserError as error:
        parser.error(str(error))


def report_each(records: Iterable[Any], file: Path | None, *, text: Callable[[Any], str] = str) -> list[Any]:
    """All records. Each is printed as it comes, as `text` says it; `file` has all so far, so that what is cut short
    leaves what it had measured."""
    found = []
    for record in records:
        found.append(record)
        print(text(record), flush=True)
        if file is not None:
            file.write_text(json.dumps(found, indent=1) + "\n")
    return found


def output_file(text: str) -> Path:
    """An argument that names a file to write: refused at once where it cannot be, not after the measurement."""
    file = Path(text)
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.touch()
    except OSError as error:
        raise argparse.ArgumentTypeError(f"cannot write {file}: {error.strerror}") from None
    return file
