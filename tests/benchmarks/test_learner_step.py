"""`bench learner`: its record, from a real update of a small network."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from kinetix_dist.cli.main import main


def test_a_gradient_step_is_measured(tmp_path: Path) -> None:
    file = tmp_path / "learner.json"
    small = "--size s --network flat --encoder-size 8 --worlds 8 --steps 4 --minibatch 16 --repeats 2 --dtype float32"
    assert main(["bench", "learner", *small.split(), "--json", str(file)]) == 0
    (record,) = json.loads(file.read_text())
    assert set(record) == {
        "benchmark", "device", "devices", "jax", "network", "parameters", "size", "dtype", "kernels", "minibatch",
        "gradient_steps", "compile_seconds", "milliseconds_a_gradient_step", "milliseconds_forward",
        "env_steps_per_second_bound",
    }  # fmt: skip
    assert (record["benchmark"], record["minibatch"], record["gradient_steps"]) == ("learner_step", 16, 2)
    update_seconds = 1e-3 * record["gradient_steps"] * record["milliseconds_a_gradient_step"]
    assert record["env_steps_per_second_bound"] == pytest.approx(8 * 4 / (8 * update_seconds), rel=0.01)


def test_kernels_that_cannot_run_are_one_line(capsys) -> None:
    small = "--size s --encoder-size 8 --worlds 8 --steps 4 --minibatch 16 --repeats 1 --kernels fused"
    assert main(["bench", "learner", *small.split()]) == 2
    assert "policy.kernels is 'fused', but policy.encoder_size is 8" in capsys.readouterr().err
