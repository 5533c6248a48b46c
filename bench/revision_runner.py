"""One revision of `jax2d`, timed in a process of its own: the other end of bench/compare_revisions.py.

    PYTHONPATH=FOLDER_WITH_JAX2D python bench/revision_runner.py '{"block_dim": 64, ...}'

The argument holds fields of `jax2d.warp.variant.CompileOptions`, for variants of today's kernel.

Reads one JSON request a line from stdin and answers each with one line on stdout:

    {"do": "describe"}      -> {"ok": true, "device", "jax", "warp", "jax2d": folder}
    {"do": "prepare", "worlds": FILE.npz, "capacity": {...}, "preset", "count": W, "steps": N, "seed": S}
                            -> {"ok": true, "seconds": to compile and run once, "bits": of what that run led to}
    {"do": "run"}           -> {"ok": true, "seconds": for N physics steps of W worlds}

A failure answers {"ok": false, "error": one line}. World i plays world `PLAYED[i]` of the file. Runs go on
from where the one before ended; new actions are drawn for every two steps. On a CPU seconds are processor time. This
file uses nothing of the project but the `jax2d` on its path, with nested scenes (`e0d5a3c`) and field names of today.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import sys
import time
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import warp as wp

FRAME_SKIP = 2  # physics steps that an action is held for
PLAYED = "played"  # [W] in the file
STARTS = ("position", "angle", "velocity", "angular_velocity")


def known_to(kind: Any, values: dict[str, Any]) -> dict[str, Any]:
    """Of these fields those that a record of this revision has: worlds that are timed do not use what came later."""
    names = {field.name for field in dataclasses.fields(kind)}
    return {name: value for name, value in values.items() if name in names}


def backend_of(options: dict[str, Any]) -> Any:
    """The kernel compiled with other options; only today's engine has them."""
    if not options:
        return "warp"
    from jax2d.warp.ffi import WarpBackend
    from jax2d.warp.variant import CompileOptions

    return partial(WarpBackend, options=CompileOptions(**options))


def effects_of_levels(capacity: Any) -> Any:
    """Effects of an engine that steps levels: all but those that no level calls for."""
    from jax2d.effects import EFFECTS, Effects

    beyond = [name for name in ("kinematic_bodies", "brakes_and_servos", "springs") if name in EFFECTS]
    return Effects.full(capacity).without(*beyond)


def packed_worlds(engine: Any, worlds: str) -> tuple[Any, Any, int]:
    """(packed scene, packed state at the start, number of worlds) of a file."""
    import jax2d
    from jax2d.fields import from_dict

    with np.load(worlds) as file:
        fields = dict(file)
    starts = [fields.pop(name) for name in STARTS]
    played = jnp.asarray(fields.pop(PLAYED))
    scene = from_dict(jax2d.Scene, fields)
    repeat = partial(jax.tree.map, lambda x: jnp.take(x, played, axis=-1))  # worlds are the last axis of tables
    packed = jax.jit(repeat)(engine.pack_scene(scene))
    return packed, jax.jit(repeat)(engine.pack_state(engine.initial_state(scene, *starts))), len(played)


def random_controls(key: jax.Array, count: int, room: Any) -> Any:
    """Controls of `count` worlds, each motor forward, still or back, each thruster on or off."""
    import jax2d

    motor_key, thruster_key = jax.random.split(key)
    motor = jax.random.randint(motor_key, (count, room.joints), -1, 2).astype(jnp.float32)
    thruster = jax.random.randint(thruster_key, (count, room.thrusters), 0, 2).astype(jnp.float32)
    return jax2d.Controls(motor=motor, thruster=thruster)


class Bench:
    """Worlds, and the compiled program that steps them."""

    def __init__(self, worlds: str, capacity: dict[str, int], preset: str, count: int, steps: int, seed: int) -> None:
        import jax2d

        options = json.loads(sys.argv[1]) if len(sys.argv) > 1 else {}
        settings = jax2d.preset(preset)
        room = jax2d.Capacity(**known_to(jax2d.Capacity, capacity))
        engine = jax2d.Engine(room, settings=settings, backend=backend_of(options), effects=effects_of_levels(room))
        self._scene, self._state, _ = packed_worlds(engine, worlds)
        self._bodies = jax.jit(engine.bodies)

        def launch(packed: Any, key: jax.Array, packed_scene: Any) -> tuple[Any, None]:
            controls = random_controls(key, count, engine.capacity)
            return engine.step_packed(packed_scene, packed, controls, num_steps=FRAME_SKIP)[0], None

        @partial(jax.jit, donate_argnums=1)
        def run_steps(packed_scene: Any, packed: Any, key: jax.Array) -> Any:
            keys = jax.random.split(key, steps // FRAME_SKIP)
            return jax.lax.scan(partial(launch, packed_scene=packed_scene), packed, keys)[0]

        self._run_steps = run_steps
        self._key = jax.random.key(seed)
        self._clock = time.perf_counter if jax.default_backend() == "gpu" else time.process_time

    def run(self) -> float:
        self._key, key = jax.random.split(self._key)
        jax.block_until_ready(key)
        started = self._clock()
        self._state = jax.block_until_ready(self._run_steps(self._scene, self._state, key))
        return self._clock() - started

    def bits(self) -> str:
        """The same for the same bits of all bodies."""
        digest = hashlib.sha256()
        for field in jax.device_get(self._bodies(self._state)):
            digest.update(np.ascontiguousarray(field).tobytes())
        return digest.hexdigest()[:12]


def main() -> None:
    bench: Bench | None = None
    for line in sys.stdin:
        request = json.loads(line)
        try:
            match request.pop("do"):
                case "describe":
                    import jax2d

                    device = jax.devices()[0].device_kind
                    versions = {"jax": jax.__version__, "warp": wp.__version__}
                    answer = {"device": device, **versions, "jax2d": str(jax2d.__path__[0])}
                case "prepare":
                    bench = None  # frees the memory of the worlds before
                    started = time.perf_counter()
                    bench = Bench(**request)
                    bench.run()
                    answer = {"seconds": time.perf_counter() - started, "bits": bench.bits()}
                case "run":
                    assert bench is not None, "prepare first"
                    answer = {"seconds": bench.run()}
                case other:
                    raise ValueError(f"unknown request {other!r}")
        except Exception as error:
            bench = None
            answer = {"ok": False, "error": " ".join(f"{type(error).__name__}: {error}".split())[:400]}
        print(json.dumps({"ok": True} | answer), flush=True)


if __name__ == "__main__":
    main()
