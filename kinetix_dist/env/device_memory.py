"""Check that a batch fits into the memory of its device, before anything is computed.

Only large observations are counted (`Observation.working_bytes`), that is pictures: one digit too many in their batch
exceeds any memory.
"""

from __future__ import annotations

import jax
import psutil


class DeviceMemoryError(ValueError):
    """A batch that is too large for its device, with the largest that fits."""


def device_bytes() -> int:
    """Memory of the default device: XLA's pool on a GPU, that of the machine on a CPU."""
    statistics = jax.local_devices()[0].memory_stats() or {}
    return statistics.get("bytes_limit") or psutil.virtual_memory().total


def check_fits(number: int, bytes_each: int, *, what: str, advice: str) -> None:
    """Raises DeviceMemoryError where `number` of `what`, of so many bytes each, need more than the device has."""
    available = device_bytes()
    if number * bytes_each > available:
        raise DeviceMemoryError(
            f"{what} {number} take {_gib(number * bytes_each)} at once, and this device "
            f"({jax.default_backend()}) has {_gib(available)}: at most {available // bytes_each} fit; {advice}"
        )


def _gib(num_bytes: int) -> str:
    return f"{num_bytes / 2**30:.1f} GiB"
