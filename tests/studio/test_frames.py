"""Frames: bytes at the places that docs/play_protocol.md gives."""

from __future__ import annotations

import dataclasses
import math
import struct
import subprocess
import sys
from typing import Any

import numpy as np
import pytest

from kinetix_dist.studio.worker import frames
from kinetix_dist.studio.worker.frames import Frame, FrameSizes
from tests.helpers import PATIENCE_S, REPOSITORY

SIZES = FrameSizes(shapes=16, joints=6, thrusters=2, outputs=16)


def drawn(sizes: FrameSizes = SIZES, **changes: Any) -> Frame:
    draws = np.random.default_rng(0)
    arrays = {name: draws.normal(size=shape).astype(np.float32) for name, shape in sizes.arrays}
    frame = Frame(
        session=3,
        step=70_000,
        poses=arrays["poses"],
        motor=arrays["motor"],
        thruster=arrays["thruster"],
        colours=arrays["colours"],
        outputs=arrays["outputs"],
        flags=frames.DONE | frames.SOLVED,
        seq=2**32 - 1,
        reward=0.5,
        total_reward=1.25,
        value=-0.25,
        gap=2.0,
    )
    return dataclasses.replace(frame, **changes)


def test_a_frame_comes_back() -> None:
    frame = drawn()
    again = frames.decode(frames.encode(frame), SIZES)
    for name in Frame.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(again, name), getattr(frame, name))


def test_bytes_are_those_of_the_documentation() -> None:
    data = frames.encode(drawn())
    # u8 version, u8 flags, u16 session, u32 step, u32 seq, f32 reward, return, value, gap
    assert struct.unpack_from("<BBHIIffff", data) == (2, 3, 3, 70_000, 2**32 - 1, 0.5, 1.25, -0.25, 2.0)
    assert struct.unpack_from("<3f", data, 28 + 12 * 5) == tuple(drawn().poses[5])
    assert len(data) == 28 + 12 * 16 + 4 * (6 + 2 + 6 + 16)
    at_l = FrameSizes(shapes=16, joints=6, thrusters=2)
    assert at_l.num_bytes == len(frames.encode(drawn(at_l))) == 276
    assert "276 at L" in (REPOSITORY / "docs" / "play_protocol.md").read_text()


@pytest.mark.parametrize("changes", [{"value": math.nan}, {"poses": np.full((16, 3), np.nan, np.float32)}])
def test_no_number_is_sent_that_is_none(changes: dict) -> None:
    with pytest.raises(ValueError, match=f"{next(iter(changes))} of step 70000 is not finite"):
        frames.encode(drawn(**changes))


def test_a_state_in_which_no_policy_acted_has_no_outputs() -> None:
    data = frames.encode(drawn(outputs=np.zeros(0, np.float32)))
    assert len(frames.decode(data, SIZES).outputs) == 0


def test_bytes_of_other_sizes_or_another_version_are_refused() -> None:
    data = frames.encode(drawn())
    with pytest.raises(ValueError, match="bytes"):
        frames.decode(data[:-1], SIZES)
    with pytest.raises(ValueError, match="version 1"):
        frames.decode(b"\1" + data[1:], SIZES)


def test_a_server_can_import_both_without_jax() -> None:
    code = "import sys; from kinetix_dist.studio.worker import frames, wire; sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=REPOSITORY, timeout=PATIENCE_S).returncode == 0
