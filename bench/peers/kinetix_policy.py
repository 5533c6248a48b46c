"""The public Kinetix package (in its own environment): what its policies see of states, and do.

    python kinetix_policy.py REQUEST.json OUT.npz

The request: {"levels": [FILE...] of one size, "moments": [physics step...], "seed": N, "recalculate": false,
"create": {FOLDER: {"legacy_entity_id": false, "seed": N}}, "checkpoints": [FOLDER...]}. States are those at the start
of each level, those reached by random actions at the moments, and the latter stirred, S in all; see
jax2d_published_steps.py. Contacts are computed again where the shapes stand, and there are none at the start.
"recalculate" replaces masses and inertias of movable shapes by the package's own. "create" initialises the paper's
network, moves all parameters by noise (its last layer starts near zero) and saves it; "checkpoints" are applied to all
states; options that their config.json leaves out are the paper's. OUT.npz:

    level, has_stepped                       [S] which file, and whether a physics step was made
    position, angle, velocity, angular_velocity [S, n, ...]
    obs.*                                    fields of the package's EntityObservation
    log_probs.K, value.K                     [S, 16] of all choices of all heads and [S], of checkpoint K

This file uses nothing of the project.
"""

from __future__ import annotations

import json
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax2d_published_steps import reach, stir
from kinetix.environment.env import make_kinetix_env
from kinetix.environment.env_state import EnvParams
from kinetix.environment.spaces import ActionType, ObservationType
from kinetix.models import make_network_from_config
from kinetix.util.saving import load_from_json_file, load_pretrained_checkpoint, save_pretrained_checkpoint

from jax2d.engine import PhysicsEngine, recalculate_mass_and_inertia

# The paper's network, as configs/model/tf-paper.yaml of the package has it.
PAPER = {
    "recurrent_model": False,
    "permutation_invariant_mlp": False,
    "activation": "tanh",
    "actor_width": 128,
    "critic_width": 128,
    "actor_depth": 5,
    "critic_depth": 5,
    "num_heads": 8,
    "transformer_depth": 2,
    "transformer_size": 16,
    "transformer_encoder_size": 128,
    "aggregate_mode": "dummy_and_mean",
    "full_attention_mask": False,
    "transformer_ffn": False,
    "multilayer_joint_thruster_mixing": False,
    "joint_thruster_block_num_layers": 1,
    "joint_thruster_block_hidden_dim_multiplication": 1,
    "dropout_prob": 0.0,
    "legacy_entity_id": False,
}
NOISE = 0.05  # added to all parameters that are created


def main() -> int:
    with open(sys.argv[1]) as file:
        request = json.load(file)
    loaded = [load_from_json_file(level) for level in request["levels"]]
    static, params = loaded[0][1], EnvParams()
    levels = jax.tree.map(lambda *xs: jnp.stack(xs), *[state for state, _, _ in loaded])
    if request["recalculate"]:
        recalculate = jax.vmap(recalculate_mass_and_inertia, in_axes=(0, None, 0, 0))
        levels = recalculate(levels, static, levels.polygon_densities, levels.circle_densities)
    states, level, has_stepped = states_of(levels, static, params, request["moments"], request["seed"])
    env = make_kinetix_env(
        ActionType.MULTI_DISCRETE, ObservationType.SYMBOLIC_ENTITY, None, params, static, auto_reset=False
    )
    obs = jax.jit(jax.vmap(env.get_obs))(states)
    answer = {f"obs.{name}": getattr(obs, name) for name in obs.__dataclass_fields__}
    answer |= {"level": level, "has_stepped": has_stepped} | visible(states)
    for folder, wanted in request.get("create", {}).items():
        create(env, params, static, obs, folder, **wanted)
    for number, folder in enumerate(request["checkpoints"]):
        answer |= {f"{name}.{number}": x for name, x in play(env, params, static, obs, folder).items()}
    np.savez_compressed(sys.argv[2], **{name: np.asarray(x) for name, x in answer.items()})
    return 0


def states_of(
    levels: Any, static: Any, params: EnvParams, moments: list[int], seed: int
) -> tuple[Any, np.ndarray, np.ndarray]:
    """(states, level of each, whether it was stepped)."""
    engine = PhysicsEngine(static)
    step = jax.vmap(lambda state, action: engine.step(state, params, action)[0])
    reached, _ = reach(step, levels, static, moments, jax.random.key(seed))
    moved = jax.tree.map(lambda *xs: np.concatenate(xs), reached, stir(reached, np.random.default_rng(seed)))
    manifolds = jax.jit(jax.vmap(engine.calculate_collision_manifolds))(moved)
    names = ("acc_rr_manifolds", "acc_cr_manifolds", "acc_cc_manifolds")
    moved = moved.replace(**dict(zip(names, manifolds, strict=True)))
    count = len(levels.gravity)
    level = np.concatenate([np.arange(count), *[np.repeat(np.arange(count), len(moments))] * 2])
    states = jax.tree.map(lambda *xs: np.concatenate(xs), levels, moved)
    return states, level, np.arange(len(level)) >= count


def visible(states: Any) -> dict[str, np.ndarray]:
    names = {
        "position": "position",
        "angle": "rotation",
        "velocity": "velocity",
        "angular_velocity": "angular_velocity",
    }
    return {
        ours: np.concatenate([getattr(states.polygon, theirs), getattr(states.circle, theirs)], axis=1)
        for ours, theirs in names.items()
    }


def network_of(env: Any, params: EnvParams, static: Any, model: dict[str, Any]) -> Any:
    bindings = {name: getattr(static, name) for name in ("num_motor_bindings", "num_thruster_bindings")}
    config = model | {
        "action_type": ActionType.MULTI_DISCRETE,
        "observation_type": ObservationType.SYMBOLIC_ENTITY,
        "static_env_params": bindings,
    }
    return make_network_from_config(env, params, config, network_kws={})


def with_time(obs: Any) -> tuple[Any, Any]:
    """Networks take [T, B, ...]."""
    return jax.tree.map(lambda x: jnp.asarray(x)[None], obs), jnp.zeros((1, len(obs.circles)), bool)


def create(env: Any, params: EnvParams, static: Any, obs: Any, folder: str, *, seed: int, **model: Any) -> None:
    model = PAPER | model
    one = jax.tree.map(lambda x: x[:1], obs)
    tree = jax.jit(network_of(env, params, static, model).init)(jax.random.key(seed), None, with_time(one))
    leaves, structure = jax.tree.flatten({"params": tree["params"]})
    rng = np.random.default_rng(seed)
    noisy = [x + NOISE * rng.standard_normal(x.shape).astype(np.float32) for x in leaves]
    save_pretrained_checkpoint(jax.tree.unflatten(structure, noisy), {"model": model}, folder)


def play(env: Any, params: EnvParams, static: Any, obs: Any, folder: str) -> dict[str, Any]:
    tree, config = load_pretrained_checkpoint(folder)
    network = network_of(env, params, static, PAPER | config["model"])

    @jax.jit
    def apply(tree: Any, obs: Any) -> tuple[Any, Any]:
        _, pi, value = network.apply(tree, None, with_time(obs))
        return [jax.nn.log_softmax(d.logits) for d in pi.distributions], value

    log_probs, value = apply(tree, obs)
    log_probs = np.concatenate([np.asarray(x) for x in log_probs], axis=-1)
    return {"log_probs": log_probs[0], "value": np.asarray(value)[0]}


if __name__ == "__main__":
    sys.exit(main())
