"""Refusals of a cluster at the start, in one line with exit status 2. Real raylets by `ray start`."""

import os
import shutil
import subprocess

import pytest
import ray

from kinetix_dist.cli.main import main
from kinetix_dist.errors import one_line
from kinetix_dist.runtime.processes.placement import PlacementError
from kinetix_dist.runtime.processes.provenance import check_nodes, versions_and_code
from tests.helpers import REPOSITORY
from tests.runtime.raylets import Raylets

TINY = ["train", "--recipe", "tiny", "--evaluation.sets", "s/kick", "--run.placement", "colocated"]


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    """A head with 8 CPU slots and one slot of a GPU."""
    raylets = Raylets(tmp_path_factory.mktemp("raylets") / "log")
    try:
        raylets.start_head("--num-cpus=8", "--num-gpus=1")
        yield raylets
    finally:
        raylets.stop()


@pytest.fixture
def joined(cluster, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)  # Ray lets workers import from the driver's directory first, on its own machine
    ray.init(address=cluster.address, log_to_driver=False)
    yield cluster
    ray.shutdown()


def _refusal(cluster, monkeypatch, capfd, *arguments) -> str:
    monkeypatch.setenv("RAY_ADDRESS", cluster.address)
    assert main([*TINY, *map(str, arguments)]) == 2
    ray.shutdown()
    lines = [line for line in capfd.readouterr().err.splitlines() if line.startswith("kinetix-dist: ")]
    assert len(lines) == 1
    return lines[0]


@pytest.mark.long
def test_nodes_of_the_same_code_that_see_the_run_directory_are_well(joined, tmp_path):
    check_nodes(tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_placement_that_the_gpus_of_a_cluster_cannot_hold(cluster, monkeypatch, capfd, tmp_path):
    options = ("--run", tmp_path / "run", "--run.device", "gpu", "--run.num_workers", "2")
    line = _refusal(cluster, monkeypatch, capfd, *options)
    assert "run.num_workers 2 needs as many GPUs; there are 1" in line
    assert not (tmp_path / "run" / "config.json").exists()


def test_a_cluster_of_another_ray(cluster, monkeypatch, capfd, tmp_path):
    """The driver says that it is of another version; the cluster and Ray's own check are real."""
    monkeypatch.setattr(ray, "__version__", "2.0.0")
    line = _refusal(cluster, monkeypatch, capfd, "--run", tmp_path / "run")
    assert "is of other versions: The cluster was started with: Ray: 2." in line and "Ray: 2.0.0" in line


@pytest.mark.long
def test_a_node_of_another_checkout_and_one_that_does_not_see_the_run_directory(joined, tmp_path):
    """A node in a mount namespace of its own, where something else is mounted at the path of the run directory; it
    imports from links to this checkout, then from a copy with another line."""
    shared, other = tmp_path / "shared", tmp_path / "other"
    shared.mkdir()
    other.mkdir()
    for package in ("jax2d", "kinetix_dist"):
        (other / package).symlink_to(REPOSITORY / package)
    within = ["unshare", "--map-root-user", "--mount", "sh", "-c", f'mount -t tmpfs none "{shared}" && exec "$@"', "sh"]
    has_namespaces = subprocess.run([*within, "true"], capture_output=True, check=False).returncode == 0
    environment = {"PYTHONPATH": str(other)}
    joined.start_node("--num-cpus=1", environment=environment, within=within if has_namespaces else ())
    try:
        check_nodes(tmp_path)
        if has_namespaces:
            with pytest.raises(PlacementError, match=r"is not shared: node .* cannot see what .* writes there; give"):
                check_nodes(shared)
        (other / "jax2d").unlink()
        shutil.copytree(REPOSITORY / "jax2d", other / "jax2d", ignore=shutil.ignore_patterns("__pycache__"))
        with (other / "jax2d" / "settings.py").open("a") as file:
            file.write("# another line\n")
        with pytest.raises(PlacementError) as caught:
            check_nodes(tmp_path)
    finally:
        joined.stop_last()
    line = one_line(caught.value)
    assert line.startswith("node ") and "give all nodes the same checkout" in line
    assert "engine " in line and f" there and {versions_and_code()['engine']} here" in line and "code " not in line
    assert os.listdir(shared) == []
