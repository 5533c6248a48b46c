"""Reads MCAP recordings back, whole or not: cut files up to the last whole chunk, damaged ones around the damage.

The mcap library's readers stop at a missing index and pass over flipped bytes, so the records are walked here:
every record is `opcode | length | content`; chunks carry a CRC of their content, the metadata records of this project
one of their own, a finished file one of all its bytes.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable, Iterator
from io import BytesIO
from typing import Any

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Chunk, DataEnd, Footer, Message, Metadata
from mcap.stream_reader import breakup_chunk

from kinetix_dist.telemetry.recording import OUTCOMES, ActionName, RecordedLevel, Recording, RecordingError, Rollout
from kinetix_dist.telemetry.rollout_schema import Sizes, decode_messages
from kinetix_dist.telemetry.sinks.mcap import FORMAT_VERSION, METADATA_NAME, STEP_CHANNEL, metadata_checksum
from kinetix_dist.text_files import loads_json

MAGIC = b"\x89MCAP0\r\n"
_RECORD_HEAD = struct.Struct("<BQ")


def read_recording(path: str | os.PathLike[str], decode_level: Callable[[str], RecordedLevel]) -> Recording:
    """Every rollout of a file, with one line for each fault.

    `decode_level` makes a level of its JSON text. A rollout whose end is missing has `is_complete` False. Raises
    RecordingError when the file is no recording, OSError when it cannot be opened.
    """
    with open(path, "rb") as file:
        data = file.read()
    name = os.fspath(path)
    if not data.startswith(MAGIC):
        raise RecordingError(f"{name} is no MCAP file; give a recording that kinetix-dist wrote (*.mcap)")
    scan = _Scan(data)
    metadata: dict[int, dict[str, str]] = {}
    messages: dict[int, dict[int, bytes]] = {}
    for offset, record in scan.records():
        if isinstance(record, Metadata) and record.name == METADATA_NAME:
            entries = record.metadata
            if entries.get("crc32") != metadata_checksum(entries):
                scan.damage(f"metadata at byte {offset} is damaged (CRC); its rollout is left out")
            else:
                metadata[int(entries["rollout"])] = entries
        elif isinstance(record, Message):
            index, step = _message_address(record.data)
            messages.setdefault(index, {})[step] = record.data
    problems = [f"{name}: {text}" for text in scan.problems]
    if not metadata and not messages and not problems:
        raise RecordingError(f"{name} holds no rollouts of kinetix-dist")
    rollouts: list[Rollout] = []
    for index, entries in sorted(metadata.items()):
        try:
            rollout = _rollout(entries, messages.get(index, {}), decode_level)
        except (ValueError, KeyError) as error:
            problems.append(f"{name}: rollout {index} cannot be read: {error}")
            continue
        if rollout is not None:
            rollouts.append(rollout)
        elif not problems:
            problems.append(f"{name}: rollout {index} has no steps")
    return Recording(path=name, rollouts=tuple(rollouts), problems=tuple(problems))


class _Scan:
    """Walks the records of a file's bytes; collects what is wrong in `problems`."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self.problems: list[str] = []
        self._is_damaged = False

    def damage(self, text: str) -> None:
        self._is_damaged = True
        self.problems.append(text)

    def records(self) -> Iterator[tuple[int, Any]]:
        """(byte offset, Metadata or Message), as far as the file can be read."""
        offset = len(MAGIC)
        summary_start = 0
        while True:
            if offset + _RECORD_HEAD.size > len(self._data):
                return self._cut(offset)
            opcode, length = _RECORD_HEAD.unpack_from(self._data, offset)
            content_at = offset + _RECORD_HEAD.size
            if content_at + length > len(self._data):
                return self._cut(offset)
            content = self._data[content_at : content_at + length]
            try:
                if opcode == Opcode.CHUNK:
                    chunk = Chunk.read(_stream(content))
                    for record in breakup_chunk(chunk, validate_crc=True):
                        if isinstance(record, Message) and record.channel_id == STEP_CHANNEL:
                            yield offset, record
                elif opcode == Opcode.METADATA:
                    yield offset, Metadata.read(_stream(content))
                elif opcode == Opcode.DATA_END:
                    self._check_data(offset, DataEnd.read(_stream(content)))
                    summary_start = content_at + length
                elif opcode == Opcode.FOOTER:
                    return self._check_end(summary_start, content_at, length, Footer.read(_stream(content)))
            except Exception as error:  # zstd, struct, UTF-8, CRC: whatever a flipped byte leads to
                what = "chunk" if opcode == Opcode.CHUNK else "record"
                reason = " ".join(str(error).split()) or type(error).__name__
                self.damage(f"{what} at byte {offset} is damaged ({reason}); what it held is left out")
            offset = content_at + length

    def _cut(self, offset: int) -> None:
        if not self._is_damaged:
            self.problems.append(
                f"ends without an index at byte {len(self._data)} (its writer was killed or is still writing); "
                f"read up to byte {offset}"
            )

    def _check_data(self, offset: int, end: DataEnd) -> None:
        if end.data_section_crc not in (0, zlib.crc32(self._data[:offset])) and not self._is_damaged:
            self.damage(f"a byte before byte {offset} is damaged (CRC of the file); chunks and levels are whole")

    def _check_end(self, summary_start: int, content_at: int, length: int, footer: Footer) -> None:
        crc = zlib.crc32(self._data[summary_start : content_at + 16])  # all of the footer but the CRC itself
        if footer.summary_crc not in (0, crc) and not self._is_damaged:
            self.damage(f"the index at byte {summary_start} is damaged (CRC); rollouts are not affected")
        if self._data[content_at + length :] != MAGIC and not self._is_damaged:
            self.damage(f"the last bytes after byte {content_at + length} are damaged; rollouts are not affected")


def _stream(content: bytes) -> ReadDataStream:
    return ReadDataStream(BytesIO(content))


def _message_address(message: bytes) -> tuple[int, int]:
    """Rollout index and step of a message: its first two fields, each a tag and a fixed32."""
    return struct.unpack_from("<xIxI", message)


def _rollout(
    entries: dict[str, str], messages: dict[int, bytes], decode_level: Callable[[str], RecordedLevel]
) -> Rollout | None:
    """One rollout, up to the first state that is missing; None when even the first is."""
    if entries["format"] != FORMAT_VERSION:
        raise ValueError(f"format {entries['format']!r} is not {FORMAT_VERSION!r}; read it with a newer kinetix-dist")
    num_states = next(k for k in range(len(messages) + 1) if k not in messages)
    if num_states == 0:
        return None
    sizes = Sizes(**{name: int(entries[f"num_{name}"]) for name in ("shapes", "joints", "thrusters", "actions")})
    columns = decode_messages(sizes, [messages[k] for k in range(num_states)])
    if entries["outcome"] not in OUTCOMES:
        raise ValueError(f"outcome {entries['outcome']!r} is none of {', '.join(OUTCOMES)}")
    is_complete = num_states == int(entries["num_steps"]) + 1 and entries["outcome"] != "cut"
    shape = (num_states, sizes.shapes, 2)
    return Rollout(
        level=decode_level(entries["level"]),
        level_json=entries["level"],
        level_name=entries["level_name"],
        position=columns["position"].reshape(shape),
        angle=columns["angle"],
        velocity=columns["velocity"].reshape(shape),
        angular_velocity=columns["angular_velocity"],
        **{name: np.ascontiguousarray(columns[name][1:]) for name in ("actions", "motor", "thruster", "reward")},
        solved=is_complete and entries["outcome"] == "solved",
        failed=is_complete and entries["outcome"] == "failed",
        unstable=is_complete and entries["outcome"] == "unstable",
        policy_version=int(entries["policy_version"]),
        seed=int(entries["seed"]),
        step_seconds=float(entries["step_seconds"]),
        action_names=tuple(_action_name(**entry) for entry in loads_json(entries.get("actions", "[]"))),
        is_complete=is_complete,
    )


def _action_name(*, name: str, values: list[str]) -> ActionName:
    return ActionName(name, tuple(values))
