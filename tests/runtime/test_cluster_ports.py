"""Every socket that a Ray cluster and a run on it listen on is named in cluster/README.md, with its port."""

from __future__ import annotations

import re
from collections.abc import Iterator

import psutil
import pytest

from tests.helpers import REPOSITORY
from tests.runtime.raylets import Raylets
from tests.runtime.sockets import family
from tests.runtime.train_process import TINY, rows, start, wait_for

README = REPOSITORY / "cluster" / "README.md"
NUM_WORKER_PORTS = 100
pytestmark = pytest.mark.slow  # a fault test: two Ray nodes, as cluster/README.md starts them


def documented() -> list[str]:
    """Command lines or titles of the documented sockets, in the order of the table."""
    table = README.read_text().split("### Ports and tokens")[1].split("\n### ")[0]
    names = re.findall(r"^\| `([^`]+)` \|", table, re.MULTILINE)
    assert len(names) >= 8, "the table of ports is gone"
    return names


def options_of(base: int) -> list[str]:
    """The flags of cluster/README.md with ports from `base` on; two nodes of one machine cannot have the same ports."""
    flags = re.findall(r"(--[a-z-]+)=\d+", README.read_text().split('PORTS="')[1].split('"')[0])
    ranges = {"--min-worker-port": base + 50, "--max-worker-port": base + 50 + NUM_WORKER_PORTS - 1}
    return [f"{flag}={ranges.get(flag, base + i)}" for i, flag in enumerate(flags)]


def free_base() -> int:
    """First of 200 ports without a listener, below those that the kernel gives away."""
    taken = {c.laddr.port for c in psutil.net_connections("inet") if c.laddr}
    return next(base for base in range(21_000, 32_000, 200) if not taken & set(range(base, base + 200)))


@pytest.fixture
def raylets(tmp_path, monkeypatch) -> Iterator[tuple[Raylets, set[int]]]:
    """Two nodes, and the ports that they may listen on."""
    monkeypatch.setenv("HOME", str(tmp_path))
    bases = [free_base()]
    metrics = {"AUTOSCALER_METRIC_PORT": bases[0] + 40, "DASHBOARD_METRIC_PORT": bases[0] + 41}
    nodes = Raylets(tmp_path / "ray", {name: str(port) for name, port in metrics.items()})
    try:
        nodes.start_head("--num-cpus=2", f"--ray-client-server-port={bases[0] + 42}", *options_of(bases[0]))
        bases.append(free_base())
        nodes.start_node("--num-cpus=2", *options_of(bases[1]))
        allowed = {port for base in bases for port in range(base, base + 50 + NUM_WORKER_PORTS)}
        yield nodes, allowed | {int(nodes.address.rpartition(":")[2])}
    finally:
        nodes.stop()


def test_each_socket_of_a_cluster_and_of_a_run_on_it_is_in_the_table_of_ports(raylets, tmp_path, monkeypatch):
    nodes, allowed = raylets
    monkeypatch.setenv("RAY_ADDRESS", nodes.address)
    options = ["--run.placement", "colocated", "--run.num_workers", "2", "--run.total_env_steps", "10000000"]
    run = tmp_path / "run"
    process = start(run, *TINY, *options)
    known, found = documented(), []
    try:
        wait_for(lambda: bool(rows(run)), process, "an update")
        for member in {m.pid: m for pid in (*nodes.pids, process.pid) for m in family(pid)}.values():
            title = f"{member.name()} {' '.join(member.cmdline())}"
            for connection in member.net_connections("inet"):
                if connection.status == psutil.CONN_LISTEN:
                    ip = connection.laddr.ip.removeprefix("::ffff:")
                    found.append((next((name for name in known if name in title), title), ip, connection.laddr.port))
    finally:
        process.kill()
        process.communicate()
    assert not {name for name, _, _ in found} - set(known), found
    assert {"gcs_server", "raylet", "ray::DashboardAgent", "ray::"} <= {name for name, _, _ in found}
    assert not [socket for socket in found if socket[0] != "ray::" and socket[2] not in allowed]
    # What JAX and its collectives listen on is not on all interfaces, and its port is the kernel's.
    others = {ip for name, ip, port in found if name == "ray::" and port not in allowed}
    assert others and others <= {"127.0.0.1", nodes.address.partition(":")[0]}, others
