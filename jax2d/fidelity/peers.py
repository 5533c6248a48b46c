"""Other engines over the same motions: Box2D and the published jax2d, each in its own environment and process.

    request (npz): the scenes' arrays, how they start, seconds, controls, and as JSON the settings to run
    answer  (npz): a path [steps + 1, n, 6] for each setting and scene, and its cost

The programs are bench/peers/box2d_motions.py and bench/peers/jax2d_published_motions.py of a checkout; a peer that is
not installed raises `PeerMissing` with one line that says how to install it.
"""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path as File
from typing import Any

import numpy as np

from jax2d.builder import BuiltWorld
from jax2d.fidelity.closed_forms import MOTOR_ACCELERATION, MOTOR_SPEED, THRUST
from jax2d.fidelity.path import Path
from jax2d.scene import stack_worlds

CHECKOUT = File(__file__).resolve().parents[2]


class PeerMissing(Exception):
    """The peer cannot run here; one line says why and what to do."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Peer:
    """Another engine, and the settings it is shown with."""

    name: str  # in place of a preset
    backend: str
    dtype: str
    program: str  # in bench/peers
    environment: str  # folder in bench/.peers
    variable: str  # names another Python; with PATH appended, its PYTHONPATH
    setup: str
    settings: tuple[dict[str, Any], ...]

    def label(self, setting: dict[str, Any]) -> str:
        """As the settings of our engine are written in a record."""
        iterations = setting.get("velocity_iterations", setting.get("iterations"))
        return f"dt 1/{round(1 / setting['dt'])}, {iterations} iterations"


def _box2d(rate: int, iterations: int, position_iterations: int) -> dict[str, Any]:
    return {"dt": 1 / rate, "velocity_iterations": iterations, "position_iterations": position_iterations}


PEERS = {
    "box2d": Peer(
        name="box2d",
        backend="box2d",
        dtype="float32",
        program="box2d_motions.py",
        environment="box2d",
        variable="KINETIX_BOX2D_PYTHON",
        setup="bash bench/peers/setup_box2d.sh",
        # 8 velocity and 3 position iterations are its manual's advice.
        settings=(*(_box2d(rate, 8, 3) for rate in (60, 30, 120, 240, 480)), _box2d(60, 4, 2), _box2d(60, 20, 10)),
    ),
    "published": Peer(
        name="published-jax2d",
        backend="xla",
        dtype="float32",
        program="jax2d_published_motions.py",
        environment="jax2d",
        variable="KINETIX_PEER_PYTHON",
        setup="bash bench/peers/setup.sh",
        settings=tuple({"dt": 1 / rate, "iterations": 10} for rate in (60, 30, 120)),
    ),
}
PEER_NAMES = tuple(peer.name for peer in PEERS.values())


@dataclasses.dataclass(frozen=True, kw_only=True)
class PeerRuns:
    """What a peer answered: for each setting its label, and for each scene path and cost."""

    device: str
    version: str
    labels: list[str]
    paths: list[list[Path]]  # [setting][scene]
    microseconds: list[list[float]]  # [setting][scene] us per world-second


def peer_runs(
    peer: Peer,
    worlds: Sequence[BuiltWorld],
    seconds: Sequence[float],
    control: Sequence[float],
    *,
    batch: int,
    steps: int,
    repeats: int,
    num_settings: int,
) -> PeerRuns:
    """Runs the peer over all worlds; raises PeerMissing where it is not installed or fails."""
    settings = peer.settings[:num_settings]
    python, environment = _python(peer)
    with tempfile.TemporaryDirectory() as folder:
        request, answer = File(folder, "request.npz"), File(folder, "answer.npz")
        _write_request(request, worlds, seconds, control, settings, batch=batch, steps=steps, repeats=repeats)
        done = subprocess.run(
            [str(python), str(CHECKOUT / "bench" / "peers" / peer.program), str(request), str(answer)],
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode != 0 or not answer.is_file():
            said = (done.stderr.strip().splitlines() or ["no message"])[-1]
            raise PeerMissing(f"{peer.name} left out: its process failed: {said[:200]}")
        with np.load(answer) as arrays:
            return _read_answer(peer, dict(arrays), worlds, settings)


def _python(peer: Peer) -> tuple[File, dict[str, str]]:
    """The peer's interpreter and its environment variables."""
    python = File(os.environ.get(peer.variable) or CHECKOUT / "bench" / ".peers" / peer.environment / "bin" / "python")
    if not (CHECKOUT / "bench" / "peers" / peer.program).is_file():
        raise PeerMissing(f"{peer.name} left out: bench/peers/{peer.program} is not here; run from a checkout")
    if not python.is_file():
        raise PeerMissing(f"{peer.name} left out: not installed; run `{peer.setup}`")
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    if path := os.environ.get(f"{peer.variable}PATH"):
        environment["PYTHONPATH"] = path
    environment.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # it shares the device with ours
    return python, environment


def _write_request(
    file: File,
    worlds: Sequence[BuiltWorld],
    seconds: Sequence[float],
    control: Sequence[float],
    settings: Sequence[dict[str, Any]],
    **how: int,
) -> None:
    scene = stack_worlds([world.scene for world in worlds])
    arrays = {f"scene.{field.name}": getattr(scene, field.name) for field in dataclasses.fields(scene)}
    for name in ("position", "angle", "velocity", "angular_velocity"):
        arrays[name] = np.stack([getattr(world, name) for world in worlds])
    asked = how | {
        "settings": list(settings),
        "constants": {
            "motor_speed": MOTOR_SPEED,
            "motor_acceleration": MOTOR_ACCELERATION,
            "thruster_power": THRUST,
        },
    }
    np.savez(file, seconds=np.array(seconds), control=np.array(control), asked=np.array(json.dumps(asked)), **arrays)


def _read_answer(
    peer: Peer, arrays: dict[str, np.ndarray], worlds: Sequence[BuiltWorld], settings: Sequence[dict[str, Any]]
) -> PeerRuns:
    def path(k: int, i: int) -> Path:
        states = arrays[f"states.{k}.{i}"].astype(np.float64)
        return Path(
            scene=worlds[i].scene,
            dt=settings[k]["dt"],
            position=states[..., :2],
            angle=states[..., 2],
            velocity=states[..., 3:5],
            angular_velocity=states[..., 5],
        )

    return PeerRuns(
        device=str(arrays["device"]),
        version=str(arrays["version"]),
        labels=[peer.label(setting) for setting in settings],
        paths=[[path(k, i) for i in range(len(worlds))] for k in range(len(settings))],
        microseconds=[arrays[f"us.{k}"].tolist() for k in range(len(settings))],
    )
