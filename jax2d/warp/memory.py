"""Memory of a world: its tables, and on a GPU the local memory of the thread that steps it."""

from __future__ import annotations

import struct
import tempfile
from collections.abc import Iterator
from pathlib import Path

import warp as wp

from jax2d.effects import Effects
from jax2d.scene import Capacity
from jax2d.settings import Settings
from jax2d.warp.kernel import make_kernel
from jax2d.warp.layout import Layout
from jax2d.warp.variant import KernelVariant

FLOAT_BYTES = 4  # as all tables hold
# Of the ELF files that CUDA calls cubin: a section with one record for each property of a kernel.
INFO_SECTION = ".nv.info"
SIZED_RECORD = 0x04  # format byte of records that name a symbol and a value
MIN_STACK_SIZE = 0x12  # attribute byte: bytes of local memory a thread


def table_bytes(capacity: Capacity) -> dict[str, int]:
    """Bytes a world of the tables that a step reads ("scene", "controls"), changes ("state") and writes ("out")."""
    heights = {table: rows["ROWS"] for table, rows in Layout(capacity).rows().items()}
    rows = {
        "scene": heights["SCENE"] + heights["INTS"],
        "controls": max(1, heights["CONTROLS"]),
        "state": heights["STATE"] + heights["IMPULSE"] + capacity.contact_slots,
        "out": heights["OUT"],
    }
    return {name: FLOAT_BYTES * height for name, height in rows.items()}


def thread_bytes(capacity: Capacity, settings: Settings, effects: Effects, compute_capability: str) -> int:
    """Local memory of a thread, bytes, of the kernel compiled for a GPU of this compute capability ("9.0").

    CUDA sets so much aside for every thread that can be resident at once, used or not. Needs no GPU, but compiles.
    """
    variant = KernelVariant.of(capacity, settings, effects)
    kernel = make_kernel(variant)
    kernel.module.options |= {"block_dim": variant.options.block_dim}
    with tempfile.TemporaryDirectory() as folder:
        wp.compile_aot_module(
            kernel.module, arch=int(compute_capability.replace(".", "")), module_dir=folder, use_ptx=False
        )
        (cubin,) = Path(folder).glob("*.cubin")
        return max(_stack_sizes(cubin.read_bytes()))


def _stack_sizes(cubin: bytes) -> Iterator[int]:
    """Bytes a thread of each function of a 64-bit little-endian cubin."""
    table, _, _, _, _, size, count, names_index = struct.unpack_from("<QIHHHHHH", cubin, 0x28)
    headers = [struct.unpack_from("<IIQQQQ", cubin, table + i * size) for i in range(count)]
    names_at = headers[names_index][4]
    for name, _, _, _, offset, length in headers:
        start = names_at + name
        if cubin[start : cubin.index(0, start)] == INFO_SECTION.encode():
            yield from _values(cubin[offset : offset + length], MIN_STACK_SIZE)


def _values(section: bytes, wanted: int) -> Iterator[int]:
    at = 0
    while at < len(section):
        kind, attribute, length = struct.unpack_from("<BBH", section, at)
        at += 4
        if kind != SIZED_RECORD:  # these hold their value in place of a length
            continue
        if attribute == wanted:
            yield struct.unpack_from("<II", section, at)[1]
        at += length
