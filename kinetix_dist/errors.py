"""Mistakes of a user: one line with the mistake and the remedy, raised from anywhere above the library code.

Library code raises its own errors (ValueError and its subclasses, OSError). Code that calls it for a user
turns the errors that it expects into a `UserError`. Any other error is a bug and keeps its traceback.

Messages quote files, which may hold anything: `printable` escapes control characters, `shortened` cuts.
"""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager

MAX_LINE = 2000  # characters of a message
MAX_QUOTED = 80  # characters of a value or a name in a message


class UserError(Exception):
    """Mistake of a user and its remedy, in one line."""


class OneLineError(Exception):
    """An error about a file of somebody else: its text is one printable line, whatever the file holds."""

    def __init__(self, text: str) -> None:
        super().__init__(one_line(text))


def one_line(error: BaseException | str) -> str:
    """Return the text of an error for a terminal or a page: no line breaks, printable, at most MAX_LINE characters."""
    text = shortened(printable(" ".join(str(error).split())), MAX_LINE)
    return text or type(error).__name__


def printable(text: str) -> str:
    """Replace characters that are not printable by their escapes: "\x1b[2J" becomes "\\x1b[2J".

    These are control characters, line breaks too, bidirectional marks, and bytes of file names that are not UTF-8.
    """
    if text.isprintable():
        return text
    return "".join(char if char.isprintable() else char.encode("unicode_escape").decode() for char in text)


def quoted(value: object) -> str:
    """Return the repr of a value that somebody else wrote, cut to MAX_QUOTED characters."""
    return shortened(repr(value), MAX_QUOTED)


def shortened(text: str, limit: int) -> str:
    """Cut the middle out of a text that is longer than `limit` characters."""
    if len(text) <= limit:
        return text
    end = (limit - 3) // 3
    return f"{text[: limit - 3 - end]}...{text[-end:]}"


@contextmanager
def user_errors(*expected: type[Exception], prefix: str = "") -> Generator[None]:
    """Turns the `expected` exceptions raised inside into a `UserError` with the same text.

    `with user_errors(ValueError, OSError): config = load(path)`
    """
    try:
        yield
    except UserError:
        raise
    except expected as error:
        raise UserError(f"{prefix}{one_line(error)}") from error
