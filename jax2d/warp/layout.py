"""Rows of each quantity in the kernel's tables, from the declarations of Scene, State and Controls.

Scene, State and the rest are pytrees of small arrays; the kernel reads and writes tables of `[field, world]`, so that
neighbouring threads touch neighbouring addresses. `Layout` gives each quantity's first row; source.py turns the same
numbers into C++ constants. A field of `Scene.joints.anchor_a` stands at SCENE_JOINTS_ANCHOR_A.

    SCENE    floats of the scene
    INTS     bools over shapes as bit sets; whole numbers of polygons; a packed word for each joint and thruster
    STATE    floats of bodies               IMPULSE  floats for warm starting         KEYS  of contacts
    CONTROLS floats of controls
    OUT      report of a call
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterable

from jax2d.fields import Field, fields_of, num_elements
from jax2d.scene import Capacity, Controls, Scene, State

# Of OUT, in engines that report contacts: rows a contact slot. The key is a whole number, the others are floats.
REPORT_ROWS = (
    ("CONTACT_KEY", 1),
    ("CONTACT_POINT", 2),
    ("CONTACT_NORMAL", 2),
    ("CONTACT_SEPARATION", 1),
    ("CONTACT_IMPULSE", 2),
)
WORD_BITS = 31  # of an int32 that stays positive


def scene_floats() -> list[Field]:
    """Rows of the SCENE table, in order."""
    return [field for field in fields_of(Scene) if field.kind is float and field.stepped]


def bit_sets() -> list[Field]:
    """Bools over shapes: rows of bits in the INTS table."""
    return [field for field in fields_of(Scene) if field.kind is bool and field.dims[-1] == "n"]


def whole_numbers() -> list[Field]:
    """Ints with a row each in the INTS table."""
    return [field for field in fields_of(Scene) if field.kind is int and field.bits is None]


@functools.cache
def packed_words() -> dict[str, dict[Field, int]]:
    """Parts of a scene that are packed into one word a slot: part -> {field: position of its lowest bit}."""
    words: dict[str, dict[Field, int]] = {}
    for field in fields_of(Scene):
        if field.bits is not None:
            word = words.setdefault(field.path[0], {})
            word[field] = field_bits(word)
    for part, word in words.items():
        assert field_bits(word) <= WORD_BITS, f"{part} does not fit a word"
    return words


def field_bits(word: Iterable[Field]) -> int:
    return sum(field.bits or 0 for field in word)


def state_floats(table: str) -> list[Field]:
    """Rows of the STATE table (of bodies) or of the IMPULSE table (of joints and contacts)."""
    is_body = {"STATE": True, "IMPULSE": False}[table]
    return [field for field in fields_of(State) if field.kind is float and (field.dims[0] == "n") == is_body]


@dataclasses.dataclass(frozen=True)
class Layout:
    """Rows of the kernel's tables for one capacity."""

    capacity: Capacity
    report_contacts: bool = False

    def rows(self) -> dict[str, dict[str, int]]:
        """First row of each quantity, by table; the key 'ROWS' gives the table's height."""
        c = self.capacity
        sizes, words = c.sizes, c.touch_words
        sets = {cpp_name(field): num_elements(field, sizes) // c.shapes * words for field in bit_sets()}
        numbers = {cpp_name(field): num_elements(field, sizes) for field in whole_numbers()}
        packed = {part.upper(): next(iter(word)).shape(sizes)[0] for part, word in packed_words().items()}
        return {
            "SCENE": _stack({cpp_name(field): num_elements(field, sizes) for field in scene_floats()}),
            "INTS": _stack(sets | numbers | packed),
            **{
                table: _stack({cpp_name(field): num_elements(field, sizes) for field in state_floats(table)})
                for table in ("STATE", "IMPULSE")
            },
            "CONTROLS": _stack({cpp_name(field): num_elements(field, sizes) for field in fields_of(Controls)}),
            "OUT": _stack(
                {"AT_END": c.shapes * words, "DURING": c.shapes * words, "OVERFLOW": 1, "LIMITED": 1, "OPEN_JOINTS": 1}
                | {name: height * (c.contact_slots if self.report_contacts else 0) for name, height in REPORT_ROWS}
                | {"CONTACT_DROPPED": int(self.report_contacts)}
            ),
        }


def cpp_name(field: Field) -> str:
    return "_".join(field.path).upper()


def word_constants() -> dict[str, int]:
    """JOINTS_A_SHIFT, JOINTS_A_MASK and so on: where numbers stand in packed words."""
    constants = {}
    for word in packed_words().values():
        for field, shift in word.items():
            constants[f"{cpp_name(field)}_SHIFT"] = shift
            constants[f"{cpp_name(field)}_MASK"] = (1 << (field.bits or 0)) - 1
    return constants


def _stack(heights: dict[str, int]) -> dict[str, int]:
    rows, total = {}, 0
    for name, height in heights.items():
        rows[name] = total
        total += height
    return rows | {"ROWS": total}
