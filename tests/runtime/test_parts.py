"""Pieces of the runtime that need no training: placement, queues, weights, config, clock, metric files."""

import dataclasses
import io
import json
import math

import pytest
from rich.console import Console

from kinetix_dist.config import ConfigError, differences, from_dict, from_dict_for_playing, to_dict
from kinetix_dist.recipes import RECIPES, recipe
from kinetix_dist.runtime.driver.totals import RoleClock
from kinetix_dist.runtime.driver.work_buffer import WeightStore, Work, WorkBuffer, WorkBufferFullError
from kinetix_dist.runtime.processes.placement import PlacementError, plan_placement, resolve_device
from kinetix_dist.telemetry.names import METRICS, UnknownMetricError, check_metrics
from kinetix_dist.telemetry.sinks.console import ConsoleSink
from kinetix_dist.telemetry.sinks.jsonl import JsonlSink, read_jsonl
from tests.runtime.runs import tiny_config, without_evaluator

# Config


@pytest.mark.parametrize("name", RECIPES)
def test_a_config_survives_its_json_file(name):
    config = recipe(name)
    assert from_dict(json.loads(json.dumps(to_dict(config)))) == config


def test_the_hash_covers_what_changes_the_numbers_and_nothing_else():
    config = tiny_config(num_updates=4)
    longer = tiny_config(num_updates=40, checkpoint_every=7, placement="colocated")
    assert longer.hash == config.hash
    assert tiny_config(num_updates=4, seed=1).hash != config.hash
    assert tiny_config(num_updates=4, placement="split").hash != config.hash  # lag 1
    faster = dataclasses.replace(config, ppo=dataclasses.replace(config.ppo, learning_rate=1.0))
    assert differences(faster, config) == ["ppo.learning_rate 1.0 instead of 0.001"]


def test_an_unknown_field_of_a_config_file_is_named():
    data = to_dict(recipe("tiny"))
    data["ppo"]["speed"] = 3
    with pytest.raises(ConfigError, match=r"ppo\.speed is unknown"):
        from_dict(data)


def test_paper_recipes_have_the_papers_numbers():
    for size in "sml":
        config = recipe(f"sfl_{size}")
        assert config.env.size == size
        assert (config.rollout.num_envs, config.rollout.num_steps) == (2048, 256)
        assert (config.ppo.epochs, config.ppo.minibatches, config.ppo.clip) == (8, 32, 0.02)
        curriculum = config.curriculum
        assert (curriculum.num_candidates, curriculum.scoring_steps, curriculum.buffer_size) == (12288, 512, 1024)
        assert (curriculum.refresh_every, curriculum.buffer_share) == (128, 0.5)


def test_recipes_learn_from_whole_episodes():
    assert [name for name in RECIPES if recipe(name).cut_episodes] == ["tiny"]
    said = recipe("tiny").cut_episodes
    assert said.startswith("rollout.num_steps is 8 and env.max_steps 16: every update begins its levels again")


def test_scores_of_candidates_need_a_whole_episode():
    config = recipe("quickstart")
    with pytest.raises(ConfigError, match=r"curriculum.scoring_steps is 63 and env.max_steps 64: of a level whose"):
        dataclasses.replace(config, curriculum=dataclasses.replace(config.curriculum, scoring_steps=63))
    old = to_dict(config)
    old["curriculum"]["scoring_steps"] = 63
    assert from_dict_for_playing(old).policy == config.policy  # such policies are still played
    # Others score no candidates by steps.
    fixed = dataclasses.replace(config.curriculum, name="domain_randomization", scoring_steps=1)
    dataclasses.replace(config, curriculum=fixed)


def test_learnability_of_a_fresh_level_needs_two_episodes():
    config = recipe("plr_s")
    plr = dataclasses.replace(config.curriculum, plr=dataclasses.replace(config.curriculum.plr, score="learnability"))
    with pytest.raises(ConfigError, match=r"with plr.score 'learnability' needs the ends of 2 episodes in every world"):
        dataclasses.replace(config, curriculum=plr)
    dataclasses.replace(config, curriculum=plr, rollout=dataclasses.replace(config.rollout, num_steps=512))
    old = to_dict(config)
    old["curriculum"]["plr"]["score"] = "learnability"
    assert from_dict_for_playing(old).policy == config.policy  # such policies are still played


# Placement


def test_colocated_is_one_worker_a_gpu_and_a_curator_with_the_first():
    placement = plan_placement(without_evaluator(recipe("sfl_s")), num_gpus=2)
    assert [(p.name, p.gpu, p.gpu_share) for p in placement.processes] == [
        ("worker 0", 0, 0.5),
        ("worker 1", 1, 1.0),
        ("curator 0", 0, 0.5),
    ]


@pytest.mark.parametrize("name", [name for name in RECIPES if recipe(name).run.device == "gpu"])
def test_recipes_for_gpus_evaluate_and_record_in_the_background(name):
    config = recipe(name)
    assert config.evaluates_in_background and config.evaluation.every > 0 and config.recording.every > 0
    num_updates = config.run.total_env_steps // config.rollout.steps_per_update
    assert num_updates // config.evaluation.every >= 10 and num_updates // config.recording.every >= 3
    assert ("evaluator 0", 0) in [
        (process.name, process.gpu) for process in plan_placement(config, num_gpus=2).processes
    ]


def test_split_has_its_curator_with_the_first_rollout_actor():
    config = without_evaluator(recipe("sfl_s"))
    config = dataclasses.replace(config, run=dataclasses.replace(config.run, placement="split", num_rollout_actors=2))
    placement = plan_placement(config, num_gpus=4)
    assert [(p.name, p.gpu) for p in placement.processes] == [
        ("learner 0", 0),
        ("rollout 0", 1),
        ("rollout 1", 2),
        ("curator 0", 1),
    ]


def test_curators_are_spread_over_the_gpus_that_play():
    def placed(num_gpus, **run):
        config = without_evaluator(recipe("sfl_s"))
        placement = plan_placement(
            dataclasses.replace(config, run=dataclasses.replace(config.run, **run)), num_gpus=num_gpus
        )
        return [(p.name, p.gpu) for p in placement.of("curator")]

    assert placed(4, num_curators=3) == [("curator 0", 0), ("curator 1", 1), ("curator 2", 2)]
    assert placed(2, num_curators=3) == [("curator 0", 0), ("curator 1", 1)]
    assert placed(3, placement="split", num_rollout_actors=2, num_curators=2) == [("curator 0", 1), ("curator 1", 2)]
    assert placed(0, device="cpu", num_curators=2) == [("curator 0", None), ("curator 1", None)]
    assert tiny_config(num_updates=1, num_curators=2).hash == tiny_config(num_updates=1).hash
    assert placed(2, num_curators=0) == []
    with pytest.raises(ConfigError, match="num_curators is 0, but in placement split no process both learns and plays"):
        tiny_config(num_updates=1, num_curators=0, placement="split")
    with pytest.raises(
        ConfigError,
        match=r"num_curators is 3, but candidates are scored in batches of .*scoring_batch 8, 2 in all: some would",
    ):
        tiny_config(num_updates=1, num_curators=3)
    with pytest.raises(ConfigError, match="num_curators is 2, but nothing of curriculum 'plr' can be shared"):
        config = recipe("plr_s")
        dataclasses.replace(config, run=dataclasses.replace(config.run, num_curators=2))


def test_any_numbers_of_learners_and_actors_have_one_config_hash():
    config = tiny_config(num_updates=1, placement="split")
    for learners, actors in ((1, 3), (2, 1), (3, 4), (4, 4)):
        other = tiny_config(num_updates=1, placement="split", num_learners=learners, num_rollout_actors=actors)
        placement = plan_placement(other, num_gpus=0)
        assert (len(placement.of("learner")), len(placement.of("rollout"))) == (learners, actors)
        assert other.hash == config.hash


def test_learners_have_gpus_of_their_own_and_only_they_form_a_group():
    config = without_evaluator(recipe("sfl_s"))
    run = dataclasses.replace(config.run, placement="split", num_learners=2, num_rollout_actors=2)
    placement = plan_placement(dataclasses.replace(config, run=run), num_gpus=4)
    groups = [None if p.memory is None else p.memory.needs[0].num_in_group for p in placement.processes]
    assert [(p.name, p.gpu, group) for p, group in zip(placement.processes, groups, strict=True)] == [
        ("learner 0", 0, 2),
        ("learner 1", 1, 2),
        ("rollout 0", 2, 1),
        ("rollout 1", 3, 1),
        ("curator 0", 2, 1),
    ]
    with pytest.raises(PlacementError, match="2 learners and 2 rollout actors, 0 of them on CPUs, needs 4 GPUs of 3"):
        plan_placement(dataclasses.replace(config, run=run), num_gpus=3)
    with pytest.raises(PlacementError, match=r"5 learners cannot share 4 blocks .* lower run.num_learners, or"):
        plan_placement(tiny_config(num_updates=1, placement="split", num_learners=5), num_gpus=0)


def test_rollout_actors_can_play_on_gpus_and_on_cpus_in_one_run():
    config = without_evaluator(recipe("sfl_s"))

    def placed(num_gpus, **run):
        run = dataclasses.replace(config.run, placement="split", **run)
        return plan_placement(dataclasses.replace(config, run=run), num_gpus=num_gpus)

    mixed = placed(2, num_rollout_actors=3, num_cpu_rollout_actors=2)
    assert [(p.name, p.gpu) for p in mixed.processes] == [
        ("learner 0", 0),
        ("rollout 0", 1),
        ("rollout 1", None),
        ("rollout 2", None),
        ("curator 0", 1),
    ]
    assert all(p.env_vars == {"JAX_PLATFORMS": "cpu"} and p.memory is None for p in mixed.processes if p.gpu is None)
    alone = placed(1, num_rollout_actors=2, num_cpu_rollout_actors=2)  # then the curator shares the GPU of the learner
    assert [(p.name, p.gpu, p.gpu_share) for p in alone.processes if p.gpu == 0] == [
        ("learner 0", 0, 0.5),
        ("curator 0", 0, 0.5),
    ]
    assert len(alone.of("rollout")) == 2
    with pytest.raises(PlacementError, match=r"1 of them on CPUs, needs 3 GPUs of 2; .* raise run.num_cpu"):
        placed(2, num_rollout_actors=3, num_cpu_rollout_actors=1)
    with pytest.raises(ConfigError, match="num_cpu_rollout_actors is 2, of num_rollout_actors 1 in all; lower the one"):
        placed(2, num_rollout_actors=1, num_cpu_rollout_actors=2)


def test_on_cpu_no_process_sees_gpus():
    placement = plan_placement(tiny_config(num_updates=1, placement="split", num_rollout_actors=2), num_gpus=0)
    assert [p.role for p in placement.processes] == ["learner", "rollout", "rollout", "curator"]
    assert all(p.env_vars == {"JAX_PLATFORMS": "cpu"} and p.memory is None for p in placement.processes)


def test_a_gpu_that_is_not_there_is_refused():
    with pytest.raises(PlacementError, match="no GPU is visible"):
        resolve_device("gpu", num_gpus=0)
    with pytest.raises(PlacementError, match="needs 2 GPUs of 1"):
        config = without_evaluator(recipe("sfl_s"))
        plan_placement(dataclasses.replace(config, run=dataclasses.replace(config.run, placement="split")), num_gpus=1)


# Queues and weights


def _work(update, version, part=0, steps=10):
    return Work(update=update, part=part, header={"policy_version": version, "num_env_steps": steps})


def test_a_batch_is_taken_whole_and_in_order_of_its_parts():
    buffer = WorkBuffer(num_parts=2, lag=1)
    assert buffer.put(_work(0, 0, part=1))
    assert buffer.missing(0) == [0]
    with pytest.raises(LookupError, match="lacks parts"):
        buffer.take(0)
    assert buffer.put(_work(0, 0, part=0))
    assert [work.part for work in buffer.take(0)] == [0, 1]


def test_work_of_another_lag_or_for_a_past_update_is_dropped_and_counted():
    buffer = WorkBuffer(num_parts=1, lag=1)
    assert not buffer.put(_work(3, 1))  # lag 2
    assert not buffer.put(_work(3, 3))  # lag 0
    assert buffer.put(_work(3, 2))
    buffer.take(3)
    assert not buffer.put(_work(2, 1))  # late
    assert buffer.dropped_steps == 30


def test_the_work_buffer_is_bounded():
    buffer = WorkBuffer(num_parts=1, lag=1, capacity=2)
    buffer.put(_work(0, 0))
    buffer.put(_work(1, 0))
    with pytest.raises(WorkBufferFullError, match="batch 2 does not fit"):
        buffer.put(_work(2, 1))


def test_weights_are_stored_while_recent():
    store = WeightStore(keep_last=2)
    for version in (0, 1, 2, 3):
        store.publish(version, version)
    assert 1 not in store and 2 in store and store.get(3) == 3
    with pytest.raises(LookupError, match="version 0 is not stored"):
        store.get(0)


# Clock and metrics


def test_roles_that_work_at_the_same_time_are_scaled_to_the_time_there_was():
    clock = RoleClock()
    clock.start()
    clock.add({"rollout": 1000.0, "learn": 1000.0})
    _, shares = clock.lap()
    assert shares["rollout"] == pytest.approx(0.5)
    assert shares["idle"] == pytest.approx(0.0)


def test_a_metric_that_nobody_described_is_refused():
    with pytest.raises(UnknownMetricError, match=r"names\.py"):
        check_metrics({"learner/magic": 1.0})
    check_metrics({"evaluation/random_s/solve_rate": 0.5})
    assert all(metric.unit and metric.meaning for metric in METRICS.values())


def test_metric_lines_of_a_killed_session_are_cut_off_where_it_is_resumed(tmp_path):
    sink = JsonlSink(tmp_path / "metrics.jsonl")
    for update in (1, 2, 3):
        sink.write(update, {"train/solve_rate": update / 10, "train/mean_return": math.nan})
    sink.close()
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write('{"update": 4, "tr')  # killed while writing
    sink = JsonlSink(tmp_path / "metrics.jsonl", resume_at=2)
    sink.write(3, {"train/solve_rate": 0.9})
    sink.close()
    rows = list(read_jsonl(tmp_path / "metrics.jsonl"))
    assert [(row["update"], row["train/solve_rate"]) for row in rows] == [(1, 0.1), (2, 0.2), (3, 0.9)]
    assert rows[0]["train/mean_return"] is None


def test_the_console_line_shows_what_a_person_follows():
    text = io.StringIO()
    sink = ConsoleSink(total_env_steps=1000, console=Console(file=text, width=200))
    sink.set_phase("compiling")
    sink.set_seconds_left(65)
    sink.write(
        3,
        {
            "progress/env_steps": 500,
            "progress/env_steps_per_second": 1234.5,
            "train/solve_rate": 0.31,
            "curriculum/learnability": 0.12,
        },
    )
    sink.set_phase("evaluating")
    sink.close()
    last = text.getvalue().splitlines()[-1]
    assert last.startswith("evaluating")
    for part in ("500 / 1,000 env steps", "1,234 steps/s", "solved 31%", "learnability 0.120", "1:05 left"):
        assert part in last
