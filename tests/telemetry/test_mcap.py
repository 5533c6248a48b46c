"""Recordings: written rollouts are read, by this project and by the mcap library; damage is reported, not hidden."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import re
import resource
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from kinetix_dist.telemetry.mcap_reader import read_recording
from kinetix_dist.telemetry.recording import RecordingError, Rollout
from kinetix_dist.telemetry.rollout_schema import FIELDS, FILE_NAME
from kinetix_dist.telemetry.sinks import mcap as sink_module
from kinetix_dist.telemetry.sinks.mcap import METADATA_NAME, SCENE_TOPIC, TOPIC, McapSink, RolloutWriter
from tests.helpers import REPOSITORY, next_line, wait_until
from tests.telemetry.worlds import GREY_TRIANGLE, LEVEL_JSON, decode_level, falling_rollout

ARRAYS = ("position", "angle", "velocity", "angular_velocity", "actions", "motor", "thruster", "reward")
SCALARS = (
    "level_json",
    "level_name",
    "solved",
    "failed",
    "unstable",
    "policy_version",
    "seed",
    "step_seconds",
    "action_names",
    "is_complete",
)


def assert_same(read: Rollout, written: Rollout) -> None:
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(read, name), getattr(written, name), err_msg=name)  # bit for bit
    for name in SCALARS:
        assert getattr(read, name) == getattr(written, name), name


def record(path: Path, num_rollouts: int, *, finish: bool = True) -> list[Rollout]:
    rollouts = [falling_rollout(10 + k, seed=k, solved=k % 2 == 0, failed=k % 2 == 1) for k in range(num_rollouts)]
    writer = RolloutWriter(path)
    for rollout in rollouts:
        writer.write(rollout)
    writer.finish() if finish else writer.abandon()
    return rollouts


def test_the_table_of_fields_is_the_proto_file() -> None:
    text = (REPOSITORY / FILE_NAME).read_text()
    fields = re.findall(r"^ +(repeated )?(\w+) (\w+) = (\d+);", text, re.MULTILINE)
    in_file = {name: (int(number), kind, bool(repeated)) for repeated, kind, name, number in fields}
    kinds = {"<f4": "float", "<u4": "fixed32"}
    in_table = {name: (number, kinds[kind], count is not None) for name, (number, kind, count) in FIELDS.items()}
    assert in_file == in_table


def test_rollouts_read_back_as_they_were_written(tmp_path: Path) -> None:
    written = record(tmp_path / "a.mcap", 3)
    recording = read_recording(tmp_path / "a.mcap", decode_level)
    assert recording.problems == ()
    for read, original in zip(recording.rollouts, written, strict=True):
        assert_same(read, original)
    assert [rollout.outcome for rollout in recording.rollouts] == ["solved", "failed", "solved"]


def test_a_recording_without_names_of_actions_has_their_numbers(tmp_path: Path) -> None:
    writer = RolloutWriter(tmp_path / "a.mcap")
    writer.write(dataclasses.replace(falling_rollout(3), action_names=()))
    writer.finish()
    [rollout] = read_recording(tmp_path / "a.mcap", decode_level).rollouts
    assert rollout.action_names == ()
    assert [name.words(1.0) for name in rollout.names_of_actions[:2]] == ["action 0: 1", "action 1: 1"]


def test_the_mcap_library_decodes_the_messages_and_finds_the_level(tmp_path: Path) -> None:
    (written,) = record(tmp_path / "a.mcap", 1)
    with open(tmp_path / "a.mcap", "rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()], validate_crcs=True)
        messages = [message for _, _, _, message in reader.iter_decoded_messages([TOPIC])]
        (metadata,) = reader.iter_metadata()
    assert [message.step for message in messages] == list(range(11))
    np.testing.assert_array_equal(messages[7].position, written.position[7].ravel())
    np.testing.assert_array_equal(messages[7].actions, written.actions[6])  # the step that led to state 7
    assert messages[7].reward == written.reward[6]
    assert messages[0].reward == 0.0
    # s = g t^2 / 2 after 10 steps of 1/30 s
    assert messages[10].position[2 * GREY_TRIANGLE + 1] == pytest.approx(1.5 - 9.81 / 18, abs=1e-6)
    assert metadata.name == METADATA_NAME
    assert metadata.metadata["level"] == LEVEL_JSON


def test_a_cut_file_replays_up_to_its_last_whole_chunk(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    ends = []
    writer = RolloutWriter(path)
    rollouts = [falling_rollout(10, seed=k) for k in range(3)]
    for rollout in rollouts:
        writer.write(rollout)
        ends.append(writer.num_bytes)
    writer.finish()
    whole = path.read_bytes()
    for size in (*ends, *range(8, len(whole), 97)):
        path.write_bytes(whole[:size])
        recording = read_recording(path, decode_level)
        # One more than were flushed when the cut is between the last chunk and its index.
        assert len(recording.rollouts) - sum(size >= end for end in ends) in (0, 1)
        (problem,) = recording.problems
        assert "ends without an index" in problem
        for read, original in zip(recording.rollouts, rollouts, strict=False):
            assert_same(read, original)


def test_a_rollout_whose_second_chunk_is_missing_is_cut(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sink_module, "CHUNK_BYTES", 4000)
    path = tmp_path / "a.mcap"
    writer = RolloutWriter(path)
    rollout = falling_rollout(60)
    writer.write(rollout)
    writer.finish()
    path.write_bytes(path.read_bytes()[: chunk_starts(path, TOPIC)[2] + 20])  # the first has the schemas
    recording = read_recording(path, decode_level)
    (read,) = recording.rollouts
    assert read.outcome == "cut"
    assert 0 < read.num_steps < 60
    np.testing.assert_array_equal(read.position, rollout.position[: read.num_steps + 1])
    np.testing.assert_array_equal(read.reward, rollout.reward[: read.num_steps])


def test_any_flipped_byte_is_told_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    written = record(path, 2)
    whole = path.read_bytes()
    for position in range(0, len(whole), 17):  # every part of the file: magic, metadata, chunks, index, footer
        damaged = bytearray(whole)
        damaged[position] ^= 0x10
        path.write_bytes(damaged)
        try:
            recording = read_recording(path, decode_level)
        except RecordingError as error:
            assert "\n" not in str(error)
            continue
        assert len(recording.problems) >= 1, f"byte {position} was passed over"
        assert all("\n" not in problem and str(path) in problem for problem in recording.problems)
        for rollout in recording.rollouts:  # what is handed out is never wrong
            original = written[rollout.seed]
            assert rollout.level_json == original.level_json
            np.testing.assert_array_equal(rollout.position, original.position[: rollout.num_steps + 1])


def test_damage_in_one_chunk_leaves_the_other_rollouts_whole(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    record(path, 3)
    damage(path, chunk_starts(path, TOPIC)[1] + 200)  # of the second rollout
    recording = read_recording(path, decode_level)
    assert [rollout.seed for rollout in recording.rollouts] == [0, 2]
    (problem,) = recording.problems
    assert "chunk at byte" in problem and "damaged" in problem


def test_damage_in_a_picture_leaves_every_rollout_whole(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    rollouts = record(path, 3)
    damage(path, chunk_starts(path, SCENE_TOPIC)[1] + 200)
    recording = read_recording(path, decode_level)
    for read, original in zip(recording.rollouts, rollouts, strict=True):
        assert_same(read, original)
    (problem,) = recording.problems
    assert "chunk at byte" in problem and "damaged" in problem


def chunk_starts(path: Path, topic: str) -> list[int]:
    """Bytes at which the chunks of a finished file with messages of a topic begin."""
    with open(path, "rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    [channel] = [channel.id for channel in summary.channels.values() if channel.topic == topic]
    return [chunk.chunk_start_offset for chunk in summary.chunk_indexes if channel in chunk.message_index_offsets]


def damage(path: Path, position: int) -> None:
    data = bytearray(path.read_bytes())
    data[position] ^= 0xFF
    path.write_bytes(data)


@pytest.mark.parametrize("content", [b"", b"hello", b"\x89PNG\r\n\x1a\n" + bytes(100)])
def test_a_file_that_is_no_recording_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.mcap").write_bytes(content)
    with pytest.raises(RecordingError, match="no MCAP file"):
        read_recording(tmp_path / "a.mcap", decode_level)


def test_an_existing_recording_is_never_overwritten(tmp_path: Path) -> None:
    record(tmp_path / "a.mcap", 1)
    with pytest.raises(FileExistsError, match="never overwritten"):
        RolloutWriter(tmp_path / "a.mcap")


KILLED_WRITER = """
import os, sys, time
from kinetix_dist.telemetry.sinks.mcap import McapSink
from tests.telemetry.worlds import falling_rollout
sink = McapSink(sys.argv[1])
for k in range(5):
    assert sink.write(falling_rollout(10 + k, seed=k))
while sink.stats().written < 5:
    assert sink.stats().error is None, sink.stats()
    time.sleep(0.01)
print("written", flush=True)
time.sleep(60)
"""


def test_nothing_flushed_is_lost_when_the_writer_is_killed(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY), "JAX_PLATFORMS": "cpu"}
    process = subprocess.Popen(
        [sys.executable, "-c", KILLED_WRITER, str(path)], stdout=subprocess.PIPE, text=True, env=environment
    )
    assert next_line(process) == "written\n"
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    recording = read_recording(path, decode_level)
    assert [rollout.seed for rollout in recording.rollouts] == [0, 1, 2, 3, 4]
    assert_same(recording.rollouts[4], falling_rollout(14, seed=4))
    (problem,) = recording.problems
    assert "writer was killed" in problem


def test_the_sink_writes_everything_it_accepted(tmp_path: Path) -> None:
    with McapSink(tmp_path / "a.mcap") as sink:
        assert all(sink.write(falling_rollout(5, seed=k)) for k in range(20))
    stats = sink.stats()
    assert (stats.written, stats.dropped, stats.queued, stats.error) == (20, 0, 0, None)
    assert stats.num_bytes == os.path.getsize(tmp_path / "a.mcap")
    assert len(read_recording(tmp_path / "a.mcap", decode_level).rollouts) == 20
    with pytest.raises(RuntimeError, match="is closed"):
        sink.write(falling_rollout(5))


def test_a_slow_disk_drops_rollouts_counts_them_and_never_stalls_the_caller(tmp_path: Path) -> None:
    events: list[tuple[str, dict]] = []
    sink = McapSink(tmp_path / "a.mcap", max_queued=2, on_event=lambda name, fields: events.append((name, fields)))
    may_write = threading.Event()
    write_for_real = sink._writer.write

    def write_late(rollout: Rollout) -> None:  # a disk that hangs
        may_write.wait()
        write_for_real(rollout)

    sink._writer.write = write_late
    rollout = falling_rollout(5)
    sink.write(rollout)
    wait_until(lambda: not sink.stats().queued, "the thread takes the first, and hangs in it", every=0.001)
    started = time.perf_counter()
    accepted = [sink.write(rollout) for _ in range(10)]
    assert time.perf_counter() - started < 0.2  # ten calls; each would hang forever if it waited for the disk
    assert accepted == [True] * 2 + [False] * 8
    assert sink.stats().dropped == 8
    assert [(name, fields["dropped"]) for name, fields in events] == [("recording_dropped", k) for k in (1, 2, 4, 8)]
    may_write.set()
    stats = sink.close()
    assert (stats.written, stats.dropped) == (3, 8)


def test_a_disk_that_hangs_does_not_hold_up_the_end_of_training(tmp_path: Path) -> None:
    events: list[str] = []
    sink = McapSink(tmp_path / "a.mcap", on_event=lambda name, fields: events.append(name))
    may_write = threading.Event()

    def write_never(rollout: Rollout) -> None:
        may_write.wait()

    sink._writer.write = write_never
    sink.write(falling_rollout(5))
    started = time.perf_counter()
    stats = sink.close(timeout=0.2)
    assert time.perf_counter() - started < 2.0
    assert stats.error is not None and "not finished within 0.2 s" in stats.error
    assert events == ["recording_failed"]
    may_write.set()


@contextlib.contextmanager
def files_may_grow_to(num_bytes: int) -> Iterator[None]:
    """The kernel takes part of the write that would pass the limit and refuses the next, as a full disk does."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (num_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_full_disk_is_an_event_and_leaves_whole_rollouts(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    events: list[tuple[str, dict]] = []
    with files_may_grow_to(12_000):
        sink = McapSink(path, on_event=lambda name, fields: events.append((name, fields)))
        for seed in range(12):
            sink.write(falling_rollout(30, seed=seed))
        stats = sink.close()
    assert stats.error is not None and "File too large" in stats.error
    assert 1 <= stats.written < 12
    assert stats.written + stats.dropped == 12
    assert [name for name, _ in events if name == "recording_failed"] == ["recording_failed"]
    recording = read_recording(path, decode_level)
    assert len(recording.rollouts) == stats.written
    assert all(rollout.is_complete for rollout in recording.rollouts)
    assert os.path.getsize(path) == stats.num_bytes  # nothing half-written behind the last whole rollout


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="/dev/full is a Linux device")
def test_a_device_without_room_fails_with_its_own_words(tmp_path: Path) -> None:
    sink = McapSink(tmp_path / "full.mcap")
    sink._writer._file._file.close()
    sink._writer._file._file = open("/dev/full", "wb", buffering=0)  # noqa: SIM115
    sink.write(falling_rollout(5))
    assert "No space left" in str(sink.close().error)
