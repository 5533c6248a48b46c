"""Other engines over the same scenes: Box2D and the published jax2d, each in its own environment and process.

    request (npz)  the scenes' arrays, how they start, seconds, controls, and as JSON the settings to run
    answer  (npz)  states [steps + 1, n, 6] for each setting and scene; the process says "ready" when it is written
    then, line by line: {"setting": k, "scene": i} -> {"us": cost of one timed run, us per world-second}

The programs are bench/peers/box2d_motions.py and bench/peers/jax2d_published_motions.py of a checkout; a peer that is
not installed raises `PeerMissing` with one line that says how to install it.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np

from jax2d.fidelity.simulator import Scenario
from jax2d.fidelity.trajectory import Trajectory
from jax2d.fidelity.units import MOTOR_ACCELERATION, MOTOR_SPEED, THRUST
from jax2d.fields import as_dict
from jax2d.scene import stack_worlds

CHECKOUT = Path(__file__).resolve().parents[2]


class PeerMissing(Exception):
    """The peer is not installed here; one line says so and what to do."""


class PeerFailed(OSError):
    """The peer's process failed; one line says with what."""


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
    cost_depends_on_scene: bool  # else one scene's cost is that of all

    def label(self, setting: dict[str, Any]) -> str:
        """Label of a peer's setting in a record, written as that of our engine."""
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
        cost_depends_on_scene=True,
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
        cost_depends_on_scene=False,  # every pair and slot is computed, in use or not
    ),
}
PEER_NAMES = tuple(peer.name for peer in PEERS.values())


class PeerRun:
    """Answer of a peer, and its process, ready to time."""

    def __init__(self, peer: Peer, process: subprocess.Popen[str], errors: IO[str]) -> None:
        self.peer = peer
        self._process = process
        self._errors = errors  # its standard error
        self.device = ""
        self.labels: list[str] = []  # of settings
        self.trajectories: list[list[Trajectory]] = []  # [setting][scene]

    def cost(self, setting: int, scene: int) -> float:
        """us per world-second of one timed run; raises PeerFailed."""
        return float(self.ask({"setting": setting, "scene": scene})["us"])

    def ask(self, request: dict[str, int] | None) -> dict[str, Any]:
        """Writes a request, if any, and reads the next line; raises PeerFailed."""
        assert self._process.stdin is not None and self._process.stdout is not None
        try:
            if request is not None:
                print(json.dumps(request), file=self._process.stdin, flush=True)
            answer = json.loads(self._process.stdout.readline() or "{}")
        except (OSError, json.JSONDecodeError):
            answer = {}
        if not answer.get("ok"):
            self._errors.seek(0)
            why = answer.get("error") or (self._errors.read().strip().splitlines() or ["it ended without a word"])[-1]
            raise PeerFailed(f"{self.peer.name} failed: {why[:200]}")
        return answer


@contextlib.contextmanager
def run_peer(peer: Peer, scenarios: Sequence[Scenario], *, batch: int, num_settings: int) -> Iterator[PeerRun]:
    """The peer's trajectories. Its process lives as long as the context; raises PeerMissing or PeerFailed."""
    settings = peer.settings[:num_settings]
    python, environment = _python(peer)
    with tempfile.TemporaryDirectory() as folder, tempfile.TemporaryFile("w+") as errors:
        request, answer = Path(folder, "request.npz"), Path(folder, "answer.npz")
        _write_request(request, scenarios, settings, batch=batch, steps=8)
        with subprocess.Popen(
            [str(python), str(CHECKOUT / "bench" / "peers" / peer.program), str(request), str(answer)],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
        ) as process:
            try:
                run = PeerRun(peer, process, errors)
                run.ask(None)  # waits until the answer is written
                with np.load(answer) as arrays:
                    _read_answer(run, dict(arrays), scenarios, settings)
                yield run
            finally:
                process.kill()


def _python(peer: Peer) -> tuple[Path, dict[str, str]]:
    """The peer's interpreter and its environment variables."""
    python = Path(os.environ.get(peer.variable) or CHECKOUT / "bench" / ".peers" / peer.environment / "bin" / "python")
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
    file: Path, scenarios: Sequence[Scenario], settings: Sequence[dict[str, Any]], *, batch: int, steps: int
) -> None:
    """`batch` and `steps`: worlds and steps of a timed run, for a peer that times batches."""
    worlds = [scenario.world for scenario in scenarios]
    scene = stack_worlds([world.scene for world in worlds])
    arrays = {f"scene.{name}": values for name, values in as_dict(scene).items()}
    for name in ("position", "angle", "velocity", "angular_velocity"):
        arrays[name] = np.stack([getattr(world, name) for world in worlds])
    query = {
        "batch": batch,
        "steps": steps,
        "settings": list(settings),
        "constants": {
            "motor_speed": MOTOR_SPEED,
            "motor_acceleration": MOTOR_ACCELERATION,
            "thruster_power": THRUST,
        },
    }
    arrays["seconds"] = np.array([scenario.seconds for scenario in scenarios])
    arrays["control"] = np.array([scenario.control for scenario in scenarios])
    np.savez(file, query=np.array(json.dumps(query)), **arrays)


def _read_answer(
    run: PeerRun,
    arrays: dict[str, np.ndarray],
    scenarios: Sequence[Scenario],
    settings: Sequence[dict[str, Any]],
) -> None:
    def trajectory(k: int, i: int) -> Trajectory:
        states = arrays[f"states.{k}.{i}"].astype(np.float64)
        return Trajectory(
            scene=scenarios[i].world.scene,
            interval=settings[k]["dt"],
            position=states[..., :2],
            angle=states[..., 2],
            velocity=states[..., 3:5],
            angular_velocity=states[..., 5],
        )

    run.device = str(arrays["device"])
    run.labels = [run.peer.label(setting) for setting in settings]
    run.trajectories = [[trajectory(k, i) for i in range(len(scenarios))] for k in range(len(settings))]
