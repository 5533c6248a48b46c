"""The wheel is complete: what is not Python is in it, and its commands run where there is no checkout."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import sysconfig
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.helpers import REPOSITORY

pytestmark = pytest.mark.skipif(importlib.util.find_spec("hatchling") is None, reason="hatchling is not installed")

ENTRY_POINT = "bin/kinetix-dist"
RUN_SECONDS = 900


def files_below(*directories: str) -> Iterator[str]:
    """Paths of all files in directories of the repository, relative to it; without what running leaves there."""
    for directory in directories:
        for file in sorted((REPOSITORY / directory).rglob("*")):
            if file.is_file() and "__pycache__" not in file.parts:
                yield file.relative_to(REPOSITORY).as_posix()


def test_the_wheel_has_every_file_of_the_packages_and_the_data() -> None:
    from hatchling.builders.wheel import WheelBuilder

    in_wheel = {file.distribution_path for file in WheelBuilder(str(REPOSITORY)).recurse_included_files()}
    packages = set(files_below("jax2d", "kinetix_dist"))
    data = {
        f"kinetix_dist/data/{name}" for name in files_below("levels", "pretrained/generalist", "pretrained/random_only")
    }
    assert in_wheel == packages | data
    assert {
        "jax2d/py.typed",
        "jax2d/warp/native/step.h",
        "jax2d/fidelity/references.json",
        "kinetix_dist/py.typed",
        "kinetix_dist/telemetry/rollout.proto",
        "kinetix_dist/data/levels/sets.toml",
        "kinetix_dist/data/levels/s/hop_home.json",
        "kinetix_dist/data/pretrained/generalist/manifest.json",
    } <= in_wheel


def test_an_editable_installation_copies_nothing(tmp_path: Path) -> None:
    import zipfile

    from hatchling.builders.wheel import WheelBuilder

    (wheel,) = WheelBuilder(str(REPOSITORY)).build(directory=str(tmp_path), versions=["editable"])
    with zipfile.ZipFile(wheel) as archive:
        outside = [name for name in archive.namelist() if ".dist-info/" not in name]
        assert len(outside) == 1 and archive.read(outside[0]).decode().strip() == str(REPOSITORY)


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An environment with the wheel, and the packages of this one behind it."""
    from hatchling.builders.wheel import WheelBuilder

    folder = tmp_path_factory.mktemp("wheel")
    (wheel,) = WheelBuilder(str(REPOSITORY)).build(directory=str(folder), versions=["standard"])
    environment = folder / "environment"
    run_command([sys.executable, "-m", "venv", "--without-pip", str(environment)], cwd=folder)
    python = environment / "bin" / "python"
    site = run_command(
        [str(python), "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"], cwd=folder
    ).strip()
    # A path file adds a directory, but not the path files there: this project's own installation stays out.
    here = {sysconfig.get_path("purelib"), sysconfig.get_path("platlib")}
    Path(site, "packages_of_the_tests.pth").write_text("\n".join(sorted(here)) + "\n")
    run_command([sys.executable, "-m", "uv", "pip", "install", "--quiet", "--offline", "--no-deps", "--python",
                 str(python), wheel], cwd=folder)  # fmt: skip
    found = run_command([str(python), "-c", "import kinetix_dist, jax2d; print(jax2d.__path__[0])"], cwd=folder)
    assert found.strip().startswith(site), found
    return environment


def run_command(command: list[str], cwd: Path) -> str:
    """stdout; fails with stderr unless the exit status is 0. No variable leads to the checkout."""
    environment = {
        name: value
        for name, value in os.environ.items()
        if name not in ("PYTHONPATH", "KINETIX_DIST_LEVELS", "KINETIX_LEVELS")
    }
    done = subprocess.run(
        command, capture_output=True, text=True, cwd=cwd, env=environment, timeout=RUN_SECONDS, check=False
    )
    assert done.returncode == 0, f"{' '.join(command)}\n{done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.mark.slow
def test_commands_run_in_an_empty_directory(installed: Path, tmp_path: Path) -> None:
    def kinetix_dist(*arguments: str) -> str:
        return run_command([str(installed / ENTRY_POINT), *arguments], cwd=tmp_path)

    assert "designed_s" in kinetix_dist("levels", "list")
    levels = next(installed.glob("lib/*/site-packages/kinetix_dist/data/levels"))
    assert "files are valid" in kinetix_dist("levels", "validate", "--no-play", str(levels))
    rates = kinetix_dist(
        "eval", "--checkpoint", "generalist", "--levels", "s/hop_home", "--attempts", "1", "--no-baselines"
    )
    assert "all, trained" in rates and str(installed) in rates
    kinetix_dist("train", "--recipe", "tiny", "--run", "run", "--recording.num_rollouts", "1",
                 "--evaluation.sets", "s/kick", "--evaluation.min_attempts", "4")  # fmt: skip
    assert (tmp_path / "run" / "report.json").is_file()
    kinetix_dist("replay", "run", "--to", "rollout.rrd")
    assert (tmp_path / "rollout.rrd").stat().st_size > 0
