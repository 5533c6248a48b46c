"""Phases that change the size of levels and the curriculum: a resume on either side of a change changes no bit.

One run goes through five states of the curriculum; a checkpoint after each update is what the resumed runs start from.
"""

import dataclasses
import json
import shutil

import numpy as np
import pytest

from kinetix_dist.checkpoint import list_checkpoints, load_checkpoint, select_arrays
from kinetix_dist.config import TrainConfig, to_dict
from kinetix_dist.config.phases import PhaseConfig
from kinetix_dist.curator.config import SlicesConfig
from kinetix_dist.runtime.cores.update_metrics import BUFFER
from kinetix_dist.runtime.driver.colocated import ColocatedTrainer
from kinetix_dist.runtime.driver.refreshes import CuratorClient, WorkerCurator
from kinetix_dist.runtime.driver.split import SplitTrainer
from kinetix_dist.runtime.processes.local import LocalBackend
from kinetix_dist.runtime.processes.placement import ProcessPlan, plan_placement
from kinetix_dist.telemetry.curriculum_log import list_snapshots, read_outcomes, read_snapshot
from tests.runtime.runs import QuietReporter, assert_same_bits, final_arrays, run_updates, tiny_config
from tests.runtime.train_process import TINY, events, finish, start, wait_for

pytestmark = pytest.mark.long
STEPS = 256  # of an update
# First update of each phase -> what it changes. Before them: sfl on S.
PHASES = {
    2: {"env.size": "m"},
    5: {"env.size": "s", "curriculum.name": "sfl_slices"},
    8: {"curriculum.name": "plr"},
    10: {"curriculum.name": "fixed", "curriculum.levels": "m/unicycle_hill", "env.size": "m"},
    12: {"curriculum.name": "sfl", "curriculum.levels": "", "curriculum.generator.triangle_chance": 0.3},
}
NUM_UPDATES = 14


def _config(placement: str = "local", num_curators: int = 1) -> TrainConfig:
    config = tiny_config(
        num_updates=2 * NUM_UPDATES,  # of 128 steps
        placement=placement,
        num_curators=num_curators,
        checkpoint_every=1,
        keep_checkpoints=NUM_UPDATES + 1,
    )
    return dataclasses.replace(
        config,
        rollout=dataclasses.replace(config.rollout, num_steps=16),
        curriculum=dataclasses.replace(
            config.curriculum,
            refresh_every=2,
            adopt_after=1,
            slices=SlicesConfig(slice_size=4, attempts=(1, 2), keep_one_of=(2,)),
        ),
        phases=tuple(PhaseConfig(start=STEPS * first, options=options) for first, options in PHASES.items()),
    )


def _train(config, path, *, resume):
    """Rows of metrics of one session."""
    reporter, backend = QuietReporter(), LocalBackend()
    if config.run.placement == "split":
        trainer = SplitTrainer(config, backend, plan_placement(config, num_gpus=0))
    else:
        trainer = ColocatedTrainer(config, backend, [ProcessPlan(role="worker", index=0)])
    if config.workers_curate:
        assert isinstance(trainer, ColocatedTrainer)
        curator = WorkerCurator(trainer)
    else:
        curator = CuratorClient(config, backend, [ProcessPlan(role="curator", index=0)])
    run_updates(config, path, trainer, curator, reporter=reporter, resume=resume)
    return reporter.rows


@pytest.fixture(scope="module", params=["local", "split"])
def unbroken(request, tmp_path_factory):
    """(config, folder, rows) of a run that nothing disturbs."""
    config, path = _config(request.param), tmp_path_factory.mktemp(request.param) / "run"
    return config, path, _train(config, path, resume=False)


def test_each_state_of_the_curriculum_is_that_of_its_phase(unbroken):
    config, path, rows = unbroken
    assert [row["progress/phase"] for row in rows] == [0, 0, 1, 1, 1, 2, 2, 2, 3, 3, 4, 4, 5, 5]
    has = {name: [name in row for row in rows] for name in ("curriculum/in_use_share", "curriculum/replay_age")}
    assert has["curriculum/in_use_share"] == [5 <= update < 8 for update in range(NUM_UPDATES)]
    assert has["curriculum/replay_age"] == [8 <= update < 10 for update in range(NUM_UPDATES)]
    assert ["curriculum/buffer_is_stale" in row for row in rows] == [not 8 <= u < 12 for u in range(NUM_UPDATES)]
    # By source: a buffer, or levels that are played again, and fresh ones; a set has one source.
    sources = [{name for name in (BUFFER, "replayed", "fresh") if f"train/solve_rate_of_{name}" in row} for row in rows]
    assert sources == 8 * [{BUFFER, "fresh"}] + 2 * [{"replayed", "fresh"}] + 2 * [set()] + 2 * [{BUFFER, "fresh"}]
    adopted = [(event["policy_version"], event["update"]) for event in events(path, "buffer_adopted")]
    lag = config.run.policy_lag
    assert [first for version, first in adopted if config.refresh_times.is_first(version)] == [0, 2, 5, 12]
    assert [version for version, _ in adopted if config.refresh_times.is_first(version)] == [
        0,
        2 - lag,
        5 - lag,
        12 - lag,
    ]


def test_parameters_and_optimiser_go_on(unbroken):
    config, path, _ = unbroken
    assert final_arrays(path)["learner/num_updates"] == NUM_UPDATES
    shapes = []
    for checkpoint in list_checkpoints(path / "checkpoints"):
        arrays = select_arrays(load_checkpoint(checkpoint).arrays, "learner")
        shapes.append({name: array.shape for name, array in arrays.items()})
        (count,) = (array for name, array in arrays.items() if name.endswith("count"))
        assert count == int(checkpoint.name) * config.ppo.epochs * config.ppo.minibatches
    assert len(shapes) == NUM_UPDATES and all(each == shapes[0] for each in shapes)


def test_what_is_logged_of_a_curriculum_names_it_and_its_size(unbroken):
    config, path, _ = unbroken
    found = {}
    for _, number, file in list_snapshots(path / "curriculum"):
        arrays = read_snapshot(file).arrays
        found[number] = (str(arrays["curriculum"]), str(arrays["size"]))
    times = config.refresh_times
    expected = {}
    for version in range(NUM_UPDATES):
        if times.is_due(version) and times.adopted_at(version) < NUM_UPDATES:
            phase = config.schedule.at(times.adopted_at(version)).config
            expected[version] = (phase.curriculum.name, phase.env.size)
    assert found.items() >= expected.items()
    windows = [
        (line["from_update"], line["update"], "buffer" in line)
        for line in read_outcomes(path / "curriculum" / "outcomes.jsonl")
    ]
    assert windows[-3:] == [(8, 10, False), (10, 12, False), (12, 14, True)]


@pytest.mark.parametrize(
    "saved_at", [2, 4, 5, 8, 10, 13, *(pytest.param(update, marks=pytest.mark.slow) for update in (1, 6, 12))]
)
def test_a_run_resumed_at_a_change_or_next_to_it_equals_the_unbroken_one(unbroken, tmp_path, saved_at):
    config, path, rows = unbroken
    shutil.copytree(path, tmp_path / "cut")
    for checkpoint in list_checkpoints(tmp_path / "cut" / "checkpoints"):
        if int(checkpoint.name) > saved_at:
            shutil.rmtree(checkpoint)
    resumed = _train(config, tmp_path / "cut", resume=True)
    compared = ("train/", "learner/", "curriculum/", "progress/env_steps", "progress/phase")
    for ours, theirs in zip(resumed, rows[saved_at:], strict=True):
        names = [name for name in theirs if name.startswith(compared) and "second" not in name]
        np.testing.assert_equal({name: ours[name] for name in names}, {name: theirs[name] for name in names})
    assert_same_bits(final_arrays(tmp_path / "cut"), final_arrays(path))


@pytest.mark.parametrize("unbroken", ["local"], indirect=True)
def test_workers_that_score_levels_make_the_same_run(unbroken, tmp_path):
    _, path, _ = unbroken
    _train(_config(num_curators=0), tmp_path / "run", resume=False)
    assert_same_bits(final_arrays(tmp_path / "run"), final_arrays(path))


class _LateOnce(CuratorClient):
    """Its second refresh is late at the first look, and there at the next."""

    num_late = 0

    def take(self, *, patience_s, meanwhile=lambda: None):
        if patience_s is not None and not self.num_late:
            self.num_late += 1
            return None
        return super().take(patience_s=patience_s, meanwhile=meanwhile)


def test_a_late_buffer_is_given_up_when_its_state_is_over(tmp_path):
    """Requested at 2, it is due at 3, late there, and there at 4: with which random levels alone begin."""
    phase = PhaseConfig(start=STEPS * 4, options={"curriculum.name": "domain_randomization"})
    config = dataclasses.replace(_config(), phases=(phase,))
    config = dataclasses.replace(config, run=dataclasses.replace(config.run, total_env_steps=6 * STEPS))
    backend, reporter = LocalBackend(), QuietReporter()
    trainer = ColocatedTrainer(config, backend, [ProcessPlan(role="worker", index=0)])
    curator = _LateOnce(config, backend, [ProcessPlan(role="curator", index=0)])
    run_updates(config, tmp_path / "run", trainer, curator, reporter=reporter)
    assert curator.num_late == 1
    assert [event["policy_version"] for event in events(tmp_path / "run", "buffer_adopted")] == [0]
    assert [(event["policy_version"], event["update"]) for event in events(tmp_path / "run", "refresh_lost")] == [
        (2, 4)
    ]
    stale = [row.get("curriculum/buffer_is_stale") for row in reporter.rows]
    assert stale == [0, 0, 0, 1, None, None]


@pytest.mark.slow
@pytest.mark.parametrize("unbroken", ["local", "split"], indirect=True)
def test_a_run_in_processes_of_ray_killed_at_a_change_and_resumed_equals_the_local_one(unbroken, tmp_path):
    """SIGKILL for the command once the checkpoint before another size is there."""
    config, path, _ = unbroken
    (tmp_path / "phases.json").write_text(json.dumps({"phases": to_dict(config)["phases"]}))
    placement = "split" if config.run.placement == "split" else "colocated"
    options = {
        "run.placement": placement,
        "run.num_workers": 1,
        "run.checkpoint_every": 1,
        "run.keep_checkpoints": NUM_UPDATES + 1,
        "run.total_env_steps": config.run.total_env_steps,
        "rollout.num_steps": 16,
        "curriculum.refresh_every": 2,
        "curriculum.adopt_after": 1,
        "curriculum.slices.slice_size": 4,
        "curriculum.slices.attempts": "1 2",
        "curriculum.slices.keep_one_of": "2",
    }
    words = [word for name, value in options.items() for word in (f"--{name}", *str(value).split())]
    process = start(tmp_path / "run", *TINY, "--phases", str(tmp_path / "phases.json"), *words)
    checkpoints = tmp_path / "run" / "checkpoints"
    wait_for(lambda: any(int(saved.name) >= 5 for saved in list_checkpoints(checkpoints)), process, "checkpoint 5")
    process.kill()
    process.wait()
    finish(start(tmp_path / "run", "--resume"))
    assert_same_bits(final_arrays(tmp_path / "run"), final_arrays(path))
