"""Mistakes of a user: one line with the mistake and the remedy, raised from anywhere above the library code.

Library code raises its own errors (ValueError and its subclasses, OSError). Code that calls it for a user
turns the errors that it expects into a `UserError`. Any other error is a bug and keeps its traceback.
"""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager


class UserError(Exception):
    """Mistake of a user and its remedy, in one line."""


def one_line(error: BaseException | str) -> str:
    """The text of an error without line breaks, for stderr."""
    text = " ".join(str(error).split())
    return text or type(error).__name__


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
