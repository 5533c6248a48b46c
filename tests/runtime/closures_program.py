"""Prints, for each program of an update, the files that run while it is traced and are not part of its key.

python tests/runtime/closures_program.py
"""

from __future__ import annotations

import json
import sys
from typing import Any
from unittest import mock

import jax

from kinetix_dist import program_cache
from kinetix_dist.learner.sharding import data_mesh
from kinetix_dist.runtime.cores.worker import Worker
from tests.runtime.runs import tiny_config


def files_outside_of_closures() -> dict[str, list[str]]:
    """Files by the kind of a program; nothing is compiled."""
    outside: dict[str, list[str]] = {}
    stored = program_cache._stored

    def watched(key: program_cache.ProgramKey, *arguments: Any) -> Any:
        files: set[str] = set()
        sys.settrace(lambda frame, event, argument: files.add(frame.f_code.co_filename))  # of this thread
        try:
            return stored(key, *arguments)
        finally:
            sys.settrace(None)
            known = {str(program_cache._file_of(module)) for module in key.closure.modules}
            ours = tuple(f"{folder}/" for folder in program_cache._DIRECTORIES.values())
            outside[key.kind] = sorted(file for file in files - known if file.startswith(ours))

    with mock.patch.object(program_cache, "_stored", watched):
        config = tiny_config(num_updates=2)
        worker = Worker(config, data_mesh(jax.devices()[:1]))
        learner = worker._learner
        _, batch = worker._playing.rollout(config).traced(learner.shapes.params, worker._state_of(0).shapes)
        update: Any = learner._update  # made by jax.jit
        update.trace(learner.shapes, *batch)
    return outside


if __name__ == "__main__":
    print(json.dumps(files_outside_of_closures()))
