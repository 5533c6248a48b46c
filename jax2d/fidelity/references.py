"""Reference solutions of the scenes without a formula, and errors against them.

    python -m jax2d.fidelity.references [SCENE ...]     computes them again (minutes), into references.json beside it

Preset `reference` (float64, 1,024 steps in 1/60 s, stiffness that rises with 1/h) in the reference backend. The file
keeps where each movable body is at every tenth of a second from `compared_from` on, and how far half as many steps end
from there. An error is accepted when it is at least TRUST times that distance: smaller ones may be the reference's.
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from jax2d.builder import BuiltWorld, SceneBuilder
from jax2d.fidelity.arguments import OneLineParser
from jax2d.fidelity.reference_scenes import CAPACITY, REFERENCE_SCENES, ReferenceScene
from jax2d.fidelity.simulator import Scenario, Simulator
from jax2d.fidelity.study_scene import Error, StudyScene
from jax2d.fidelity.trajectory import Trajectory
from jax2d.fidelity.units import G, with_plain_friction
from jax2d.fields import as_dict, empty
from jax2d.scene import Capacity, Scene
from jax2d.settings import preset

FILE = Path(__file__).with_name("references.json")
SAMPLES_PER_SECOND = 10  # a tenth of a second is a whole number of steps at every dt of the study
TRUST = 10.0
DECIMALS = 9  # m, of the file


class StaleReference(ValueError):
    """The stored solution is not that of the scene as it now is."""


def study_scenes(names: Sequence[str] | None = None) -> dict[str, StudyScene]:
    """The scenes with their stored truth; raises StaleReference where it is missing or of another scene."""
    stored = json.loads(FILE.read_text())
    return {
        name: _study_scene(REFERENCE_SCENES[name], stored.get(name))
        for name in (REFERENCE_SCENES if names is None else names)
    }


def _study_scene(scene: ReferenceScene, stored: dict[str, Any] | None) -> StudyScene:
    world = scene.world()
    if stored is None or not _agree(stored["signature"], signature(scene)):
        raise StaleReference(
            f"references.json has no solution of {scene.name} as it now is; "
            f"run python -m jax2d.fidelity.references {scene.name}"
        )
    error = error_against(scene, world, np.array(stored["position"]))
    when = f"from {scene.compared_from:g} to {scene.seconds:g} s" if scene.compared_from else f"in {scene.seconds:g} s"

    def build(builder: SceneBuilder) -> Error:
        scene.build(builder)
        return error

    return StudyScene(
        name=scene.name,
        metric=f"largest position error of a body {when} / {scene.length:g} m (reference solution)",
        seconds=scene.seconds,
        capacity=CAPACITY,
        gravity=G,
        control=scene.control,
        uncertainty=stored["uncertainty"] / scene.length,
        build=build,
    )


def error_against(scene: ReferenceScene, world: BuiltWorld, truth: np.ndarray) -> Error:
    """Largest distance of a movable body from `truth` [samples, movable, 2] over `scene.length`."""
    bodies = movable(world)
    time = samples_of(scene) / SAMPLES_PER_SECOND

    def error(trajectory: Trajectory) -> float:
        steps = time / trajectory.interval
        if np.abs(steps - steps.round()).max() > 1e-6:
            raise ValueError(
                f"dt is {trajectory.interval:g} s; errors are taken every 0.1 s, so use a dt that divides it"
            )
        there = trajectory.position[steps.round().astype(int)][:, bodies]
        return float(np.linalg.norm(there - truth, axis=-1).max()) / scene.length

    return error


def samples_of(scene: ReferenceScene) -> np.ndarray:
    """Indices of the tenths of a second that are compared."""
    return np.arange(
        max(1, round(scene.compared_from * SAMPLES_PER_SECOND)), round(scene.seconds * SAMPLES_PER_SECOND) + 1
    )


def movable(world: BuiltWorld) -> np.ndarray:
    """[n] bool"""
    return np.asarray(world.scene.shapes.active) & (np.asarray(world.scene.shapes.inverse_mass) > 0)


def signature(scene: ReferenceScene) -> dict[str, float]:
    """Returns a number for each array that shapes the trajectory, which changes with any part of it. Fields of a scene
    that are as in an empty one are left out, so that solutions outlive fields that are new or in another order."""
    capacity = snug(scene)
    world = scene.world(capacity)
    unused = as_dict(empty(Scene, capacity.sizes))
    arrays = {name: x for name, x in as_dict(world.scene).items() if not np.array_equal(x, unused[name])}
    arrays |= {f"start.{name}": getattr(world, name) for name in world._fields if name != "scene"}

    def number(values: Any) -> float:
        flat = np.asarray(values, np.float64).ravel()
        return round(float(flat @ np.cos(np.arange(len(flat)))), 6)

    times = {"seconds": scene.seconds, "control": scene.control, "compared_from": scene.compared_from}
    return times | {name: number(values) for name, values in arrays.items()}


def _agree(stored: Any, now: dict[str, float]) -> bool:
    """Returns True if two signatures are of the same scene, whose arrays are float32."""
    if not isinstance(stored, dict) or set(stored) != set(now):
        return False
    return all(np.isclose(stored[name], value, rtol=1e-4, atol=1e-5) for name, value in now.items())


# Computing them


def snug(scene: ReferenceScene) -> Capacity:
    """Smallest capacity of a scene: the reference backend pays for every slot, in use or not."""
    used = scene.world().scene
    shapes = np.asarray(used.shapes.active)
    return Capacity(
        polygons=int(shapes[: CAPACITY.polygons].sum()),
        circles=int(shapes[CAPACITY.polygons :].sum()),
        joints=int(np.asarray(used.joints.active).sum()),
        thrusters=int(np.asarray(used.thrusters.active).sum()),
    )


def solve(scene: ReferenceScene, *, divisions: Sequence[int], seconds: float | None = None) -> list[np.ndarray]:
    """Solutions for each number of steps in 1/60 s (a multiple of 16): positions [samples, movable, 2] m, float64."""
    capacity = snug(scene)
    world = scene.world(capacity)
    simulator = Simulator(capacity=capacity, backend="xla", dtype="float64")
    scenario = Scenario(world=world, seconds=seconds or scene.seconds, control=scene.control)
    every = 96  # steps of a compiled loop: a whole number of them in a tenth of a second, whatever the division
    solutions = []
    for division in divisions:
        settings = with_plain_friction(preset("reference")).replace(dt=1 / 60 / division)
        tenth = 60 // SAMPLES_PER_SECOND * division // every
        positions = simulator.positions(scenario, settings, every=every)
        solutions.append(positions[tenth - 1 :: tenth][:, movable(world)])
    return solutions


def main(arguments: Sequence[str] | None = None) -> int:
    parser = OneLineParser(prog="python -m jax2d.fidelity.references", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("scenes", nargs="*", choices=[*REFERENCE_SCENES, []], default=[], metavar="SCENE")
    console = Console()
    chosen = parser.parse_args(arguments).scenes or list(REFERENCE_SCENES)
    for name in chosen:
        started = time.perf_counter()
        scene = REFERENCE_SCENES[name]
        coarse, fine = (x[samples_of(scene) - 1] for x in solve(scene, divisions=(512, 1024)))
        if not np.isfinite(fine).all():
            Console(stderr=True).print(f"{name}: the reference solution is not finite; change the scene")
            return 1
        uncertainty = float(np.linalg.norm(fine - coarse, axis=-1).max())
        stored = json.loads(FILE.read_text()) if FILE.is_file() else {}
        stored[name] = {
            "signature": signature(scene),
            "uncertainty": float(f"{uncertainty:.3g}"),  # m, between dt/512 and dt/1024
            "position": fine.round(DECIMALS).tolist(),  # [samples, movable, 2] m
        }
        ordered = {known: stored[known] for known in REFERENCE_SCENES if known in stored}
        lines = ",\n".join(f" {json.dumps(known)}: {json.dumps(entry)}" for known, entry in ordered.items())
        FILE.write_text(f"{{\n{lines}\n}}\n")
        seconds = time.perf_counter() - started
        console.print(
            f"{name}: dt/512 agrees within {uncertainty / scene.length:.1e} of {scene.length:g} m, {seconds:.0f} s"
        )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
