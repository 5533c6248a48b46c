"""Frames: a state of a session as bytes, which a browser gets as they are. No jax.

FIELDS of HEADER, then float32: poses [n, 3], motor [J], thruster [T], colours [6], outputs [P]; little-endian
"""

from __future__ import annotations

import dataclasses
import math
import struct

import numpy as np

FRAME_VERSION = 2
FIELDS = (  # struct code, name
    ("B", "version"),
    ("B", "flags"),
    ("H", "session"),
    ("I", "step"),
    ("I", "seq"),
    ("f", "reward"),
    ("f", "total_reward"),
    ("f", "value"),
    ("f", "gap"),
)
HEADER = struct.Struct("<" + "".join(code for code, _ in FIELDS))
DONE, SOLVED, FAILED, UNSTABLE, AGAIN = 1, 2, 4, 8, 16  # flags; AGAIN: a step that was played before
NUM_COLOURS = 6  # four of motors, two of thrusters


@dataclasses.dataclass(frozen=True, kw_only=True)
class FrameSizes:
    """Sizes of the arrays of a frame, by level and policy."""

    shapes: int
    joints: int
    thrusters: int
    outputs: int = 0  # numbers of the policy's distribution, in frames of states in which it acted

    @property
    def arrays(self) -> tuple[tuple[str, tuple[int, ...]], ...]:
        """Names and shapes of the arrays, in their order."""
        return (
            ("poses", (self.shapes, 3)),
            ("motor", (self.joints,)),
            ("thruster", (self.thrusters,)),
            ("colours", (NUM_COLOURS,)),
            ("outputs", (self.outputs,)),
        )

    @property
    def num_bytes(self) -> int:
        return HEADER.size + sum(4 * math.prod(shape) for _, shape in self.arrays)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Frame:
    """State of a session, with the step that led to it."""

    session: int
    step: int  # since the start of the episode
    poses: np.ndarray  # [n, 3] float32: x, y (m), angle (rad)
    motor: np.ndarray  # [J] float32, -1..1
    thruster: np.ndarray  # [T] float32, 0..1
    colours: np.ndarray  # [6] float32, value of each colour's control
    outputs: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, np.float32))  # [P] of the policy
    flags: int = 0
    seq: int = 0  # of the last input that acted
    reward: float = 0.0
    total_reward: float = 0.0  # the return so far
    value: float = 0.0  # by the policy; 0 without one
    gap: float = 0.0  # m, from the edge of green to that of blue; 0 where they touch or overlap


def encode(frame: Frame) -> bytes:
    """Raises ValueError for a number that is not finite: a page can show none."""
    names = [name for _, name in FIELDS[1:]] + ["poses", "motor", "thruster", "colours", "outputs"]
    if bad := [name for name in names if not np.isfinite(getattr(frame, name)).all()]:
        raise ValueError(f"{', '.join(bad)} of step {frame.step} is not finite")
    header = HEADER.pack(FRAME_VERSION, *(getattr(frame, name) for _, name in FIELDS[1:]))
    arrays = (frame.poses, frame.motor, frame.thruster, frame.colours, frame.outputs)
    return header + b"".join(np.ascontiguousarray(array, "<f4").tobytes() for array in arrays)


def decode(data: bytes, sizes: FrameSizes) -> Frame:
    """Frame of its bytes; no outputs where no policy acted. Raises ValueError for another version or other sizes."""
    if len(data) == sizes.num_bytes - 4 * sizes.outputs:
        sizes = dataclasses.replace(sizes, outputs=0)
    if len(data) != sizes.num_bytes:
        raise ValueError(f"a frame has {len(data)} bytes; one of {sizes} has {sizes.num_bytes}")
    values = dict(zip((name for _, name in FIELDS), HEADER.unpack_from(data)))
    if (version := values.pop("version")) != FRAME_VERSION:
        raise ValueError(f"a frame has version {version}; this reader knows {FRAME_VERSION}")
    numbers, start = np.frombuffer(data, "<f4", offset=HEADER.size), 0
    arrays = {}
    for name, shape in sizes.arrays:
        count = math.prod(shape)
        arrays[name] = numbers[start : start + count].reshape(shape)
        start += count
    return Frame(
        **values,
        poses=arrays["poses"],
        motor=arrays["motor"],
        thruster=arrays["thruster"],
        colours=arrays["colours"],
        outputs=arrays["outputs"],
    )
