"""Updates at which refreshes of the curriculum are requested and adopted, as the configuration says.

    a curriculum's state begins with batch f     f ...                        ... f of the next one
    refreshes are requested at updates           r = f - policy lag, r + T, r + 2 T, ...
    and adopted for batches                      f, r + T + a, r + 2 T + a, ...

T is `refresh_every` and a `adopt_after`. A refresh has the number of the update at which it is requested, which is the
policy version that it is worked out with. The first one of a state is adopted at once, and training waits for it.
None is requested that would be adopted when its state is no longer in use.
"""

from __future__ import annotations

import bisect
import dataclasses
import math
from collections.abc import Sequence
from typing import Any

from kinetix_dist.config.phases import Phase
from kinetix_dist.setting import ConfigError


@dataclasses.dataclass(frozen=True)
class _Stretch:
    """Updates with one state of the curriculum."""

    first_request: int
    first_batch: int
    end_batch: float
    every: int
    adopt_after: int
    refreshes: bool

    def adopted_at(self, version: int) -> int:
        return self.first_batch if version == self.first_request else version + self.adopt_after

    def next(self, num_updates: int) -> int | None:
        """First request from an update on."""
        after = max(num_updates - self.first_request, 0)
        version = self.first_request - -after // self.every * self.every
        return version if self.refreshes and self.adopted_at(version) < self.end_batch else None


@dataclasses.dataclass(frozen=True)
class RefreshTimes:
    """Refreshes of one run."""

    _stretches: tuple[_Stretch, ...]

    def is_due(self, num_updates: int) -> bool:
        """A refresh is requested at the start of this update, with the policy version of that number."""
        return self._stretch_of(num_updates).next(num_updates) == num_updates

    def next(self, num_updates: int) -> int | None:
        """The first update from this one on at which one is due; None: there is none."""
        later = self._stretches[self._stretches.index(self._stretch_of(num_updates)) :]
        found = (stretch.next(num_updates) for stretch in later)
        return next((version for version in found if version is not None), None)

    def adopted_at(self, version: int) -> int:
        """The batch that first uses a refresh."""
        return self._stretch_of(version).adopted_at(version)

    def is_first(self, version: int) -> bool:
        """A state of the curriculum begins with this refresh."""
        return version == self._stretch_of(version).first_request

    def is_over(self, version: int, batch: int) -> bool:
        """The state of the curriculum that a refresh is of is no longer in use in a batch."""
        return batch >= self._stretch_of(version).end_batch

    def number(self, version: int) -> int:
        """Number of a refresh among those of its state; 0 is the first."""
        stretch = self._stretch_of(version)
        return (version - stretch.first_request) // stretch.every

    def _stretch_of(self, version: int) -> _Stretch:
        return self._stretches[bisect.bisect_right(self._stretches, version, key=lambda each: each.first_request) - 1]


def refresh_times(phases: Sequence[Phase[Any]], *, policy_lag: int) -> RefreshTimes:
    """Refreshes of a run. Raises ConfigError where two states of the curriculum would be refreshed first at the same
    update."""
    firsts = [phase for phase in phases if phase.curriculum_since == phase.first_update]
    ends = [*(phase.first_update for phase in firsts[1:]), math.inf]
    stretches: list[_Stretch] = []
    for phase, end in zip(firsts, ends, strict=True):
        curriculum = phase.config.curriculum
        first_request = max(phase.first_update - policy_lag, 0)
        if stretches and first_request == stretches[-1].first_request:
            raise ConfigError(
                f"phase {phase.number} begins another curriculum at update {phase.first_update}: in placement 'split' "
                "its levels are drawn with those of the first update; start it one update later"
            )
        stretches.append(
            _Stretch(
                first_request=first_request,
                first_batch=phase.first_update,
                end_batch=end,
                every=curriculum.refresh_every,
                adopt_after=curriculum.adopt_after,
                refreshes=phase.config.curriculum_class.refreshes,
            )
        )
    return RefreshTimes(tuple(stretches))
