"""Random levels of the public Kinetix package, drawn in its own environment, unfiltered. Uses nothing of the project.

    python kinetix_levels.py OUT.npz SIZE NUM_LEVELS SEED       # SIZE is s, m or l; level i is of key split(SEED)[i]

The arrays are those of its `EnvState`: polygon_*, circle_*, joint_*, thruster_*, one row for each level.
"""

from __future__ import annotations

import dataclasses
import functools
import sys

import jax
import numpy as np
from kinetix.environment.env_state import EnvParams
from kinetix.environment.ued.distributions import sample_kinetix_level
from kinetix.environment.ued.ued_state import UEDParams
from kinetix.environment.utils import static_env_params_from_size

from jax2d.engine import PhysicsEngine

BATCH = 500


def main(file: str, size: str, num_levels: int, seed: int) -> None:
    static = static_env_params_from_size(size)
    engine = PhysicsEngine(static)
    sample = functools.partial(
        sample_kinetix_level, engine=engine, env_params=EnvParams(), static_env_params=static, ued_params=UEDParams()
    )
    draw = jax.jit(jax.vmap(sample))
    keys = jax.random.split(jax.random.PRNGKey(seed), num_levels)
    batches = [jax.tree.map(np.asarray, draw(keys[i : i + BATCH])) for i in range(0, num_levels, BATCH)]
    state = jax.tree.map(lambda *parts: np.concatenate(parts), *batches)
    np.savez_compressed(file, **_arrays(state))


def _arrays(state: object) -> dict[str, np.ndarray]:
    arrays = {}
    for part in ("polygon", "circle", "joint", "thruster"):
        rows = getattr(state, part)
        arrays |= {f"{part}_{field.name}": getattr(rows, field.name) for field in dataclasses.fields(rows)}
    for part, fields in (
        ("polygon", {"role": "polygon_shape_roles", "density": "polygon_densities"}),
        ("circle", {"role": "circle_shape_roles", "density": "circle_densities"}),
        ("joint", {"motor_binding": "motor_bindings", "motor_auto": "motor_auto"}),
        ("thruster", {"binding": "thruster_bindings"}),
    ):
        arrays |= {f"{part}_{name}": getattr(state, field) for name, field in fields.items()}
    return arrays


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))
