"""Scores candidates in some number of parts, each on some number of CPU devices, and saves the buffers.

JAX_NUM_CPU_DEVICES=3 python tests/curator/scoring_program.py OUT.npz sfl 1x1 1x3 3x2
"""

from __future__ import annotations

import dataclasses
import sys

import jax
import numpy as np

from kinetix_dist.checkpoint import flatten_arrays
from kinetix_dist.curator.config import CurriculumConfig, SlicesConfig
from kinetix_dist.learner.sharding import data_mesh
from kinetix_dist.models.policy import make_policy
from kinetix_dist.runtime.cores.curriculum_state import make_curriculum
from kinetix_dist.runtime.cores.learner_core import initial_state
from kinetix_dist.runtime.cores.playing import make_environment
from tests.runtime.runs import tiny_config

NUM_CANDIDATES, KEPT, BATCH = 32, 12, 8
SLICES = SlicesConfig(slice_size=KEPT, attempts=(2, 4), keep_one_of=(2,))


def main() -> None:
    out, name, *counts = sys.argv[1:]
    tiny = tiny_config(num_updates=1)
    config = dataclasses.replace(
        tiny,
        env=dataclasses.replace(tiny.env, max_steps=64),
        curriculum=CurriculumConfig(
            name=name,
            num_candidates=NUM_CANDIDATES,
            scoring_batch=BATCH,
            scoring_steps=192,
            buffer_size=KEPT,
            slices=SLICES,
        ),
        rollout=dataclasses.replace(tiny.rollout, num_steps=64),
    )
    env = make_environment(config)
    policy = make_policy(config.policy, env.action_distribution.head_sizes)
    params = jax.device_get(jax.jit(lambda: initial_state(config, env, policy))().params)
    curriculum, buffers = make_curriculum(config, env, policy, data_mesh()), {}
    for count in counts:
        num_parts, num_devices = map(int, count.split("x"))
        curriculum.tools = dataclasses.replace(curriculum.tools, devices=jax.devices()[:num_devices])
        parts = [curriculum.refresh_part(params, 5, jax.random.key(3), part, num_parts) for part in range(num_parts)]
        buffers[count] = curriculum.join(parts)
    np.savez(out, allow_pickle=False, **flatten_arrays(buffers))


if __name__ == "__main__":
    main()
