"""The program of an update, exported: read from the compile cache instead of traced.

Tracing and lowering an update takes seconds of Python, also where its compiled program is in the cache: of
`pretrain_l` on a GPU 5 of the 22 s from `--resume` to the first new update.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import flax
import jax
import optax
from flax import linen as nn
from jax.sharding import Mesh, NamedSharding

from jax2d.scene import Array
from kinetix_dist.env.action_spaces import ActionDistribution
from kinetix_dist.env.observations import Observation
from kinetix_dist.learner.config import PpoConfig
from kinetix_dist.learner.division import Division
from kinetix_dist.learner.state import LearnerState
from kinetix_dist.learner.update import IN_SPECS, METRICS, Update, make_update
from kinetix_dist.messages import StaticInput, Trajectory
from kinetix_dist.models.kernels.cuda_kernel import TARGET
from kinetix_dist.models.kernels.support import traced_for
from kinetix_dist.telemetry.exported_program import are_of_this_project, current_settings, exported, told_apart

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
    parts = policy, observation, distribution
    update = make_update(*parts, config, mesh, division=division)
    if not are_of_this_project(*parts):
        return update
    made_from = (
        (flax.__version__, optax.__version__),
        *(told_apart(part) for part in (observation, distribution)),
        (type(policy).__module__, policy),
        (config, division),
    )

    def call(
        state: LearnerState, static: StaticInput, trajectory: Trajectory, last_value: Array
    ) -> tuple[LearnerState, dict[str, Array]]:
        inputs = state, static, trajectory, last_value
        structure = jax.tree.structure(inputs)
        results = jax.tree.structure((state, dict.fromkeys(METRICS, 0)))

        def of_leaves(*leaves: Array) -> Sequence[Array]:
            given, found = jax.tree.flatten(update(*jax.tree.unflatten(structure, leaves)))
            assert found == results, f"an update gives {found} and not {results}"
            return given

        made = made_from, str(structure), traced_for()
        program = exported(KIND, made, of_leaves, _shapes(inputs, mesh), current_settings(), custom_calls=[TARGET])
        return jax.tree.unflatten(results, program.call(*jax.tree.leaves(inputs)))

    call.__name__ = call.__qualname__ = "update"  # in profiles and logs
    return jax.jit(call)


def _shapes(inputs: tuple[Any, ...], mesh: Mesh) -> list[jax.ShapeDtypeStruct]:
    specs = jax.tree.leaves(jax.tree.broadcast(IN_SPECS, inputs))
    return [
        jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=NamedSharding(mesh, spec))
        for x, spec in zip(jax.tree.leaves(inputs), specs, strict=True)
    ]
