"""Gradients of the gate's kernels, sums over rows.

    kernel_y: y^T [grad_r, grad_z, grad_h]       kernel_x: x^T [grad_r, grad_z]       kernel_h: (r x)^T grad_h

Six sums of 128 x 128 float32 do not fit in the registers of one block, so blocks work in pairs: the even one of a pair
has the three sums of y, the odd one the others, and both read the same rows. Each of three warpgroups keeps one sum in
registers over all steps; a fourth loads. What the pairs found is added in a fixed order.
"""

from __future__ import annotations

import functools
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import mosaic_gpu as plgpu

from jax2d.scene import Array
from kinetix_dist.models.kernels.tiles import (
    BLOCK_AXIS,
    PAIRS,
    ROWS,
    SWIZZLED,
    WARPGROUP_AXIS,
    WIDTH,
    call,
)

SUMS = 3  # of a block
STAGES = 2  # steps that loads are ahead
LOADS = 5  # copies of a step
# Registers of a thread: 3 x 160 + 32 is what 4 warpgroups have, 4 x 128.
_REGISTERS_OF_A_SUM, _REGISTERS_OF_LOADING = 160, 32


@functools.partial(jax.jit, static_argnames="interpret")
def gate_weight_gradients(
    x: Array, y: Array, rx: Array, grad_rz: Array, grad_h: Array, *, interpret: bool = False
) -> tuple[Array, Array, Array]:
    """Gradients of kernel_y [128, 384], kernel_x [128, 256] and kernel_h [128, 128], float32; rows: 64 n."""

    one, three = (plgpu.SMEM((STAGES, *sums, ROWS, WIDTH), jnp.bfloat16, transforms=SWIZZLED) for sums in ((), (SUMS,)))
    kernel = call(
        functools.partial(_body, interpret=interpret),
        jax.ShapeDtypeStruct((2 * PAIRS, SUMS, WIDTH, WIDTH), jnp.float32),
        [
            one,
            one,
            three,
            plgpu.Barrier(num_arrivals=LOADS, num_barriers=STAGES),
            plgpu.Barrier(num_arrivals=SUMS, num_barriers=STAGES),
        ],
        interpret,
        num_threads=SUMS + 1,
    )
    partial = kernel(x, y, rx, grad_rz, grad_h)
    of_y, of_x = jnp.sum(partial.reshape(PAIRS, 2, SUMS, WIDTH, WIDTH), axis=0)
    return jnp.concatenate([*of_y], axis=1), jnp.concatenate([of_x[0], of_x[1]], axis=1), of_x[2]


class _Refs(NamedTuple):
    """Arguments of the kernel."""

    # Rows in:
    x: Any
    y: Any
    rx: Any
    grad_rz: Any
    grad_h: Any
    # Sums out, of each block:
    out: Any
    # Shared memory:
    a: Any
    a_of_h: Any
    b: Any
    full: Any
    empty: Any


def _body(*refs: Any, interpret: bool) -> None:
    ref = _Refs(*refs)
    block, warpgroup = jax.lax.axis_index(BLOCK_AXIS), jax.lax.axis_index(WARPGROUP_AXIS)
    is_of_y, pair = jax.lax.rem(block, 2) == 0, block // 2
    num_steps = (ref.x.shape[0] // ROWS - pair + PAIRS - 1) // PAIRS

    def set_registers(number: int, action: Literal["increase", "decrease"]) -> None:
        if not interpret:  # which has no registers to give
            plgpu.set_max_registers(number, action=action)

    @pl.when(warpgroup < SUMS)
    def _() -> None:
        set_registers(_REGISTERS_OF_A_SUM, "increase")

        def scope(total: Any) -> None:
            def step(k: Any, _: None) -> None:
                stage = jax.lax.rem(k, STAGES)
                plgpu.barrier_wait(ref.full.at[stage])
                for n in range(SUMS):  # the last sum of x is of r x

                    @pl.when((warpgroup == n) & (is_of_y | (n < SUMS - 1)))
                    def _(n: int = n) -> None:
                        plgpu.wgmma(total, ref.a.at[stage].T, ref.b.at[stage, n])

                @pl.when((warpgroup == SUMS - 1) & ~is_of_y)
                def _() -> None:
                    plgpu.wgmma(total, ref.a_of_h.at[stage].T, ref.b.at[stage, SUMS - 1])

                plgpu.wgmma_wait(0)
                plgpu.barrier_arrive(ref.empty.at[stage])

            jax.lax.fori_loop(0, num_steps, step, None)
            ref.out[block, warpgroup] = total[...]

        pl.run_scoped(scope, plgpu.ACC((WIDTH, WIDTH), jnp.float32))

    @pl.when(warpgroup == SUMS)
    def _() -> None:
        set_registers(_REGISTERS_OF_LOADING, "decrease")

        def step(k: Any, _: None) -> None:
            stage = jax.lax.rem(k, STAGES)
            pl.when(k >= STAGES)(lambda: plgpu.barrier_wait(ref.empty.at[stage]))
            first = (pair + k * PAIRS) * ROWS
            rows = pl.ds(first, ROWS)

            def copy(source: Any, target: Any) -> None:
                plgpu.copy_gmem_to_smem(source, target, ref.full.at[stage])

            copy(ref.grad_rz.at[rows, pl.ds(0, WIDTH)], ref.b.at[stage, 0])
            copy(ref.grad_rz.at[rows, pl.ds(WIDTH, WIDTH)], ref.b.at[stage, 1])
            copy(ref.grad_h.at[rows], ref.b.at[stage, 2])

            @pl.when(is_of_y)
            def _() -> None:
                for n in (0, 1):  # in two parts: as many copies as the other block's
                    part = pl.ds(n * (ROWS // 2), ROWS // 2)
                    copy(ref.y.at[pl.ds(first + n * (ROWS // 2), ROWS // 2)], ref.a.at[stage, part])

            @pl.when(~is_of_y)
            def _() -> None:
                copy(ref.x.at[rows], ref.a.at[stage])
                copy(ref.rx.at[rows], ref.a_of_h.at[stage])

        jax.lax.fori_loop(0, num_steps, step, None)
        # Until every step has been used.
        last = jax.lax.max(num_steps - STAGES, 0)
        jax.lax.fori_loop(last, num_steps, lambda k, _: plgpu.barrier_wait(ref.empty.at[jax.lax.rem(k, STAGES)]), None)
