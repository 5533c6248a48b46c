"""One revision of `jax2d`, timed in a process of its own: the other end of bench/compare_revisions.py.

    PYTHONPATH=FOLDER_WITH_JAX2D python bench/revision_runner.py '{"block_dim": 64, ...}'

The argument changes how the kernel is compiled and launched, for variants that are no setting of the engine:

    block_dim           threads a block
    kernel              options of `warp.kernel`: cuda_max_registers, launch_bounds, enable_cuda_smem_spilling
    module              options of its module: fast_math, fuse_fp
    shared_bytes        of a block's bodies in shared memory, at most
    sweep_above_shapes  from how many shapes on pairs are found by sort and sweep

Reads one JSON request a line from stdin and answers each with one line on stdout:

    {"do": "describe"}      -> {"ok": true, "device", "jax", "warp", "jax2d": folder}
    {"do": "prepare", "worlds": FILE.npz, "capacity": {...}, "preset", "count": W, "steps": N, "seed": S}
                            -> {"ok": true, "seconds": to compile and run once, "bits": of what that run led to}
    {"do": "run"}           -> {"ok": true, "seconds": for N physics steps of W worlds}

A failure answers {"ok": false, "error": one line}. World i plays world i of the file modulo their number. Runs go on
from where the one before ended; actions are drawn anew for every two steps. On a CPU seconds are processor time. This
file uses nothing of the project but the `jax2d` on its path, in ways that every revision since 1df39d4 understands.
"""

from __future__ import annotations

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
STARTS = ("position", "angle", "velocity", "angular_velocity")


def compile_with(variant: dict[str, Any]) -> None:
    """Makes the engine ask Warp for a kernel with these options. Before its modules are imported."""
    make_kernel, make_call = wp.kernel, wp.jax_kernel

    def kernel(*arguments: Any, module_options: dict[str, Any] | None = None, **options: Any) -> Any:
        module_options = (module_options or {}) | variant.get("module", {})
        return make_kernel(*arguments, module_options=module_options, **options, **variant.get("kernel", {}))

    def call(*arguments: Any, block_dim: int, **options: Any) -> Any:
        return make_call(*arguments, block_dim=variant.get("block_dim", block_dim), **options)

    wp.kernel, wp.jax_kernel = kernel, call
    for name in {"sweep_above_shapes", "shared_bytes"} & variant.keys():
        from jax2d.warp import source

        setattr(source, name.upper(), variant[name])


class Bench:
    """Worlds, and the compiled program that steps them."""

    def __init__(self, worlds: str, capacity: dict[str, int], preset: str, count: int, steps: int, seed: int) -> None:
        import jax2d

        engine = jax2d.Engine(jax2d.Capacity(**capacity), settings=jax2d.preset(preset))
        with np.load(worlds) as file:
            fields = dict(file)
        starts = [fields.pop(name) for name in STARTS]
        scene = jax2d.Scene(**fields)
        order = jnp.arange(count) % len(starts[0])
        repeat = partial(jax.tree.map, lambda x: jnp.take(x, order, axis=-1))  # worlds are the last axis of tables
        self._scene = jax.jit(repeat)(engine.pack_scene(scene))
        self._state = jax.jit(repeat)(engine.pack_state(engine.initial_state(scene, *starts)))
        self._bodies = jax.jit(engine.bodies)
        joints, thrusters = engine.capacity.joints, engine.capacity.thrusters

        def launch(packed: Any, key: jax.Array, packed_scene: Any) -> tuple[Any, None]:
            motor_key, thruster_key = jax.random.split(key)
            motor = jax.random.randint(motor_key, (count, joints), -1, 2).astype(jnp.float32)
            thruster = jax.random.randint(thruster_key, (count, thrusters), 0, 2).astype(jnp.float32)
            controls = jax2d.Controls(motor=motor, thruster=thruster)
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
    if len(sys.argv) > 1:
        compile_with(json.loads(sys.argv[1]))
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
