"""Kernels compile for an NVIDIA GPU, which takes NVRTC and ptxas (both come with Warp) and no GPU."""

from __future__ import annotations

from pathlib import Path

import pytest
import warp as wp

from jax2d import Capacity, Effects, preset
from jax2d.settings import Settings
from jax2d.warp.kernel import make_kernel
from jax2d.warp.variant import KernelVariant
from kinetix_dist.level.level import SIZES
from kinetix_dist.level.simulation import level_effects

EVERYTHING = Capacity(polygons=3, circles=2, joints=2, thrusters=1, springs=2, extended_shapes=True)


def build(capacity: Capacity, settings: Settings, effects: Effects, worlds: int, path: Path) -> list[Path]:
    variant = KernelVariant.of(capacity, settings, effects, report_contacts=capacity == EVERYTHING).for_worlds(worlds)
    module = make_kernel(variant).module
    module.options["block_dim"] = variant.options.block_dim  # as at a launch
    module.options["optimization_level"] = 3  # as for users: tests have another one for a CPU
    wp.compile_aot_module(module, arch=90, module_dir=str(path))
    return list(path.glob("*.sm90.cubin"))


@pytest.mark.parametrize(
    "name",
    [
        "standard",
        pytest.param("fine", marks=pytest.mark.slow),
        pytest.param("paper", marks=pytest.mark.slow),
    ],
)
def test_engine_of_levels_compiles_for_a_gpu_that_steps_many_worlds(name: str, tmp_path: Path):
    settings = preset(name)
    assert build(SIZES["s"], settings, level_effects(SIZES["s"], settings), 131_072, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("size", ["m", "l"])
def test_engines_of_larger_levels_compile_for_a_gpu(size: str, tmp_path: Path):
    settings = preset("standard")
    assert build(SIZES[size], settings, level_effects(SIZES[size], settings), 131_072, tmp_path)


@pytest.mark.long
def test_engine_with_every_effect_compiles_for_a_gpu(tmp_path: Path):
    assert build(EVERYTHING, preset("standard"), Effects.full(EVERYTHING), 2_048, tmp_path)
