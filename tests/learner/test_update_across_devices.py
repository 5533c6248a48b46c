"""One device, several devices of one process and two processes over gloo make the same update."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from kinetix_dist.learner.update import METRICS
from tests.helpers import REPOSITORY, environment_of_cpus, python_path
from tests.learner.update_program import PPO

PROGRAM = REPOSITORY / "tests" / "learner" / "update_program.py"
TIMEOUT_S = 240


def _start(out: Path, *arguments: str, fake_devices: int = 1) -> subprocess.Popen:
    return _start_with(out, *arguments, **environment_of_cpus(fake_devices))


def _start_with(out: Path, *arguments: str, **variables: str) -> subprocess.Popen:
    environment = os.environ | {"PYTHONPATH": python_path()} | variables
    command = [sys.executable, str(PROGRAM), str(out), *arguments]
    return subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)


def _results(*runs: tuple[subprocess.Popen, Path]) -> list[dict[str, np.ndarray]]:
    try:
        for process, _ in runs:
            _, errors = process.communicate(timeout=TIMEOUT_S)
            assert process.returncode == 0, errors[-3000:]
    finally:
        for process, _ in runs:
            process.kill()
    return [dict(np.load(out)) for _, out in runs]


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture(scope="module")
def one_device(tmp_path_factory):
    out = tmp_path_factory.mktemp("one") / "out.npz"
    return _results((_start(out), out))[0]


def _assert_same(found: dict[str, np.ndarray], expected: dict[str, np.ndarray]) -> None:
    for number in (0, 1):
        # Six Adam steps of 1e-2 in float32: sums in another order change gradients by 1e-7 relative, which Adam
        # magnifies where a gradient is near its epsilon.
        np.testing.assert_allclose(found[f"params_{number}"], expected[f"params_{number}"], atol=5e-5)
        for name in METRICS:
            np.testing.assert_allclose(
                found[f"{name}_{number}"], expected[f"{name}_{number}"], rtol=1e-3, atol=1e-5, err_msg=name
            )
    for name in ("dormant_share", "actor_feature_rank", "critic_feature_rank"):  # counts, of the same samples
        assert found[name] == expected[name], name
    assert found["actor_feature_rank"] > 1
    np.testing.assert_allclose(found["weight_norm"], expected["weight_norm"], rtol=1e-6)  # the order of a sum
    assert found["skipped_steps_0"] == 0
    assert found["skipped_steps_1"] == PPO.epochs  # every rank skipped the minibatches with the broken sample
    assert np.all(np.isfinite(found["params_1"]))
    assert not np.allclose(found["params_0"], found["params_1"], atol=1e-3)


@pytest.mark.long
@pytest.mark.parametrize("count", [*(pytest.param(count, marks=pytest.mark.slow) for count in (3, 4)), 7])
def test_several_devices_make_the_update_of_one(one_device, tmp_path, count):
    """Eight virtual shards: 3 and 7 devices cannot share them evenly."""
    out = tmp_path / "several.npz"
    (found,) = _results((_start(out, fake_devices=count), out))
    assert found["devices"] == count
    _assert_same(found, one_device)


@pytest.mark.gpu
def test_all_gpus_make_the_update_of_one(tmp_path):
    if (count := jax.local_device_count()) < 2:
        pytest.skip(f"needs two GPUs or more; there is {count}")
    count = min(count, PPO.virtual_shards)
    outs = [tmp_path / name for name in ("one.npz", "all.npz")]
    visible = os.environ.get("CUDA_VISIBLE_DEVICES", ",".join(str(i) for i in range(count))).split(",")
    one, several = (
        _results((_start_with(out, CUDA_VISIBLE_DEVICES=",".join(visible[:n])), out))[0]
        for out, n in zip(outs, (1, count))
    )
    assert (one["devices"], several["devices"]) == (1, count)
    _assert_same(several, one)


@pytest.mark.parametrize(
    "variables",
    [pytest.param({}, id="traced", marks=pytest.mark.long), pytest.param({"EXPORTED_UPDATE": "1"}, id="exported")],
)
def test_two_processes_make_the_update_of_one(one_device, tmp_path, variables):
    address = f"127.0.0.1:{_free_port()}"
    outs = [tmp_path / f"rank_{rank}.npz" for rank in range(2)]
    variables = environment_of_cpus(1) | variables
    runs = [(_start_with(out, address, "2", str(rank), **variables), out) for rank, out in enumerate(outs)]
    first, second = _results(*runs)
    assert first["devices"] == second["devices"] == 2
    _assert_same(first, one_device)
    for name, value in first.items():
        np.testing.assert_array_equal(value, second[name], err_msg=name)  # ranks agree bitwise


@pytest.mark.slow  # the same division as of other policies, with samples in another order
def test_three_devices_make_the_update_of_one_for_a_recurrent_policy(tmp_path):
    """Four virtual shards on three devices: two of them are there twice and count once."""
    one, three = tmp_path / "one.npz", tmp_path / "three.npz"
    (expected,) = _results((_start(one, "recurrent"), one))
    (found,) = _results((_start(three, "recurrent", fake_devices=3), three))
    assert found["devices"] == 3
    _assert_same(found, expected)
