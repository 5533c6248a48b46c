"""The program of an update, exported: read from the compile cache instead of traced, see `exported_on_mesh.py`."""

from __future__ import annotations

import functools

import optax
from flax import linen as nn
from jax.sharding import Mesh

from kinetix_dist.env.action_spaces import ActionDistribution
from kinetix_dist.env.observations import Observation
from kinetix_dist.learner.config import PpoConfig
from kinetix_dist.learner.division import Division
from kinetix_dist.learner.exported_on_mesh import exported_on_mesh
from kinetix_dist.learner.update import IN_SPECS, OUT_SPECS, Update, make_update
from kinetix_dist.telemetry.exported_program import are_of_this_project, told_apart

KIND = "updates"  # folder in the compile cache


@functools.lru_cache(maxsize=8)
def exported_update(
    policy: nn.Module,
    observation: Observation,
    distribution: ActionDistribution,
    config: PpoConfig,
    mesh: Mesh,
    *,
    division: Division | None = None,
) -> Update:
    """As `make_update`, traced where no process has done that for equal arguments and arrays.

    Where a part is of a class from outside of this project it is traced in every process: that code may change.
    """
    update = make_update(policy, observation, distribution, config, mesh, division=division)
    if not are_of_this_project(policy, observation, distribution):
        return update
    parts = told_apart(observation), told_apart(distribution), (type(policy).__module__, policy)
    made_from = optax.__version__, *parts, config, division
    return exported_on_mesh(KIND, made_from, update, mesh, in_specs=IN_SPECS, out_specs=OUT_SPECS)
