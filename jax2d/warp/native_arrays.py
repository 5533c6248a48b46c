"""Memory for the arrays of the native structs: `ARRAY(type, name, size)` in native/*.h declares a pointer.

An array that is used by an index stays in a GPU's local memory, and so does every number of the object that it is a
member of: each would be loaded again after every store to an array. With arrays apart, the numbers are in registers:
1.4 to 1.5 times the speed at sizes S and M on an H200 (docs/lab_log.md).
"""

from __future__ import annotations

import re
from collections.abc import Iterator

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
