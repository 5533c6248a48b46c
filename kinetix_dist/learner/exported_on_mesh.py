"""Functions of arrays on a mesh, exported: read from the compile cache instead of traced.

Tracing and lowering a rollout or an update takes seconds of Python, also where its compiled program is in the cache:
of `pretrain_l` on a GPU five each.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import flax
import jax
from jax.sharding import Mesh, NamedSharding

from jax2d.scene import Array
from kinetix_dist.models.kernels.cuda_kernel import TARGET
from kinetix_dist.models.kernels.support import traced_for
from kinetix_dist.telemetry.exported_program import current_settings, exported

_CUSTOM_CALLS = TARGET, "LayoutConstraint"  # a kernel; `jax.experimental.layout`


def exported_on_mesh(
    kind: str,
    made_from: object,
    function: Callable[..., Any],
    mesh: Mesh,
    *,
    in_specs: Sequence[Any],
    out_specs: Any,
) -> Any:
    """As `jax.jit(function)`, traced where no process has done that for equal arguments.

    kind, made_from: see `exported`, which is told the structure of the arguments, the version of flax and the device
    that networks are traced for, too. in_specs, out_specs: how what goes in and what comes out lies on `mesh`, trees of
    `PartitionSpec`, each of which may stand for a whole tree of arrays.
    """

    def call(*inputs: Any) -> Any:
        structure = jax.tree.structure(inputs)

        def of_leaves(*leaves: Array) -> Any:
            return function(*jax.tree.unflatten(structure, leaves))

        specs = jax.tree.leaves(jax.tree.broadcast(tuple(in_specs), inputs))
        leaves = jax.tree.leaves(inputs)
        shapes = [
            jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=NamedSharding(mesh, spec))
            for x, spec in zip(leaves, specs, strict=True)
        ]
        made = flax.__version__, made_from, str(structure), traced_for()
        return exported(kind, made, of_leaves, shapes, current_settings(), custom_calls=_CUSTOM_CALLS)(*leaves)

    call.__name__ = call.__qualname__ = function.__name__  # in profiles and logs
    return jax.jit(call, out_shardings=jax.tree.map(functools.partial(NamedSharding, mesh), out_specs))
