"""docs/play_protocol.md names what the code has: requests, controls, codes, fields of frames, kinds of primitives."""

from __future__ import annotations

import pytest

from jax2d.display_list import KINDS
from kinetix_dist.studio.worker import frames, play_requests, process, session_loop, wire
from kinetix_dist.studio.worker.request import ENV_FIELDS
from kinetix_dist.studio.worker.service import MAX_WAITING, Service
from kinetix_dist.studio.worker.wire import Outbox
from tests.helpers import REPOSITORY

TEXT = (REPOSITORY / "docs" / "play_protocol.md").read_text()
CODES = (wire.BAD_REQUEST, wire.NOT_FOUND, wire.TOO_LARGE, wire.BUSY, wire.CANCELLED, wire.FAILED)


@pytest.fixture(scope="module")
def requests(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    with (tmp_path_factory.mktemp("pipe") / "out").open("wb") as pipe:
        outbox = Outbox(pipe)
        names = list(Service(outbox)._handlers)
        outbox.close(5)
    return [*names, "play.open", "play.input", "play.control", "play.close", "cancel"]


def test_every_request_is_described(requests: list[str]) -> None:
    assert not [name for name in requests if f'"type": "{name}"' not in TEXT]


def test_every_code_control_field_and_kind_is_described() -> None:
    assert not [code for code in CODES if f"| `{code}` |" not in TEXT]
    assert not [name for name in play_requests.CONTROLS if f'"{name}"' not in TEXT]
    assert not [name for name in ENV_FIELDS if f'"{name}"' not in TEXT]
    assert not [kind for kind in KINDS if f"`{kind}`" not in TEXT]


def test_frames_are_described_field_by_field() -> None:
    types = {"B": "u8", "H": "u16", "I": "u32", "f": "f32"}
    rows = [line for line in TEXT.splitlines() if line.startswith("| ")]
    named = {"total_reward": "return"}
    for code, name in frames.FIELDS:
        assert [row for row in rows if row.startswith(f"| {types[code]} | {named.get(name, name)} |")], name
    for name, _ in frames.FrameSizes(shapes=1, joints=1, thrusters=1).arrays:
        assert [row for row in rows if row.startswith("| f32 x ") and f"| {name} |" in row], name


def test_limits_are_those_of_the_code() -> None:
    assert f"`{wire.BUSY}` | {session_loop.MAX_SESSIONS} sessions are open, or {MAX_WAITING} requests wait" in TEXT
    assert f"At most {wire.MAX_MESSAGE_BYTES >> 20} MiB" in TEXT
    assert f"after {process.IDLE_SECONDS / 60:.0f} minutes without a message" in TEXT
    assert f"Protocol version {wire.PROTOCOL_VERSION}." in TEXT
