"""The updates from which buffers of the curriculum were used: adoptions.json of a run.

A refresh is adopted at an update that is fixed beforehand, unless the curator was lost or silent then. So the record is
part of what a run's numbers depend on: whatever is computed again, after a loss or with --resume, follows it.
"""

from __future__ import annotations

import math
from typing import Any

from kinetix_dist.errors import one_line
from kinetix_dist.runtime.driver.run_directory import RunDirectory

NEVER = math.inf


class Adoptions:
    """By policy version of the refresh: the update that first used it, or NEVER."""

    def __init__(self, run: RunDirectory) -> None:
        self._run = run
        found = run.read_json(run.adoptions_path, is_whole=_are_adoptions) or {}
        self._at = {int(version): NEVER if update is None else update for version, update in found.items()}

    def get(self, policy_version: int) -> float | None:
        """None where nothing is recorded yet."""
        return self._at.get(policy_version)

    def in_use(self, update: int) -> int | None:
        """The newest version that was adopted by that update; None where none ever was. Nothing can be played before
        the first one: it is in use from the beginning, also where an earlier version recorded it from update 1 on."""
        return max((version for version, at in self._at.items() if at <= update), default=min(self._at, default=None))

    def record(self, policy_version: int, update: float) -> None:
        """A disk that does not take it is an event: the record is complete with the next one that is written."""
        if self._at.get(policy_version) == update:
            return
        self._at[policy_version] = update
        content = {str(version): None if at == NEVER else at for version, at in self._at.items()}
        try:
            self._run.write_json(self._run.adoptions_path, content)
        except OSError as error:
            self._run.event("file_failed", file=self._run.adoptions_path.name, error=one_line(error))


def _are_adoptions(content: Any) -> bool:
    """{"3": 5, "6": null}"""
    return isinstance(content, dict) and all(
        version.isdecimal() and (update is None or isinstance(update, int)) for version, update in content.items()
    )
