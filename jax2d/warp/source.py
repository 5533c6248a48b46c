"""The kernel's C++ source for one capacity, solver and set of effects: generated constants, then the files of native/.

What scenes do not call for is switched off by constants (HAS_FRICTION, ...), so that the compiler leaves it out, and
local arrays (NUM_...) are as long as the slots in use. Tables (CAPACITY_...) are laid out the same for all effects.
"""

from __future__ import annotations

import functools
from pathlib import Path

from jax2d.effects import EFFECTS, Effects
from jax2d.scene import Capacity
from jax2d.settings import MOST_STOPS, Settings
from jax2d.warp.layout import JOINT_FLAGS, PARAMS, Layout

NATIVE_FILES = (
    "vec2.h",
    "soft.h",
    "bodies.h",
    "manifolds.h",
    "sweep.h",
    "pairs.h",
    "contacts.h",
    "joints.h",
    "forces.h",
    "bounces.h",
    "paper.h",
    "step.h",
)

# Up to here testing every pair costs less than a sweep (docs/engine.md, "How cost grows").
SWEEP_ABOVE_SHAPES = 32


# Threads a block on a GPU, one a world.
BLOCK = 64
# Of shared memory for a block: with more, fewer blocks run at a time than registers leave room for.
SHARED_BYTES = 20480
# How many numbers of a body a GPU keeps in shared memory (all that solving uses; all but what it has moved), and from
# how many worlds on that is faster: what is shared is taken from the cache, which few worlds make better use of.
SHARED_RECORDS = ((8, 65536), (5, 131072))


def shared_record(shapes: int, worlds: int) -> int:
    """How many numbers of a body a kernel for so many shapes keeps in a GPU's shared memory."""
    for numbers, least_worlds in SHARED_RECORDS:
        if 4 * numbers * shapes * BLOCK <= SHARED_BYTES:
            return numbers if worlds >= least_worlds else 0
    return 0


@functools.cache
def _read(name: str) -> str:
    return (Path(__file__).parent / "native" / name).read_text()


def constants(capacity: Capacity, settings: Settings, effects: Effects, in_shared: int) -> dict[str, int]:
    """Everything that is compiled in."""
    polygons, circles = effects.polygon_slots, effects.circle_slots
    if polygons + circles == 0:  # arrays need a length: a shape that is never active
        polygons, circles = min(1, capacity.polygons), min(1, capacity.circles)
    has_pairs = effects.polygon_pairs or effects.polygon_circle_pairs or effects.circle_pairs
    has_joints = effects.revolute_joints or effects.fixed_joints
    sweep = has_pairs and polygons + circles > SWEEP_ABOVE_SHAPES
    values = {
        "CAPACITY_POLYGONS": capacity.polygons,
        "CAPACITY_SHAPES": capacity.shapes,
        "CAPACITY_JOINTS": capacity.joints,
        "CAPACITY_CONTACTS": capacity.contact_slots,
        "NUM_POLYGONS": polygons,
        "NUM_CIRCLES": circles,
        "NUM_SHAPES": polygons + circles,
        "NUM_JOINTS": effects.joint_slots if has_joints else 0,
        "NUM_THRUSTERS": effects.thruster_slots if effects.thrusters else 0,
        "SKIPPED_POLYGONS": capacity.polygons - polygons,
        "ALL_SHAPES": int(polygons + circles == capacity.shapes),
        "MAX_VERTICES": capacity.vertices,
        "NUM_CORNERS": max(1, polygons * capacity.vertices),
        "SHARED_RECORD": in_shared,
        "SHAPE_WORDS": -(-(polygons + circles) // 32),
        "BOUNCE_SHAPES": polygons + circles if effects.restitution and settings.solver == "soft_step" else 1,
        "NUM_CONTACTS": effects.contact_slots if has_pairs else 0,
        "TOUCH_WORDS": capacity.touch_words,
        "SWEEP": int(sweep),
        "SWEEP_SHAPES": polygons + circles if sweep else 1,
        "SOFT_STEP": int(settings.solver == "soft_step"),
        "MOST_STOPS": MOST_STOPS,
        "FRICTION_ROOT_SUM_SQUARE": int(settings.friction_mixing == "root_sum_square"),
    }
    values |= {f"HAS_{name.upper()}": int(getattr(effects, name)) for name in EFFECTS}
    values |= {f"PARAM_{name}": i for i, name in enumerate(PARAMS)}
    values |= JOINT_FLAGS
    for table, rows in Layout(capacity).rows().items():
        values |= {f"{table}_{name}": row for name, row in rows.items()}
    return values


def kernel_source(capacity: Capacity, settings: Settings, effects: Effects, in_shared: int) -> str:
    """Body of the native function, with so many numbers of a body in shared memory; its arguments are named in
    kernel.py."""
    enum = ",\n  ".join(
        f"{name} = {value}" for name, value in constants(capacity, settings, effects, in_shared).items()
    )
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
state.take(state_before.data + world, STATE_ROWS);
impulses.take(impulses_before.data + world, IMPULSE_ROWS);
keys.take(keys_before.data + world, CAPACITY_CONTACTS);
World one = {scene, ints, controls, params, state, impulses, keys};
one.run(num_steps, out);
"""
    return f"enum {{\n  {enum}\n}};\n" + "\n".join(_read(name) for name in NATIVE_FILES) + call
