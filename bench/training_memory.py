"""Memory that training takes on an H200, and launches of a rollout's step. Needs no GPU.

    python -m bench.training_memory                                       # pretrain_s, pretrain_m, pretrain_l
    python -m bench.training_memory --recipes pretrain_m --worlds 131072 --network transformer --json runs/memory.json

Rollout and update of a recipe are compiled for a described device, as in `bench.learner_traffic`, which says what that
needs. Memory is what XLA plans: arguments, results and temporary arrays at their peak. That of a rollout grows with
its worlds, that of an update by its batch beside a minibatch's activations, so that is compiled twice; from both
follows how many worlds fit into what a process has (`--pool-gib`, docs/operating.md: GPU memory). A rollout of so many
has not been run. Launches and bytes are those of one step of all worlds, see `bench.compiled_traffic`.
"""

from __future__ import annotations

import dataclasses
import sys
import time
from collections.abc import Iterable
from pathlib import PurePath
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

from bench.compiled_traffic import CompiledText, Launch, launches_of, loop_body
from bench.learner_traffic import COMPILER_OPTIONS, COPY_BYTES_A_SECOND, compiled, h200, shapes
from bench.program import exit_code, output_file, parser_of, report_each
from kinetix_dist.config import TrainConfig
from kinetix_dist.errors import UserError, user_errors
from kinetix_dist.learner.division import Division
from kinetix_dist.learner.sharding import DATA_AXIS
from kinetix_dist.learner.update import make_update
from kinetix_dist.models.kernels.support import compiling_for
from kinetix_dist.models.policy import NETWORKS
from kinetix_dist.recipes import recipe
from kinetix_dist.runtime.cores.learner_core import initial_state
from kinetix_dist.runtime.cores.playing import Playing

KIB, GIB = 1 << 10, 1 << 30
# By directory of the source that a launch comes from, innermost first; what is in none is "other".
PARTS = {
    "policy": ("kinetix_dist/models", "flax"),
    "observation": ("kinetix_dist/env/observations",),
    "engine": ("jax2d", "warp"),
    "sampling, storing": ("kinetix_dist/actors", "kinetix_dist/env/action_spaces"),
    "outcome, restart": ("kinetix_dist/env",),
}
OTHER = "other"


def configuration(name: str, worlds: int, network: str | None) -> TrainConfig:
    """A recipe with so many worlds, in minibatches as large as its own. Raises ValueError."""
    base = recipe(name)
    share = worlds / base.rollout.num_envs
    return dataclasses.replace(
        base,
        policy=dataclasses.replace(base.policy, network=network or base.policy.network),
        rollout=dataclasses.replace(base.rollout, num_envs=worlds),
        ppo=dataclasses.replace(base.ppo, minibatches=max(round(base.ppo.minibatches * share), 1)),
    )


class Programs:
    """Rollout and update of a configuration, compiled for one described device."""

    def __init__(self, config: TrainConfig, device: Any) -> None:
        self.config = config
        self.mesh = Mesh(np.array([device]), (DATA_AXIS,))
        self._division = Division(config.num_blocks, 1)
        self._playing = Playing(config, self.mesh, division=self._division)
        self._env = self._playing.environment(config)
        self._core = self._playing.rollout(config)
        self._arguments = jax.eval_shape(self.arguments)

    def state(self) -> Any:
        """The learner's first."""
        return initial_state(self.config, self._env, self._playing.policy)

    def arguments(self) -> tuple[Any, Any, Any]:
        """What the rollout of the first update takes."""
        return self.state().params, self._playing.curriculum(self.config).init(), np.uint32(0)

    def rollout(self, compiler_options: dict[str, Any] = COMPILER_OPTIONS) -> Any:
        arguments = shapes(self.mesh, self._arguments)
        return self._core.program.lower(*arguments).compile(compiler_options=compiler_options)

    def update(self, compiler_options: dict[str, Any] = COMPILER_OPTIONS) -> Any:
        batch, _, _ = jax.eval_shape(self._core.program, *self._arguments)
        update = make_update(
            self._playing.policy,
            self._env.observation,
            self._env.action_distribution,
            self.config.ppo,
            self.mesh,
            division=self._division,
        )
        return compiled(update, self.mesh, jax.eval_shape(self.state), *batch, compiler_options=compiler_options)


def planned(program: Any) -> int:
    """Bytes of a compiled program at its peak, as XLA plans them."""
    found = program.memory_analysis()
    whole = found.argument_size_in_bytes + found.output_size_in_bytes + found.temp_size_in_bytes
    return int(whole - found.alias_size_in_bytes)


def part_of(launch: Launch) -> str:
    for file, _ in launch.stack:
        for part, folders in PARTS.items():
            if any(f"{folder}/" in PurePath(file).as_posix() for folder in folders):
                return part
    return OTHER


def by_part(launches: Iterable[Launch]) -> dict[str, dict[str, float]]:
    """Launches and bytes of each part, in the order of PARTS."""
    rows = {part: {"launches": 0, "bytes": 0.0} for part in (*PARTS, OTHER)}
    for launch in launches:
        row = rows[part_of(launch)]
        row["launches"] += launch.times
        row["bytes"] += launch.times * (launch.read_bytes + launch.written_bytes)
    return {part: row for part, row in rows.items() if row["launches"]}


def measure(name: str, options: Any, device: Any) -> dict[str, Any]:
    """The record of one recipe."""
    began = time.perf_counter()
    config, half = (configuration(name, worlds, options.network) for worlds in _worlds_of(options))
    programs = Programs(config, device)
    rollout = programs.rollout()
    played, learned = planned(rollout), planned(programs.update())
    more = (learned - planned(Programs(half, device).update())) / (options.worlds - options.worlds // 2)
    text = CompiledText(rollout.as_text())
    parts = by_part(launches_of(text, loop_body(text)))
    pool = options.pool_gib * GIB
    return {
        "benchmark": "training_memory",
        "recipe": name,
        "network": config.policy.network,
        "worlds": options.worlds,
        "steps": config.rollout.num_steps,
        "minibatch": config.rollout.steps_per_update // config.ppo.minibatches,
        "jax": jax.__version__,
        "target": "NVIDIA H200",
        "rollout_bytes": played,
        "update_bytes": learned,
        "update_bytes_a_world": round(more),
        "pool_gib": options.pool_gib,
        "worlds_that_fit": int(min(pool / played, (pool - learned) / (more * options.worlds) + 1) * options.worlds),
        "launches_a_step": sum(row["launches"] for row in parts.values()),
        "bytes_a_step": round(sum(row["bytes"] for row in parts.values())),
        "parts": parts,
        "seconds": round(time.perf_counter() - began, 1),
    }


def _worlds_of(options: Any) -> tuple[int, int]:
    return options.worlds, options.worlds // 2


def check(options: Any) -> None:
    """Raises UserError for what cannot be compiled."""
    if options.worlds < 2 or not options.pool_gib > 0:
        raise UserError(
            f"--worlds is {options.worlds} and --pool-gib {options.pool_gib:g}; give at least 2, and above 0"
        )
    with user_errors(ValueError):
        for name in options.recipes:
            for worlds in _worlds_of(options):
                configuration(name, worlds, options.network).check_batch()


def table(record: dict[str, Any]) -> str:
    worlds = record["worlds"]
    lines = [
        f"{record['recipe']} ({record['network']}), {worlds:,} worlds x {record['steps']} steps, "
        f"minibatches of {record['minibatch']:,}",
        f"  rollout {record['rollout_bytes'] / GIB:.2f} GiB, {record['rollout_bytes'] / worlds / KIB:.1f} KiB a world",
        f"  update {record['update_bytes'] / GIB:.2f} GiB, {record['update_bytes_a_world'] / KIB:.1f} KiB a world more",
        f"  {record['worlds_that_fit']:,} worlds in {record['pool_gib']:g} GiB",
        f"  a step of the rollout: {record['launches_a_step']} launches, {record['bytes_a_step'] / 1e9:.2f} GB, "
        f"{1e3 * record['bytes_a_step'] / COPY_BYTES_A_SECOND:.2f} ms at {COPY_BYTES_A_SECOND / 1e12:g} TB/s",
    ]
    lines += [
        f"    {part:18s} {row['launches']:4.0f} {row['bytes'] / 1e9:7.3f} GB" for part, row in record["parts"].items()
    ]
    return "\n".join(lines)


def main() -> int:
    parser = parser_of(__doc__, prog="python -m bench.training_memory")
    parser.add_argument("--recipes", nargs="+", default=["pretrain_s", "pretrain_m", "pretrain_l"])
    parser.add_argument("--worlds", type=int, default=16_384)
    parser.add_argument("--network", choices=sorted(NETWORKS), help="instead of the recipe's")
    parser.add_argument("--pool-gib", type=float, default=130.4, help="XLA's pool of a process that has a GPU")
    parser.add_argument("--json", type=output_file, help="write the records here")
    options = parser.parse_args()

    def work() -> int:
        check(options)
        device = h200()
        with jax.default_device(jax.devices("cpu")[0]), compiling_for(device):
            report_each((measure(name, options, device) for name in options.recipes), options.json, text=table)
        return 0

    return exit_code(parser, work)


if __name__ == "__main__":
    sys.exit(main())
