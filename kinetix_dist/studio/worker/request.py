"""A request that a client waits for: its fields, its progress, whether it was cancelled."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

from kinetix_dist.studio.worker.outbox import Outbox
from kinetix_dist.studio.worker.wire import BAD_REQUEST, CANCELLED, RequestError

_NOTHING = object()


class Request:
    """One request. `fields` are those of the message; the methods raise RequestError that names the field."""

    def __init__(self, fields: dict[str, Any], outbox: Outbox) -> None:
        self.fields, self._outbox = fields, outbox
        self.id: int = fields["id"]
        self._is_cancelled = threading.Event()

    def cancel(self) -> None:
        self._is_cancelled.set()

    def check_cancelled(self) -> None:
        """Raises RequestError where the client wants no answer any more."""
        if self._is_cancelled.is_set():
            raise RequestError(CANCELLED, "cancelled")

    def progress(self, stage: str, **facts: Any) -> None:
        """Says how far it is. Raises RequestError where it was cancelled."""
        self.check_cancelled()
        self._outbox.send({"type": "progress", "id": self.id, "stage": stage, **facts})

    def number(self, name: str, *, low: int, high: int, default: Any = _NOTHING) -> int:
        value = self.fields.get(name, default)
        if type(value) is not int or not low <= value <= high:
            raise self._wrong(name, value, f"give a whole number from {low} to {high}")
        return value

    def real(self, name: str, *, low: float, high: float) -> float:
        value = self.fields.get(name)
        if not isinstance(value, int | float) or isinstance(value, bool) or not low <= value <= high:
            raise self._wrong(name, value, f"give a number from {low:g} to {high:g}")
        return float(value)

    def flag(self, name: str, *, default: bool) -> bool:
        value = self.fields.get(name, default)
        if not isinstance(value, bool):
            raise self._wrong(name, value, "give true or false")
        return value

    def choice(self, name: str, known: Any, default: Any = _NOTHING) -> str:
        value = self.fields.get(name, default)
        if not isinstance(value, str) or value not in known:
            raise self._wrong(name, value, f"give one of {', '.join(known)}")
        return value

    def path(self, name: str) -> Path:
        value = self.fields.get(name)
        if not isinstance(value, str) or not Path(value).is_absolute():
            raise self._wrong(name, value, "give an absolute path")
        return Path(value)

    def _wrong(self, name: str, value: Any, advice: str) -> RequestError:
        if value is _NOTHING or name not in self.fields:
            return RequestError(BAD_REQUEST, f"{self.fields['type']}: {name} is missing; {advice}")
        text = repr(value)
        return RequestError(BAD_REQUEST, f"{self.fields['type']}: {name} is {text[:60]}; {advice}")
