"""Kernels in CUDA C++ (folder `cuda`) as operations of JAX: compiled by NVRTC, launched by XLA.

XLA takes PTX as a custom call of its own and launches it like what it compiled itself, in CUDA graphs too; nothing of
Python runs at a launch. The call is XLA's, not a documented interface of JAX: `support.JAX_VERSIONS` says with which
versions it was tried.
"""

from __future__ import annotations

import dataclasses
import functools
import re
from collections.abc import Sequence
from pathlib import Path

import jax

from jax2d.scene import Array
from kinetix_dist.models.kernels.nvrtc import cached_ptx
from kinetix_dist.models.kernels.support import MULTIPROCESSORS

FOLDER = Path(__file__).parent / "cuda"
HEADER = "tile.cuh"
TARGET = "__gpu$xla.gpu.ptx"
CUSTOM_CALLS = (TARGET, "LayoutConstraint")  # that networks make; the latter is `jax.experimental.layout`
THREADS = 256  # of a block, see tile.cuh
ROWS = 64  # of a tile
MULTIPROCESSOR_BYTES = 228 * 1024  # of shared memory, of which each block takes what it asks for, and
RESERVED_BYTES = 1024


@dataclasses.dataclass(frozen=True)
class CudaKernel:
    """A kernel of a file, for these values of its macros."""

    file: str
    name: str
    macros: tuple[tuple[str, int], ...] = ()


def call(kernel: CudaKernel, out: Sequence[jax.ShapeDtypeStruct], blocks: int, *operands: Array) -> Sequence[Array]:
    """Results of `kernel` when `blocks` blocks of it run. Its parameters are the operands, then the results."""
    numbers = {"grid_x": blocks, "grid_y": 1, "grid_z": 1, "block_x": THREADS, "block_y": 1, "block_z": 1}
    numbers["shared_mem_bytes"] = _shared_bytes(kernel)
    ptx = _quoted(_ptx(kernel.file, kernel.macros))
    fields = [f'name = "{kernel.name}"', 'kernel_type = "ptx"', f"kernel_data = {ptx}"]
    fields += [f"{name} = {number} : i32" for name, number in numbers.items()]
    config = f"{{{', '.join(fields)}}}"
    return jax.ffi.ffi_call(TARGET, list(out), custom_call_api_version=1, legacy_backend_config=config)(*operands)


def num_blocks(kernel: CudaKernel, tiles: int, at_most: int) -> int:
    """Number of blocks that share the tiles: all that run at once, `at_most` of them on a multiprocessor."""
    fitting = MULTIPROCESSOR_BYTES // (_shared_bytes(kernel) + RESERVED_BYTES)
    return min(MULTIPROCESSORS * min(at_most, fitting), tiles)


def _shared_bytes(kernel: CudaKernel) -> int:
    found = re.search(rf"\b{kernel.name}_shared_bytes = (\d+);", _ptx(kernel.file, kernel.macros))
    assert found is not None, f"{kernel.file} does not say what shared memory {kernel.name} takes"
    return int(found[1])


@functools.cache
def _ptx(file: str, macros: tuple[tuple[str, int], ...]) -> str:
    headers = {HEADER: (FOLDER / HEADER).read_text()}
    return cached_ptx((FOLDER / file).read_text(), file, headers=headers, macros=dict(macros))


def _quoted(text: str) -> str:
    """Text as a string of MLIR."""
    return '"' + "".join(c if " " <= c <= "~" and c not in '"\\' else f"\\{ord(c):02X}" for c in text) + '"'
