"""The Warp kernel: one thread steps one world."""

from __future__ import annotations

import functools
import hashlib

import warp as wp

from jax2d.warp.source import kernel_source
from jax2d.warp.variant import KernelVariant


@functools.cache
def make_kernel(variant: KernelVariant) -> wp.Kernel:
    """Builds (once a process) the kernel for what is compiled in; numbers of the settings come at run time.

    Its name says which variant it is: Warp would number kernels in the order in which a process makes them, and
    programs call them by name.
    """

    @wp.func_native(kernel_source(variant))
    def step_world(
        world: int,
        num_worlds: int,
        num_steps: int,
        # Scene:
        scene_table: wp.array2d[wp.float32],
        ints_table: wp.array2d[wp.int32],
        controls_table: wp.array2d[wp.float32],
        params_table: wp.array[wp.float32],
        # State before and after, which may be the same memory:
        state_before: wp.array2d[wp.float32],
        impulses_before: wp.array2d[wp.float32],
        keys_before: wp.array2d[wp.int32],
        state_table: wp.array2d[wp.float32],
        impulse_table: wp.array2d[wp.float32],
        key_table: wp.array2d[wp.int32],
        # Out:
        out_table: wp.array2d[wp.int32],
    ): ...

    def step_worlds(
        # Scene:
        scene_table: wp.array2d[wp.float32],
        ints_table: wp.array2d[wp.int32],
        controls_table: wp.array2d[wp.float32],
        params_table: wp.array[wp.float32],
        # State before:
        state_before: wp.array2d[wp.float32],
        impulses_before: wp.array2d[wp.float32],
        keys_before: wp.array2d[wp.int32],
        # Static:
        num_steps: int,
        # State after:
        state_table: wp.array2d[wp.float32],
        impulse_table: wp.array2d[wp.float32],
        key_table: wp.array2d[wp.int32],
        # Out:
        out_table: wp.array2d[wp.int32],
    ):
        world = wp.tid()
        step_world(
            world,
            out_table.shape[1],
            num_steps,
            scene_table,
            ints_table,
            controls_table,
            params_table,
            state_before,
            impulses_before,
            keys_before,
            state_table,
            impulse_table,
            key_table,
            out_table,
        )

    step_worlds.__qualname__ = f"step_worlds_{hashlib.sha256(repr(variant).encode()).hexdigest()[:16]}"
    kernel = wp.kernel(
        step_worlds,
        module="unique",
        module_options=variant.options.module_options,
        enable_backward=False,
        **variant.kernel_options,
    )
    assert isinstance(kernel, wp.Kernel)
    return kernel
