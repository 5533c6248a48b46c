"""Bytes and launches of a program that XLA compiled for a GPU, read from its text: `compiled.as_text()`.

A launch reads its operands and writes its results once, whatever it does in between: caches between two launches are
not counted. Of an operand that a kernel only slices or gathers, what it takes is counted; of a result that it updates
in place, what it writes.

    launches = launches_of(text)         # of the entry, loops times their iterations
    launches = launches_of(text, loop_body(text))

Free of a launch are views (bitcast, tuple, ...), parameters and constants. Work space of libraries is not counted.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator

# Bytes of an element; `pred` is a byte a value.
ELEMENT_BYTES = {"pred": 1, "s4": 0.5, "u4": 0.5, "s8": 1, "u8": 1, "s16": 2, "u16": 2, "f16": 2, "bf16": 2}
ELEMENT_BYTES |= {"s32": 4, "u32": 4, "f32": 4, "s64": 8, "u64": 8, "f64": 8, "c64": 8, "c128": 16, "token": 0}
VIEWS = {"parameter", "constant", "tuple", "get-tuple-element", "bitcast", "after-all", "partition-id", "replica-id"}
TAKES_A_PART = {"slice", "dynamic-slice", "gather"}
_ARRAY = re.compile(r"\b([a-z]+[0-9]*)\[([0-9,]*)\]")
_HEAD = re.compile(r"^(ENTRY )?%?([\w.\-]+) \(.*\) -> .*\{$")
_LINE = re.compile(r"^(ROOT )?%?([\w.\-]+) = (.*)$")
_NAME = re.compile(r"%([\w.\-]+)")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Instruction:
    name: str
    result: str  # its type, as it is written
    opcode: str
    operands: tuple[str, ...]  # names
    arguments: str  # between the parentheses, as it is written
    attributes: str  # behind them
    is_root: bool


Computation = dict[str, Instruction]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Launch:
    """One kernel, or one call of a library."""

    name: str
    read_bytes: float
    written_bytes: float
    times: int  # it is launched
    stack: tuple[tuple[str, str], ...]  # (file, function) that it comes from, innermost first; parts may be missing
    scopes: tuple[str, ...]  # named scopes that it was traced in, innermost first


class CompiledText:
    """The computations and stack frames of `compiled.as_text()`."""

    def __init__(self, text: str) -> None:
        """Raises ValueError for a text without an entry computation."""
        self.computations: dict[str, Computation] = {}
        self.entry = ""
        tables: dict[str, list[str]] = {}
        table = ""
        current: Computation | None = None
        for line in text.splitlines():
            if head := _HEAD.match(line):
                current = self.computations.setdefault(head[2], {})
                self.entry = head[2] if head[1] else self.entry
            elif line == "}":
                current = None
            elif current is not None:
                if found := _instruction(line.strip()):
                    current[found.name] = found
            elif line in ("FileNames", "FunctionNames", "FileLocations", "StackFrames"):
                table = line
            elif table and (row := re.match(r"^\d+ (.*)$", line)):
                tables.setdefault(table, []).append(row[1])
        if not self.entry:
            raise ValueError("this is no compiled program: it has no computation ENTRY")
        self._tables = tables

    def source(self, instruction: Instruction) -> Instruction:
        """Source line of an instruction: its own, or that of the last instruction that it calls."""
        if "stack_frame_id=" in instruction.attributes:
            return instruction
        called = self.computations.get(_attribute(instruction, "calls"), {})
        working = [x for x in called.values() if x.opcode not in VIEWS and "stack_frame_id=" in x.attributes]
        # A slice that is fused into a product is counted where what it is a slice of was stored.
        working = [x for x in working if x.opcode not in TAKES_A_PART] or working
        return working[-1] if working else instruction

    def stack(self, instruction: Instruction) -> tuple[tuple[str, str], ...]:
        """(file, function), innermost first."""
        found = re.search(r"stack_frame_id=(\d+)", instruction.attributes)
        return tuple(self._frames(int(found[1]))) if found else ()

    def scopes(self, instruction: Instruction) -> tuple[str, ...]:
        found = re.search(r'op_name="([^"]*)"', instruction.attributes)
        return tuple(reversed(found[1].split("/"))) if found else ()

    def _frames(self, frame: int) -> Iterator[tuple[str, str]]:
        while True:
            location, parent = _numbers(self._tables["StackFrames"][frame - 1], "file_location_id", "parent_frame_id")
            file, function = _numbers(self._tables["FileLocations"][location - 1], "file_name_id", "function_name_id")
            yield (
                self._tables["FileNames"][file - 1].strip('"'),
                self._tables["FunctionNames"][function - 1].strip('"'),
            )
            if parent == frame or parent == 0:
                return
            frame = parent


def launches_of(program: CompiledText, computation: str | None = None) -> list[Launch]:
    """Every launch of a computation, by default of the whole program, with loops inside it.

    Raises ValueError for a loop whose number of iterations the compiler did not find, and for branches.
    """
    return list(_launches(program, computation or program.entry, 1))


def loop_body(program: CompiledText, iterations: int | None = None) -> str:
    """The body of the loop that moves most bytes an iteration, of those with no loop in them, or, where `iterations` is
    given, of those that run so often. Raises ValueError where there is none."""
    bodies = {}
    for computation in program.computations.values():
        for instruction in computation.values():
            if instruction.opcode == "while":
                body = _attribute(instruction, "body")
                if iterations is None:
                    counts = not any(inner.opcode == "while" for inner in program.computations[body].values())
                else:
                    counts = _iterations(instruction) == iterations
                if counts:
                    bodies[body] = sum(x.read_bytes + x.written_bytes for x in launches_of(program, body))
    if not bodies:
        raise ValueError("the compiled program has no loop" + (f" of {iterations} iterations" if iterations else ""))
    return max(bodies, key=lambda body: bodies[body])


def _launches(program: CompiledText, name: str, times: int) -> Iterator[Launch]:
    computation = program.computations[name]
    for instruction in computation.values():
        if instruction.opcode in VIEWS or instruction.opcode.endswith("-done"):
            continue
        if instruction.opcode == "while":
            count = _iterations(instruction)
            if count is None:
                raise ValueError(f"{instruction.name}: a loop of an unknown number of iterations")
            yield from _launches(program, _attribute(instruction, "body"), times * count)
        elif instruction.opcode == "call":
            yield from _launches(program, _attribute(instruction, "to_apply"), times)
        elif instruction.opcode == "conditional":
            raise ValueError(f"{instruction.name}: what a branch costs depends on the data")
        else:
            read, written = _traffic(program, computation, instruction)
            source = program.source(instruction)
            yield Launch(
                name=instruction.name,
                read_bytes=read,
                written_bytes=written,
                times=times,
                stack=program.stack(source),
                scopes=program.scopes(source),
            )


def _iterations(loop: Instruction) -> int | None:
    """None: the compiler did not find it."""
    count = re.search(r'"known_trip_count":\{"n":"(\d+)"\}', loop.attributes)
    return int(count[1]) if count else None


def _traffic(program: CompiledText, computation: Computation, instruction: Instruction) -> tuple[float, float]:
    """Bytes that a launch reads and writes."""
    if instruction.opcode in ("fusion", "fusion-start"):  # the latter beside other launches
        return _fusion_traffic(program.computations[_attribute(instruction, "calls")], computation, instruction)
    written = _result_bytes(instruction)
    if instruction.opcode in TAKES_A_PART:  # indices are small, but are read
        return written + sum(_type_bytes(_type(computation, name)) for name in instruction.operands[1:]), written
    if instruction.opcode == "dynamic-update-slice":
        update = _type_bytes(_type(computation, instruction.operands[1]))
        return update, update
    return sum(_type_bytes(_type(computation, name)) for name in instruction.operands), written


def _fusion_traffic(inside: Computation, outside: Computation, fusion: Instruction) -> tuple[float, float]:
    users: dict[str, list[Instruction]] = {}
    for inner in inside.values():
        for name in inner.operands:
            users.setdefault(name, []).append(inner)
    parameters = {int(x.arguments): x.name for x in inside.values() if x.opcode == "parameter"}
    read = 0.0
    for number, operand in enumerate(fusion.operands):
        read += min(_taken(parameters[number], users), _type_bytes(_type(outside, operand)))
    (root,) = (x for x in inside.values() if x.is_root)
    results = [inside[name] for name in root.operands] if root.opcode == "tuple" else [root]
    return read, sum(_written(inside, result) for result in results)


def _taken(name: str, users: dict[str, list[Instruction]]) -> float:
    """Bytes that a fusion takes of one of its parameters; infinite: all of it."""
    total = 0.0
    for user in users.get(name, []):
        if user.opcode == "bitcast":
            total += _taken(user.name, users)
        elif user.opcode in TAKES_A_PART and user.operands[0] == name and name not in user.operands[1:]:
            total += _type_bytes(user.result)
        elif user.opcode == "dynamic-update-slice" and user.operands[0] == name and name not in user.operands[1:]:
            pass  # updated in place
        else:
            return float("inf")
    return total


def _written(inside: Computation, result: Instruction) -> float:
    while result.opcode == "bitcast":
        result = inside[result.operands[0]]
    if result.opcode == "dynamic-update-slice":
        return _type_bytes(_type(inside, result.operands[1]))
    return _result_bytes(result)


def _result_bytes(instruction: Instruction) -> float:
    """Bytes of a result, without the work space that a library's call has as its last one."""
    arrays = _ARRAY.findall(instruction.result)
    if instruction.opcode == "custom-call" and "__cu" in instruction.attributes and arrays[-1][0] == "s8":
        arrays = arrays[:-1]
    return sum(map(_array_bytes, arrays))


def _type_bytes(text: str) -> float:
    return sum(map(_array_bytes, _ARRAY.findall(text)))


def _array_bytes(array: tuple[str, str]) -> float:
    """Raises ValueError for a type of element that is not known."""
    element, shape = array
    if element not in ELEMENT_BYTES and not element.startswith("f8"):
        raise ValueError(f"how large is an element of type {element}?")
    size = ELEMENT_BYTES.get(element, 1)
    for length in filter(None, shape.split(",")):
        size *= int(length)
    return size


def _type(computation: Computation, name: str) -> str:
    return computation[name].result


def _attribute(instruction: Instruction, name: str) -> str:
    found = re.search(rf"\b{name}=%?([\w.\-]+)", instruction.attributes)
    return found[1] if found else ""


def _numbers(text: str, *names: str) -> Iterator[int]:
    for name in names:
        found = re.search(rf"\b{name}=(\d+)", text)
        yield int(found[1]) if found else 0


def _instruction(line: str) -> Instruction | None:
    """`ROOT %name = type opcode(operands), attributes`."""
    found = _LINE.match(line)
    if found is None:
        return None
    result, rest = _split_type(found[3])
    opcode, _, rest = rest.partition("(")
    inside, attributes = _split_parenthesis(rest)
    return Instruction(
        name=found[2],
        result=result,
        opcode=opcode,
        operands=() if opcode in ("parameter", "constant") else tuple(_NAME.findall(inside)),
        arguments=inside,
        attributes=attributes,
        is_root=found[1] is not None,
    )


def _split_type(text: str) -> tuple[str, str]:
    """The type, which has no space outside of parentheses, and what follows it."""
    depth = 0
    for at, letter in enumerate(text):
        depth += (letter in "({") - (letter in ")}")
        if letter == " " and depth == 0:
            return text[:at], text[at + 1 :]
    return text, ""


def _split_parenthesis(text: str) -> tuple[str, str]:
    depth = 1
    for at, letter in enumerate(text):
        depth += (letter == "(") - (letter == ")")
        if depth == 0:
            return text[:at], text[at + 1 :]
    return text, ""
