"""The Warp kernel: one thread steps one world."""

from __future__ import annotations

import functools

import warp as wp

from jax2d.effects import Effects
from jax2d.scene import Capacity
from jax2d.settings import Settings
from jax2d.warp.source import kernel_source

# Loops over compile-time constants would be unrolled 86 s deep; gradients are the reference backend's job.
MODULE_OPTIONS = {"max_unroll": 0, "enable_backward": False}


@functools.cache
def make_kernel(
    capacity: Capacity, solver: str, friction_mixing: str, effects: Effects, in_shared: int = 0
) -> wp.Kernel:
    """Builds (once a process) the kernel for what is compiled in; numbers of the settings come at run time.

    `in_shared`: how many numbers of a body a GPU keeps in shared memory, as source.shared_record says."""
    settings = Settings(solver=solver, friction_mixing=friction_mixing)  # type: ignore[arg-type]

    @wp.func_native(kernel_source(capacity, settings, effects, in_shared))
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

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS, enable_backward=False)
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

    return step_worlds
