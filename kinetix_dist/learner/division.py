"""Any number of devices: parts of a batch (groups of worlds, say) divided over them, evenly or not.

Every device runs the same program on as many slots. Where the division is uneven, the last devices have one part
less than the first; the slot that is left over there holds the last part of the device once more, and sums
over worlds leave it out. So it costs time and changes no number.

    5 parts on 3 devices:    0 1 | 2 3 | 4 (4)
"""

from __future__ import annotations

import dataclasses
import functools

import numpy as np


@dataclasses.dataclass(frozen=True)
class Division:
    """`num_parts` parts in order on `num_devices` devices in order. Raises ValueError where some would have none."""

    num_parts: int
    num_devices: int

    def __post_init__(self) -> None:
        if not 1 <= self.num_devices <= self.num_parts:
            raise ValueError(
                f"{self.num_parts} parts of a batch cannot be divided over {self.num_devices} devices: some would have "
                "nothing to do; raise rollout.num_groups and ppo.virtual_shards, or use fewer devices"
            )

    @property
    def slots(self) -> int:
        """Slots on each device."""
        return -(-self.num_parts // self.num_devices)

    @property
    def is_even(self) -> bool:
        return self.num_parts % self.num_devices == 0

    @functools.cached_property
    def parts(self) -> np.ndarray:
        """[devices, slots] int32: the part in each slot, the last one of a device twice where one is left over."""
        least, more = divmod(self.num_parts, self.num_devices)
        count = least + (np.arange(self.num_devices) < more)
        first = np.cumsum(count) - count
        slot = np.minimum(np.arange(self.slots), count[:, None] - 1)
        return (first[:, None] + slot).astype(np.int32)

    @functools.cached_property
    def is_counted(self) -> np.ndarray:
        """[devices, slots] bool: false where a part is there once more."""
        return np.diff(self.parts, axis=1, prepend=-1) > 0

    def spread(self, num_rows: int) -> np.ndarray:
        """Row that lies in each row of all slots, device by device, of `num_rows` rows with as many for each part."""
        return _rows(self.parts.reshape(-1), num_rows // self.num_parts)

    def gathered(self, num_rows: int) -> np.ndarray:
        """Inverse of `spread`: of `num_rows` rows in all slots, those of each part once, in order."""
        return _rows(np.flatnonzero(self.is_counted), num_rows // self.parts.size)


def _rows(parts: np.ndarray, rows_per_part: int) -> np.ndarray:
    return (parts[:, None] * rows_per_part + np.arange(rows_per_part)).reshape(-1)
