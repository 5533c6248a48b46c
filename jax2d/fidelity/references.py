"""Reference solutions of the scenes without a formula, and errors against them.

    python -m jax2d.fidelity.references [SCENE ...]     computes them again (minutes), into references.json beside it

Preset `reference` (float64, 1,024 steps in 1/60 s, stiffness that rises with 1/h) in the reference backend; the file
keeps where each movable body is at every tenth of a second from `judged_from` on, and how far half as many steps end
from there. An error is accepted when it is at least TRUST times that distance: smaller ones may be the reference's.
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from pathlib import Path as File
from typing import Any

import numpy as np
from rich.console import Console

from jax2d.builder import BuiltWorld, SceneBuilder
from jax2d.fidelity.arguments import OneLineParser
from jax2d.fidelity.closed_forms import G, with_plain_friction
from jax2d.fidelity.path import Path
from jax2d.fidelity.reference_scenes import CAPACITY, REFERENCE_SCENES, ReferenceScene
from jax2d.fidelity.study_scene import Error, StudyScene
from jax2d.fields import as_dict
from jax2d.scene import Capacity
from jax2d.settings import preset

FILE = File(__file__).with_name("references.json")
MOMENTS_A_SECOND = 10  # a tenth of a second is a whole number of steps at every dt of the study
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
    if stored is None or not np.allclose(stored["signature"], signature(scene), rtol=1e-4, atol=1e-5):
        raise StaleReference(
            f"references.json has no solution of {scene.name} as it now is; "
            f"run python -m jax2d.fidelity.references {scene.name}"
        )
    error = error_against(scene, world, np.array(stored["position"]))
    when = f"from {scene.judged_from:g} to {scene.seconds:g} s" if scene.judged_from else f"in {scene.seconds:g} s"

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
    """Largest distance of a movable body from `truth` [moments, movable, 2] over `scene.length`."""
    bodies = movable(world)
    moments = moments_of(scene) / MOMENTS_A_SECOND

    def error(path: Path) -> float:
        steps = moments / path.dt
        if np.abs(steps - steps.round()).max() > 1e-6:
            raise ValueError(f"dt is {path.dt:g} s; errors are taken every 0.1 s, so use a dt that divides it")
        there = path.position[steps.round().astype(int)][:, bodies]
        return float(np.linalg.norm(there - truth, axis=-1).max()) / scene.length

    return error


def moments_of(scene: ReferenceScene) -> np.ndarray:
    """Which tenths of a second are judged."""
    return np.arange(max(1, round(scene.judged_from * MOMENTS_A_SECOND)), round(scene.seconds * MOMENTS_A_SECOND) + 1)


def movable(world: BuiltWorld) -> np.ndarray:
    """[n] bool"""
    return np.asarray(world.scene.shapes.active) & (np.asarray(world.scene.shapes.inverse_mass) > 0)


def signature(scene: ReferenceScene) -> list[float]:
    """A number for each thing that shapes the motion, which changes with any part of it."""
    world = scene.world(snug(scene))

    def number(values: Any) -> float:
        flat = np.asarray(values, np.float64).ravel()
        return float(flat @ np.cos(np.arange(len(flat))))

    fields = list(as_dict(world.scene).values())
    return [
        scene.seconds,
        scene.control,
        scene.judged_from,
        *(round(number(values), 6) for values in (*fields, *world[1:])),
    ]


# Computing them


def snug(scene: ReferenceScene) -> Capacity:
    """No room to spare: the reference backend pays for every slot, in use or not."""
    used = scene.world().scene
    shapes = np.asarray(used.shapes.active)
    return Capacity(
        polygons=int(shapes[: CAPACITY.polygons].sum()),
        circles=int(shapes[CAPACITY.polygons :].sum()),
        joints=int(np.asarray(used.joints.active).sum()),
        thrusters=int(np.asarray(used.thrusters.active).sum()),
    )


def solve(scene: ReferenceScene, *, divisions: Sequence[int], seconds: float | None = None) -> list[np.ndarray]:
    """For each number of steps in 1/60 s (a multiple of 16) the positions [moments, movable, 2] m, float64."""
    from jax2d.fidelity.simulate import Group

    capacity = snug(scene)
    world = scene.world(capacity)
    group = Group(capacity, "xla", "float64")
    return [
        group.positions(
            world,
            with_plain_friction(preset("reference")).replace(dt=1 / 60 / division),
            control=scene.control,
            moments=round((seconds or scene.seconds) * MOMENTS_A_SECOND),
            steps_between=60 // MOMENTS_A_SECOND * division,
        )[:, movable(world)]
        for division in divisions
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    parser = OneLineParser(prog="python -m jax2d.fidelity.references", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("scenes", nargs="*", choices=[*REFERENCE_SCENES, []], default=[], metavar="SCENE")
    console = Console()
    chosen = parser.parse_args(arguments).scenes or list(REFERENCE_SCENES)
    for name in chosen:
        started = time.perf_counter()
        scene = REFERENCE_SCENES[name]
        coarse, fine = (x[moments_of(scene) - 1] for x in solve(scene, divisions=(512, 1024)))
        if not np.isfinite(fine).all():
            Console(stderr=True).print(f"{name}: the reference solution is not finite; change the scene")
            return 1
        uncertainty = float(np.linalg.norm(fine - coarse, axis=-1).max())
        stored = json.loads(FILE.read_text()) if FILE.is_file() else {}
        stored[name] = {
            "signature": signature(scene),
            "uncertainty": float(f"{uncertainty:.3g}"),  # m, between dt/512 and dt/1024
            "position": fine.round(DECIMALS).tolist(),  # [moments, movable, 2] m
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
