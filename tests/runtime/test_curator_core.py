"""A program that a curator compiled while it was idle is not compiled again when training waits for it."""

import dataclasses

import jax
import pytest

from kinetix_dist.learner.sharding import data_mesh
from kinetix_dist.runtime.cores.curator_core import CuratorCore
from kinetix_dist.runtime.cores.worker import Worker
from tests.runtime.runs import tiny_config


@pytest.fixture
def compiled(caplog):
    """Names of programs that were compiled since it was called last."""

    def names() -> set[str]:
        found = {record.message.split()[4] for record in caplog.records if record.message.startswith("Finished XLA")}
        caplog.clear()
        return found

    with jax.log_compiles():
        yield names


@pytest.mark.long
def test_a_prepared_curator_compiles_nothing_for_its_first_probe(compiled):
    config = tiny_config(num_updates=8)
    log = dataclasses.replace(config.curriculum_log, probe_levels=4)
    # Of no other test: what those in the same process have compiled is not compiled again.
    curriculum = dataclasses.replace(config.curriculum, scoring_steps=config.curriculum.scoring_steps + 1)
    config = dataclasses.replace(config, curriculum=curriculum, curriculum_log=log)
    worker = Worker(config, data_mesh())
    worker.start(None)
    curator = CuratorCore(config)
    header, refreshed = curator.refresh(worker.weights(), 0, 0, 1)
    assert header["probe"] == {} and "jit(play)" not in compiled()
    worker.adopt(refreshed)
    curator.prepare(config.curriculum.refresh_every)
    assert "jit(play)" in compiled()
    curator.prepare(2 * config.curriculum.refresh_every)  # after a refresh without a probe, too
    assert "jit(play)" not in compiled()
    header, _ = curator.refresh(worker.weights(), config.curriculum.refresh_every, 0, 1, worker.probe(4))
    assert header["probe"]["finished"].shape == (4,)
    assert "jit(play)" not in compiled()
