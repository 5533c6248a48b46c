"""doctor answers on this machine, and on machines where something is broken."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from kinetix_dist.cli.doctor import Check, check_disk, check_gpu, check_warp
from tests.cli.test_main import run_command


@pytest.fixture(scope="module")
def report() -> dict:
    done = run_command("doctor", "--json")
    assert done.returncode == 0, done.stdout + done.stderr
    return json.loads(done.stdout)


def test_doctor_finds_that_training_can_run_here(report: dict) -> None:
    assert report["can_train"] is True
    assert not [check for check in report["checks"] if check["status"] == "error"]


def test_doctor_reports_each_thing_that_training_depends_on(report: dict) -> None:
    names = {check["name"] for check in report["checks"]}
    assert {"python", "machine", "packages", "warp", "ray", "jax", "gpu", "kernels", "disk", "ports"} <= names


def test_doctor_compiles_a_kernel_and_names_the_devices(report: dict) -> None:
    facts = {check["name"]: check["facts"] for check in report["checks"]}
    assert facts["warp"]["kernel"]["cpu"]["seconds"] >= 0.0
    assert len(facts["jax"]["devices"]) >= 1


def test_doctor_says_which_kernels_can_run_and_why_not_others(report: dict) -> None:
    (check,) = (check for check in report["checks"] if check["name"] == "kernels")
    if not check["facts"]["fused"]:
        assert check["detail"].startswith("policy.kernels: xla only (")
        assert "the kernels are written for" in check["detail"] or "the kernels need" in check["detail"]


def test_whatever_is_not_ok_comes_with_a_remedy(report: dict) -> None:
    for check in report["checks"]:
        assert check["status"] == "ok" or check["remedy"], check


def test_a_broken_jax_costs_one_check_and_the_exit_status(tmp_path: Path) -> None:
    (tmp_path / "jax.py").write_text("raise ImportError('libxla.so is broken')\n")
    done = run_command("doctor", "--json", path=tmp_path)
    assert done.returncode == 1
    report = json.loads(done.stdout)
    assert report["can_train"] is False
    broken = [check for check in report["checks"] if check["status"] == "error"]
    assert [check["name"] for check in broken] == ["jax"]
    assert "libxla.so is broken" in broken[0]["detail"]


@pytest.mark.parametrize(
    ("kernel", "status"),
    [
        ({"cpu": {"seconds": 0.1}}, "ok"),
        ({"cpu": {"error": "no compiler"}}, "error"),
        ({"cpu": {"error": "no compiler"}, "cuda:0": {"seconds": 0.1}}, "warning"),
        ({"cpu": {"error": "no compiler"}, "cuda:0": {"error": "no driver"}}, "error"),
    ],
)
def test_a_kernel_must_work_on_some_device(kernel: dict, status: str) -> None:
    probed = Check(name="warp", status="ok", detail="", facts={"kernel": kernel})
    assert check_warp(probed).status == status


def test_a_run_folder_that_cannot_be_written_is_an_error_that_names_it(tmp_path: Path) -> None:
    file = tmp_path / "a_file"
    file.touch()
    check = check_disk(file / "runs")
    assert check.status == "error"
    assert str(file) in check.detail


def test_a_gpu_that_is_asked_for_and_absent_is_an_error_with_a_remedy(report: dict) -> None:
    found = next(check for check in report["checks"] if check["name"] == "gpu")
    if found["facts"].get("gpus"):
        pytest.skip("this machine has a GPU")
    jax_on_cpu = Check(name="jax", status="ok", detail="", facts={"platform": "cpu"})
    assert check_gpu(jax_on_cpu, required=False).status == "ok"
    check = check_gpu(jax_on_cpu, required=True)
    assert check.status == "error"
    assert check.remedy
