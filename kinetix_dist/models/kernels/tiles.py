"""Shared parts of the gate's kernels: tiles of rows that come and go by the copy engine, products in registers.

A tile is 64 rows. Blocks work in pairs: both read the same tiles (the second finds them in the L2 cache) and each gives
one half of the columns, its own. So the weights of a block leave room in shared memory for rings of loads and stores.
Each of the two warpgroups of a block has tiles, rings and barriers of its own; nothing waits for the other.

    loads    a ring of IN granules [64, 64]; as soon as every thread has read one, the copy engine fills it again
    products A from registers, B (a block [64, 64] of the weights) from shared memory, float32 sums
    stores   a ring of OUT granules, emptied by the copy engine: 4 bytes a thread straight to memory took twice as long

In the CPU interpreter, which takes no A from registers, a product is `jnp.matmul` of the same operands.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import mosaic_gpu as plgpu

from kinetix_dist.models.kernels.stable_programs import without_caller_frames
from kinetix_dist.models.kernels.support import MULTIPROCESSORS, WIDTH

HALF = 64  # columns of a granule: 128 bytes, the widest swizzle
ROWS = 64  # of a tile: those of a product by one warpgroup
WARPGROUPS = 2
IN, OUT = 4, 2  # granules of a warpgroup
PAIRS = MULTIPROCESSORS // 2  # of blocks
BLOCK_AXIS, WARPGROUP_AXIS = "block", "warpgroup"
OWN, OTHER = 0, 1  # halves of the columns, as a block sees them

SWIZZLED = (plgpu.TilingTransform((8, HALF)), plgpu.SwizzleTransform(128))
_LATER_THAN_ANY_TILE = 20  # log2 of a number of tiles that no array reaches


def granules(*shape: int) -> Any:
    """Shared memory for arrays [64, 64] bfloat16, laid out for products and the copy engine."""
    return plgpu.SMEM((*shape, ROWS, HALF), jnp.bfloat16, transforms=SWIZZLED)


def scratch(num_blocks: int, num_weight_copies: int) -> list[Any]:
    """Weights, loads, stores; barriers of the weights and of the loads."""
    return [
        granules(num_blocks),
        granules(WARPGROUPS, IN),
        granules(WARPGROUPS, OUT),
        plgpu.Barrier(num_arrivals=num_weight_copies),
        plgpu.Barrier(num_barriers=WARPGROUPS * IN),
    ]


def call(
    body: Callable[..., None],
    out_type: Any,
    scratch_types: Sequence[Any],
    interpret: bool,
    num_threads: int = WARPGROUPS,
) -> Callable[..., Any]:
    """A kernel of PAIRS pairs of blocks of so many warpgroups."""
    return without_caller_frames(
        plgpu.kernel(  # pyrefly: ignore[missing-argument]  # jax 0.10, which never runs it, has out_shape for out_type
            body,
            out_type=out_type,
            grid=(2 * PAIRS,),
            grid_names=(BLOCK_AXIS,),
            num_threads=num_threads,
            thread_name=WARPGROUP_AXIS,
            scratch_types=scratch_types,
            # Barriers are placed by hand: those that Pallas adds around loads and stores keep copies from overlapping.
            compiler_params=plgpu.CompilerParams(approx_math=True, unsafe_no_auto_barriers=True),
            # pyrefly: ignore[missing-attribute]  # jax 0.10, which never runs it, has no such class
            interpret=plgpu.InterpretGPUParams() if interpret else False,
        )
    )


class Tiles:
    """The tiles of a warpgroup, one after another."""

    def __init__(self, num_rows: int, order: Sequence[tuple[Any, int]], loads: Any, stores: Any, barriers: Any) -> None:
        """order: (array [rows, 128], half) of the granules of a tile in the order in which `take` gives them; a
        multiple of IN. loads, stores, barriers: see `scratch`."""
        if len(order) % IN:
            raise ValueError(f"{len(order)} granules a tile; it must be a multiple of the ring's {IN}")
        block = jax.lax.axis_index(BLOCK_AXIS)
        self.warpgroup = jax.lax.axis_index(WARPGROUP_AXIS)
        self.own = jax.lax.rem(block, 2)
        self._first, self._stride = (block // 2) * WARPGROUPS + self.warpgroup, PAIRS * WARPGROUPS
        self._count = (num_rows // ROWS - self._first + self._stride - 1) // self._stride
        self._order, self._loads, self._stores, self._barriers = order, loads, stores, barriers

    def half(self, half: int, block: int | Any = 0) -> Any:
        """The columns (or rows) of a half, OWN or OTHER, of the block of 128 of that number."""
        return pl.ds(block * WIDTH + (self.own if half == OWN else 1 - self.own) * HALF, HALF)

    def each(self, body: Callable[[Any], None]) -> None:
        """`body(tile)` for each tile; `take` and `give` belong to it. Waits for all stores in the end."""

        @pl.when(self._count > 0)
        def _() -> None:
            for n in range(IN):
                self._load(n, 0)

        def one(tile: Any, _: None) -> None:
            self._tile, self._taken, self._given = tile, 0, 0
            body(tile)

        jax.lax.fori_loop(0, self._count, one, None)
        plgpu.wait_smem_to_gmem(0)

    def take(self) -> Any:
        """The next granule of the order in registers; its place is filled again."""
        n = self._taken
        self._taken += 1
        place = n % IN
        plgpu.barrier_wait(self._barriers.at[self.warpgroup * IN + place])
        value = plgpu.load(self._loads.at[self.warpgroup, place], (), layout=plgpu.Layout.WGMMA)
        plgpu.commit_smem()  # every thread has read
        if n + IN < len(self._order):
            self._load(n + IN, self._tile)
        else:
            pl.when(self._tile + 1 < self._count)(lambda: self._load(n + IN - len(self._order), self._tile + 1))
        return value

    def give(self, array: Any, columns: Any, value: Any) -> None:
        """Stores [64, 64] into these columns of the tile's rows."""
        place = self._given % OUT
        self._given += 1
        plgpu.wait_smem_to_gmem(OUT - 1, wait_read_only=True)
        granule = self._stores.at[self.warpgroup, place]
        granule[...] = value.astype(jnp.bfloat16)
        plgpu.commit_smem()
        plgpu.copy_smem_to_gmem(granule, array.at[self._rows(self._tile), columns])

    def _rows(self, tile: Any) -> Any:
        return pl.ds((self._first + tile * self._stride) * ROWS, ROWS)

    def _load(self, n: int, tile: Any) -> None:
        array, half = self._order[n]
        place = n % IN
        plgpu.copy_gmem_to_smem(
            array.at[self._rows(tile), self.half(half)],
            self._loads.at[self.warpgroup, place],
            self._barriers.at[self.warpgroup * IN + place],
        )


class Products:
    """Products of two halves in registers with the blocks of weights of a kernel."""

    def __init__(self, blocks: Any, tile: Any, *, transposed: bool, interpret: bool) -> None:
        self._blocks, self._transposed, self._interpret = blocks, transposed, interpret
        # 0, but not for the compiler: it would take the addresses of all blocks out of the loop over tiles and keep
        # them in registers, a hundred of them, and spill what the products need.
        self._zero = jax.lax.shift_right_logical(tile, _LATER_THAN_ANY_TILE)

    def add(self, accumulator: Any, halves: Sequence[Any], first: int) -> None:
        """accumulator += halves[0] @ block `first` + halves[1] @ the next; two products that run on by themselves."""
        for n, a in enumerate(halves):
            block = self._blocks.at[first + n + self._zero]
            block = block.T if self._transposed else block
            if self._interpret:
                accumulator.append(jnp.matmul(a.astype(jnp.float32), block[...].astype(jnp.float32)))
            else:
                plgpu.wgmma(accumulator, a, block)

    def chain(self, *stages: tuple[Callable[[Any], None], Callable[[Any], None]]) -> None:
        """Runs each (issue, finish): `issue(accumulator)` adds products, `finish` gets their sum [64, 64] float32.

        A stage may use what earlier ones found: it is traced inside them, so that nothing leaves its scope.
        """
        if not stages:
            return
        (issue, finish), *others = stages

        def scope(accumulator: Any) -> None:
            issue(accumulator)
            finish(sum(accumulator) if self._interpret else accumulator[...])
            self.chain(*others)

        if self._interpret:
            scope([])
        else:
            pl.run_scoped(scope, plgpu.ACC((ROWS, HALF), jnp.float32))


def load_blocks(tiles: Tiles, weights: Any, blocks: Any, barrier: Any, where: Sequence[tuple[int, int, int]]) -> None:
    """Begins to copy blocks [64, 64] of packed weights, see gate.py. where: (half of the rows, 128 columns, half)."""

    @pl.when(tiles.warpgroup == 0)
    def _() -> None:
        for n, (row, block, column) in enumerate(where):
            plgpu.copy_gmem_to_smem(weights.at[tiles.half(row), tiles.half(column, block)], blocks.at[n], barrier)
