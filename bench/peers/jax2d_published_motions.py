"""The published jax2d (in its own environment) over the scenes of `python -m jax2d.fidelity`.

    python jax2d_published_motions.py IN.npz OUT.npz     scenes as jax2d/fidelity/peers.py writes them, states as it
                                                         reads them

then a request a line on standard input, {"setting": k, "scene": i}, and what one timed run of it cost on standard
output, {"ok": true, "us": us per simulated world-second}; a failure answers {"ok": false, "error": one line}.

Called as its authors do: jit, vmap over worlds, scan over steps. Its first four polygons are meant for floor and walls
and never collide with each other, so the shapes of a scene follow them. Its cost does not depend on what moves, so each
scene is timed from its start. This file uses nothing of the project.
"""

from __future__ import annotations

import functools
import importlib.metadata
import json
import math
import sys
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.engine import PhysicsEngine, create_empty_sim
from jax2d.sim_state import SimParams, StaticSimParams

FIXED = 1  # `JointKind` of a weld
RESERVED = 4  # polygon slots of floor, walls and ceiling
CHUNK_STEPS = 4
ITERATIONS = 10


def main() -> int:
    request = dict(np.load(sys.argv[1]))
    query = json.loads(str(request["query"]))
    constants = query["constants"]
    scene = {name.removeprefix("scene."): value for name, value in request.items() if name.startswith("scene.")}
    count, polygons = scene["shapes.num_vertices"].shape
    static = StaticSimParams(
        num_polygons=RESERVED + polygons,
        num_circles=scene["shapes.radius"].shape[1],
        num_joints=scene["joints.active"].shape[1],
        num_thrusters=scene["thrusters.active"].shape[1],
        max_polygon_vertices=scene["shapes.vertices"].shape[2],
        num_solver_iterations=ITERATIONS,
    )
    states = [world(static, request, scene, i) for i in range(count)]
    stacked = jax.tree.map(lambda *xs: jnp.stack(xs), *states)
    # Each world's gravity is in its state; two shapes of coefficient mu are to have a friction of mu.
    params = SimParams(
        base_friction=1.0 / math.sqrt(2.0),
        base_motor_speed=constants["motor_speed"],
        base_motor_power=constants["motor_acceleration"],
        base_thruster_power=constants["thruster_power"],
    )
    width = static.num_joints + static.num_thrusters
    actions = jnp.repeat(jnp.asarray(request["control"], jnp.float32)[:, None], width, 1)
    step = jax.vmap(PhysicsEngine(static).step, in_axes=(0, None, 0))

    @functools.partial(jax.jit, static_argnames=("steps", "record"))
    def run(state: Any, dt: Any, action: Any, *, steps: int, record: bool) -> Any:
        def one(state: Any, _: None) -> Any:
            state = step(state, params.replace(dt=dt), action)[0]
            return state, visible(state) if record else None

        return jax.lax.scan(one, state, length=steps)

    answer: dict[str, np.ndarray] = {}
    worlds = query["batch"]
    for k, setting in enumerate(query["settings"]):
        dt = setting["dt"]
        steps = [round(float(seconds) / dt) for seconds in request["seconds"]]
        state, recorded = stacked, [np.asarray(visible(stacked))[None]]
        for _ in range(-(-max(steps) // CHUNK_STEPS)):
            state, seen = run(state, dt, actions, steps=CHUNK_STEPS, record=True)
            recorded.append(np.asarray(seen))
        recorded_states = np.concatenate(recorded)
        for i in range(count):
            answer[f"states.{k}.{i}"] = recorded_states[: steps[i] + 1, i]
    version = importlib.metadata.version("jax2d")
    np.savez(sys.argv[2], device=np.array(jax.devices()[0].device_kind), version=np.array(version), **answer)
    print(json.dumps({"ok": True}), flush=True)

    def cost(k: int, i: int) -> float:
        dt = query["settings"][k]["dt"]
        batch = jax.tree.map(lambda x: jnp.repeat(x[i : i + 1], worlds, 0), stacked)
        action = jnp.repeat(actions[i : i + 1], worlds, 0)
        jax.block_until_ready((batch, action))
        started = time.perf_counter()
        jax.block_until_ready(run(batch, dt, action, steps=query["steps"], record=False))
        return 1e6 * (time.perf_counter() - started) / (worlds * query["steps"] * dt)

    for line in sys.stdin:
        wanted = json.loads(line)
        try:
            reply = {"ok": True, "us": cost(wanted["setting"], wanted["scene"])}
        except Exception as error:
            reply = {"ok": False, "error": " ".join(f"{type(error).__name__}: {error}".split())[:400]}
        print(json.dumps(reply), flush=True)
    return 0


def visible(state: Any) -> jax.Array:
    """[W, n, 6]: position, angle, velocity, angular velocity, without the reserved polygons."""

    def rows(body: Any, first: int) -> jax.Array:
        parts = (body.position, body.rotation[..., None], body.velocity, body.angular_velocity[..., None])
        return jnp.concatenate(parts, -1)[:, first:]

    return jnp.concatenate([rows(state.polygon, RESERVED), rows(state.circle, 0)], axis=1)


def world(static: Any, request: dict[str, np.ndarray], scene: dict[str, np.ndarray], i: int) -> Any:
    """World i of the request as the published package's state."""
    empty = create_empty_sim(static, add_floor=False, add_walls_and_ceiling=False)
    polygons = scene["shapes.num_vertices"].shape[1]
    one = {name: value[i] for name, value in scene.items()}
    start = {name: request[name][i] for name in ("position", "angle", "velocity", "angular_velocity")}
    shapes = {
        "position": start["position"],
        "rotation": start["angle"],
        "velocity": start["velocity"],
        "angular_velocity": start["angular_velocity"],
        "inverse_mass": one["shapes.inverse_mass"],
        "inverse_inertia": one["shapes.inverse_inertia"],
        "friction": one["shapes.friction"],
        "restitution": one["shapes.restitution"],
        "active": one["shapes.active"],
    }

    def put(field: jax.Array, values: np.ndarray, first: int) -> jax.Array:
        return field.at[first:].set(jnp.asarray(values, field.dtype))

    def bodies(template: Any, part: slice, first: int, **geometry: np.ndarray) -> Any:
        values = {name: value[part] for name, value in shapes.items()} | geometry
        return template.replace(**{name: put(getattr(template, name), value, first) for name, value in values.items()})

    corners, counts = one["shapes.vertices"].copy(), one["shapes.num_vertices"]
    for p, n in enumerate(counts):  # its polygons run clockwise
        corners[p, :n] = corners[p, :n][::-1]
    total = RESERVED + polygons + len(one["shapes.radius"])
    can_touch = np.zeros((total, total), bool)
    can_touch[RESERVED:, RESERVED:] = one["shapes.can_touch"]
    return empty.replace(
        polygon=bodies(empty.polygon, slice(0, polygons), RESERVED, vertices=corners, n_vertices=counts),
        circle=bodies(empty.circle, slice(polygons, None), 0, radius=one["shapes.radius"]),
        joint=empty.joint.replace(
            a_index=jnp.asarray(one["joints.a"] + RESERVED),
            b_index=jnp.asarray(one["joints.b"] + RESERVED),
            a_relative_pos=jnp.asarray(one["joints.anchor_a"]),
            b_relative_pos=jnp.asarray(one["joints.anchor_b"]),
            active=jnp.asarray(one["joints.active"]),
            motor_speed=jnp.asarray(one["joints.motor_speed"]),
            motor_power=jnp.asarray(one["joints.motor_power"]),
            motor_on=jnp.asarray(one["joints.motor_on"]),
            motor_has_joint_limits=jnp.asarray(one["joints.has_limits"]),
            min_rotation=jnp.asarray(one["joints.lower_limit"]),
            max_rotation=jnp.asarray(one["joints.upper_limit"]),
            is_fixed_joint=jnp.asarray(one["joints.kind"] == FIXED),
            rotation=jnp.asarray(one["joints.rest_angle"]),
        ),
        thruster=empty.thruster.replace(
            object_index=jnp.asarray(one["thrusters.body"] + RESERVED),
            relative_position=jnp.asarray(one["thrusters.position"]),
            rotation=jnp.asarray(one["thrusters.angle"]),
            power=jnp.asarray(one["thrusters.power"]),
            active=jnp.asarray(one["thrusters.active"]),
        ),
        collision_matrix=jnp.asarray(can_touch),
        gravity=jnp.asarray(one["gravity"]),
    )


if __name__ == "__main__":
    sys.exit(main())
