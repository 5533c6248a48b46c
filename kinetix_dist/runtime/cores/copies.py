"""Copies of a batch and of weights between processes and devices (split placement): how many bytes, how many seconds.

rollout actor   device_to_host -> store_put      learner   store_get -> host_layout -> host_to_device
learner         weights_to_host -> weights_put   rollout actor   weights_to_device
"""

from __future__ import annotations

import time
from collections.abc import Generator
from contextlib import contextmanager
from typing import Any

from kinetix_dist.telemetry.sizes import bytes_of


class Copies:
    """Adds up by name, in one process: {name: (bytes, seconds)}."""

    def __init__(self) -> None:
        self.found: dict[str, tuple[int, float]] = {}

    @contextmanager
    def timed(self, name: str) -> Generator[list[Any]]:
        """Around a copy; what is copied is appended to the list that it gives."""
        copied: list[Any] = []
        began = time.monotonic()
        yield copied
        num_bytes, seconds = self.found.get(name, (0, 0.0))
        self.found[name] = (num_bytes + bytes_of(copied), seconds + time.monotonic() - began)
