"""Tickets: addresses that name one file for a while, for requests that carry no cookie.

rerun's viewer fetches its .rrd without cookies, so the address itself says that it may: an HMAC of the file's name and
of the time until which it holds, by a key that is new with every start of the server.
"""

from __future__ import annotations

import hmac
import secrets
import time

HOLDS_SECONDS = 600.0


class Tickets:
    """Makes and checks tickets."""

    def __init__(self) -> None:
        self._key = secrets.token_bytes(32)

    def ticket(self, name: str, now: float | None = None) -> str:
        """For a name, from now (unix time s) on."""
        until = int((time.time() if now is None else now) + HOLDS_SECONDS)
        return f"{until}-{self._code(name, until)}"

    def is_good(self, ticket: str, name: str, now: float | None = None) -> bool:
        """Whether the ticket is ours, for this name, and holds."""
        until, _, code = ticket.partition("-")
        if not (until.isascii() and until.isdigit() and len(until) < 16):
            return False
        is_ours = hmac.compare_digest(code.encode(), self._code(name, int(until)).encode())
        return is_ours and (time.time() if now is None else now) < int(until)

    def _code(self, name: str, until: int) -> str:
        return hmac.new(self._key, f"{until} {name}".encode(), "sha256").hexdigest()
