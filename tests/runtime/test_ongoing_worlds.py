"""Worlds that go on from update to update (`rollout.reset_every`): episodes longer than an update, counted once and
trained to their end; a run that is cut anywhere in between goes on bit for bit."""

import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kinetix_dist.actors.outcomes import add_step, no_outcomes
from kinetix_dist.checkpoint import list_checkpoints, load_checkpoint, select_arrays
from kinetix_dist.config import differences, from_dict, to_dict
from kinetix_dist.config.phases import PhaseConfig
from kinetix_dist.curator.config import CurriculumConfig
from kinetix_dist.finetune.specialists import Specialists
from kinetix_dist.learner.division import Division
from kinetix_dist.learner.plasticity import PlasticityConfig
from kinetix_dist.learner.sharding import data_mesh, spread_worlds
from kinetix_dist.runtime.cores.ongoing_worlds import OngoingWorlds, restored, stored
from kinetix_dist.runtime.cores.playing import Playing
from kinetix_dist.runtime.cores.run_names import WORLDS
from kinetix_dist.runtime.driver.colocated import ColocatedTrainer
from kinetix_dist.runtime.driver.refreshes import CuratorClient, WorkerCurator
from kinetix_dist.runtime.processes.local import LocalBackend
from kinetix_dist.runtime.processes.placement import ProcessPlan, plan_placement
from tests.helpers import REPOSITORY, environment_of_cpus
from tests.runtime.runs import QuietReporter, assert_same_bits, final_arrays, run_updates, tiny_config
from tests.runtime.train_process import events

RESET_EVERY, NUM_STEPS, NUM_WORLDS = 3, 8, 16
MORE_WORLDS = PhaseConfig(start=130, options={"rollout.num_envs": 32})


def with_resets(config, *, reset_every=RESET_EVERY, max_steps=20, recurrent="none", **rollout):
    """`config` with worlds that go on; an episode of `max_steps` is longer than two updates."""
    return dataclasses.replace(
        config,
        env=dataclasses.replace(config.env, max_steps=max_steps),
        policy=dataclasses.replace(config.policy, recurrent=recurrent, memory_size=8),
        curriculum=dataclasses.replace(config.curriculum, scoring_steps=max_steps),
        rollout=dataclasses.replace(config.rollout, reset_every=reset_every, **rollout),
    )


def on_one_level(config, level="s/kick"):
    return dataclasses.replace(config, curriculum=CurriculumConfig(name="fixed", levels=level))


# What an update plays


class Played:
    """Updates from a reset to the next, without learning."""

    def __init__(self, config):
        self.config = config
        playing = Playing(config, data_mesh(jax.devices()[:1]))
        self.env, self.policy, core = playing.environment(config), playing.policy, playing.rollout(config)
        state = playing.curriculum(config).init()
        obs = self.env.prepare(jax.tree.map(lambda x: jnp.asarray(x)[:1], state))
        self.params = self.policy.init(jax.random.key(0), self.env.observe(obs, obs.initial_obs))
        self.updates, worlds = [], None
        for update in range(config.rollout.reset_every):
            played = core.play(self.params, state, update, worlds)
            worlds = played.worlds
            self.updates.append(played)

    @property
    def trajectory(self):
        """[K T, W, ...], one update behind the other."""
        return jax.tree.map(lambda *xs: np.concatenate(xs), *(played.batch.trajectory for played in self.updates))


@pytest.fixture(scope="module", params=["none", "gru"])
def three_updates(request):
    return Played(on_one_level(with_resets(tiny_config(num_updates=1), recurrent=request.param)))


@pytest.mark.long
def test_the_updates_are_pieces_of_one_rollout(three_updates):
    """The environment alone, given the actions of all three updates, does what the worlds did."""
    env, trajectory = three_updates.env, three_updates.trajectory
    levels = three_updates.updates[0].worlds.levels
    prepared = env.prepare(levels)

    def step(carry, actions):
        env_state, outcome = carry
        env_state, _, reward, done, info = env.step(prepared, env_state, actions)
        return (env_state, add_step(outcome, done, info)), (reward, done)

    start = env.reset(prepared)[0], no_outcomes(NUM_WORLDS)
    actions = trajectory.actions.astype(jnp.int32)
    (_, outcome), (reward, done) = jax.lax.scan(step, start, actions)
    np.testing.assert_array_equal(trajectory.done_after, done)
    np.testing.assert_allclose(trajectory.rewards, reward, atol=1e-6)
    assert trajectory.timed_out[19].any() and not trajectory.timed_out[:19].any()  # longer than two updates
    sums = [played.sums for played in three_updates.updates]
    assert [int(one["attempts"]) for one in sums] == [0, 0, NUM_WORLDS]
    assert int(sums[2]["solved"]) == int(outcome.first_solved.sum())
    assert int(sums[2]["failed"]) == int(outcome.first_failed.sum())
    assert float(sums[2]["return"]) == pytest.approx(float(outcome.first_return.sum()), abs=1e-4)
    assert sum(int(one["finished"]) for one in sums) == int(outcome.num_finished.sum())
    assert int(sums[2]["by_source"]["attempts"].sum()) == NUM_WORLDS and not sums[1]["by_source"]["attempts"].any()
    assert three_updates.updates[2].worlds is None


@pytest.mark.long
def test_the_learner_is_given_the_memory_that_the_policy_acted_with(three_updates):
    if three_updates.config.policy.recurrent == "none":
        assert all(played.batch.static.memory is None for played in three_updates.updates)
        return
    env, policy, params = three_updates.env, three_updates.policy, three_updates.params
    for number, played in enumerate(three_updates.updates):
        static, trajectory, _ = played.batch
        rows = jax.tree.map(lambda x: x.reshape(NUM_STEPS * NUM_WORLDS, *x.shape[2:]), trajectory.dynamic_obs)
        fixed = jax.tree.map(lambda x: jnp.tile(x, (NUM_STEPS, *[1] * (x.ndim - 1))), static.obs)
        is_first = np.roll(trajectory.done_after, 1, axis=0)
        is_first[0] = False
        obs = env.observation.join(fixed, rows)
        values = policy.apply(params, obs, static.memory, is_first=jnp.asarray(is_first))[1]
        # Another program than the one that acted rounds otherwise.
        np.testing.assert_allclose(values.reshape(NUM_STEPS, NUM_WORLDS), trajectory.values, atol=2e-5)
        from_zero = policy.apply(params, obs, is_first=jnp.asarray(is_first))[1].reshape(NUM_STEPS, NUM_WORLDS)
        assert np.allclose(from_zero[0], trajectory.values[0], atol=2e-5) == (number == 0)


@pytest.mark.long
def test_episodes_of_256_steps_are_learned_from_to_their_end_in_updates_of_32():
    """On a level that random actions hardly ever solve: first episodes end at the time limit, in the eighth update."""
    config = on_one_level(tiny_config(num_updates=1), "s/swing_up")
    config = with_resets(config, reset_every=8, max_steps=256, num_steps=32)
    played = Played(config)
    trajectory = played.trajectory
    goes_on = np.asarray(played.updates[6].worlds.episodes.outcome.num_finished == 0)  # after 224 steps
    assert goes_on.sum() > NUM_WORLDS / 2
    assert trajectory.done_after[255][goes_on].mean() > 0.5 and trajectory.timed_out[255].any()
    assert not trajectory.timed_out[:255].any()
    assert int(played.updates[7].sums["attempts"]) == NUM_WORLDS


# What can run


@pytest.mark.parametrize(
    ("curriculum", "placement", "message"),
    [
        ("sfl", "split", "rollout.reset_every is 3, but in placement split worlds are lost with their rollout actor"),
        ("plr", "local", "reset_every is 3, but curriculum 'plr' observes whole levels in every update; set it to 1"),
        ("robust_plr", "local", "curriculum 'robust_plr' observes whole levels"),
        ("accel", "local", "curriculum 'accel' observes whole levels"),
        ("paired", "local", "curriculum 'paired' observes whole levels"),
        ("sfl_slices", "local", "curriculum 'sfl_slices' observes whole levels"),
    ],
)
def test_what_cannot_go_on_is_refused_in_one_line(curriculum, placement, message):
    config = tiny_config(num_updates=1, placement=placement)
    rollout = dataclasses.replace(config.rollout, reset_every=RESET_EVERY)
    with pytest.raises(ValueError, match=message) as refused:
        dataclasses.replace(config, curriculum=CurriculumConfig(name=curriculum), rollout=rollout)
    assert "\n" not in str(refused.value)


def test_less_than_one_update_and_specialists_are_refused():
    config = tiny_config(num_updates=1)
    with pytest.raises(ValueError, match=r"RolloutConfig.reset_every is 0; it must be 1 or more"):
        dataclasses.replace(config.rollout, reset_every=0)
    with pytest.raises(ValueError, match=r"rollout.reset_every is 3; specialists play their level from its start"):
        Specialists(on_one_level(with_resets(config)))


def test_it_is_part_of_the_hash_where_worlds_go_on():
    config = tiny_config(num_updates=1)
    assert config.hash == "cdd676c1a6800887"  # as before there was such a setting
    longer = dataclasses.replace(config, rollout=dataclasses.replace(config.rollout, reset_every=2))
    assert longer.hash != config.hash and differences(longer, config) == ["rollout.reset_every 2 instead of 1"]
    assert from_dict(json.loads(json.dumps(to_dict(longer)))) == longer


def test_a_run_says_which_steps_of_an_episode_it_never_plays():
    config = with_resets(tiny_config(num_updates=1), max_steps=30)
    assert "levels begin again every 3 updates, so that what comes after step 24" in config.cut_episodes
    assert not with_resets(tiny_config(num_updates=1), max_steps=24).cut_episodes


def test_a_phase_begins_with_a_reset():
    config = with_resets(tiny_config(num_updates=9))
    schedule = dataclasses.replace(config, phases=(MORE_WORLDS,)).schedule
    assert [schedule.at(update).number for update in range(7)] == [0, 0, 0, 1, 1, 1, 1]
    assert [schedule.env_steps(number) for number in (3, 4)] == [3 * 128, 3 * 128 + 256]


# Runs


def train(config, path, *, resume=False):
    """Rows of metrics of one session."""
    backend, reporter = LocalBackend(), QuietReporter()
    trainer = ColocatedTrainer(config, backend, [ProcessPlan(role="worker", index=0)])
    curator = None
    if config.has_curator:
        curators = [ProcessPlan(role="curator", index=0)]
        curator = CuratorClient(config, backend, curators) if config.run.num_curators else WorkerCurator(trainer)
    run_updates(config, path, trainer, curator, reporter=reporter, resume=resume)
    return reporter.rows


def _compared(row):
    names = [name for name in row if name.startswith(("train/", "learner/", "curriculum/")) and "second" not in name]
    return {name: row[name] for name in names}


RUN = {"checkpoint_every": 1, "keep_checkpoints": 20}


@pytest.fixture(scope="module", params=["none", "gru"])
def eight_updates(request, tmp_path_factory):
    """(config, folder, rows) of a run that nothing disturbs. Resets before updates 0, 3 and 6."""
    path = tmp_path_factory.mktemp(request.param) / "run"
    config = with_resets(tiny_config(num_updates=8, **RUN), recurrent=request.param)
    return config, path, train(config, path)


@pytest.mark.long
def test_attempts_are_counted_once_between_resets(eight_updates):
    _, path, rows = eight_updates
    assert [row["train/attempts"] for row in rows] == [0, 0, 16, 0, 0, 16, 0, 0]
    assert [update for update, row in enumerate(rows) if "train/solve_rate" in row] == [2, 5]
    assert all(row["learner/skipped_steps"] == 0 and row["learner/grad_norm"] > 0 for row in rows)
    lines = [json.loads(line) for line in (path / "curriculum" / "outcomes.jsonl").read_text().splitlines()]
    counted = [sum(line["attempts"]) + line["sources"]["fresh"]["attempts"] for line in lines]
    # The buffer of update 0 is replaced at update 5, within the second stretch, whose levels were drawn before.
    assert [(line["from_update"], line["update"], line["buffer"]) for line in lines] == [(0, 8, 0)]
    assert counted == [32]
    # A pair of fresh worlds in each of four groups, at two resets: all fresh worlds there are.
    pairs, fresh = lines[0]["fresh_pairs"], lines[0]["sources"]["fresh"]
    assert sum(pairs.values()) == 8 and 2 * pairs["both"] + pairs["one"] == fresh["solved"]
    assert fresh["attempts"] == 16


@pytest.mark.long
def test_checkpoints_hold_worlds_unless_a_reset_follows(eight_updates):
    config, path, _ = eight_updates
    held = {
        int(saved.name): select_arrays(load_checkpoint(saved).arrays, WORLDS)
        for saved in list_checkpoints(path / "checkpoints")
    }
    assert {number for number, arrays in held.items() if not arrays} == {3, 6}
    assert np.count_nonzero(held[4]["copy_of"] >= 0) == 4  # one of each group
    assert held[4]["episodes/env_state/num_steps"].max() == 8 and held[5]["episodes/env_state/num_steps"].max() == 16
    assert ("episodes/memory" in held[4]) == (config.policy.recurrent == "gru")


@pytest.mark.long
@pytest.mark.parametrize("saved_at", [3, 4, 5])
def test_a_run_that_is_resumed_has_the_bits_of_one_that_was_not(eight_updates, tmp_path, saved_at):
    config, path, rows = eight_updates
    shutil.copytree(path, tmp_path / "cut")
    for checkpoint in list_checkpoints(tmp_path / "cut" / "checkpoints"):
        if int(checkpoint.name) > saved_at:
            shutil.rmtree(checkpoint)
    resumed = train(config, tmp_path / "cut", resume=True)
    for ours, theirs in zip(resumed, rows[saved_at:], strict=True):
        np.testing.assert_equal(_compared(ours), _compared(theirs))
    assert_same_bits(final_arrays(tmp_path / "cut"), final_arrays(path))
    outcomes = [folder / "curriculum" / "outcomes.jsonl" for folder in (tmp_path / "cut", path)]
    assert outcomes[0].read_bytes() == outcomes[1].read_bytes()


def test_worlds_of_a_checkpoint_without_pairs_go_on_without_them():
    """Versions before there were pairs stored no `copy_of`."""
    number = np.arange(4, dtype=np.int32)
    levels: Any = {"size": number}
    episodes: Any = {"steps": number}
    worlds = OngoingWorlds(levels=levels, source=number, copy_of=None, episodes=episodes)
    mesh, division = data_mesh(jax.devices()[:1]), Division(1, 1)
    for copy_of in (None, np.array([-1, 0, -1, 2], np.int32)):
        some = spread_worlds(dataclasses.replace(worlds, copy_of=copy_of), mesh, division)
        arrays = select_arrays(stored(some, mesh, division), WORLDS)
        found = restored(arrays, worlds, mesh, division)
        jax.tree.map(np.testing.assert_array_equal, found, some)


@pytest.mark.long
def test_a_phase_with_other_worlds_begins_with_them(tmp_path):
    config = with_resets(tiny_config(num_updates=1, **RUN, total_env_steps=3 * 128 + 2 * 256))
    config = dataclasses.replace(config, phases=(MORE_WORLDS,))
    rows = train(config, tmp_path / "run")
    assert [row["progress/env_steps"] for row in rows] == [128, 256, 384, 640, 896]
    assert final_arrays(tmp_path / "run")[f"{WORLDS}/source"].shape == (32,)
    shutil.rmtree(list_checkpoints(tmp_path / "run" / "checkpoints")[-1])
    (resumed,) = train(config, tmp_path / "run", resume=True)
    np.testing.assert_equal(_compared(resumed), _compared(rows[-1]))


@pytest.mark.long
def test_a_phase_of_another_size_and_curriculum_goes_on_where_it_was_cut(tmp_path):
    """S with sfl, then M with random levels and another reward, resets before updates 0, 3 and 6; with a memory, and
    measures of plasticity, which take it."""
    options = {"env.size": "m", "curriculum.name": "domain_randomization", "env.reward": "sparse"}
    config = with_resets(tiny_config(num_updates=8, num_curators=0, **RUN), recurrent="gru")
    config = dataclasses.replace(
        config, phases=(PhaseConfig(start=130, options=options),), plasticity=PlasticityConfig(every=1)
    )
    rows = train(config, tmp_path / "run")
    assert [row["progress/phase"] for row in rows] == [0, 0, 0, 1, 1, 1, 1, 1]
    assert [row["train/attempts"] for row in rows] == [0, 0, 16, 0, 0, 16, 0, 0]
    assert all(row["learner/dormant_share"] < 1 for row in rows)
    lines = [json.loads(line) for line in (tmp_path / "run" / "curriculum" / "outcomes.jsonl").read_text().splitlines()]
    assert [(line["from_update"], line["update"]) for line in lines] == [(0, 3), (3, 8)]
    assert [list(line["sources"]) for line in lines] == [["fresh"], ["fresh"]]
    assert ["buffer" in line for line in lines] == [True, False]
    final = final_arrays(tmp_path / "run")
    for saved in list_checkpoints(tmp_path / "run" / "checkpoints"):
        if int(saved.name) > 4:
            shutil.rmtree(saved)
    resumed = train(config, tmp_path / "run", resume=True)
    for ours, theirs in zip(resumed, rows[4:], strict=True):
        np.testing.assert_equal(_compared(ours), _compared(theirs))
    assert_same_bits(final_arrays(tmp_path / "run"), final)


@pytest.mark.long
def test_a_run_of_three_devices_is_resumed_bit_for_bit(tmp_path):
    """Four groups on three devices: two have a slot that repeats a world."""
    command = [sys.executable, str(REPOSITORY / "tests/runtime/ongoing_program.py"), str(tmp_path / "run")]
    done = subprocess.run(command, env=environment_of_cpus(3), capture_output=True, text=True, timeout=400)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["devices"] == 3 and found["arrays"] > 50 and found["differing"] == []


@pytest.mark.slow
def test_two_workers_of_ray_of_which_one_is_killed_give_the_run_that_nothing_disturbs(tmp_path):
    from kinetix_dist.runtime.processes.ray_backend import RayBackend

    config = with_resets(tiny_config(num_updates=5, placement="colocated", num_workers=2, num_curators=0, **RUN))
    backend, killed = RayBackend(heartbeat_seconds=120.0), []

    def session(path, at_update):
        placement = plan_placement(config, num_gpus=0)
        trainer = ColocatedTrainer(config, backend, placement.of("worker"))
        reporter = QuietReporter(lambda number: at_update(number, trainer))
        try:
            run_updates(config, path, trainer, WorkerCurator(trainer), reporter=reporter)
        finally:
            trainer.stop()

    def kill(number, trainer):
        if number == 4 and not killed:  # after its first update since the reset; its checkpoint holds worlds
            killed.append(trainer._handles[1].pid)
            os.kill(killed[0], signal.SIGKILL)

    try:
        session(tmp_path / "unbroken", lambda number, trainer: None)
        session(tmp_path / "killed", kill)
    finally:
        backend.stop()
    assert len(events(tmp_path / "killed", "process_lost")) == 1
    assert_same_bits(final_arrays(tmp_path / "killed"), final_arrays(tmp_path / "unbroken"))
