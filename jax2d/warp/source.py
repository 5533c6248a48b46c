"""The kernel's C++ source for one capacity, solver and set of effects: generated constants, then the files of native/.

What scenes do not call for is switched off by constants (HAS_FRICTION, ...), so that the compiler leaves it out, and
local arrays (NUM_...) are as long as the slots in use. Tables (CAPACITY_...) are laid out the same for all effects.

Local arrays: `ARRAY(type, name, size)` in native/*.h declares a pointer, and its memory stands apart. An array that is
used by an index stays in a GPU's local memory, and so does every number of the object that it is a member of: each
would be loaded again after every store to an array. With arrays apart, the numbers are in registers: 1.4 to 1.5 times
the speed at sizes S and M on an H200 (docs/lab_log.md).
"""

from __future__ import annotations

import functools
import re
from collections.abc import Iterator
from pathlib import Path

from jax2d.constants import cpp_macros
from jax2d.effects import EFFECTS
from jax2d.scene import JointDrive, JointKind
from jax2d.settings import Settings
from jax2d.solver_numbers import flat, solver_numbers
from jax2d.warp.layout import Layout, word_constants
from jax2d.warp.variant import KernelVariant

PARAMETERS = tuple(flat(solver_numbers(Settings())))  # run-time numbers, in the order of the kernel's table

NATIVE_FILES = (
    "vec2.h",
    "soft.h",
    "bodies.h",
    "active_set.h",
    "impact_plane.h",
    "manifolds.h",
    "sweep.h",
    "pairs.h",
    "surfaces.h",
    "joint_system.h",
    "joint.h",
    "drives.h",
    "springs.h",
    "line_search.h",
    "joints.h",
    "joint_answers.h",
    "contact.h",
    "contacts.h",
    "impact_propagation.h",
    "forces.h",
    "islands.h",
    "bounces.h",
    "report.h",
    "paper.h",
    "step.h",
)


@functools.cache
def _read(name: str) -> str:
    return (Path(__file__).parent / "native" / name).read_text()


def constants(variant: KernelVariant) -> dict[str, int]:
    """Constants of a kernel by name."""
    capacity, effects = variant.capacity, variant.effects
    polygons, circles = effects.polygon_slots, effects.circle_slots
    if polygons + circles == 0:  # arrays need a length: a shape that is never active
        polygons, circles = min(1, capacity.polygons), min(1, capacity.circles)
    has_pairs = effects.polygon_pairs or effects.polygon_circle_pairs or effects.circle_pairs
    has_joints = effects.revolute_joints or effects.fixed_joints or effects.prismatic_joints
    joint_slots = effects.joint_slots if has_joints else 0
    springs = capacity.springs if effects.springs else 0
    joints = joint_slots + springs  # ropes and rods are joints
    has_axes = effects.motors or effects.joint_limits or springs > 0
    line_search = variant.line_search and has_pairs and joints > 0
    sweep = has_pairs and polygons + circles > variant.options.sweep_above_shapes
    values = {
        "CAPACITY_POLYGONS": capacity.polygons,
        "CAPACITY_SHAPES": capacity.shapes,
        "CAPACITY_JOINTS": capacity.joints,
        "CAPACITY_CONTACTS": capacity.contact_slots,
        "NUM_POLYGONS": polygons,
        "NUM_CIRCLES": circles,
        "NUM_SHAPES": polygons + circles,
        "NUM_JOINTS": joints,
        "JOINT_SLOTS": joint_slots,
        "JOINT_WORDS": max(1, -(-joints // 32)),
        "HAS_AXES": int(bool(has_axes)),  # joints drive or bound what is along their axes
        "HELD_ROWS": 3 if effects.fixed_joints or has_axes else 2,  # of a joint
        "NUM_SPRINGS": springs,
        "HAS_RODS": int(springs > 0),
        "HAS_AXIS_JOINTS": int(bool(effects.prismatic_joints) or springs > 0),  # joints along a line
        "NUM_THRUSTERS": effects.thruster_slots if effects.thrusters else 0,
        "SKIPPED_POLYGONS": capacity.polygons - polygons,
        "ALL_SHAPES": int(polygons + circles == capacity.shapes),
        "MAX_VERTICES": capacity.vertices,
        "NUM_CORNERS": max(1, polygons * capacity.vertices),
        "SHARED_RECORD": variant.shared_record,
        "WARP_WORLDS": variant.warp_worlds,
        "SHAPE_WORDS": -(-(polygons + circles) // 32),
        "ISLAND_SHAPES": polygons + circles if variant.is_soft else 1,
        "BOUNCE_SHAPES": polygons + circles if effects.restitution and variant.is_soft else 1,
        "REPORT_CONTACTS": effects.contact_slots if has_pairs and variant.report_contacts else 0,
        "NUM_CONTACTS": effects.contact_slots if has_pairs else 0,
        "TOUCH_WORDS": capacity.touch_words,
        "SWEEP": int(sweep),
        "SWEEP_SHAPES": polygons + circles if sweep else 1,
        "SOFT_STEP": int(variant.is_soft),
        "SHARES_IMPACTS": int(variant.shares_impacts),
        "LINE_SEARCH": int(line_search),
        "SEARCHED_SHAPES": polygons + circles if line_search else 1,
        "SEARCHED_CONTACTS": effects.contact_slots + 1 if line_search else 1,
        "FRICTION_ROOT_SUM_SQUARE": int(variant.friction_mixing == "root_sum_square"),
    }
    values |= {f"HAS_{name.upper()}": int(getattr(effects, name)) for name in EFFECTS}
    values |= {f"PARAM_{name.upper()}": i for i, name in enumerate(PARAMETERS)}
    values |= {f"KIND_{kind.name}": int(kind) for kind in JointKind}
    values |= {f"DRIVE_{drive.name}": int(drive) for drive in JointDrive}
    values |= word_constants()
    for table, rows in Layout(capacity, report_contacts=variant.report_contacts).rows().items():
        values |= {f"{table}_{name}": row for name, row in rows.items()}
    return values


def kernel_source(variant: KernelVariant) -> str:
    """Body of the native function; its arguments are named in kernel.py."""
    enum = ",\n  ".join(f"{name} = {value}" for name, value in constants(variant).items())
    call = """
#if defined(__CUDA_ARCH__)
if (WARP_WORLDS < 32) {  // the other lanes have no world
  if (world % 32 >= WARP_WORLDS) return;
  world = world / 32 * WARP_WORLDS + world % 32;
  if (world >= num_worlds) return;
}
#endif
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
"""
    has_springs = constants(variant)["NUM_SPRINGS"] > 0
    files = [name if name != "springs.h" or has_springs else "no_springs.h" for name in NATIVE_FILES]
    structs = "\n".join(map(_read, files))
    arrays = storage_of(structs, "World", "one")
    return f"enum {{\n  {enum}\n}};\n{cpp_macros()}\n{structs}{call}{arrays}\none.run(num_steps, out);\n"


_STRUCT = re.compile(r"^struct (\w+) \{\n(.*?)^\};", re.MULTILINE | re.DOTALL)
_ARRAY = re.compile(r"^  ARRAY\(([\w: ]+), (\w+), (.+?)\);", re.MULTILINE)
_MEMBER = re.compile(r"^  (\w+) (\w+);", re.MULTILINE)


def storage_of(structs: str, name: str, variable: str) -> str:
    """C++ that gives memory to the arrays of `variable` and of its members: a struct `name` of the text `structs`."""
    lines = []
    for kind, path, size in _arrays(dict(_STRUCT.findall(structs)), name, variable):
        array = "array_" + path.replace(".", "_")
        lines += [f"{kind} {array}[{size}];", f"{path} = {array};"]
    return "\n".join(lines)


def _arrays(bodies: dict[str, str], name: str, path: str) -> Iterator[tuple[str, str, str]]:
    """(type, path, length) of each array of the struct `name`."""
    for kind, array, size in _ARRAY.findall(bodies[name]):
        yield kind, f"{path}.{array}", size
    for kind, member in _MEMBER.findall(bodies[name]):
        if kind in bodies:
            yield from _arrays(bodies, kind, f"{path}.{member}")
