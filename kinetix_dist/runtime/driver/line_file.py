"""A file of JSON lines of a run: opened for a session, where later lines of a killed one are removed, and again after
failures, where all lines are kept."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Generic, TypeVar

from kinetix_dist.telemetry.sinks.jsonl import LinesSink

Sink = TypeVar("Sink", bound=LinesSink)


class LineFile(Generic[Sink]):
    """`open` is for a `BackgroundSink`, and called in its thread."""

    def __init__(
        self, run: Path, open_sink: Callable[[bool], Sink], tell: Callable[[str, dict[str, Any]], None], path: Path
    ) -> None:
        """run: directory of the run; open_sink(is_first): of `path`, for the first time in the session or again."""
        self._name = str(path.relative_to(run))
        self._open_sink = open_sink
        self._tell = tell
        self._is_first = True

    def open(self) -> Sink:
        sink = self._open_sink(self._is_first)
        self._is_first = False  # rows of this session are kept from now on
        if sink.set_aside is not None:
            self._tell("file_set_aside", {"file": self._name, "to": sink.set_aside.name, "reason": "it cannot be read"})
        if sink.num_damaged:
            aside = str(Path(self._name).with_name(sink.damaged_path.name))
            self._tell("lines_set_aside", {"file": self._name, "lines": sink.num_damaged, "to": aside})
        return sink
