"""Commands that train keep JAX off the GPUs before they compute anything, the check of its arithmetic included.

JAX starts on all platforms that it may use, once. `JAX_PLATFORMS=absent,cpu` makes a start that is not held to the CPU
fail on every machine, as it takes GPUs on a machine that has some.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from kinetix_dist.child_python import command_of
from tests.helpers import PATIENCE_S, python_path

MISSING = "nosuch"  # a checkpoint: a run looks for it after it has prepared JAX, and before it compiles


def ended(command: list[str], folder: Path, platforms: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PYTHONPATH": python_path(), "JAX_PLATFORMS": platforms}
    return subprocess.run(
        command, env=environment, cwd=folder, capture_output=True, text=True, check=False, timeout=PATIENCE_S
    )


def test_a_start_of_jax_that_is_not_held_to_the_cpu_fails(tmp_path: Path) -> None:
    code = "from kinetix_dist.jax_checks import check_arithmetic; check_arithmetic()"
    done = ended([sys.executable, "-c", code], tmp_path, "absent,cpu")
    assert done.returncode != 0 and "Unable to initialize backend 'absent'" in done.stderr


@pytest.mark.parametrize(
    "command",
    [
        f"train --recipe tiny --from {MISSING}",
        f"bench train --recipe tiny --set run.start_from={MISSING}",
        f"bench train --recipe tiny --placement colocated --set run.start_from={MISSING}",
        f"finetune --levels s/kick --from generalist --run.start_from {MISSING}",
        f"finetune --levels s/kick --from generalist --run.placement=colocated --run.start_from {MISSING}",
    ],
)
def test_a_command_that_trains_holds_jax_to_the_cpu_first(command: str, tmp_path: Path) -> None:
    done = ended(command_of("kinetix_dist.cli.main", *command.split()), tmp_path, "absent,cpu")
    *_, line = done.stderr.splitlines()
    assert line.startswith(f"kinetix-dist: there is no checkpoint {MISSING}"), done.stderr
    assert done.returncode == 2
