"""Environment steps per second in an RL loop: Box2D in gymnasium, ours in the same loop, and ours compiled.

    bash bench/peers/setup_box2d.sh
    python -m bench.rl_loop --size m --worlds 1 16 64 --json runs/rl_loop.json

All play the designed levels of a size, world i level i modulo their number, two physics steps of 1/60 s in an
environment step, with random weights of the same policy (five layers of 128, numpy in gymnasium). Medians of repeats:

    engine      Box2D's step alone, called from Python
    gymnasium   policy and environment in one process (SyncVectorEnv; ours is one vector environment)
    workers     Box2D in a process for each world (AsyncVectorEnv)
    compiled    ours with the policy in JAX, a scan in one program
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np

import kinetix_dist.gymnasium_envs  # noqa: F401  registers them
from bench.peer_process import PeerMissing, PeerProgram
from bench.peers.vector_loop import Policy, steps_per_second
from bench.program import exit_code, output_file, parser_of
from jax2d.fidelity.units import MOTOR_ACCELERATION, MOTOR_SPEED, THRUST
from jax2d.fields import as_dict
from kinetix_dist.env.environment import EnvConfig, Environment
from kinetix_dist.errors import UserError
from kinetix_dist.level.level import Level
from kinetix_dist.level.sets import load_level_set

BOX2D_LOOP = PeerProgram(
    program="box2d_loop.py", folder="box2d", setup="setup_box2d.sh", variable="KINETIX_BOX2D_PYTHON"
)
DT = 1 / 60  # s


def main(arguments: Sequence[str] | None = None) -> int:
    parser = parser_of(__doc__, prog="python -m bench.rl_loop")
    parser.add_argument("--size", choices=("s", "m", "l"), default="m")
    parser.add_argument("--worlds", type=int, nargs="+", default=[1, 16, 64])
    parser.add_argument(
        "--compiled-worlds", type=int, nargs="+", default=[], help="besides, of the compiled loop alone"
    )
    parser.add_argument("--max-workers", type=int, default=64, help="processes of one vector environment")
    parser.add_argument("--steps", type=int, default=64, help="environment steps of a timed run")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--json", type=output_file)
    args = parser.parse_args(arguments)
    return exit_code(parser, lambda: run(args))


def run(args: argparse.Namespace) -> int:
    if min(*args.worlds, *args.compiled_worlds, args.steps, args.repeats) < 1:
        raise UserError("--worlds, --compiled-worlds, --steps and --repeats are 1 or more")
    config = EnvConfig(size=args.size, observation="flat", action_space="continuous")
    levels, _ = load_level_set(f"designed_{args.size}", args.size)
    device = jax.devices()[0].device_kind
    records = [record | {"engine": "box2d", "device": "cpu"} for record in box2d(args, config, levels)]
    for worlds in args.worlds:
        name = f"kinetix-dist/{args.size.upper()}-v0"
        options = {"levels": f"designed_{args.size}", "observation": "flat", "action_space": "continuous"}
        envs = gymnasium.make_vec(name, num_envs=worlds, **options)
        found = steps_per_second(envs, args.steps, args.repeats)
        records.append({"loop": "gymnasium", "worlds": worlds, "env_steps_per_second": found} | _ours(device))
        envs.close()
    for worlds in (*args.worlds, *args.compiled_worlds):
        found = compiled(Environment(config), levels, worlds, args.steps, args.repeats)
        records.append({"loop": "compiled", "worlds": worlds, "env_steps_per_second": found} | _ours(device))
    for record in records:
        record["env_steps_per_second"] = statistics.median(record["env_steps_per_second"])
        print(
            f"{record['engine']:6} {record['loop']:10} {record['worlds']:8,} worlds on {record['device']:12} "
            f"{record['env_steps_per_second']:12,.0f} environment steps/s"
        )
    if args.json is not None:
        args.json.write_text(json.dumps(records, indent=1) + "\n")
    return 0


def _ours(device: str) -> dict[str, str]:
    return {"engine": "jax2d", "device": device}


def box2d(args: argparse.Namespace, config: EnvConfig, levels: Level) -> list[dict[str, Any]]:
    """Records of Box2D. Raises UserError where it is not installed or fails."""
    arrays = {f"scene.{name}": np.asarray(values) for name, values in as_dict(jax.device_get(levels.scene)).items()}
    for name in ("position", "angle", "velocity", "angular_velocity"):
        arrays[name] = np.asarray(getattr(levels, name))
    arrays["control"] = np.ones(len(arrays["angle"]))
    request = {
        "worlds": args.worlds,
        "max_workers": args.max_workers,
        "num_steps": args.steps,
        "repeats": args.repeats,
        "dt": DT,
        "frame_skip": config.frame_skip,
        "max_steps": config.max_steps,
        "constants": {"motor_speed": MOTOR_SPEED, "motor_acceleration": MOTOR_ACCELERATION, "thruster_power": THRUST},
    }
    with tempfile.TemporaryDirectory() as folder:
        scenes, answer = Path(folder, "scenes.npz"), Path(folder, "answer.json")
        np.savez(scenes, allow_pickle=False, **arrays)
        try:
            BOX2D_LOOP.run(request | {"scenes": str(scenes)}, answer)
        except (PeerMissing, RuntimeError) as error:
            raise UserError(str(error)) from error
        records: list[dict[str, Any]] = json.loads(answer.read_text())
    return records


def compiled(env: Environment, levels: Level, worlds: int, num_steps: int, repeats: int) -> list[float]:
    """Environment steps per second of each repeat of one program, which is compiled and run once before."""
    index = np.arange(worlds) % len(np.asarray(levels.angle))
    prepared = env.prepare(jax.tree.map(lambda x: jnp.asarray(x)[index], levels))
    state, obs = env.reset(prepared)
    flat = env.observe(prepared, obs)
    weights = Policy(flat.shape[1], env.action_space.num_dimensions).weights

    low, high = jnp.asarray(env.action_space.low), jnp.asarray(env.action_space.high)

    @jax.jit
    def play(state: Any, obs: Any) -> tuple[Any, Any]:
        def step(carry: tuple[Any, Any], _: None) -> tuple[tuple[Any, Any], None]:
            state, obs = carry
            actions = env.observe(prepared, obs)
            for each in weights:
                actions = jnp.tanh(actions @ each)
            state, obs, *_rest = env.step(prepared, state, jnp.clip(actions, low, high))
            return (state, obs), None

        return jax.lax.scan(step, (state, obs), length=num_steps)[0]

    found = []
    for _ in range(repeats + 1):
        began = time.perf_counter()
        state, obs = jax.block_until_ready(play(state, obs))
        found.append(worlds * num_steps / (time.perf_counter() - began))
    return found[1:]


if __name__ == "__main__":
    sys.exit(main())
