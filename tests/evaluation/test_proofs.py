"""Every designed level ships with a proof, and the proof does what it claims."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from kinetix_dist.env.environment import EnvConfig, Environment
from kinetix_dist.evaluation.proofs import fault_of_replay, replay
from kinetix_dist.level.level import SIZES, Level
from kinetix_dist.level.level_data import levels_root
from kinetix_dist.level.proof import Proof, check_proof_is_of, proof_path, read_proof
from kinetix_dist.level.schema import load_level
from kinetix_dist.level.sets import files_of_set
from kinetix_dist.level.validate import read_document
from kinetix_dist.telemetry.recording import Rollout
from tests.helpers import REPOSITORY, environment_of_cpus

OPTIMISED = True  # proofs hold with the rounding of programs as users compile them: see tests/conftest.py

Replayed = tuple[list[Proof], list[Rollout], list[Rollout]]


def levels_and_proofs(size: str) -> tuple[list[Path], list[Level], list[Proof]]:
    files = files_of_set(f"all_designed_{size}")
    return files, [load_level(file)[0] for file in files], [read_proof(proof_path(file)) for file in files]


@pytest.fixture(scope="module", params=SIZES)
def replayed(request: pytest.FixtureRequest) -> Replayed:
    """The proofs of a size and two replays of them, the second with the levels in the opposite order."""
    env = Environment(EnvConfig(size=request.param))
    _, levels, proofs = levels_and_proofs(request.param)
    return proofs, replay(env, levels, proofs), replay(env, levels[::-1], proofs[::-1])[::-1]


@pytest.mark.also_gpu
def test_every_proof_solves_its_level(replayed: Replayed) -> None:
    proofs, rollouts, _ = replayed
    faults = {proof.level: fault_of_replay(proof, rollout) for proof, rollout in zip(proofs, rollouts)}
    assert not {level: fault for level, fault in faults.items() if fault}


def test_a_replay_is_the_same_bit_for_bit_wherever_the_level_stands_in_the_batch(replayed: Replayed) -> None:
    _, rollouts, again = replayed
    for first, second in zip(rollouts, again):
        for field in ("position", "angle", "velocity", "angular_velocity", "reward"):
            np.testing.assert_array_equal(getattr(first, field), getattr(second, field), err_msg=first.level_name)


@pytest.mark.long
@pytest.mark.parametrize(
    "size", ["s", pytest.param("m", marks=pytest.mark.slow), pytest.param("l", marks=pytest.mark.slow)]
)
def test_as_users_run_it_every_proof_takes_exactly_as_many_steps_as_it_says(size: str) -> None:
    """Uses the flags of XLA and the optimisations that users have, which tests have not."""
    command = [sys.executable, "-m", "kinetix_dist.cli.main", "levels", "solve", f"all_designed_{size}", "--check"]
    command += ["--worlds", "32"]  # of slightly different starts, which are not what this is about
    environment = {**environment_of_cpus(1), "XLA_FLAGS": "", "JAX_DISABLE_MOST_OPTIMIZATIONS": "false"}
    done = subprocess.run(command, env=environment, cwd=REPOSITORY, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    _, _, proofs = levels_and_proofs(size)
    lines = [line.partition(", also from ")[0] for line in done.stdout.splitlines()[:-1]]
    assert lines == [f"{proof.level}: solved in {proof.num_steps} steps" for proof in proofs]


def test_a_proof_with_its_last_step_left_out_proves_nothing(replayed: Replayed) -> None:
    """The step that is said to solve a level is the one that does: no earlier state is solved."""
    _, rollouts, _ = replayed
    for rollout in rollouts:
        assert rollout.reward[-1] > 0.9 > np.abs(rollout.reward[:-1]).max(initial=0.0)


@pytest.mark.parametrize("size", SIZES)
def test_proofs_are_of_the_levels_as_they_are(size: str) -> None:
    config = EnvConfig(size=size)
    files, _, proofs = levels_and_proofs(size)
    for file, proof in zip(files, proofs):
        assert proof.level == file.stem
        check_proof_is_of(
            proof,
            file,
            read_document(file),
            preset="standard",
            frame_skip=config.frame_skip,
            max_steps=config.max_steps,
        )
    stored = {path.stem for path in (levels_root() / "proofs" / size).glob("*.json")}
    assert stored == {file.stem for file in files}


def test_a_proof_that_does_not_solve_its_level_is_found_out() -> None:
    """The proof of one level, played in another."""
    env = Environment(EnvConfig(size="s"))
    _, levels, proofs = levels_and_proofs("s")
    fault = fault_of_replay(proofs[0], replay(env, levels[1:2], proofs[:1])[0])
    assert fault is not None and f"claims to solve it in {proofs[0].num_steps} steps; replayed, it is" in fault
