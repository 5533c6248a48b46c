"""Files of training for dashboards: true to what was trained on, rewound with it, and without influence on it."""

import contextlib
import dataclasses
import json
import shutil
from collections.abc import Mapping

import numpy as np
import pytest

from kinetix_dist.checkpoint import list_checkpoints, load_checkpoint, select_arrays
from kinetix_dist.curator.config import CurriculumConfig
from kinetix_dist.curator.scores import learnability
from kinetix_dist.runtime.driver.colocated import ColocatedTrainer
from kinetix_dist.runtime.driver.controller import Controller, Roles
from kinetix_dist.runtime.driver.refreshes import CuratorClient
from kinetix_dist.runtime.driver.run_data import RunData
from kinetix_dist.runtime.driver.run_directory import RunDirectory
from kinetix_dist.runtime.driver.split import SplitTrainer
from kinetix_dist.runtime.driver.training_run import train
from kinetix_dist.runtime.processes.local import LocalBackend
from kinetix_dist.runtime.processes.placement import plan_placement
from kinetix_dist.telemetry.curriculum_log import (
    BUFFER,
    REFRESH,
    CurriculumLogConfig,
    Snapshot,
    level_ids,
    list_snapshots,
    read_outcomes,
    read_snapshot,
    snapshot_name,
)
from kinetix_dist.telemetry.json_lines import read_lines
from kinetix_dist.telemetry.status import FAILED, FINISHED, Status, read_status
from tests.runtime.runs import QuietReporter, assert_same_bits, final_arrays, tiny_config
from tests.runtime.test_full_disk import full_disk
from tests.runtime.train_process import events

NUM_WORLDS, NUM_GROUPS = 16, 4
NUM_UPDATES, EVERY, BUFFER_SIZE = 8, 3, 8  # a refresh every 3 updates, adopted after 2
LOG = CurriculumLogConfig(outcomes_every=EVERY, probe_levels=4)
OFF = CurriculumLogConfig(outcomes_every=0, probe_levels=0, max_snapshots=0)


def _config(*, log=LOG, curriculum=None, placement="local", checkpoint_every=2):
    config = tiny_config(num_updates=NUM_UPDATES, placement=placement, checkpoint_every=checkpoint_every)
    env = dataclasses.replace(config.env, max_steps=3)  # so that many episodes end within an update of 8 steps
    run = dataclasses.replace(config.run, keep_checkpoints=NUM_UPDATES)
    curriculum = curriculum or config.curriculum
    return dataclasses.replace(config, env=env, curriculum=curriculum, curriculum_log=log, run=run)


def _train(config, path, *, resume=False, backend=None, reporter=None):
    """Rows of metrics."""
    run = RunDirectory.open_existing(path) if resume else RunDirectory.create(path, numbered=False)
    run.write_json(run.config_path, {})
    backend, placement, reporter = (
        backend or LocalBackend(),
        plan_placement(config, num_gpus=0),
        reporter or QuietReporter(),
    )
    split = config.run.placement == "split"
    trainer = SplitTrainer(config, backend, placement) if split else None
    trainer = trainer or ColocatedTrainer(config, backend, placement.of("worker"))
    curator = CuratorClient(config, backend, placement.of("curator")) if config.has_curator else None
    controller = Controller(config, run, Roles(trainer=trainer, curator=curator), reporter)
    try:
        controller.restore(resume=resume)
        controller.train()
    finally:
        controller.close()
        for role in filter(None, (curator, trainer)):
            role.stop()
        run.close()
    return reporter.rows


def _arrays_at(path, num_updates):
    (found,) = (one for one in list_checkpoints(path / "checkpoints") if int(one.name) == num_updates)
    return load_checkpoint(found).arrays


def _snapshots(path):
    return [read_snapshot(file) for _, _, file in list_snapshots(path / "curriculum")]


def _levels(snapshot: Snapshot) -> Mapping[str, np.ndarray]:
    assert snapshot.levels is not None
    return snapshot.levels


def _assert_same_data(ours, theirs):
    assert (ours / "curriculum" / "outcomes.jsonl").read_bytes() == (
        theirs / "curriculum" / "outcomes.jsonl"
    ).read_bytes()
    for one, other in zip(_snapshots(ours), _snapshots(theirs), strict=True):
        arrays = [{k: v for k, v in each.arrays.items() if k != "scoring_seconds"} for each in (one, other)]
        assert_same_bits(*arrays)
        assert_same_bits(_levels(one), _levels(other))


def _assert_counts_add_up(path, rows):
    """Compares every window with the metrics of its updates."""
    lines = read_outcomes(path / "curriculum" / "outcomes.jsonl")
    assert [line["from_update"] for line in lines] == [0, *(line["update"] for line in lines[:-1])]
    assert lines[-1]["update"] == len(rows)
    for line in lines:
        window = rows[line["from_update"] : line["update"]]
        counts = [line, *line["sources"].values()]
        attempts, solved = (sum(np.sum(count.get(name, 0)) for count in counts) for name in ("attempts", "solved"))
        assert attempts == sum(row["train/attempts"] for row in window)
        assert solved == pytest.approx(sum(row["train/attempts"] * row["train/solve_rate"] for row in window))
    assert {row["train/attempts"] for row in rows} == {NUM_WORLDS}
    assert sum(row["train/episodes"] for row in rows) >= 2 * NUM_WORLDS * len(rows)  # of 3 steps at most, in 8
    return lines


def _assert_pairs_add_up(lines, rows):
    """One pair a group and update; their learnability is the mean of the metric of each update."""
    for line in lines:
        pairs, window = line["fresh_pairs"], rows[line["from_update"] : line["update"]]
        assert pairs.keys() == {"both", "one", "none"}
        assert sum(pairs.values()) == NUM_GROUPS * len(window)
        # Two of the four worlds of a group play fresh levels, both the same one.
        assert 2 * pairs["both"] + pairs["one"] == line["sources"]["fresh"]["solved"]
        learnability = np.mean([row["curriculum/fresh_learnability"] for row in window])
        assert pairs["one"] / (2 * sum(pairs.values())) == pytest.approx(learnability)


@pytest.fixture(scope="module")
def logged(tmp_path_factory):
    """(folder, rows of metrics) of a run in one process."""
    path = tmp_path_factory.mktemp("logged") / "run"
    return path, _train(_config(), path)


def test_the_snapshot_of_a_refresh_is_the_buffer_that_was_adopted(logged):
    path, _ = logged
    first, second, *more = _snapshots(path)
    assert not more and (first.kind, first.number, second.number) == (REFRESH, 0, 3)
    for snapshot, saved_at in ((first, 4), (second, 8)):
        state = select_arrays(_arrays_at(path, saved_at), "curriculum")
        assert_same_bits(_levels(snapshot), select_arrays(state, "levels"))
        for ours, theirs in {"solved": "num_solved", "finished": "num_finished"}.items():
            np.testing.assert_array_equal(snapshot.arrays[ours], state[theirs], strict=True)
        for name in ("candidate", "score", "policy_version"):
            np.testing.assert_array_equal(snapshot.arrays[name], state[name], strict=True)
        candidates = select_arrays(snapshot.arrays, "candidates")
        assert {len(counts) for counts in candidates.values()} == {16}
        score = learnability(candidates["solved"].astype(float), candidates["finished"].astype(float))
        assert score.mean() == pytest.approx(float(state["mean_candidate_score"]))
        np.testing.assert_array_equal(candidates["solved"][state["candidate"]], state["num_solved"])
        np.testing.assert_array_equal(candidates["features"][state["candidate"]], snapshot.arrays["features"])
        np.testing.assert_array_equal(snapshot.arrays["level_id"], level_ids(_levels(snapshot)))
    assert (int(first.arrays["first_batch"]), int(second.arrays["first_batch"])) == (0, 5)
    adopted = events(path, "buffer_adopted")
    assert [row["update"] for row in adopted] == [0, 5]


def test_the_buffer_before_is_played_again_by_the_policy_of_the_next_refresh(logged):
    first, second = _snapshots(logged[0])
    assert not [name for name in first.arrays if name.startswith("probe/")]
    probe = select_arrays(second.arrays, "probe")
    assert int(probe["policy_version"]) == 0
    np.testing.assert_array_equal(probe["index"], [0, 2, 4, 6])  # 4 of 8, evenly spread
    assert (probe["finished"] > 0).all() and (probe["solved"] <= probe["finished"]).all()


def test_outcomes_of_a_window_add_up_to_the_attempts_of_its_updates(logged):
    path, rows = logged
    lines = _assert_counts_add_up(path, rows)
    # Every 3 updates, and at 5, where the second buffer is adopted.
    assert [(line["update"], line["buffer"]) for line in lines] == [(3, 0), (5, 0), (6, 3), (8, 3)]
    assert all(len(line["solved"]) == len(line["attempts"]) == BUFFER_SIZE for line in lines)
    # Half of the worlds play levels of the buffer, each once in an update.
    buffered, fresh = (
        sum(map(sum, (line["attempts"] for line in lines))),
        sum(line["sources"]["fresh"]["attempts"] for line in lines),
    )
    assert buffered == fresh == NUM_WORLDS // 2 * NUM_UPDATES
    _assert_pairs_add_up(lines, rows)


def test_parameters_are_the_same_to_the_bit_without_any_of_it(logged, tmp_path):
    path, rows = logged
    without = _train(_config(log=OFF), tmp_path / "off")
    assert_same_bits(final_arrays(tmp_path / "off"), final_arrays(path))
    assert [row["train/episodes"] for row in without] == [row["train/episodes"] for row in rows]
    assert not (tmp_path / "off" / "curriculum").exists()


@pytest.mark.parametrize("saved_at", [2, 4, 6])
def test_a_run_that_goes_on_from_a_checkpoint_writes_the_same(logged, tmp_path, saved_at):
    """2: within a window; 4: with a refresh in flight; 6: after it was adopted."""
    path, _ = logged
    cut = tmp_path / "cut"
    shutil.copytree(path, cut)
    for checkpoint in list_checkpoints(cut / "checkpoints"):
        if int(checkpoint.name) > saved_at:
            shutil.rmtree(checkpoint)
    _train(_config(), cut, resume=True)
    assert_same_bits(final_arrays(cut), final_arrays(path))
    _assert_same_data(cut, path)


def test_what_is_later_than_the_checkpoint_is_removed_at_once(logged, tmp_path):
    path, _ = logged
    cut = tmp_path / "cut"
    shutil.copytree(path, cut)
    for checkpoint in list_checkpoints(cut / "checkpoints"):
        if int(checkpoint.name) > 2:
            shutil.rmtree(checkpoint)
    (cut / "curriculum" / snapshot_name(REFRESH, 6)).write_bytes(b"damaged")
    with (cut / "curriculum" / "outcomes.jsonl").open("a") as file:
        file.write('{"upda')
    config = _config()
    config = dataclasses.replace(
        config, run=dataclasses.replace(config.run, total_env_steps=2 * config.rollout.steps_per_update)
    )
    _train(config, cut, resume=True)  # it is over already
    assert [snapshot.number for snapshot in _snapshots(cut)] == [0]
    lines = read_lines(cut / "curriculum" / "outcomes.jsonl")
    assert [row["update"] for row in lines.rows] == [2] and not lines.damaged  # the window that was begun
    aside = {row["file"]: row for row in events(cut, "file_set_aside")}
    assert aside["curriculum/refresh_00000006.npz"]["to"] == "refresh_00000006.npz.damaged"
    assert [row["file"] for row in events(cut, "lines_set_aside")] == ["curriculum/outcomes.jsonl"]


def test_in_the_split_placement_a_window_ends_with_the_batches_of_a_buffer(tmp_path):
    path = tmp_path / "split"
    rows = _train(_config(placement="split"), path)
    lines = _assert_counts_add_up(path, rows)
    _assert_pairs_add_up(lines, rows)
    first_batch = {row["policy_version"]: row["update"] for row in events(path, "buffer_adopted")}
    assert first_batch == {0: 0, 3: 5, 6: 8}
    for line in lines:
        batches = range(line["from_update"], line["update"])
        used = {max(version for version, at in first_batch.items() if at <= batch) for batch in batches}
        assert used == {line["buffer"]}
    assert [int(snapshot.arrays["first_batch"]) for snapshot in _snapshots(path)] == [*first_batch.values()]


@pytest.mark.long
def test_a_replay_buffer_is_written_with_each_checkpoint(tmp_path):
    curriculum = CurriculumConfig(name="accel", buffer_size=12)
    path = tmp_path / "accel"
    rows = _train(_config(curriculum=curriculum), path)
    lines = _assert_counts_add_up(path, rows)
    assert [line["update"] for line in lines] == [3, 6, 8]
    for line in lines:
        assert "buffer" not in line and "attempts" not in line
        assert line["sources"].keys() == {"fresh", "replayed", "edited"}
        assert all(count["attempts"] > 0 for count in line["sources"].values())
    snapshots = _snapshots(path)
    assert [(snapshot.kind, snapshot.number) for snapshot in snapshots] == [(BUFFER, number) for number in (2, 4, 6, 8)]
    for snapshot in snapshots:
        state = select_arrays(_arrays_at(path, snapshot.number), "curriculum")
        filled = state["born"] >= 0
        for name in ("score", "best_return", "born", "last_played"):
            np.testing.assert_array_equal(snapshot.arrays[name], state[name][filled], strict=True)
        for name, array in select_arrays(state, "levels").items():
            np.testing.assert_array_equal(_levels(snapshot)[name], array[filled], strict=True)
    # What persists: the same slot and birth is the same level, and nothing else is.
    by_birth, by_id = {}, {}
    for snapshot in snapshots:
        columns = (snapshot.arrays[name].tolist() for name in ("slot", "born", "level_id"))
        for slot, born, level_id in zip(*columns, strict=True):
            assert by_birth.setdefault((slot, born), level_id) == level_id
            by_id.setdefault(level_id, set()).add((slot, born))
    assert len(by_birth) < sum(len(snapshot.arrays["slot"]) for snapshot in snapshots), "nothing persisted"


def test_levels_of_a_fixed_set_are_counted_one_by_one(tmp_path):
    curriculum = CurriculumConfig(name="fixed", levels="s/kick")
    rows = _train(_config(curriculum=curriculum), tmp_path / "fixed")
    lines = _assert_counts_add_up(tmp_path / "fixed", rows)
    assert all(len(line["attempts"]) == 1 and line["sources"] == {} and "buffer" not in line for line in lines)
    assert not list_snapshots(tmp_path / "fixed" / "curriculum")


def _a_file_in_its_place(path):
    path.mkdir()
    (path / "curriculum").write_text("no directory")
    return contextlib.nullcontext()


def _a_full_disk(path):
    del path
    return full_disk()


@pytest.mark.parametrize("broken", [_a_file_in_its_place, _a_full_disk])
def test_what_the_disk_does_not_take_is_counted_and_training_is_the_same(logged, tmp_path, broken):
    path, full = tmp_path / "run", contextlib.ExitStack()

    def at_update(number):
        if number == 1 and broken is _a_full_disk:
            full.enter_context(full_disk())
        if number == NUM_UPDATES - 1:
            full.close()

    if broken is _a_file_in_its_place:
        full.enter_context(broken(path))
    with full:
        rows = _train(_config(checkpoint_every=NUM_UPDATES), path, reporter=QuietReporter(at_update))
    assert_same_bits(final_arrays(path), final_arrays(logged[0]))
    assert [row["update"] for row in rows] == [*range(1, NUM_UPDATES + 1)]
    failing = {row["sink"] for row in events(path, "sink_failing")}
    assert "curriculum" in failing or "curriculum/outcomes.jsonl" in failing
    assert rows[-1]["telemetry/dropped_writes"] > 0
    lines = read_lines(path / "curriculum" / "outcomes.jsonl") if broken is _a_full_disk else None
    assert lines is None or (not lines.damaged and [row["update"] for row in lines.rows] == [8])


def test_processes_say_what_they_hold(logged):
    (line,) = read_lines(logged[0] / "processes.jsonl").rows
    (process,) = line["processes"]
    assert process["name"] == process["role"] == "driver" and process["device"] == "cpu"
    assert process["resident_bytes"] > 1 << 20 and process["age_seconds"] < 60
    assert "pool_bytes" not in process and "busy" not in process


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A whole run, with an evaluation every 2 updates."""
    config = _config()
    config = dataclasses.replace(config, evaluation=dataclasses.replace(config.evaluation, every=4))
    run = RunDirectory.create(tmp_path_factory.mktemp("trained") / "run", numbered=False)
    report = train(config, run, resume=False)
    run.close()
    return run, config, report


def test_every_evaluation_is_a_line_with_the_attempts_of_each_level(trained):
    run, config, report = trained
    rows = read_lines(run.evaluation_rows).rows
    expected = [("random_policy", 0), ("before", 0), ("training", 4), ("training", 8), ("after", 8)]
    assert [(row["phase"], row["update"]) for row in rows] == expected
    metrics = {row["update"]: row for row in read_lines(run.metrics / "metrics.jsonl").rows}
    for row in rows:
        assert row["env_steps"] == row["update"] * config.rollout.steps_per_update
        (counts,) = row["sets"].values()
        assert counts["names"] == ["kick"] and counts["attempts"] == 4
        rate = sum(counts["solved"]) / 4
        if row["phase"] == "training":
            assert metrics[row["reported_at"]]["evaluation/s/kick/solve_rate"] == rate
        else:
            assert report["solve_rate"][row["phase"]]["s/kick"]["rate"] == rate
    assert '"levels"' not in json.dumps(report["solve_rate"])  # of each level: in evaluations.jsonl alone
    assert [row["update"] for row in events(run.path, "evaluated")] == [4, 8]


def _status(run: RunDirectory) -> Status:
    status = read_status(run.status)
    assert status is not None
    return status


def test_status_and_events_say_that_a_run_is_finished_and_a_session_more_that_goes_on(trained):
    run, config, _ = trained
    status = _status(run)
    steps = config.rollout.steps_per_update
    assert (status.state, status.phase, status.session) == (FINISHED, "done", 1)
    assert (status.update, status.env_steps, status.total_env_steps) == (NUM_UPDATES, 8 * steps, 8 * steps)
    assert [row["update"] for row in events(run.path, "checkpoint_saved")] == [2, 4, 6, 8]
    assert events(run.path, "run_started")[0]["session"] == 1 and not events(run.path, "run_failed")
    (finished,) = events(run.path, "run_finished")
    assert finished["update"] == NUM_UPDATES
    again = RunDirectory.open_existing(run.path)
    train(config, again, resume=True)
    again.close()
    assert _status(run).session == 2
    assert [row["session"] for row in events(run.path, "run_started")] == [
        1,
        2,
    ]


def test_status_and_event_have_the_line_that_a_failed_run_ends_with(tmp_path):
    config = _config()
    config = dataclasses.replace(config, run=dataclasses.replace(config.run, start_from=str(tmp_path / "none")))
    run = RunDirectory.create(tmp_path / "run", numbered=False)
    with pytest.raises(Exception, match="none") as caught:
        train(config, run, resume=False)
    run.close()
    status = _status(run)
    assert status.state == FAILED and status.error == str(caught.value)
    assert [row["error"] for row in events(run.path, "run_failed")] == [status.error]


def test_a_curriculum_that_leaves_worlds_out_of_the_counts_is_refused(tmp_path):
    run = RunDirectory.create(tmp_path / "run", numbered=False)
    data = RunData(_config(), run, QuietReporter())
    data.start({}, {}, num_updates=0)
    attempts = {"attempts": np.array([3, 1]), "solved": np.array([0, 0])}
    with pytest.raises(ValueError, match="'sfl': of 5 worlds 4 have a source"):
        data.played(1, attempts, num_attempts=5.0, buffer=0)
    run.close()


def test_evaluations_before_training_are_there_once_after_an_end_before_the_first_checkpoint(tmp_path):
    run = RunDirectory.create(tmp_path / "run", numbered=False)

    def session(*phases, loses_a_worker=False):
        data = RunData(_config(), run, QuietReporter())
        data.start({}, {}, num_updates=0)
        for phase in phases:
            data.evaluated(phase, 0, {"s": {"levels": {}}}, reported_at=0)
        if loses_a_worker:  # training goes on from nothing, and what was evaluated stays
            data.start({}, {}, num_updates=0)
        data.close(0)
        return [row["phase"] for row in read_lines(run.evaluation_rows).rows]

    assert session("random_policy") == ["random_policy"]
    assert session("random_policy", "before", loses_a_worker=True) == ["random_policy", "before"]
    assert session() == []
    run.close()


@pytest.mark.slow  # starts three processes
def test_in_processes_of_their_own_the_same_is_written(logged, tmp_path):
    from kinetix_dist.runtime.processes.ray_backend import RayBackend

    backend = RayBackend(heartbeat_seconds=60.0)
    try:
        _train(_config(placement="colocated"), tmp_path / "ray", backend=backend)
    finally:
        backend.stop()
    _assert_same_data(tmp_path / "ray", logged[0])
    assert_same_bits(final_arrays(tmp_path / "ray"), final_arrays(logged[0]))
    processes = {one["name"]: one for one in read_lines(tmp_path / "ray" / "processes.jsonl").rows[-1]["processes"]}
    assert processes.keys() == {"driver", "worker 0", "curator 0"}
    assert len({one["pid"] for one in processes.values()}) == 3
    assert processes["worker 0"]["device"] == "cpu" and "device" not in processes["driver"]
