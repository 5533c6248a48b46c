"""Plays and learns two updates on several numbers of CPU devices and saves what comes out.

    JAX_NUM_CPU_DEVICES=7 python tests/runtime/devices_program.py OUT.npz most_failed 1 7

The curriculum is one that sees all worlds of an update: that of a user, "paired" or "sfl_slices". Saved for each
number of devices: levels and actions of the first update, its sums, and a checkpoint and the metrics after the second.
"""

from __future__ import annotations

import dataclasses
import sys
from typing import Any

import jax
import numpy as np

from kinetix_dist.checkpoint import flatten_arrays
from kinetix_dist.config import TrainConfig
from kinetix_dist.curator.config import CurriculumConfig, PairedConfig, SlicesConfig
from kinetix_dist.learner.sharding import data_mesh
from kinetix_dist.registry import import_plugins
from kinetix_dist.runtime.cores.worker import Worker
from tests.runtime.runs import tiny_config

NUM_UPDATES = 2
PLUGINS = ("examples.own_curriculum",)
CURRICULA = {
    "most_failed": CurriculumConfig(name="most_failed", levels="designed_s"),
    "paired": CurriculumConfig(name="paired", paired=PairedConfig(hidden_size=16, epochs=2)),
    "sfl_slices": CurriculumConfig(
        name="sfl_slices",
        num_candidates=16,
        scoring_batch=8,
        buffer_size=8,
        slices=SlicesConfig(slice_size=4, num_harvested=8, attempts=(2, 4), keep_one_of=(2,), window=2),
    ),
}


def config(curriculum: str) -> TrainConfig:
    """Eight groups of two worlds or four."""
    import_plugins(PLUGINS)
    tiny = tiny_config(num_updates=NUM_UPDATES, plugins=PLUGINS)
    num_envs = 32 if curriculum == "sfl_slices" else 16  # with two fresh levels a group there is a pair of them
    return dataclasses.replace(
        tiny,
        env=dataclasses.replace(tiny.env, max_steps=5),
        curriculum=CURRICULA[curriculum],
        rollout=dataclasses.replace(tiny.rollout, num_envs=num_envs, num_groups=8),
        ppo=dataclasses.replace(tiny.ppo, virtual_shards=8),
    )


def play_and_learn(curriculum: str, num_devices: int) -> dict[str, np.ndarray]:
    worker = Worker(config(curriculum), data_mesh(jax.devices()[:num_devices]))
    worker.start(None)
    kind = worker._state_of(0).curriculum
    if kind.refreshes:
        worker.adopt(kind.refresh_part(worker._learner.params, 0, jax.random.key(0), 0, 1))
    rollout = worker._playing.rollout(worker._config)
    batch, seen, sums, _ = rollout.play(worker._learner.params, worker._state_of(0).on_devices, 0)
    assert seen is not None
    levels = seen[0].levels

    def once(x: jax.Array, axis: int = 0) -> np.ndarray:
        return np.take(np.asarray(x), rollout.division.gathered(x.shape[axis]), axis=axis)

    found = {"levels": jax.tree.map(once, levels), "actions": once(batch.trajectory.actions, axis=1)}
    rows = [worker.run_update(number)[0] for number in range(NUM_UPDATES)]
    return flatten_arrays({**found, "sums": jax.device_get(sums), "metrics": rows[-1]}) | worker.snapshot()


def main() -> None:
    out, curriculum, *counts = sys.argv[1:]
    found: dict[str, Any] = {}
    for count in counts:
        found |= {f"{count}:{name}": x for name, x in play_and_learn(curriculum, int(count)).items()}
    np.savez(out, **found)


if __name__ == "__main__":
    main()
