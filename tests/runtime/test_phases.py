"""Phases of a run: what they change and when, what is refused, and that a resume on either side changes no bit."""

import dataclasses
import json
import shutil

import numpy as np
import pytest

from kinetix_dist.checkpoint import CheckpointError, list_checkpoints, load_checkpoint, select_arrays
from kinetix_dist.config import TrainConfig, differences, from_dict, to_dict
from kinetix_dist.config.phases import PhaseConfig
from kinetix_dist.models.added_layers import GATE_BIAS
from kinetix_dist.runtime.driver.checkpoints import lineage_from, starting_point
from kinetix_dist.runtime.driver.colocated import ColocatedTrainer
from kinetix_dist.runtime.driver.controller import Controller, Roles
from kinetix_dist.runtime.driver.refreshes import CuratorClient
from kinetix_dist.runtime.driver.run_directory import RunDirectory
from kinetix_dist.runtime.driver.split import SplitTrainer
from kinetix_dist.runtime.processes.local import LocalBackend
from kinetix_dist.runtime.processes.placement import ProcessPlan, plan_placement
from tests.runtime.runs import NotingReporter, assert_same_bits, final_arrays, tiny_config
from tests.runtime.train_process import TINY, events, finish, start, wait_for

STEPS = 128  # environment steps of an update before the last phase, 256 in it
# Update 1 is the first with other steps of PPO, update 3 the first with more worlds and another reward.
PHASES = (
    PhaseConfig(
        start=100,
        options={
            "ppo.learning_rate": 3e-3,
            "ppo.clip": 0.1,
            "ppo.entropy_coefficient": 0.02,
            "ppo.minibatches": 4,
            "ppo.epochs": 1,
        },
    ),
    PhaseConfig(
        start=3 * STEPS,
        options={"rollout.num_envs": 32, "env.reward": "sparse", "env.failure_penalty": 0.0},
    ),
)
NUM_UPDATES = 5


def _config(placement: str = "local", phases: tuple[PhaseConfig, ...] = PHASES) -> TrainConfig:
    run = {"placement": placement, "checkpoint_every": 1, "keep_checkpoints": NUM_UPDATES + 1}
    config = tiny_config(num_updates=NUM_UPDATES, **run, total_env_steps=3 * STEPS + 2 * 2 * STEPS)
    return dataclasses.replace(config, phases=phases)


# What is in force


def test_a_phase_begins_with_the_first_update_at_or_after_its_start():
    schedule = _config().schedule
    assert [schedule.at(update).number for update in range(6)] == [0, 1, 1, 2, 2, 2]
    assert [schedule.env_steps(number) for number in range(6)] == [0, 128, 256, 384, 640, 896]
    first, second, third = (schedule.at(update).config for update in (0, 1, 3))
    assert first.ppo == _config().ppo and not first.phases
    assert (second.ppo.clip, second.ppo.minibatches, second.rollout.num_envs) == (0.1, 4, 16)
    assert (third.ppo, third.rollout.num_envs, third.env.reward) == (second.ppo, 32, "sparse")
    assert (second.env.failure_penalty, third.env.failure_penalty) == (1.0, 0.0)


def test_phases_are_part_of_the_hash_and_of_config_json():
    config, without = _config(), _config(phases=())
    assert config.hash != without.hash and without.hash == tiny_config(num_updates=1).hash
    assert from_dict(json.loads(json.dumps(to_dict(config)))) == config
    assert differences(config, without)[0].startswith("phases [{")


@pytest.mark.parametrize(
    ("phases", "message"),
    [
        ({0: {"ppo.clip": 0.1}}, "phase 1 starts at 0 environment steps, the run at 0; starts have to rise"),
        ({500: {"ppo.clip": 0.1}, 400: {"ppo.clip": 0.2}}, "phase 2 starts at 400 .* phase 1 at 500"),
        ({130: {"ppo.clip": 0.1}, 140: {"ppo.clip": 0.2}}, "phase 2 .* within the first update of phase 1"),
        ({500: {}}, "phase 1 changes nothing; name settings in its options"),
        ({500: {"rollout.num_envs": 18}}, "phase 1: RolloutConfig.num_envs 18 is not a multiple of num_groups 4"),
        ({500: {"ppo.minibatches": 3}}, "phase 1: 8 steps of 16 worlds .* cannot be divided into 3 minibatches"),
        ({500: {"ppo.learning_rate": 0.0}}, "phase 1: PpoConfig.learning_rate is 0.0; it must be above 0"),
        ({500: {"curriculum.sizes": [["m", 1.0]]}}, "phase 1: curriculum.sizes has 'm', which does not fit env.size"),
        ({500: {"curriculum.sizes": [["s", -1.0]]}}, "phase 1: CurriculumConfig.sizes gives 's' the weight -1.0"),
        ({500: {"ppo.clip": "wide"}}, "phase 1: config field clip is 'wide'; float is needed"),
        ({500: {"ppo.clipp": 0.1}}, r"phase 1: unknown setting 'ppo.clipp'; did you mean 'ppo.clip'\?"),
        (
            {500: {"ppo": {"clip": 0.1}}},
            "phase 1: unknown setting 'ppo'; it is a section: name its settings, \"ppo.NAME\"",
        ),
        ({500: {"policy.num_layers": 2}}, "phase 1: policy.num_layers cannot change within a run: the parameters have"),
        ({500: {"env.observation": "flat"}}, "phase 1: env.observation cannot change within a run: the parameters"),
        (
            {500: {"ppo.average_updates": 0}},
            "phase 1: ppo.average_updates cannot change .* the learner's state has its",
        ),
        ({500: {"rollout.num_groups": 2}}, "phase 1: rollout.num_groups cannot change .* worlds are divided over"),
        ({500: {"rollout.reset_every": 2}}, "phase 1: rollout.reset_every cannot change .* resets are counted from"),
        ({500: {"run.seed": 2}}, "phase 1: run.seed cannot change within a run: it is of the run as a whole; leave"),
        ({500: {"curriculum.name": "fixed"}}, "phase 1: CurriculumConfig.levels is '' with name 'fixed'"),
        ({500: {"curriculum.name": "paired"}}, "phase 1: curriculum 'paired' needs the end of an episode in every w"),
    ],
)
def test_phases_that_cannot_run_are_refused(phases, message):
    with pytest.raises(ValueError, match=message):
        _config(phases=tuple(PhaseConfig(start=start, options=options) for start, options in phases.items()))


# Runs


def _train(config, path, *, resume, reporter=None):
    """Rows of metrics of one session."""
    run = RunDirectory.open_existing(path) if resume else RunDirectory.create(path, numbered=False)
    run.write_json(run.config_path, {})
    reporter, backend = reporter or NotingReporter(), LocalBackend()
    curator = CuratorClient(config, backend, [ProcessPlan(role="curator", index=0)])
    if config.run.placement == "split":
        trainer = SplitTrainer(config, backend, plan_placement(config, num_gpus=0))
    else:
        trainer = ColocatedTrainer(config, backend, [ProcessPlan(role="worker", index=0)])
    controller = Controller(config, run, Roles(trainer=trainer, curator=curator), reporter)
    controller.restore(resume=resume)
    controller.train()
    run.close()
    return reporter.rows


@pytest.fixture(scope="module", params=[pytest.param("local", marks=pytest.mark.long), "split"])
def unbroken(request, tmp_path_factory):
    """(config, folder, rows, notes) of a run that nothing disturbs."""
    config, path = _config(request.param), tmp_path_factory.mktemp(request.param) / "run"
    reporter = NotingReporter()
    return config, path, _train(config, path, resume=False, reporter=reporter), reporter.notes


def test_each_phase_is_noted_and_counted(unbroken):
    config, path, rows, notes = unbroken
    assert [row["progress/phase"] for row in rows] == [0, 1, 1, 2, 2]
    assert [row["progress/env_steps"] for row in rows] == [128, 256, 384, 640, 896]
    began = [(event["phase"], event["update"], event["env_steps"]) for event in events(path, "phase_began")]
    assert began == [(1, 1, 128), (2, 3, 384)]
    changed = "rollout.num_envs 32, env.reward sparse, env.failure_penalty 0.0"
    assert f"phase 2 begins after 3 updates, 384 env steps: {changed}" in notes[1]
    # What is annealed and what a phase sets multiply: `tiny` lowers the rate from 256 steps on.
    rates = [row["learner/learning_rate"] for row in rows]
    assert rates[0] == pytest.approx(1e-3) and rates[1] == pytest.approx(3e-3) and rates[3] < rates[2] * 1.001
    learner = final_arrays(path)
    # Epochs and minibatches of each phase; worlds of each.
    assert learner["learner/num_gradient_steps"] == 2 * 2 + 4 * 4
    assert learner["learner/env_steps"][0] == 640  # the clock of the last update
    if config.run.placement == "local":  # the other comes after it, and finds programs of equal settings here
        assert rows[3]["runtime/compile_seconds"] > rows[2]["runtime/compile_seconds"]


SAVED_AT = {"local": 3, "split": 2}  # in split, batch 3 is in flight at 2: the first one of the phase


@pytest.mark.parametrize("side", ["as the phase begins", pytest.param("an update away", marks=pytest.mark.slow)])
def test_a_run_resumed_just_before_or_just_after_a_change_equals_the_unbroken_one(unbroken, tmp_path, side):
    """Resumes from the checkpoint with which the change comes, and from one update before (local) or after (split)."""
    config, path, rows, _ = unbroken
    saved_at = SAVED_AT[config.run.placement] if side == "as the phase begins" else 5 - SAVED_AT[config.run.placement]
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


@pytest.mark.slow
@pytest.mark.parametrize("unbroken", ["local"], indirect=True)
def test_a_run_in_processes_of_ray_killed_at_a_change_and_resumed_equals_the_local_one(unbroken, tmp_path):
    """SIGKILL for the command once the checkpoint is there with which the last phase begins: while that is compiled."""
    config, path, _, _ = unbroken
    (tmp_path / "phases.json").write_text(json.dumps({"phases": to_dict(config)["phases"]}))
    run = {"placement": "colocated", "num_workers": 1, "checkpoint_every": 1, "keep_checkpoints": 9}
    run["total_env_steps"] = config.run.total_env_steps
    options = [part for name, value in run.items() for part in (f"--run.{name}", str(value))]
    process = start(tmp_path / "run", *TINY, "--phases", str(tmp_path / "phases.json"), *options)
    checkpoints = tmp_path / "run" / "checkpoints"
    wait_for(lambda: any(int(saved.name) == 3 for saved in list_checkpoints(checkpoints)), process, "checkpoint 3")
    process.kill()
    process.wait()
    assert int(list_checkpoints(checkpoints)[-1].name) == 3
    finish(start(tmp_path / "run", "--resume"))
    assert [event["update"] for event in events(tmp_path / "run", "phase_began")][-1] == 3
    assert_same_bits(final_arrays(tmp_path / "run"), final_arrays(path))


# Starting from a checkpoint of the run


@pytest.mark.long
@pytest.mark.parametrize("unbroken", ["local"], indirect=True)
def test_a_new_run_takes_parameters_and_optimiser_of_a_checkpoint_and_keeps_its_lineage(unbroken, tmp_path):
    config, path, _, _ = unbroken
    parent = list_checkpoints(path / "checkpoints")[-1]
    run = {"start_from": str(parent), "start_optimizer": True, "total_env_steps": STEPS}
    child = dataclasses.replace(tiny_config(num_updates=1), run=dataclasses.replace(config.run, **run))
    theirs = load_checkpoint(parent)
    start = starting_point(child)
    assert start.arrays is not None
    for kind in ("params", "opt_state"):
        ours, wanted = select_arrays(start.arrays, f"start/{kind}"), select_arrays(theirs.arrays, f"learner/{kind}")
        assert_same_bits(ours, wanted)
    assert [one["num_updates"] for one in start.lineage] == [NUM_UPDATES]
    _train(child, tmp_path / "child", resume=False)
    saved = load_checkpoint(list_checkpoints(tmp_path / "child" / "checkpoints")[-1])
    (ancestor,) = saved.description["lineage"]
    about = {"checkpoint": str(parent), "recipe": "tiny", "config_hash": config.hash, "num_updates": NUM_UPDATES}
    assert ancestor.items() >= about.items() and ancestor["env_steps"] == 896
    # Adam counted on: its moments are those of the parent and of one update more.
    count = next(name for name in saved.arrays if name.startswith("learner/opt_state") and name.endswith("count"))
    assert saved.arrays[count] == theirs.arrays[count] + 4
    assert [one["num_updates"] for one in lineage_from(saved)] == [NUM_UPDATES, 1]


@pytest.mark.long
@pytest.mark.parametrize("unbroken", ["local"], indirect=True)
def test_what_makes_another_policy_of_the_same_parameters_is_said(unbroken):
    config, path, _, _ = unbroken
    parent = str(list_checkpoints(path / "checkpoints")[-1])
    like_it = dataclasses.replace(config, phases=(), run=dataclasses.replace(config.run, start_from=parent))
    assert starting_point(like_it).differs == ()
    other = dataclasses.replace(like_it, policy=dataclasses.replace(config.policy, num_heads=4, max_qk_norm=2.0))
    assert starting_point(other).differs == (
        "policy.max_qk_norm 2.0 instead of 0.0",
        "policy.num_heads 4 instead of 8",
    )


@pytest.mark.long
@pytest.mark.parametrize("unbroken", ["local"], indirect=True)
def test_a_run_with_more_layers_starts_from_a_policy_with_fewer(unbroken, tmp_path):
    """The learned layers are taken as they are, those that are missing are added, and their number is noted."""
    config, path, _, _ = unbroken
    parent = list_checkpoints(path / "checkpoints")[-1]
    policy = dataclasses.replace(config.policy, num_layers=config.policy.num_layers + 1)
    run = dataclasses.replace(config.run, start_from=str(parent), total_env_steps=STEPS)
    child = dataclasses.replace(tiny_config(num_updates=1), policy=policy, run=run)
    assert starting_point(child).differs == ("policy.num_layers 2 instead of 1",)
    _train(child, tmp_path / "child", resume=False)
    given = select_arrays(load_checkpoint(parent).arrays, "learner/average")
    first = load_checkpoint(list_checkpoints(tmp_path / "child" / "checkpoints")[0])
    learned = select_arrays(first.arrays, "learner/params")
    added = learned.keys() - given.keys()
    assert added and all("_1_" in name for name in added) and not given.keys() - learned.keys()
    # A few steps of Adam at 1e-3 away from what was given, and from what was added.
    assert all(np.abs(learned[name] - array).max() < 0.1 for name, array in given.items())
    (bias,) = (array for name, array in learned.items() if name.endswith("attention_1_gate_bias"))
    assert np.abs(bias - GATE_BIAS).max() < 0.1
    shallower = dataclasses.replace(config, phases=(), run=dataclasses.replace(run, start_from=str(first.path)))
    with pytest.raises(CheckpointError, match=r"has 2 layers and policy.num_layers is 1; set it to 2"):
        starting_point(shallower)


@pytest.mark.parametrize("unbroken", ["local"], indirect=True)
def test_an_optimiser_of_fewer_layers_and_layers_for_another_network_are_refused(unbroken):
    config, path, _, _ = unbroken
    run = dataclasses.replace(config.run, start_from=str(list_checkpoints(path / "checkpoints")[-1]))
    deeper = dataclasses.replace(config.policy, num_layers=2)
    with_optimizer = dataclasses.replace(run, start_optimizer=True)
    with pytest.raises(CheckpointError, match=r"policy.num_layers is 2 and the optimiser of .* is of 1; leave it out"):
        starting_point(dataclasses.replace(config, phases=(), policy=deeper, run=with_optimizer))
    other = dataclasses.replace(deeper, encoder_size=16)  # layers are added to nothing but the same network
    with pytest.raises(CheckpointError, match=r"array params/\S+ is float32"):
        starting_point(dataclasses.replace(config, phases=(), policy=other, run=run))
