"""Single steps of the published jax2d, as arrays of ours: what bench/peers/jax2d_published_steps.py writes.

Masses, inertias, vertices and positions are those of its own states, so that its mass defects do not mix in. The
published package has polygons clockwise and names the impulse on a joint's first body; ours are the other way round.

    python -m bench.published_steps runs/published_steps/m-seed0.npz tests/engine/published_steps_m.npz

writes an excerpt: of each level the state with most contacts, as played and stirred, and what a test needs of it.
"""

from __future__ import annotations

import dataclasses
import sys
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bench.peer_process import PUBLISHED_JAX2D_STEPS
from bench.program import parser_of
from jax2d import Capacity, Controls, JointKind, Joints, Scene, Shapes, Springs, State, Thrusters
from jax2d.fields import broadcast, empty
from jax2d.scene import JOINT_IMPULSES

KEY_A, KEY_B = 1 << 22, 1 << 12  # of a contact's key, which is KEY_A a + KEY_B b + feature


@dataclasses.dataclass(frozen=True, kw_only=True)
class Steps:
    """`S` states that the published engine reached, and its next step from each."""

    capacity: Capacity
    scene: Scene
    controls: Controls
    state: State  # without contact impulses
    contact_key: np.ndarray  # [S, C] int32 with the order in the pair as the feature, -1 where no impulse is stored
    contact_impulse: np.ndarray  # [S, C, 2] N s
    after: dict[tuple[str, str], np.ndarray]  # (precision, "warm" or "cold") -> [S, n, 6]


def run_published(files: Sequence[Path], moments: Sequence[int], seed: int, to: Path) -> None:
    """Lets the published package play the levels (of one size) and writes its states and steps to `to`."""
    PUBLISHED_JAX2D_STEPS.run({"levels": [str(f) for f in files], "moments": [*moments], "seed": seed}, to)


def load(file: Path) -> Steps:
    with np.load(file) as archive:
        d = {name: archive[name] for name in archive.files}
    polygons, circles = d["polygon.position"].shape[1], d["circle.position"].shape[1]
    capacity = Capacity(
        polygons=polygons,
        circles=circles,
        joints=d["joint.active"].shape[1],
        thrusters=d["thruster.active"].shape[1],
        vertices=d["polygon.vertices"].shape[2],
    )

    def shapes(name: str) -> np.ndarray:
        return np.concatenate([d[f"polygon.{name}"], d[f"circle.{name}"]], axis=1)

    scene = Scene(
        shapes=Shapes(
            active=shapes("active"),
            inverse_mass=shapes("inverse_mass"),
            inverse_inertia=shapes("inverse_inertia"),
            density=np.ones_like(shapes("friction")),
            kinematic=np.zeros_like(shapes("active")),
            friction=shapes("friction"),
            restitution=shapes("restitution"),
            vertices=counter_clockwise(d["polygon.vertices"], d["polygon.n_vertices"]),
            num_vertices=d["polygon.n_vertices"],
            radius=d["circle.radius"],
            can_touch=d["can_touch"],
            **dict.fromkeys(
                ("surface_speed", "linear_damping", "angular_damping", "rolling_resistance"),
                np.zeros((len(d["gravity"]), 0), np.float32),
            ),
        ),
        joints=Joints(
            active=d["joint.active"],
            a=d["joint.a_index"],
            b=d["joint.b_index"],
            anchor_a=d["joint.a_relative_pos"],
            anchor_b=d["joint.b_relative_pos"],
            kind=np.where(d["joint.is_fixed_joint"], JointKind.FIXED, JointKind.REVOLUTE).astype(np.int32),
            rest_angle=d["joint.rotation"],
            axis_angle=np.zeros_like(d["joint.rotation"]),
            motor_on=d["joint.motor_on"],
            drive=np.zeros_like(d["joint.a_index"]),
            motor_speed=d["joint.motor_speed"],
            motor_power=d["joint.motor_power"],
            has_limits=d["joint.motor_has_joint_limits"],
            lower_limit=d["joint.min_rotation"],
            upper_limit=d["joint.max_rotation"],
        ),
        thrusters=Thrusters(
            active=d["thruster.active"],
            body=d["thruster.object_index"],
            position=d["thruster.relative_position"],
            angle=d["thruster.rotation"],
            power=d["thruster.power"],
        ),
        springs=broadcast(empty(Springs, capacity.sizes), (len(d["gravity"]),)),
        gravity=d["gravity"],
    )
    joint_impulse = np.zeros((*d["joint.active"].shape, JOINT_IMPULSES), np.float32)
    joint_impulse[..., :2] = -d["joint.acc_impulse"]
    joint_impulse[..., 2] = -d["joint.acc_r_impulse"]
    count, slots = len(d["gravity"]), capacity.contact_slots
    state = State(
        position=shapes("position"),
        angle=shapes("rotation"),
        velocity=shapes("velocity"),
        angular_velocity=shapes("angular_velocity"),
        joint_impulse=joint_impulse,
        spring_impulse=np.zeros((count, 0, 3), np.float32),
        contact_key=np.full((count, slots), -1, np.int32),
        contact_impulse=np.zeros((count, slots, 2), np.float32),
        rolling_impulse=np.zeros((count, 0), np.float32),
    )
    key = d["contact_pair"] @ np.array([KEY_A, KEY_B]) + d["contact_order"]
    return Steps(
        capacity=capacity,
        scene=scene,
        controls=Controls(motor=d["action"][:, : capacity.joints], thruster=d["action"][:, capacity.joints :]),
        state=state,
        contact_key=np.where(d["contact_active"], key, -1).astype(np.int32),
        contact_impulse=d["contact_impulse"],
        after={
            (precision, start): d[name]
            for precision in ("float32", "float64")
            for start in ("warm", "cold")
            if (name := f"after.{precision}.{start}") in d
        },
    )


def counter_clockwise(vertices: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """[S, P, V, 2] with the first corner first, unused slots repeating the last corner."""
    slot = np.arange(vertices.shape[2])
    source = np.where(slot == 0, 0, np.maximum(counts[..., None] - slot, 1))
    return np.take_along_axis(vertices, source[..., None], axis=2)


def warm(steps: Steps) -> State:
    """The states with the impulses that the published engine caches of its contacts."""
    keys, impulses = np.array(steps.state.contact_key), np.array(steps.state.contact_impulse)
    for i, key in enumerate(steps.contact_key):
        used = np.flatnonzero(key >= 0)
        if len(used) > keys.shape[1]:
            raise ValueError(f"state {i} caches {len(used)} contacts; {steps.capacity} has {keys.shape[1]} slots")
        keys[i, : len(used)], impulses[i, : len(used)] = key[used], steps.contact_impulse[i, used]
    return dataclasses.replace(steps.state, contact_key=keys, contact_impulse=impulses)


def differences(ours: State, theirs: np.ndarray, active: np.ndarray) -> dict[str, np.ndarray]:
    """Largest difference of each field in each state, [S], in units of 1 + the field's largest value there."""
    fields = {
        "position": (ours.position, theirs[..., 0:2]),
        "angle": (ours.angle, theirs[..., 2]),
        "velocity": (ours.velocity, theirs[..., 3:5]),
        "angular_velocity": (ours.angular_velocity, theirs[..., 5]),
    }

    def largest(x: Any) -> np.ndarray:
        x = np.abs(np.asarray(x, np.float64)).reshape(*active.shape, -1)
        return np.max(np.where(active[..., None], x, 0), axis=(1, 2))

    return {name: largest(x - y) / (1 + largest(y)) for name, (x, y) in fields.items()}


OF_ALL_STATES = ("contact_pair", "contact_order", "described")
NOT_NEEDED = ("global_position", "collision_mode")


def write_excerpt(file: Path, to: Path, moments: int = 8) -> None:
    """`moments` states of each level lie side by side, first as played, then stirred."""
    with np.load(file) as archive:
        d = {name: archive[name] for name in archive.files}
    contacts = d["contact_active"].sum(axis=1).reshape(-1, moments)
    chosen = np.arange(len(contacts)) * moments + contacts.argmax(axis=1)
    arrays = {
        name: value if name in OF_ALL_STATES else value[chosen]
        for name, value in d.items()
        if name.split(".")[-1] not in NOT_NEEDED and (not name.startswith("after.") or name == "after.float64.warm")
    }
    np.savez_compressed(to, **arrays)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = parser_of(__doc__, prog="python -m bench.published_steps")
    parser.add_argument("steps", type=Path, help="a file of steps that bench/paper_single_steps.py had made")
    parser.add_argument("excerpt", type=Path, help="the file to write")
    args = parser.parse_args(arguments)
    if not args.steps.is_file():
        parser.error(f"{args.steps} does not exist; python -m bench.paper_single_steps makes such files")
    try:
        write_excerpt(args.steps, args.excerpt)
    except (OSError, KeyError, ValueError, zipfile.BadZipFile) as error:
        parser.error(f"no excerpt of {args.steps} in {args.excerpt}: {error}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
