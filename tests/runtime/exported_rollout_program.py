"""Plays an update by the program of a run and prints how often it was traced and a checksum of all that it gave.

python tests/runtime/exported_rollout_program.py CACHE
"""

from __future__ import annotations

import hashlib
import json
import sys
from pathlib import Path
from typing import Any
from unittest import mock

import jax
import numpy as np

from kinetix_dist.learner.sharding import data_mesh
from kinetix_dist.runtime.cores.rollout_core import Players, RolloutCore
from kinetix_dist.runtime.cores.worker import Worker
from tests.helpers import compile_cache
from tests.runtime.runs import tiny_config


def play(*, is_exported: bool = True) -> dict[str, Any]:
    """The first update of a new worker, of a program that was traced where it is not to be exported."""
    config = tiny_config(num_updates=2)
    worker = Worker(config, data_mesh(jax.devices()[:1]))
    worker.start(None)
    _, refreshed = worker.refresh(worker.released(), 0, 0, 1)
    worker.adopt(refreshed)
    playing, groups = worker._playing, range(config.rollout.num_groups)
    players = Players(playing.environment(config), playing.policy, playing.curriculum(config))
    with mock.patch.object(RolloutCore, "_play_shard", autospec=True, side_effect=RolloutCore._play_shard) as traced:
        traced_here = RolloutCore(config, players, worker._mesh, groups=groups)
        core = playing.rollout(config) if is_exported else traced_here
        results = core.play(worker._learner.params, worker._state_of(0).on_devices, 0)
    content = hashlib.sha256()
    for path, leaf in jax.tree_util.tree_leaves_with_path(results):
        content.update(f"{jax.tree_util.keystr(path)} {leaf.dtype} {leaf.shape}".encode())
        content.update(np.ascontiguousarray(leaf).tobytes())
    return {"traced": traced.call_count, "content": content.hexdigest()}


if __name__ == "__main__":
    with compile_cache(Path(sys.argv[1])):
        print(json.dumps(play()))
