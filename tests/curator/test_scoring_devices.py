"""Candidates scored in some number of parts, each on some number of devices, make the same buffer, bit for bit."""

import subprocess
import sys

import numpy as np
import pytest

from tests.curator.scoring_program import BATCH, KEPT
from tests.helpers import REPOSITORY, environment_of_cpus

PROGRAM = REPOSITORY / "tests" / "curator" / "scoring_program.py"


@pytest.mark.long
@pytest.mark.parametrize(
    ("curriculum", "counts"),
    [
        ("sfl", "1x1 3x1 1x2"),
        pytest.param("sfl", "1x1 2x2 4x1 1x3", marks=pytest.mark.slow),
        pytest.param("sfl_slices", "1x1 3x1 1x4", marks=pytest.mark.slow),
    ],
)
def test_the_buffer_is_the_same_however_many_processes_and_devices_score(tmp_path, curriculum, counts):
    """Four batches of candidates; three parts or devices cannot share them evenly. counts: parts x devices."""
    counts = counts.split()
    num_devices = max(int(count.split("x")[1]) for count in counts)
    out = tmp_path / "out.npz"
    command = [sys.executable, str(PROGRAM), str(out), curriculum, *counts]
    done = subprocess.run(command, env=environment_of_cpus(num_devices), capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-3000:]
    arrays = dict(np.load(out))
    names = [name.removeprefix("1x1/") for name in arrays if name.startswith("1x1/")]
    assert len(names) > 10
    for count in counts[1:]:
        for name in names:
            np.testing.assert_array_equal(arrays[f"{count}/{name}"], arrays[f"1x1/{name}"], err_msg=name)
    # There was something to choose, in batches of several devices.
    chosen, score = arrays["1x1/candidate"], arrays["1x1/score"]
    assert len(set(chosen)) == KEPT and np.all(np.diff(score) <= 0)
    assert len(set(chosen[score > 0] // BATCH)) > 1
