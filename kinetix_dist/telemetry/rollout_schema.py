"""The protobuf message of a recorded state, and its bytes as one numpy array for a whole rollout.

rollout.proto is the schema for readers in other languages; the table `FIELDS` says the same here, and a test
compiles the one and compares it with the other. There is no generated code, so no protoc and no tie to one
protobuf version. All fields have fixed width (float, fixed32), so within a rollout every message has the
same layout: a numpy record of constant headers (tag, length) and numbers, written and read without a
loop over messages.

    wire bytes of a repeated float:   tag | length in bytes (varint) | 4 bytes a number
    of a single float or fixed32:     tag | 4 bytes
"""

from __future__ import annotations

import dataclasses

import numpy as np

PACKAGE = "kinetix_dist"
MESSAGE = "Step"
FILE_NAME = "kinetix_dist/telemetry/rollout.proto"

# name: (field number, numpy type, count: None for a single value, else which size and how many numbers of it)
FIELDS: dict[str, tuple[int, str, tuple[str, int] | None]] = {
    "rollout": (1, "<u4", None),
    "step": (2, "<u4", None),
    "position": (3, "<f4", ("shapes", 2)),
    "angle": (4, "<f4", ("shapes", 1)),
    "velocity": (5, "<f4", ("shapes", 2)),
    "angular_velocity": (6, "<f4", ("shapes", 1)),
    "actions": (7, "<f4", ("actions", 1)),
    "motor": (8, "<f4", ("joints", 1)),
    "thruster": (9, "<f4", ("thrusters", 1)),
    "reward": (10, "<f4", None),
}
_WIRE_LENGTH_DELIMITED, _WIRE_32_BIT = 2, 5


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sizes:
    """Numbers of bodies, joints and so on of a rollout; they fix the layout of its messages."""

    shapes: int
    joints: int
    thrusters: int
    actions: int


def message_dtype(sizes: Sizes) -> tuple[np.dtype, dict[str, bytes]]:
    """The numpy record of one message, and the constant header bytes before each field."""
    columns: list[tuple] = []
    headers: dict[str, bytes] = {}
    for name, (number, kind, count) in FIELDS.items():
        if count is None:
            header, shape = bytes([number << 3 | _WIRE_32_BIT]), ()
        else:
            length = getattr(sizes, count[0]) * count[1]
            header, shape = bytes([number << 3 | _WIRE_LENGTH_DELIMITED]) + _varint(4 * length), (length,)
        headers[name] = header
        columns += [(f"{name}.header", "u1", (len(header),)), (name, kind, shape)]
    return np.dtype(columns), headers  # packed: no padding between columns


def encode_messages(sizes: Sizes, columns: dict[str, np.ndarray]) -> list[bytes]:
    """Serialized messages of a rollout. Each column is `[num_messages, ...]`; `rollout` may be one number."""
    dtype, headers = message_dtype(sizes)
    messages = np.zeros(len(columns["step"]), dtype)
    for name, header in headers.items():
        messages[f"{name}.header"] = np.frombuffer(header, np.uint8)
        values = np.asarray(columns[name])
        messages[name] = values.reshape(messages[name].shape) if values.ndim else values
    data, width = messages.tobytes(), dtype.itemsize
    return [data[start : start + width] for start in range(0, len(data), width)]


def decode_messages(sizes: Sizes, messages: list[bytes]) -> dict[str, np.ndarray]:
    """Columns of messages that `encode_messages` made. Raises ValueError for any other layout."""
    dtype, headers = message_dtype(sizes)
    wrong = next((k for k, message in enumerate(messages) if len(message) != dtype.itemsize), None)
    if wrong is not None:
        raise ValueError(f"message {wrong} has {len(messages[wrong])} bytes where the level needs {dtype.itemsize}")
    records = np.frombuffer(b"".join(messages), dtype)
    for name, header in headers.items():
        if not (records[f"{name}.header"] == np.frombuffer(header, np.uint8)).all():
            raise ValueError(f"field {name!r} is not laid out as this version writes it")
    return {name: records[name] for name in FIELDS}


def file_descriptor_set() -> bytes:
    """The schema as a serialized FileDescriptorSet, which MCAP files carry for readers that know nothing of it."""
    from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorSet

    descriptors = FileDescriptorSet()
    file = descriptors.file.add(name=FILE_NAME, package=PACKAGE, syntax="proto3")
    message = file.message_type.add(name=MESSAGE)
    for name, (number, kind, count) in FIELDS.items():
        is_float = kind == "<f4"
        message.field.add(
            name=name,
            number=number,
            json_name=_camel_case(name),
            type=FieldDescriptorProto.TYPE_FLOAT if is_float else FieldDescriptorProto.TYPE_FIXED32,
            label=FieldDescriptorProto.LABEL_OPTIONAL if count is None else FieldDescriptorProto.LABEL_REPEATED,
        )
    return descriptors.SerializeToString(deterministic=True)


def _varint(number: int) -> bytes:
    out = bytearray()
    while number >= 0x80:
        out.append(number & 0x7F | 0x80)
        number >>= 7
    return bytes([*out, number])


def _camel_case(name: str) -> str:
    first, *rest = name.split("_")
    return first + "".join(word.capitalize() for word in rest)
