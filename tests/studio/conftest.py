"""Engine worker shared by all tests of this directory that do not end it."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from bench.worker_client import Client


@pytest.fixture
def worker(shared_worker: Client) -> Iterator[Client]:
    """No session is open."""
    yield shared_worker
    shared_worker.close_sessions()


@pytest.fixture(scope="session")
def shared_worker(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Client]:
    client = Client(log=tmp_path_factory.mktemp("worker") / "log")
    yield client
    assert client.close() == 0
