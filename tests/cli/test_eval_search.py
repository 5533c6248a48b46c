"""`kinetix-dist eval --search`: a table and numbers of their own, and one line for a search that cannot be."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from kinetix_dist.cli.main import main
from kinetix_dist.models.policy import PolicyConfig
from tests.cli.test_eval_command import TINY_POLICY, refusal, save_run

SEARCH = ["--levels", "s/trapdoor", "--attempts", "2", "--search-worlds", "32", "--search-levels", "1"]


@pytest.mark.long
def test_a_level_that_the_policy_never_solves_is_solved_by_search(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """And the same again for the same seed: both runs write the same numbers, but for times."""
    results = []
    for number in range(2):
        target = tmp_path / f"{number}.json"
        options = ["--policy", "noop", "--search-rounds", "4", "--search-starts", "2", "--json", str(target)]
        assert main(["eval", *SEARCH, *options]) == 0
        results.append(json.loads(target.read_text()))
    printed, said = capsys.readouterr()
    assert said.splitlines()[-1] == "searched 1 of 1 levels: 1 have a plan"
    assert "policy alone, one attempt a level: 0.0%, 0 of 1" in printed
    assert "with search: 100.0%, 1 of 1" in printed
    assert results[0]["solve_rate"]["noop"]["rate"] == 0.0  # no part of the rate with search
    search = results[0]["search"]
    assert search["solve_rate"]["with_search"]["rate"] == 1.0 and search["solve_rate"]["policy_alone"]["rate"] == 0.0
    assert search["solve_rate"]["perturbed_starts"]["attempts"] == 2
    for result in results:
        for name in ("compile_seconds", "search_seconds"):
            assert result["search"].pop(name) > 0
        assert result["search"]["levels"][0].pop("found_after_seconds") > 0
    assert results[0] == results[1]


@pytest.mark.long
def test_a_network_is_searched_with_in_seconds(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    checkpoint = save_run(tmp_path, TINY_POLICY)
    options = ["--checkpoint", str(checkpoint), "--greedy", "--no-baselines", "--search", "3", "--search-starts", "0"]
    assert main(["eval", *SEARCH, *options]) == 0
    printed = capsys.readouterr().out
    assert "search of 3 s a level, 1 levels at once, 32 worlds each" in printed and "solved after 0 s: " in printed


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--search", "0"], "--search is 0.0; give the seconds"),
        (["--search", "-1"], "--search is -1.0"),
        (["--search", "nan"], "--search is nan"),
        (["--search", "inf"], "--search is inf"),
        (["--search", "1", "--search-rounds", "1"], "give one of them"),
        (["--search-rounds", "0"], "--search-rounds is 0; give 1 or more"),
        (["--search", "1", "--search-worlds", "8"], "--search-worlds is 8; give 16 or more"),
        (["--search", "1", "--search-levels", "0"], "--search-levels is 0"),
        (["--search", "1", "--search-starts", "-1"], "--search-starts is -1"),
        (["--search-worlds", "64"], "give --search SECONDS"),
    ],
)
def test_a_search_without_time_or_worlds_gets_one_line(
    options: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert message in refusal(capsys, "--levels", "s/trapdoor", "--policy", "noop", *options)


def test_an_unknown_policy_gets_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    error = refusal(capsys, "--levels", "s/trapdoor", "--checkpoint", "generalists", "--search", "1")
    assert "there is no checkpoint generalists" in error


def test_a_policy_with_a_memory_cannot_be_searched_with(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    checkpoint = save_run(tmp_path, RECURRENT)
    options = ["--checkpoint", str(checkpoint), "--attempts", "1", "--no-baselines", "--search", "1"]
    assert "a policy with a memory cannot be planned with" in refusal(capsys, "--levels", "s/trapdoor", *options)


RECURRENT = PolicyConfig(
    encoder_size=8, hidden_size=8, hidden_layers=1, num_layers=1, attention_features=8, recurrent="gru", memory_size=8
)
