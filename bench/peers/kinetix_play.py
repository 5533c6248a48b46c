"""Public level files played by the public Kinetix package (in its own environment), by actions that are given.

    python kinetix_play.py REQUEST.json OUT.npz
    python kinetix_play.py --check

The request: {"levels": [FILE...] of one size, "actions": FILE.npy of [T, W, 6] multi-discrete actions, "num_seen": K}.
Every level is loaded and stepped as the package does, T environment steps in each of W worlds. Fields of OUT.npz:

    outcome   [levels, W]   how the first episode ended: 0 not at all, 1 solved, 2 green touched red, 3 not finite
    length    [levels, W]   environment steps until then, T where it did not end
    position  [levels, K, T, shapes, 2] m, of the first K worlds, polygons first, after each step
    described versions, as JSON

This file uses nothing of the project.
"""

from __future__ import annotations

import importlib.metadata
import json
import sys
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

WANTED_VERSION = "3.0.2"


def main() -> int:
    described = describe()
    if "--check" in sys.argv:
        print(json.dumps(described))
        return 0
    with open(sys.argv[1]) as file:
        request = json.load(file)
    from kinetix.util.saving import load_from_json_file

    loaded = [load_from_json_file(file) for file in request["levels"]]
    _, static_params, env_params = loaded[0]
    if any(static != static_params or params != env_params for _, static, params in loaded):
        raise ValueError("levels of one request must be of one size and have the same parameters")
    play = jax.jit(partial(_play, _environment(static_params, env_params), env_params.replace(dense_reward_scale=0.0)))
    actions = jnp.asarray(np.load(request["actions"]))
    answers = []
    for file, (state, _, _) in zip(request["levels"], loaded, strict=True):
        outcome, length, position = jax.device_get(play(state, actions))
        answers.append((outcome, length, position[:, : request["num_seen"]].swapaxes(0, 1)))
        print(f"{file}: {np.mean(outcome[1:] == 1):.0%} of random actions", flush=True)
    outcome, length, position = (np.stack(column) for column in zip(*answers, strict=True))
    np.savez_compressed(
        sys.argv[2], outcome=outcome, length=length, position=position, described=np.array(json.dumps(described))
    )
    return 0


def describe() -> dict[str, str]:
    """Versions; raises ImportError where the package found is another than the one wanted."""
    try:
        version = importlib.metadata.version("kinetix-env")
    except importlib.metadata.PackageNotFoundError:
        raise ImportError(f"no kinetix-env in {sys.prefix}; run `bash bench/peers/setup_kinetix.sh`") from None
    if version != WANTED_VERSION:
        raise ImportError(f"kinetix-env {version}, {WANTED_VERSION} wanted; run `bash bench/peers/setup_kinetix.sh`")
    versions = {name: importlib.metadata.version(name) for name in ("kinetix-env", "jax2d", "jax")}
    return versions | {"device": jax.devices()[0].device_kind}


def _environment(static_params: Any, env_params: Any) -> Any:
    from kinetix.environment.env import make_kinetix_env
    from kinetix.environment.spaces import ActionType, ObservationType

    return make_kinetix_env(
        ActionType.MULTI_DISCRETE, ObservationType.SYMBOLIC_ENTITY, None, env_params, static_params, auto_reset=False
    )


def _play(env: Any, params: Any, start: Any, actions: Any) -> tuple[Any, Any, Any]:
    """(outcome [W], length [W], position [T, W, shapes, 2]). Steps on after the end, which counts for nothing."""
    key = jax.random.key(0)  # the package's steps draw nothing
    step_worlds = jax.vmap(lambda state, action: env.step_env(key, state, action, params)[1:4])

    def step(carry: tuple, now: tuple) -> tuple[tuple, Any]:
        state, outcome, length = carry
        number, action = now
        # Without dense reward: 1 where green touched blue first, -1 where it touched red, else 0.
        state, reward, done = step_worlds(state, action)
        position = jnp.concatenate([state.polygon.position, state.circle.position], axis=1)
        timed_out = number >= params.max_timesteps
        ended = jnp.where(reward > 0.5, 1, jnp.where(reward < -0.5, 2, jnp.where(done & ~timed_out, 3, 0)))
        is_first = (outcome == 0) & (ended > 0)
        return (state, jnp.where(is_first, ended, outcome), jnp.where(is_first, number, length)), position

    num_steps, num_worlds = actions.shape[:2]
    worlds = jax.tree.map(lambda x: jnp.broadcast_to(x, (num_worlds, *jnp.shape(x))), start)
    nothing = jnp.zeros(num_worlds, jnp.int32)
    (_, outcome, length), position = jax.lax.scan(
        step, (worlds, nothing, nothing + num_steps), (jnp.arange(1, num_steps + 1), actions)
    )
    return outcome, length, position


if __name__ == "__main__":
    sys.exit(main())
