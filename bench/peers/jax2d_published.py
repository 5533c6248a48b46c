"""The published jax2d, timed, in its own environment: the other end of `bench engine speed --peers`.

Reads one JSON request a line from stdin and answers each with one line on stdout:

    {"do": "describe"}      -> {"ok": true, "version", "jax", "device"}
    {"do": "prepare", "levels": [FILE...], "worlds": W, "steps": N, "seed": S}
                            -> {"ok": true, "seconds": to compile and run once}
    {"do": "compile", the same} -> {"ok": true, "seconds"}  into JAX's cache; nothing runs
    {"do": "restart"}       -> {"ok": true}                 worlds back to their start
    {"do": "run"}           -> {"ok": true, "seconds": for N physics steps of W worlds}

A failure answers {"ok": false, "error": one line}. World i plays level i modulo the number of levels. Actions
are drawn at random for every two physics steps, inside the compiled program: motors from -1, 0, 1, thrusters
from 0, 1, the same as for our engine. This file uses nothing of the project.
"""

from __future__ import annotations

import functools
import importlib.metadata
import json
import sys
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

WANTED_VERSION = "1.0.2"
FRAME_SKIP = 2  # physics steps that an action is held for


def main() -> int:
    if "--check" in sys.argv:
        print(json.dumps(describe()))
        return 0
    bench: Bench | None = None
    for line in sys.stdin:
        request = json.loads(line)
        try:
            match request.pop("do"):
                case "describe":
                    answer = describe()
                case "prepare":
                    bench = None  # frees the memory of the previous worlds first
                    started = time.perf_counter()
                    bench = Bench(**request)
                    bench.run()
                    bench.restart()
                    answer = {"seconds": time.perf_counter() - started}
                case "compile":
                    started = time.perf_counter()
                    Bench(**request).compile()
                    answer = {"seconds": time.perf_counter() - started}
                case "restart":
                    assert bench is not None, "prepare first"
                    bench.restart()
                    answer = {}
                case "run":
                    assert bench is not None, "prepare first"
                    answer = {"seconds": bench.run()}
                case other:
                    raise ValueError(f"unknown request {other!r}")
        except Exception as error:
            bench = None
            answer = {"ok": False, "error": " ".join(f"{type(error).__name__}: {error}".split())[:400]}
        print(json.dumps({"ok": True} | answer), flush=True)
    return 0


def describe() -> dict[str, Any]:
    """Versions and device; raises ImportError where the jax2d found is another than the published one."""
    try:
        version = importlib.metadata.version("jax2d")
    except importlib.metadata.PackageNotFoundError:
        raise ImportError(f"no published jax2d in {sys.prefix}; run `bash bench/peers/setup.sh`") from None
    if version != WANTED_VERSION:
        raise ImportError(f"jax2d {version} found, {WANTED_VERSION} wanted; run `bash bench/peers/setup.sh`")
    import jax2d.engine

    if (Path(jax2d.__path__[0]) / "warp").is_dir():
        raise ImportError(f"{jax2d.__path__[0]} is this project's engine, not the published one")
    return {"version": version, "jax": jax.__version__, "device": jax.devices()[0].device_kind}


class Bench:
    """Worlds of one size, and the compiled program that steps them."""

    def __init__(self, levels: list[str], worlds: int, steps: int, seed: int) -> None:
        from jax2d.engine import PhysicsEngine

        static_params, params, loaded = load_levels(levels)
        engine = PhysicsEngine(static_params)
        num_joints, num_thrusters = static_params.num_joints, static_params.num_thrusters
        order = np.arange(worlds) % len(loaded)
        self._start = jax.tree.map(lambda *xs: jnp.stack(xs)[order], *loaded)
        step_worlds = jax.vmap(lambda state, action: engine.step(state, params, action)[0])

        def env_step(states: Any, key: jax.Array) -> tuple[Any, None]:
            motor_key, thruster_key = jax.random.split(key)
            motor = jax.random.randint(motor_key, (worlds, num_joints), -1, 2)
            thruster = jax.random.randint(thruster_key, (worlds, num_thrusters), 0, 2)
            action = jnp.concatenate([motor, thruster], axis=1).astype(jnp.float32)
            for _ in range(FRAME_SKIP):
                states = step_worlds(states, action)
            return states, None

        @functools.partial(jax.jit, donate_argnums=0)
        def run_steps(states: Any, key: jax.Array) -> Any:
            return jax.lax.scan(env_step, states, jax.random.split(key, steps // FRAME_SKIP))[0]

        self._run_steps = run_steps
        self._key = jax.random.key(seed)
        self.restart()

    def restart(self) -> None:
        self._states = jax.block_until_ready(jax.tree.map(jnp.copy, self._start))

    def compile(self) -> None:
        self._run_steps.lower(self._states, self._key).compile()

    def run(self) -> float:
        """Steps all worlds and returns the seconds it took."""
        self._key, key = jax.random.split(self._key)
        jax.block_until_ready(key)
        started = time.perf_counter()
        self._states = jax.block_until_ready(self._run_steps(self._states, key))
        return time.perf_counter() - started


def load_levels(files: list[str]) -> tuple[Any, Any, list[Any]]:
    """Public level files of one size -> (static parameters, parameters, one SimState a file)."""
    from jax2d.sim_state import SimParams, StaticSimParams

    documents = [json.loads(Path(file).read_text()) for file in files]
    static_params = _of_fields(StaticSimParams, documents[0]["static_env_params"])
    params = _of_fields(SimParams, documents[0]["env_params"])
    return static_params, params, [_sim_state(document["env_state"], static_params) for document in documents]


def _sim_state(document: dict[str, Any], static_params: Any) -> Any:
    """The state in a level file. Caches of impulses start empty, as they do for our engine."""
    from jax2d.engine import create_empty_sim

    empty = create_empty_sim(static_params)
    fill = functools.partial(_fill, document)
    return empty.replace(
        polygon=fill("polygon", empty.polygon),
        circle=fill("circle", empty.circle),
        joint=fill("joint", empty.joint),
        thruster=fill("thruster", empty.thruster),
        collision_matrix=jnp.asarray(_array(document["collision_matrix"]), bool),
        gravity=jnp.asarray(_array(document["gravity"]), jnp.float32),
    )


def _fill(document: dict[str, Any], name: str, template: Any) -> Any:
    """A struct of arrays with the fields of `template` from a list of objects."""
    rows = document[name]
    fields = {}
    for field in template.__dataclass_fields__:
        like = getattr(template, field)
        values = jnp.asarray([_array(row[field]) for row in rows], like.dtype)
        fields[field] = values.reshape(like.shape)
    return template.replace(**fields)


def _array(value: Any) -> Any:
    """Files write arrays as objects with the keys "0", "1", ..."""
    if isinstance(value, dict):
        return [_array(value[str(i)]) for i in range(len(value))]
    return value


def _of_fields(kind: Any, values: dict[str, Any]) -> Any:
    return kind(**{name: value for name, value in values.items() if name in kind.__dataclass_fields__})


if __name__ == "__main__":
    sys.exit(main())
