"""`bench.step_profile`: kernels of a trace by the instructions of a program, and what is refused."""

from __future__ import annotations

import gzip
import json
import subprocess
import sys
from pathlib import Path

import pytest

from bench.compiled_traffic import CompiledText, launches_of, loop_body
from bench.step_profile import kernel_microseconds, table
from tests.bench.test_learner_traffic import TEXT


def test_microseconds_are_summed_by_instruction(tmp_path: Path) -> None:
    events = [
        {"ph": "X", "dur": 1.5, "args": {"hlo_op": "step"}},
        {"ph": "X", "dur": 2.0, "args": {"hlo_op": "step"}},
        {"ph": "X", "dur": 9.0, "args": {}},  # a transfer
        {"ph": "M", "args": {"hlo_op": "step"}},
        {"ph": "X", "dur": 4.0, "args": {"hlo_op": "product"}},
    ]
    file = tmp_path / "plugins" / "vm.trace.json.gz"
    file.parent.mkdir()
    with gzip.open(file, "wt") as stream:
        json.dump({"traceEvents": events}, stream)
    assert kernel_microseconds(tmp_path) == {"step": 3.5, "product": 4.0}


def test_a_loop_is_found_by_its_iterations() -> None:
    program = CompiledText(TEXT)
    assert [launch.name for launch in launches_of(program, loop_body(program, 3))] == ["step", "product"]
    with pytest.raises(ValueError, match="no loop of 4 iterations"):
        loop_body(program, 4)


def test_the_table_adds_up_what_belongs_together() -> None:
    def kernel(name: str, part: str, microseconds: float, megabytes: float) -> dict:
        return {
            "name": name,
            "part": part,
            "source": f"{part}.py:f",
            "microseconds": microseconds,
            "bytes": megabytes * 1e6,
        }

    record = {
        "recipe": "pretrain_m",
        "network": "transformer",
        "policy_kernels": "xla",
        "program": "rollout",
        "worlds": 64,
        "minibatch": 64,
        "device": "a device",
        "microseconds_a_step": 40.0,
        "microseconds_outside_of_the_loop": 5.0,
        "kernels": [kernel("a", "policy", 20.0, 43.0), kernel("b", "engine", 10.0, 1.0), kernel("c", "policy", 5.0, 0)],
        "outside": {"reset": 5.0},
    }
    lines = [line.split() for line in table(record, rows=1).splitlines()]
    assert ["35.0", "us", "10.2", "44.0", "MB", "3", "all", "kernels", "of", "a", "step"] in lines
    assert ["25.0", "us", "10.0", "43.0", "MB", "2", "policy"] in lines
    assert ["20.0", "us", "10.0", "43.0", "MB", "1", "policy:", "policy.py:f", "(a)"] in lines
    assert not any("(b)" in line for line in lines)


@pytest.mark.parametrize(
    "options, said",
    [
        (("--steps", "0"), "must be 1 or more"),
        (("--worlds", "64"), "buffer_share"),
        (("--text", "not/there"), "is no folder"),
        (("--recipes", "nonsense"), "nonsense"),
    ],
)
def test_bad_options_are_one_line(options: tuple[str, ...], said: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "bench.step_profile", *options], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 2
    assert said in done.stderr and "Traceback" not in done.stderr and len(done.stderr.strip().splitlines()) == 1
