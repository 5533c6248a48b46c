"""A program with steps of the engine that one process exports is run by another, which registers its launches."""

from __future__ import annotations

import functools
import pickle
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from jax import export

from jax2d.warp import ffi
from tests.engine import exported_steps_program
from tests.engine.exported_steps_program import NUM_WORLDS, engine, packed, step
from tests.helpers import PATIENCE_S, environment_of_cpus


@pytest.mark.long
def test_another_process_steps_to_the_same_bits(tmp_path: Path) -> None:
    one = engine(is_full=False)
    tables, structure = jax.tree.flatten(packed(one))

    def simulate(*leaves: jax.Array) -> list[jax.Array]:
        return jax.tree.leaves(step(one, *jax.tree.unflatten(structure, leaves)))

    program = jax.jit(simulate)
    expected = [np.asarray(table) for table in program(*tables)]
    allowed = [export.DisabledSafetyCheck.custom_call(name) for name in ffi.targets()]
    shapes = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in tables]
    exported = export.export(program, disabled_checks=allowed)(*shapes)
    (launch,) = ffi.launches_of(exported.mlir_module())
    assert (launch.num_steps, launch.num_worlds) == (3, NUM_WORLDS)
    assert launch.variant.effects == one.effects
    file = tmp_path / "program"
    file.write_bytes(pickle.dumps((bytes(exported.serialize()), [launch])))
    command = [sys.executable, exported_steps_program.__file__, str(file)]
    found = subprocess.run(
        command, env=environment_of_cpus(1), check=True, capture_output=True, text=True, timeout=PATIENCE_S
    ).stdout
    assert found.splitlines()[-len(expected) :] == [table.tobytes().hex() for table in expected]


def test_kernels_of_other_variants_have_other_names() -> None:
    full, lean = (engine(is_full=is_full) for is_full in (True, False))
    before = set(ffi.targets())
    for one in (full, lean):
        jax.eval_shape(functools.partial(step, one), *packed(one))
    names = {ffi._VARIANTS[name].effects: name for name in ffi.targets()}
    assert names[full.effects] != names[lean.effects]
    assert before <= set(ffi.targets())
