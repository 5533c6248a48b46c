"""Trains with worlds that go on, cuts the run between two resets, resumes it, and prints what differs from the unbroken
one.

JAX_NUM_CPU_DEVICES=3 python tests/runtime/ongoing_program.py RUN
"""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import jax
import numpy as np

from kinetix_dist.checkpoint import list_checkpoints
from tests.runtime.runs import final_arrays, tiny_config
from tests.runtime.test_ongoing_worlds import RUN, train, with_resets


def main() -> None:
    path = Path(sys.argv[1])
    config = with_resets(tiny_config(num_updates=5, **RUN), recurrent="gru")
    train(config, path)
    cut = path.with_name("cut")
    shutil.copytree(path, cut)
    shutil.rmtree(list_checkpoints(cut / "checkpoints")[-1])
    train(config, cut, resume=True)
    ours, theirs = final_arrays(cut), final_arrays(path)
    differing = sorted({*ours} ^ {*theirs}) + [
        name for name in theirs if name in ours and not np.array_equal(ours[name], theirs[name])
    ]
    print(json.dumps({"devices": len(jax.devices()), "differing": differing, "arrays": len(theirs)}))


if __name__ == "__main__":
    main()
