"""The published jax2d (in its own environment): states that it reaches, and single steps from them.

    python jax2d_published_steps.py REQUEST.json OUT.npz

The request: {"levels": [FILE...] of one size, "moments": [physics step...], "seed": S}. From each level, worlds play
random actions as in jax2d_published.py; at each moment the state, the action and the next step are written, level by
level, and after these the same states stirred: movable shapes thrown about, most a little and some far, so that they
overlap in every way; S states in all. The step is taken in the package's float32 and with the same program in
float64, and in both from the state's remembered contact impulses ("warm") and from none ("cold"). Fields of OUT.npz,
[S, ...]:

    polygon.* circle.* joint.* thruster.*   as in the package's SimState
    can_touch, gravity, action, contact_*   its manifolds' pairs [C, 2], order in the pair [C], impulses [S, C, 2]
    after.{float32,float64}.{warm,cold}     [S, n, 6] position, angle, velocity, angular velocity

This file uses nothing of the project.
"""

from __future__ import annotations

import json
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax2d_published import FRAME_SKIP, describe, load_levels

from jax2d.engine import PhysicsEngine, get_empty_collision_manifolds

MANIFOLDS = ("acc_rr_manifolds", "acc_cr_manifolds", "acc_cc_manifolds")


def main() -> int:
    with open(sys.argv[1]) as file:
        request = json.load(file)
    described = describe()
    static, params, loaded = load_levels(request["levels"])
    engine = PhysicsEngine(static)
    worlds = jax.tree.map(lambda *xs: jnp.stack(xs), *loaded)
    step = jax.vmap(lambda state, action: engine.step(state, params, action)[0])

    states, actions = reach(step, worlds, static, request["moments"], jax.random.key(request["seed"]))
    stirred = stir(states, np.random.default_rng(request["seed"]))
    states = jax.tree.map(lambda x, y: np.concatenate([x, y]), states, stirred)
    actions = np.concatenate([actions, actions])
    empty = dict(zip(MANIFOLDS, get_empty_collision_manifolds(static)))
    forgotten = {
        name: jax.tree.map(lambda x: jnp.broadcast_to(x, (len(actions), *x.shape)), value)
        for name, value in empty.items()
    }
    answer: dict[str, np.ndarray] = {}
    for precision in ("float32", "float64"):
        with jax.enable_x64(precision == "float64"):
            one_step = jax.jit(step)
            for start, kept in (("warm", {}), ("cold", forgotten)):
                begun, action = in_precision((states.replace(**kept), actions), precision)
                answer[f"after.{precision}.{start}"] = visible(one_step(begun, action))
    answer |= scene_of(states) | contacts_of(states, engine, static)
    np.savez(sys.argv[2], action=actions, described=np.array(json.dumps(described)), **answer)
    return 0


def reach(step: Any, worlds: Any, static: Any, moments: list[int], key: Any) -> tuple[Any, np.ndarray]:
    """States at the moments and the actions taken there, level by level, in numpy."""
    count = worlds.gravity.shape[0]

    def action_of(index: Any) -> Any:
        motor_key, thruster_key = jax.random.split(jax.random.fold_in(key, index))
        motor = jax.random.randint(motor_key, (count, static.num_joints), -1, 2)
        thruster = jax.random.randint(thruster_key, (count, static.num_thrusters), 0, 2)
        return jnp.concatenate([motor, thruster], axis=1).astype(jnp.float32)

    @jax.jit
    def play(worlds: Any, first: Any, last: Any) -> Any:
        return jax.lax.fori_loop(first, last, lambda i, worlds: step(worlds, action_of(i // FRAME_SKIP)), worlds)

    states, actions, now = [], [], 0
    for moment in moments:
        worlds, now = play(worlds, now, moment), moment
        states.append(jax.tree.map(np.asarray, worlds))
        actions.append(np.asarray(action_of(moment // FRAME_SKIP)))

    def by_level(*xs: np.ndarray) -> np.ndarray:
        return np.stack(xs, axis=1).reshape(-1, *xs[0].shape[1:])

    return jax.tree.map(by_level, *states), by_level(*actions)


def stir(states: Any, rng: np.random.Generator) -> Any:
    """The states with movable shapes displaced, turned and pushed by amounts of heavy-tailed distributions."""

    def thrown(x: np.ndarray, scale: float, movable: np.ndarray) -> np.ndarray:
        by = scale * rng.standard_cauchy(x.shape) * movable.reshape(*movable.shape, *[1] * (x.ndim - 2))
        return (x + by).astype(x.dtype)

    def bodies(body: Any) -> Any:
        movable = body.active & (body.inverse_mass != 0)
        return body.replace(
            position=thrown(body.position, 0.1, movable),
            rotation=thrown(body.rotation, 0.1, movable),
            velocity=thrown(body.velocity, 1.0, movable),
            angular_velocity=thrown(body.angular_velocity, 1.0, movable),
        )

    return states.replace(polygon=bodies(states.polygon), circle=bodies(states.circle))


def in_precision(tree: Any, precision: str) -> Any:
    return jax.tree.map(lambda x: jnp.asarray(x.astype(precision) if x.dtype.kind == "f" else x), tree)


def visible(state: Any) -> np.ndarray:
    """[S, n, 6], polygons first."""

    def rows(body: Any) -> np.ndarray:
        parts = (body.position, body.rotation[..., None], body.velocity, body.angular_velocity[..., None])
        return np.concatenate([np.asarray(part) for part in parts], -1)

    return np.concatenate([rows(state.polygon), rows(state.circle)], axis=1)


def scene_of(states: Any) -> dict[str, np.ndarray]:
    parts = ("polygon", "circle", "joint", "thruster")
    fields = {
        f"{part}.{name}": np.asarray(getattr(getattr(states, part), name))
        for part in parts
        for name in getattr(states, part).__dataclass_fields__
    }
    mode = np.concatenate([fields["polygon.collision_mode"], fields["circle.collision_mode"]], axis=1)
    one, other = mode[:, :, None], mode[:, None, :]
    meets = (one == 2) | (other == 2) | (one * other > 0)
    can_touch = meets & np.asarray(states.collision_matrix) & ~np.eye(mode.shape[1], dtype=bool)
    return fields | {"can_touch": can_touch, "gravity": np.asarray(states.gravity)}


def contacts_of(states: Any, engine: Any, static: Any) -> dict[str, np.ndarray]:
    """What is remembered of contacts: pairs of shapes (the lower index first), zero where nothing is."""
    first_circle = static.num_polygons
    pairs = (
        np.repeat(np.asarray(engine.poly_poly_pairs), 2, axis=0),
        np.asarray(engine.circle_poly_pairs)[:, ::-1] + np.array([0, first_circle]),
        np.asarray(engine.circle_circle_pairs) + first_circle,
    )
    orders = (np.tile([0, 1], len(pairs[0]) // 2), np.zeros(len(pairs[1]), int), np.zeros(len(pairs[2]), int))
    impulses, active = [], []
    for name in MANIFOLDS:
        manifolds = getattr(states, name)
        rows = np.stack([manifolds.acc_impulse_normal, manifolds.acc_impulse_tangent], -1)
        impulses.append(rows.reshape(len(rows), -1, 2))
        active.append(np.asarray(manifolds.active).reshape(len(rows), -1))
    return {
        "contact_pair": np.concatenate(pairs),
        "contact_order": np.concatenate(orders),
        "contact_impulse": np.concatenate(impulses, axis=1),
        "contact_active": np.concatenate(active, axis=1),
    }


if __name__ == "__main__":
    sys.exit(main())
