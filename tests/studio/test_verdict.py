"""Verdicts on runs that are written by formula: each judgement where it should be, and nowhere else."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kinetix_dist.studio.runs.fresh_pairs import learnability_of_pairs
from kinetix_dist.studio.runs.processes import Processes
from kinetix_dist.studio.runs.refreshes import Refreshes
from kinetix_dist.studio.runs.run_reader import RunReader
from kinetix_dist.studio.runs.statements import Statement
from kinetix_dist.studio.runs.verdict import Verdict, verdict_of
from kinetix_dist.studio.runs.verdict_sets import SetHistory
from kinetix_dist.studio.runs.verdict_stability import stability_of
from kinetix_dist.telemetry.curriculum_log import BUFFER, DIRECTORY, OUTCOMES, write_snapshot
from kinetix_dist.telemetry.json_lines import append_line
from tests.helpers import REPOSITORY
from tests.studio.runs_for_tests import write_config, write_rows
from tests.studio.serving import serving
from tests.studio.verdict_runs import (
    ATTEMPTS,
    WINDOW,
    undecided,
    write_collapsed,
    write_curriculum,
    write_evaluation,
    write_learning,
    write_metrics,
    write_mislabelled,
    write_state,
)
from tests.studio.verdict_runs import (
    BUFFER as LEVELS_OF_BUFFER,
)


def verdict(run: Path) -> Verdict:
    reader = RunReader(run)
    reader.read_first(lambda left: None)
    found = verdict_of(reader, Refreshes(run), Processes(run))
    json.dumps(found.to_json(), allow_nan=False)
    return found


def statement(found: Verdict, key: str) -> Statement:
    return next(one for one in found.statements if one.key == key)


def states(found: Verdict) -> dict[str, str]:
    return {one.key: one.state for one in found.statements}


@pytest.fixture(scope="module")
def learning(tmp_path_factory: pytest.TempPathFactory) -> Verdict:
    return verdict(write_learning(tmp_path_factory.mktemp("runs") / "learns"))


def test_a_run_that_learns_is_called_so_with_its_numbers(learning: Verdict) -> None:
    assert learning.state == "good" and not learning.problems
    assert learning.heading == (
        "Yes: it learned. 2 of 2 held-out sets rose by more than chance: frontier_s 14.0 → 40.0 % (random actions "
        "12.0 %), random_s 34.0 → 54.0 % (random actions 36.0 %)."
    )
    assert {key for key, state in states(learning).items() if state != "good"} == {"failing", "untouched"}
    random_s = statement(learning, "set/random_s")
    assert (
        "54.0 % (52.0 to 55.9; 2,500 attempts) at update 96: a gain of 20.0 points (17.3 to 22.7)" in random_s.sentence
    )
    assert "Random actions 36.0 % (34.1 to 37.9; 2,500 attempts): above (+18.0 points" in random_s.sentence
    assert (random_s.page, random_s.query) == (
        "evaluation",
        {"set": "random_s", "sort": "least", "panel": "random_s: "},
    )


def test_learnability_of_the_buffer_is_held_against_fresh_levels_in_training(learning: Verdict) -> None:
    sentence = statement(learning, "learnability").sentence
    for part in ("Buffer 80 in training 0.2", "claimed by scoring 0.25", "all 2,048 candidates 0.0", "1,024 pairs"):
        assert part in sentence
    assert sentence.endswith("times that of fresh levels in training.")


def test_levels_made_easy_and_never_touched_are_named(learning: Verdict) -> None:
    easy, untouched = statement(learning, "easy"), statement(learning, "untouched")
    assert "Of 48 levels of buffer 64, played again at refresh 80" in easy.sentence and "a gain of" in easy.sentence
    assert "in none of the newest 6 buffers: 4 joints (" in untouched.sentence and "0 of 3," in untouched.sentence
    assert easy.query["refresh"] == "64" and untouched.query["refresh"] == "80"


def test_a_feature_that_is_easy_more_often_stands_out(tmp_path: Path) -> None:
    run = write_learning(tmp_path / "a")
    (path,) = (run / DIRECTORY).glob("refresh_00000064.npz")
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files if name not in ("format", "kind")}
    arrays["features"][:24, 0], arrays["features"][24:, 0] = 1, 2
    write_snapshot(run / DIRECTORY, "refresh", 64, arrays)
    (path,) = (run / DIRECTORY).glob("refresh_00000080.npz")
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files if name not in ("format", "kind")}
    arrays["probe/solved"] = np.array([8] * 24 + [3] * 24, np.int32)
    write_snapshot(run / DIRECTORY, "refresh", 80, arrays)
    assert "More often than others: 1 shape (24 of 24)." in statement(verdict(run), "easy").sentence


def test_a_collapse_is_called_so_with_all_its_signs(tmp_path: Path) -> None:
    found = verdict(write_collapsed(tmp_path / "a"))
    assert found.state == "bad" and found.heading.startswith(
        "No: training collapsed; random_s fell from 50.0 % at update 48 to 4.0 %"
    )
    stability = statement(found, "stability")
    assert stability.state == "bad" and "lower ppo.learning_rate" in stability.remedy
    for sign in (
        "fresh levels in training fell from",
        "entropy 0.01 nat (5 in the first row)",
        "gradient steps skipped",
    ):
        assert sign in stability.sentence
    worse = statement(found, "worse")
    assert worse.state == "bad" and worse.sentence.startswith("2 of 2 sets: random_s, a loss of 46.0 points")
    assert statement(found, "warnings").sentence == "None of other metrics: see the parts above.", "each is said once"


def test_a_collapse_is_seen_in_metrics_alone_and_a_new_phase_is_none(tmp_path: Path) -> None:
    for name, phase in (("same", 0.0), ("other", 1.0)):
        run = write_config(tmp_path / name)
        write_metrics(
            run,
            100,
            lambda update, phase=phase: (
                {"train/solve_rate": 0.5 + 0.01 * (update % 3), "progress/phase": 0.0}
                if update <= 60
                else {"train/solve_rate": 0.1 + 0.01 * (update % 3), "progress/phase": phase}
            ),
        )
    assert "all levels in training fell from 51." in verdict(tmp_path / "same").heading
    other = verdict(tmp_path / "other")
    assert other.state == "unknown" and states(other)["stability"] == "good"


@pytest.mark.parametrize(
    ("metrics", "state", "text"),
    [
        ({"learner/entropy": 0.1}, "neutral", "No collapse of solve rates, but entropy 0.1 nat"),
        ({"learner/skipped_steps": 2.0}, "bad", "Collapsed: 40 gradient steps skipped"),
        ({"learner/policy_loss": float("nan")}, "bad", "the policy loss is no finite number since update 81"),
    ],
)
def test_signs_of_a_collapse(tmp_path: Path, metrics: dict[str, Any], state: str, text: str) -> None:
    run = write_config(tmp_path / "a")
    write_metrics(
        run, 100, lambda u: {"train/solve_rate": 0.5, "learner/policy_loss": 0.1, **(metrics if u > 80 else {})}
    )
    found = statement(verdict(run), "stability")
    assert found.state == state and text in found.sentence


def test_labels_by_few_episodes_are_called_so_and_the_remedy_named(tmp_path: Path) -> None:
    found = verdict(write_mislabelled(tmp_path / "a"))
    claim = statement(found, "claim")
    assert claim.state == "bad" and claim.sentence.startswith("Mislabelled: buffer 80 claims p (1 - p) 0.2")
    assert "by 2.0 scoring episodes per level" in claim.sentence and "raise curriculum.scoring_steps" in claim.remedy
    assert found.state == "bad" and "its buffer is mislabelled" in found.heading


def test_a_good_run_with_a_mislabelled_buffer_is_neither(tmp_path: Path) -> None:
    run = write_mislabelled(tmp_path / "a")
    write_evaluation(run, "after", 97, {"random_s": 0.6})
    found = verdict(run)
    assert (
        found.state == "neutral" and found.heading.startswith("Yes: it learned.") and "But its buffer" in found.heading
    )


def test_levels_that_are_learned_while_they_are_used_are_not_mislabelled(tmp_path: Path) -> None:
    """p rises from 1/2 to 1 within a buffer's use, so that all plays together find far less than the claim."""
    run = write_config(tmp_path / "a")
    write_metrics(run, 2 * WINDOW, lambda update: {})
    write_curriculum(run, 2, undecided, episodes=24, rise=0.5)
    found = verdict(run)
    assert statement(found, "claim").state == "good"
    overall = statement(found, "learnability").sentence.split("in training ")[1]
    assert float(overall.split()[0]) < 0.6 * 0.25


def test_solve_rates_in_training_are_held_against_the_first_the_best_and_a_line(tmp_path: Path) -> None:
    """They rise to update 48, then fall back half of the way: more than at first, less than at best, and falling."""
    run = write_config(tmp_path / "a")
    write_metrics(run, 96, lambda update: {})
    write_curriculum(run, 6, undecided, episodes=8, fresh_rate=lambda u: 0.3 + (u if u < 48 else 96 - u / 1.5) / 160)
    found = statement(verdict(run), "training")
    assert found.state == "neutral" and ": a gain of " in found.sentence
    assert "The best part was" in found.sentence and "; since then a loss of" in found.sentence
    assert "A line through the last half falls (-" in found.sentence


def test_a_run_with_its_configuration_alone_is_unknown(tmp_path: Path) -> None:
    run = write_config(tmp_path / "a", run={"total_env_steps": 1024})
    found = verdict(run)
    assert (found.state, found.heading) == ("unknown", "Too early to tell: no update is done.")
    assert set(states(found).values()) == {"unknown", "good"} and states(found)["warnings"] == "good"
    assert "First buffer expected after update 0" in statement(found, "learnability").sentence
    write_state(run, "running", "compiling", None)
    assert verdict(run).heading.endswith("The run is compiling.")
    write_state(run, "failed", "compiling", None, error="no memory is left")
    found = verdict(run)
    assert (found.state, found.heading) == ("bad", "The run failed before its first update.")
    assert "no memory is left" in statement(found, "status").sentence


def test_a_run_that_failed_is_judged_until_then(tmp_path: Path) -> None:
    run = write_learning(tmp_path / "a")
    write_state(run, "failed", "training", 96, error="the disk is full")
    found = verdict(run)
    assert found.state == "bad" and found.heading.startswith("The run failed. Until then: yes: it learned.")


def test_an_empty_directory_of_a_run_without_config_has_a_verdict(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text("{}")
    assert "no config.json that can be read" in statement(verdict(tmp_path), "learnability").sentence


def test_damaged_lines_and_files_are_left_out_and_named(tmp_path: Path) -> None:
    run = write_learning(tmp_path / "a")
    before = verdict(run)
    for name in ("evaluations.jsonl", f"{DIRECTORY}/{OUTCOMES}", "metrics/metrics.jsonl", "processes.jsonl"):
        with (run / name).open("ab") as file:
            file.write(b'{"cut": \n{"update": 3}\n[]\n')
    (run / DIRECTORY / "refresh_00000000.npz").write_bytes(b"no archive")
    after = verdict(run)
    assert (after.state, after.heading) == (before.state, before.heading)
    assert [statement(after, key) for key in ("claim", "easy")] == [statement(before, key) for key in ("claim", "easy")]
    assert "since buffer 0," in statement(before, "learnability").sentence
    assert "since buffer 16," in statement(after, "learnability").sentence
    text = "\n".join(after.problems)
    for name in ("evaluations.jsonl", OUTCOMES, "processes.jsonl", "refresh_00000000.npz"):
        assert name in text


def test_a_snapshot_without_an_array_is_left_out(tmp_path: Path) -> None:
    run = write_learning(tmp_path / "a", refreshes=2)
    (path,) = (run / DIRECTORY).glob("refresh_00000016.npz")
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files if name not in ("format", "kind", "finished")}
    write_snapshot(run / DIRECTORY, "refresh", 16, arrays)
    found = verdict(run)
    assert "refresh 16 lacks finished; it is left out" in found.problems
    assert statement(found, "claim").sentence.startswith("Buffer 0 claims")


def test_without_evaluations_fresh_levels_in_training_answer(tmp_path: Path) -> None:
    run = write_learning(tmp_path / "a")
    (run / "evaluations.jsonl").unlink()
    found = verdict(run)
    assert found.state == "good" and found.heading.startswith("Yes on fresh levels in training")
    assert states(found)["sets"] == "unknown"


def test_one_evaluation_says_nothing_of_a_change(tmp_path: Path) -> None:
    run = write_config(tmp_path / "a", evaluation={"sets": ["random_s"], "every": 8})
    write_rows(run, 1, 5)
    write_evaluation(run, "random_policy", 0, {"random_s": 0.3})
    write_evaluation(run, "before", 0, {"random_s": 0.1})
    found = verdict(run)
    assert found.state == "unknown" and "was evaluated once" in found.heading
    assert statement(found, "set/random_s").state == "unknown"
    assert "Evaluations come every 8 updates" in statement(found, "set/random_s").sentence
    assert states(found)["worse"] == "unknown"


def test_a_gain_below_random_actions_is_not_called_good(tmp_path: Path) -> None:
    run = write_config(tmp_path / "a")
    write_rows(run, 1, 5)
    for phase, update, rate in (("random_policy", 0, 0.4), ("before", 0, 0.1), ("after", 5, 0.2)):
        write_evaluation(run, phase, update, {"random_s": rate})
    found = verdict(run)
    assert found.state == "neutral" and "not above random actions" in found.heading
    assert "below (-20.0 points" in statement(found, "set/random_s").sentence


def test_a_run_that_went_on_after_its_end_is_judged_by_its_newest_evaluation(tmp_path: Path) -> None:
    run = write_config(tmp_path / "a")
    write_rows(run, 1, 60)
    for phase, update, rate in (("before", 0, 0.2), ("after", 40, 0.3), ("training", 60, 0.5)):
        write_evaluation(run, phase, update, {"random_s": rate})
    assert "50.0 % (48.0 to 52.0; 2,500 attempts) at update 60" in statement(verdict(run), "set/random_s").sentence


def test_the_best_of_many_evaluations_is_no_loss_by_chance_alone(tmp_path: Path) -> None:
    """40 evaluations of a constant rate: the best is 3.6 points above the last, beyond the interval of one comparison,
    and within that of forty."""
    run = write_config(tmp_path / "a")
    write_rows(run, 1, 40)
    for update in range(40):
        write_evaluation(
            run, "before" if not update else "training", update, {"random_s": 0.54 if update == 9 else 0.5}
        )
    write_evaluation(run, "after", 40, {"random_s": 0.5})
    found = statement(verdict(run), "worse")
    assert found.state == "good" and found.sentence.startswith("random_s is not below")


def test_variants_are_judged_by_their_base_levels(tmp_path: Path) -> None:
    """One of four base levels is mastered: eight variants of it are one observation, no gain that can be told."""
    run = write_config(tmp_path / "a")
    write_rows(run, 1, 5)
    names = [f"base{level}_{variant}" for level in "abcd" for variant in range(8)]
    for phase, update, solved in (("before", 0, [0] * 32), ("after", 5, [16] * 8 + [0] * 24)):
        entry = {"names": names, "solved": solved, "attempts": 16}
        row = {"format": 1, "phase": phase, "update": update, "env_steps": 0, "reported_at": update}
        append_line(run / "evaluations.jsonl", row | {"sets": {"dev_designed_s": entry}})
    found = verdict(run)
    assert statement(found, "set/dev_designed_s").state == "neutral" and found.state == "neutral"


def test_a_curriculum_without_a_buffer_has_the_learnability_of_fresh_levels(tmp_path: Path) -> None:
    run = write_config(tmp_path / "a", curriculum={"name": "domain_randomization"})
    write_rows(run, 1, 32)
    for first in (0, 16):
        sources = {"fresh": {"solved": 100 + 10 * first, "attempts": 512}}
        pairs = {"both": 20, "one": 40, "none": 140}
        line = {"format": 2, "from_update": first, "update": first + 16, "sources": sources, "fresh_pairs": pairs}
        append_line_of_outcomes(run, line)
    found = statement(verdict(run), "learnability")
    assert found.state == "neutral" and "domain_randomization keeps no buffer" in found.sentence
    assert "0.100 (0.082 to 0.121), 400 pairs of worlds" in found.sentence
    assert states(verdict(run))["training"] == "good"


def append_line_of_outcomes(run: Path, line: dict[str, Any]) -> None:
    (run / DIRECTORY).mkdir(exist_ok=True)
    append_line(run / DIRECTORY / OUTCOMES, line)


def test_a_replay_buffer_has_rates_of_its_sources(tmp_path: Path) -> None:
    run = write_config(tmp_path / "a", curriculum={"name": "plr"})
    write_rows(run, 1, 16)
    assert "First buffer expected after update 2 (" in statement(verdict(run), "learnability").sentence
    sources = {"fresh": {"solved": 100, "attempts": 400}, "replayed": {"solved": 300, "attempts": 400}}
    append_line_of_outcomes(run, {"format": 2, "from_update": 0, "update": 16, "sources": sources})
    arrays = {
        "curriculum": np.str_("plr"), "size": np.str_("s"), "policy_version": np.int32(16),
        "written_after": np.int32(16), "level_id": np.arange(4, dtype=np.uint64), "score": np.ones(4, np.float32),
        "features": np.zeros((4, 1), np.uint8), "feature_names": np.array(["shapes"]),
    }  # fmt: skip
    write_snapshot(run / DIRECTORY, BUFFER, 16, arrays)
    sentence = statement(verdict(run), "learnability").sentence
    assert "plr claims no solve rates" in sentence and "replayed 75.0 % (300 of 400)" in sentence
    assert sentence.endswith("Fresh levels in training: not recorded by this run.")


def test_pairs_of_worlds_measure_p_1_minus_p_without_bias() -> None:
    chance = np.random.default_rng(0)
    p = chance.beta(0.4, 0.4, 20_000)
    twice = chance.binomial(2, p)
    pairs = {name: int((twice == count).sum()) for count, name in enumerate(("none", "one", "both"))}
    found = learnability_of_pairs([{"fresh_pairs": pairs}, {"no": "pairs"}])
    assert found is not None and found["pairs"] == 20_000
    assert found["low"] < (p * (1 - p)).mean() < found["high"] and found["high"] - found["low"] < 0.01
    assert (
        learnability_of_pairs([]) is None and learnability_of_pairs([{"fresh_pairs": dict.fromkeys(pairs, 0)}]) is None
    )


def test_pairs_belong_to_the_buffer_in_whose_windows_they_were(tmp_path: Path) -> None:
    run = write_learning(tmp_path / "a", refreshes=2)
    first, second = Refreshes(run).summaries()["snapshots"]
    for entry in (first, second):
        assert entry["fresh_pairs"]["pairs"] == 4 * ATTEMPTS // 2, "four windows of a buffer"
        assert entry["num_levels"] == LEVELS_OF_BUFFER
    line = {
        "format": 2,
        "from_update": 32,
        "update": 36,
        "sources": {},
        "fresh_pairs": {"both": -1, "one": 0, "none": 0},
    }
    append_line(run / DIRECTORY / OUTCOMES, line)
    (problem,) = Refreshes(run).summaries()["problems"]
    assert OUTCOMES in problem and problem.startswith("1 line")


def test_a_curriculum_that_chooses_all_levels_does_not_collapse_by_harder_ones(tmp_path: Path) -> None:
    run = write_config(tmp_path / "a", curriculum={"name": "paired"})
    write_metrics(run, 100, lambda update: {"train/solve_rate": 0.6 if update <= 50 else 0.1 + 0.01 * (update % 3)})
    sources = {"protagonist": {"solved": 200, "attempts": 400}}
    append_line_of_outcomes(run, {"format": 2, "from_update": 0, "update": 50, "sources": sources})
    assert states(verdict(run))["training"] == "unknown" and states(verdict(run))["stability"] == "good"


def test_slices_are_measured_by_their_own_metric(tmp_path: Path) -> None:
    run = write_config(tmp_path / "a", curriculum={"name": "sfl_slices"})
    now = {"curriculum/learnability_now": 0.06, "curriculum/learnability_now_error": 0.005}
    write_metrics(run, 20, lambda update: now)
    write_curriculum(run, 1, undecided, episodes=24)
    (run / DIRECTORY / OUTCOMES).unlink()
    (path,) = (run / DIRECTORY).glob("refresh_*.npz")
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files if name not in ("format", "kind")}
    write_snapshot(run / DIRECTORY, "refresh", 0, arrays | {"curriculum": np.str_("sfl_slices")})
    found = verdict(run)
    assert "training finds 0.060 (0.050 to 0.070)" in statement(found, "claim").sentence
    assert "candidates unknown" in statement(found, "learnability").sentence
    assert states(found)["untouched"] == "unknown"


def test_speed_names_its_bottleneck_and_a_run_that_became_slow(tmp_path: Path) -> None:
    run = write_config(tmp_path / "a")
    write_metrics(run, 50, lambda u: {"progress/env_steps_per_second": 1000.0 if u <= 40 else 400.0, "time/idle": 0.3})
    found = statement(verdict(run), "speed")
    assert (
        found.state == "bad"
        and found.sentence.startswith("400 env steps/s")
        and "playing levels (60.0 %)" in found.sentence
    )
    process = {"name": "learner 0", "role": "learner", "host": "a", "pid": 1, "resident_bytes": 1, "busy": 0.25}
    row = {"format": 1, "time": "2026-01-31T12:00:00Z", "update": 50, "processes": [process]}
    append_line(run / "processes.jsonl", row)
    assert "idlest process: learner 0, in no call for 75.0 % of the time" in statement(verdict(run), "speed").sentence


def test_the_server_answers_and_every_statement_is_documented(tmp_path: Path, learning: Verdict) -> None:
    write_collapsed(tmp_path / "a", refreshes=2)
    with serving(tmp_path, "--no-play") as server:
        found = server.json("/api/runs/a/verdict")
    assert found["state"] == "bad" and found["statements"][0]["key"] == "set/random_s"
    documented = (REPOSITORY / "docs" / "dashboard.md").read_text()
    for one in learning.statements:
        assert f"| {'a set' if one.key.startswith('set/') else one.title} |" in documented, one.title


def test_a_phase_that_began_before_a_collapse_is_its_cause(tmp_path: Path) -> None:
    run = write_config(tmp_path / "a")
    phase = {"event": "phase_began", "phase": 1, "changed": {"ppo.learning_rate": 0.3}}
    point = {"solved": [0], "attempts": 64, "rate": 0.0, "low": 0.0, "high": 0.06, "episodes": 64, "env_steps": 0}
    top = point | {"update": 20, "rate": 0.5, "solved": [32], "phase": "training"}
    first = point | {"update": 0, "rate": 0.1, "solved": [6], "phase": "before"}
    lost = SetHistory(
        name="s",
        levels=None,
        first=first,
        best=top,
        now=point | {"update": 30, "phase": "training"},
        random=None,
        since_first=(-0.1, -0.2, -0.01),
        since_best=(-0.5, -0.6, -0.4),
        since_half=(-0.5, -0.6, -0.4),
        above_random=None,
    )
    events = [
        {"event": "checkpoint_saved", "update": 20},
        phase | {"update": 10},
        phase | {"update": 22, "phase": 2},
        phase | {"update": 31, "phase": 3},
    ]
    reader = RunReader(run)
    reader.read_first(lambda left: None)
    found = stability_of(reader.table, [lost], None, events)
    assert found.causes == ("phase 2 began at update 22 and set ppo.learning_rate 0.3",)
    assert "go on from the checkpoint of update 20" in found.remedy and "take back what changed" in found.remedy
    assert not stability_of(reader.table, [lost], None, []).causes
