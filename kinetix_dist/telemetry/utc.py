"""Times as files of a run have them: 2026-01-31T12:00:00Z."""

from __future__ import annotations

import calendar
import time

_FORMAT = "%Y-%m-%dT%H:%M:%SZ"


def utc_text(seconds: float | None = None) -> str:
    """Of s since the epoch; None: now."""
    return time.strftime(_FORMAT, time.gmtime(seconds))


def utc_seconds(text: str) -> float:
    """The inverse, s since the epoch. Raises ValueError."""
    return float(calendar.timegm(time.strptime(text, _FORMAT)))
