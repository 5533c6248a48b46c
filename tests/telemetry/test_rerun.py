"""The .rrd: read back with rerun's own reader; bodies are where the rollout says, at the time it says."""

from __future__ import annotations

import dataclasses
import os
import signal
import socket
import subprocess
import sys
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from jax2d.palette import ROLE_PALETTE
from jax2d.scene import JointKind
from kinetix_dist.level.level import Role
from kinetix_dist.telemetry.recording import ActionName
from kinetix_dist.telemetry.sinks import rerun
from kinetix_dist.telemetry.sinks.rerun import MOTOR_FORWARD, rollout_to_rrd, rollout_to_viewer
from tests.helpers import PATIENCE_S
from tests.telemetry.worlds import GREEN_BOX, GREY_TRIANGLE, falling_rollout, level


@pytest.fixture(scope="module")
def rrd(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("rrd") / "a.rrd"
    rollout_to_rrd(falling_rollout(20), path)
    return path


def column(path: Path, entity: str, component: str) -> list[Any]:
    """All values of one component of one entity, in the order of the file."""
    from rerun.chunk import RrdReader

    values: list[Any] = []
    for chunk in RrdReader(path).stream().to_chunks():
        if chunk.entity_path == entity:
            batch = chunk.to_record_batch()
            for name in batch.schema.names:
                if name == component or name.endswith(f":{component}"):
                    array = batch.column(name)
                    values += (array.cast("int64") if name == "time" else array).to_pylist()  # durations: in ns
    return values


def test_a_body_moves_as_recorded(rrd: Path) -> None:
    rollout = falling_rollout(20)
    translation = column(rrd, f"/world/shape_{GREY_TRIANGLE:02d}", "translation")
    np.testing.assert_allclose(np.array(translation)[:, 0, :2], rollout.position[:, GREY_TRIANGLE], atol=1e-6)
    quaternion = np.array(column(rrd, f"/world/shape_{GREY_TRIANGLE:02d}", "quaternion"))[:, 0]
    # A turn by theta about z is (0, 0, sin(theta / 2), cos(theta / 2)); it turns by 1 rad/s.
    np.testing.assert_allclose(2 * np.arctan2(quaternion[:, 2], quaternion[:, 3]), np.arange(21) / 30, atol=1e-6)


def test_times_are_simulated_seconds(rrd: Path) -> None:
    nanoseconds = column(rrd, f"/world/shape_{GREY_TRIANGLE:02d}", "time")
    np.testing.assert_allclose(np.array(nanoseconds) * 1e-9, np.arange(21) / 30, atol=1e-6)


def test_a_flame_shows_only_while_its_thruster_fires(rrd: Path) -> None:
    flames = column(rrd, f"/world/shape_{GREEN_BOX:02d}/thruster_0/part_0", "vertex_positions")
    assert [len(vertices) for vertices in flames] == [0, 3] * 10


def test_a_motor_is_coloured_while_it_drives(rrd: Path) -> None:
    rollout = falling_rollout(20)
    colours = np.array(column(rrd, "/world/shape_02/joint_0/part_1/fill", "albedo_factor"))[:, 0]
    forward = int.from_bytes([*MOTOR_FORWARD, 255], "big")
    np.testing.assert_array_equal(colours == forward, rollout.motor[:, 0] > 0)


def test_crosses_of_welds_stand_upright_where_the_body_goes(tmp_path: Path) -> None:
    rollout = falling_rollout(20)
    joints = rollout.level.scene.joints
    fixed = {"kind": np.full_like(joints.kind, JointKind.FIXED), "a": np.full_like(joints.a, GREY_TRIANGLE)}
    welded = dataclasses.replace(level(), scene=rollout.level.scene.replace(joints=fixed))
    rollout_to_rrd(dataclasses.replace(rollout, level=welded), tmp_path / "weld.rrd")
    ends = np.array(column(tmp_path / "weld.rrd", "/world/joint_0/part_0", "strips"))[:, 0, :, :2]  # [states, 2, 2]
    anchor = np.array([-0.4, 0.0])
    turned = np.stack([np.cos(rollout.angle[:, GREY_TRIANGLE]), np.sin(rollout.angle[:, GREY_TRIANGLE])], axis=-1)
    middle = rollout.position[:, GREY_TRIANGLE] + anchor[0] * turned
    np.testing.assert_allclose(ends.mean(axis=1), middle, atol=1e-6)
    np.testing.assert_allclose(ends[:, 1] - ends[:, 0], np.full((21, 2), 0.12 / np.sqrt(2)), atol=1e-6)


def test_rewards_and_actions_are_plotted(rrd: Path) -> None:
    rollout = falling_rollout(20)
    np.testing.assert_allclose(np.array(column(rrd, "/reward", "scalars"))[:, 0], rollout.reward, atol=1e-6)
    np.testing.assert_allclose(np.array(column(rrd, "/return", "scalars"))[-1, 0], rollout.reward.sum(), atol=1e-5)
    for k in range(6):
        np.testing.assert_array_equal(np.array(column(rrd, f"/actions/{k}", "scalars"))[:, 0], rollout.actions[:, k])


def test_actions_have_names_in_the_legend_and_in_words(tmp_path: Path) -> None:
    names = (
        *(ActionName(f"motor colour {colour}", ("off", "forward", "backward")) for colour in range(4)),
        *(ActionName(f"thruster colour {colour}", ("off", "on")) for colour in range(2)),
    )
    rollout = falling_rollout(3)
    actions = np.array([[2, 0, 0, 0, 1, 0], [2, 0, 0, 0, 1, 0], [1, 0, 0, 0, 1, 0]], np.float32)
    rollout_to_rrd(dataclasses.replace(rollout, actions=actions, action_names=names), tmp_path / "a.rrd")
    assert column(tmp_path / "a.rrd", "/actions/0", "names") == [["motor colour 0: 0 off, 1 forward, 2 backward"]]
    first, later = (text for [text] in column(tmp_path / "a.rrd", "/action_words", "text"))
    assert first.startswith("motor colour 0: backward, motor colour 1: off") and "thruster colour 0: on" in first
    assert later == "motor colour 0: forward"  # step 1 repeats step 0
    assert column(tmp_path / "a.rrd", "/action_words", "step") == [0, 2]


def test_the_layout_is_in_the_file(rrd: Path) -> None:
    from rerun.chunk import RrdReader

    stores = RrdReader(rrd).blueprints()
    assert len(stores) == 1


def test_a_running_viewer_is_shown_the_rollout(tmp_path: Path) -> None:
    received = tmp_path / "received.rrd"
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    # Listens as a viewer does and keeps what comes in a file. A group of its own: `python -m rerun` is a wrapper.
    command = [sys.executable, "-m", "rerun", "--save", str(received), "--port", str(port), "--bind", "127.0.0.1"]
    listener = subprocess.Popen(command, start_new_session=True, stderr=subprocess.DEVNULL)
    try:
        rollout_to_viewer(falling_rollout(20), f"rerun+http://127.0.0.1:{port}/proxy")
        deadline = time.monotonic() + PATIENCE_S
        while not received.exists() and time.monotonic() < deadline:
            time.sleep(0.05)
        time.sleep(0.5)  # for the last of it
    finally:
        os.killpg(listener.pid, signal.SIGTERM)  # not SIGINT: what a shell starts in the background may ignore it
        listener.wait(timeout=PATIENCE_S)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # an interrupted file has no footer
        translation = column(received, f"/world/shape_{GREY_TRIANGLE:02d}", "translation")
    assert len(translation) == 21


@pytest.mark.parametrize(
    "listens",
    [pytest.param(True, id="one that answers nothing"), pytest.param(False, id="nobody", marks=pytest.mark.long)],
)
def test_what_takes_nothing_is_an_error_and_is_not_waited_for(monkeypatch: pytest.MonkeyPatch, listens: bool) -> None:
    """rerun itself waits for ever for the first of them, even at its exit."""
    monkeypatch.setattr(rerun, "CONNECT_SECONDS", 1.0)
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))  # nobody else gets the port meanwhile
        if listens:
            listener.listen()
        with pytest.raises(ConnectionError, match=r"no rerun viewer answers at .*; start `rerun --bind") as caught:
            rollout_to_viewer(falling_rollout(20), f"rerun+http://127.0.0.1:{listener.getsockname()[1]}/proxy")
    assert "exit status" not in str(caught.value) and "\n" not in str(caught.value)


def test_a_place_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "a.rrd").mkdir()
    with pytest.raises(OSError, match="cannot be written"):
        rollout_to_rrd(falling_rollout(3), tmp_path / "a.rrd")


def test_a_missing_folder_is_an_error_and_not_a_warning(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no directory"):
        rollout_to_rrd(falling_rollout(3), tmp_path / "missing" / "a.rrd")


@pytest.mark.slow
@pytest.mark.skipif(not list(Path("/usr/share/vulkan/icd.d").glob("*.json")), reason="needs a Vulkan driver (lavapipe)")
def test_rerun_paints_filled_shapes_in_the_colours_of_their_roles(rrd: Path, tmp_path: Path) -> None:
    picture = tmp_path / "a.png"
    command = [sys.executable, "-m", "rerun", str(rrd), "--headless", "--screenshot-to", str(picture)]
    subprocess.run([*command, "--window-size", "1400x800", "--port", "auto"], check=True, timeout=PATIENCE_S)
    with Image.open(picture) as image:
        pixels = np.asarray(image.convert("RGB")).reshape(-1, 3)
    filled = {
        role: int((np.abs(pixels.astype(int) - ROLE_PALETTE[role]).max(axis=-1) <= 2).sum())
        for role in (Role.GREEN, Role.BLUE)
    }
    # 0.48 m^2 of green, 0.5 m^2 of blue: as large as each other, and thousands of pixels.
    assert filled[Role.GREEN] > 5000
    assert filled[Role.GREEN] == pytest.approx(filled[Role.BLUE] * 0.48 / 0.5, rel=0.1)
