"""The kernel's C++ source for one capacity and solver: generated constants, then the files of native/."""

from __future__ import annotations

import functools
from pathlib import Path

from jax2d.scene import Capacity
from jax2d.settings import Settings
from jax2d.warp.layout import JOINT_FLAGS, PARAMS, Layout

NATIVE_FILES = (
    "vec2.h",
    "bodies.h",
    "manifolds.h",
    "contacts.h",
    "joints.h",
    "forces.h",
    "paper.h",
    "step.h",
)


@functools.cache
def _read(name: str) -> str:
    return (Path(__file__).parent / "native" / name).read_text()


def constants(capacity: Capacity, settings: Settings) -> dict[str, int]:
    """Everything that is compiled in."""
    values = {
        "NUM_POLYGONS": capacity.polygons,
        "NUM_CIRCLES": capacity.circles,
        "NUM_SHAPES": capacity.shapes,
        "NUM_JOINTS": capacity.joints,
        "NUM_THRUSTERS": capacity.thrusters,
        "MAX_VERTICES": capacity.vertices,
        "NUM_CORNERS": max(1, capacity.polygons * capacity.vertices),
        "NUM_CONTACTS": capacity.contact_slots,
        "TOUCH_WORDS": capacity.touch_words,
        "SOFT_STEP": int(settings.solver == "soft_step"),
        "FRICTION_ROOT_SUM_SQUARE": int(settings.friction_mixing == "root_sum_square"),
    }
    values |= {f"PARAM_{name}": i for i, name in enumerate(PARAMS)}
    values |= JOINT_FLAGS
    for table, rows in Layout(capacity).rows().items():
        values |= {f"{table}_{name}": row for name, row in rows.items()}
    return values


def kernel_source(capacity: Capacity, settings: Settings) -> str:
    """Body of the native function; its arguments are named in kernel.py."""
    enum = ",\n  ".join(f"{name} = {value}" for name, value in constants(capacity, settings).items())
    call = """
size_t stride = size_t(num_worlds);
Column scene = {scene_table.data + world, stride};
IntColumn ints = {ints_table.data + world, stride};
Column controls = {controls_table.data + world, stride};
Column params = {params_table.data, 1};
Column state = {state_table.data + world, stride};
Column impulses = {impulse_table.data + world, stride};
IntColumn keys = {key_table.data + world, stride};
IntColumn out = {out_table.data + world, stride};
World one = {scene, ints, controls, params, state, impulses, keys};
one.run(num_steps, out);
"""
    return f"enum {{\n  {enum}\n}};\n" + "\n".join(_read(name) for name in NATIVE_FILES) + call
