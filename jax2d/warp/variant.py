"""Variants of the kernel: all choices that are compiled in."""

from __future__ import annotations

import dataclasses
from typing import Any

from jax2d.effects import Effects
from jax2d.scene import Capacity
from jax2d.settings import Settings, Solver

# What a GPU steps many worlds with, and from how many on that is faster. Numbers of a body in shared memory, all that
# solving uses: that is taken from the cache, of which few worlds make better use, and so do kernels of many shapes.
MANY_WORLDS, SHARED_RECORD = 65536, 8

# From how many worlds on the compiler keeps to registers for so many blocks of a multiprocessor. With eight of them
# 65,536 worlds run at once; more take turns anyway, and then have more registers and more of the cache.
MIN_BLOCKS = ((131072, 6), (65536, 8))

# Up to how many worlds a warp has so few of them, a lane each: it takes as long as the longest of its worlds. More
# warps with idle lanes are in each other's way in the cache.
WARP, FEW_WORLDS, FEW_IN_WARP = 32, 2048, 8


@dataclasses.dataclass(frozen=True, kw_only=True)
class CompileOptions:
    """Options of compiling and launching a kernel. They change its speed, and no result but for `fast_math` and
    `fuse_fp`."""

    block_dim: int = 64  # threads a block on a GPU, one a world
    shared_bytes: int = 20480  # of shared memory for a block: with more, fewer blocks run at a time
    shared_record: int | None = None  # numbers of a body in shared memory; None: by shapes and worlds
    warp_worlds: int | None = None  # worlds of a warp, a power of two; None: by worlds
    sweep_above_shapes: int = 32  # up to here testing every pair costs less than a sweep (docs: how cost grows)
    max_registers: int | None = None  # a thread
    min_blocks: int | None = None  # a multiprocessor, for which the compiler limits registers; None: by worlds
    spills_in_shared: bool = False
    fast_math: bool = False
    fuse_fp: bool = False  # fused multiplies and adds: the compiler chooses where, so other kernels give other bits

    @property
    def module_options(self) -> dict[str, Any]:
        """Options of a Warp module. Loops over compile-time constants would be unrolled 86 s deep; gradients are the
        reference backend's job."""
        return {
            "max_unroll": 0,
            "enable_backward": False,
            **({"fast_math": True} if self.fast_math else {}),
            "fuse_fp": self.fuse_fp,
        }


@dataclasses.dataclass(frozen=True, kw_only=True)
class KernelVariant:
    """One kernel. Hashable: kernels are built once a process."""

    capacity: Capacity
    effects: Effects
    solver: Solver
    friction_mixing: str
    shares_impacts: bool = False  # passes are repeated until an impact is shared out
    line_search: bool = False  # of contacts of jointed bodies
    report_contacts: bool = False  # of the last step of a call
    shared_record: int = 0  # numbers of a body in a GPU's shared memory
    warp_worlds: int = WARP  # worlds that a warp of a GPU steps, a lane each
    min_blocks: int | None = None  # of a GPU's multiprocessor
    options: CompileOptions = CompileOptions()

    @classmethod
    def of(
        cls,
        capacity: Capacity,
        settings: Settings,
        effects: Effects,
        options: CompileOptions | None = None,
        *,
        report_contacts: bool = False,
    ) -> KernelVariant:
        return cls(
            capacity=capacity,
            effects=effects,
            solver=settings.solver,
            friction_mixing=settings.friction_mixing,
            shares_impacts=settings.solver == "soft_step" and settings.impact_passes > 0,
            line_search=settings.solver == "soft_step" and settings.line_search,
            report_contacts=report_contacts,
            shared_record=(options.shared_record or 0) if options is not None else 0,
            options=options if options is not None else CompileOptions(),
        )

    @property
    def is_soft(self) -> bool:
        return self.solver == "soft_step"

    def for_worlds(self, worlds: int) -> KernelVariant:
        """The variant that a GPU steps so many worlds with."""
        options, shapes = self.options, self.effects.polygon_slots + self.effects.circle_slots
        record = shared_record(shapes, worlds, options) if options.shared_record is None else self.shared_record
        lanes, blocks = options.warp_worlds, options.min_blocks
        if lanes is None:
            lanes = FEW_IN_WARP if worlds <= FEW_WORLDS else WARP
        if blocks is None:
            blocks = next((number for least, number in MIN_BLOCKS if worlds >= least), None)
        return dataclasses.replace(self, shared_record=record, warp_worlds=lanes, min_blocks=blocks)

    @property
    def kernel_options(self) -> dict[str, Any]:
        """Options of a Warp kernel."""
        options: dict[str, Any] = {}
        if self.options.max_registers is not None:
            options["cuda_max_registers"] = self.options.max_registers
        elif self.min_blocks is not None:
            options["launch_bounds"] = (self.options.block_dim, self.min_blocks)
        if self.options.spills_in_shared:
            options["enable_cuda_smem_spilling"] = True
        return options

    def threads(self, worlds: int) -> int:
        """Threads of a launch for so many worlds, those of lanes without a world included."""
        return worlds if self.warp_worlds == WARP else -(-worlds // self.warp_worlds) * WARP


def shared_record(shapes: int, worlds: int, options: CompileOptions | None = None) -> int:
    """Number of floats of a body that a kernel for so many shapes holds in a GPU's shared memory."""
    options = options if options is not None else CompileOptions()
    fits = 4 * SHARED_RECORD * shapes * options.block_dim <= options.shared_bytes
    return SHARED_RECORD if fits and worlds >= MANY_WORLDS else 0
