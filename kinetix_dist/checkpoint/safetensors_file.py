"""Reading the safetensors format: named arrays in one file, and nothing that could run.

    8 bytes      length N of the header, little-endian
    N bytes      JSON {name: {"dtype", "shape", "data_offsets": [begin, end]}, "__metadata__": {...}}
    the rest     arrays, row by row, little-endian

Policies hold float32 only, so that other types are refused by name.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

MAX_HEADER_BYTES = 100_000_000  # as in the reference implementation
_PICKLE_STARTS = (b"BZh", b"\x80\x02", b"\x80\x03", b"\x80\x04", b"\x80\x05", b"\x1f\x8b", b"PK")  # bare or compressed


class SafetensorsError(ValueError):
    """A file that cannot be read, and why."""


def read_safetensors(path: Path) -> dict[str, np.ndarray]:
    """Every array of a file by name. Raises SafetensorsError naming the file, and OSError."""
    content = path.read_bytes()
    if content.startswith(_PICKLE_STARTS):
        raise SafetensorsError(
            f"{path} is a pickle or an archive, which could run anything when it is read; write its parameters as "
            "safetensors where you trust it (kinetix.util.saving.save_pretrained_checkpoint)"
        )
    if len(content) < 8:
        raise SafetensorsError(f"{path} has {len(content)} bytes: it is no safetensors file")
    length = int.from_bytes(content[:8], "little")
    if length > min(MAX_HEADER_BYTES, len(content) - 8):
        raise SafetensorsError(f"{path} is cut or no safetensors file: its header would have {length:,} bytes")
    try:
        header = json.loads(content[8 : 8 + length])
        entries = {name: entry for name, entry in header.items() if name != "__metadata__"}
    except (ValueError, AttributeError, RecursionError) as error:
        raise SafetensorsError(f"{path} is no safetensors file: its header cannot be read") from error
    return {name: _array(path, name, entry, memoryview(content)[8 + length :]) for name, entry in entries.items()}


def _array(path: Path, name: str, entry: Any, data: memoryview) -> np.ndarray:
    try:
        dtype, shape, (begin, end) = entry["dtype"], [int(size) for size in entry["shape"]], entry["data_offsets"]
        is_whole = 0 <= begin <= end <= len(data) and all(size >= 0 for size in shape)
    except (KeyError, TypeError, ValueError) as error:
        raise SafetensorsError(f"{path}: the entry of {name} cannot be read") from error
    if dtype != "F32":
        raise SafetensorsError(f"{path}: {name} is {dtype}; only F32 is read")
    if not is_whole or end - begin != 4 * math.prod(shape):
        raise SafetensorsError(f"{path} is cut or damaged: {name} {shape} does not lie in bytes {begin} to {end}")
    return np.frombuffer(data[begin:end], "<f4").reshape(shape).copy()
