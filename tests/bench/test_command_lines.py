"""Programs that are not commands of kinetix-dist: help is help, and bad input is one line and exit code 2."""

from __future__ import annotations

import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from bench import (
    compare_revisions,
    compile_time,
    control_plane,
    dashboard,
    engine_promises,
    engine_worker,
    export_policy,
    fault_tests,
    frontier_sets,
    kernel_profile,
    learnability,
    learner_traffic,
    mixed_cost,
    paper_single_steps,
    policy_rounding,
    public_package,
    published_steps,
    recovery,
    rl_loop,
    set_fingerprints,
    smoke,
    soak,
    training_memory,
)
from jax2d.fidelity import hard_table, references

PROGRAMS = [
    compare_revisions.main,
    compile_time.main,
    control_plane.main,
    dashboard.main,
    engine_promises.main,
    learnability.main,
    learner_traffic.main,
    mixed_cost.main,
    engine_worker.main,
    export_policy.main,
    fault_tests.main,
    frontier_sets.main,
    hard_table.main,
    kernel_profile.main,
    paper_single_steps.main,
    policy_rounding.main,
    public_package.main,
    published_steps.main,
    recovery.main,
    references.main,
    rl_loop.main,
    set_fingerprints.main,
    smoke.main,
    soak.main,
    training_memory.main,
]


def end_of(main: Callable, arguments: list[str], monkeypatch: pytest.MonkeyPatch) -> int:
    """The exit code of a program that is called with these arguments."""
    monkeypatch.setattr(sys, "argv", ["program", *arguments])
    try:
        return main()
    except SystemExit as end:
        assert isinstance(end.code, int), end.code
        return end.code


@pytest.mark.parametrize("main", PROGRAMS, ids=lambda main: main.__module__)
def test_help_is_printed(main: Callable, monkeypatch, capsys):
    assert end_of(main, ["--help"], monkeypatch) == 0
    assert capsys.readouterr().out.startswith("usage: ")


@pytest.mark.parametrize("main", PROGRAMS, ids=lambda main: main.__module__)
def test_an_unknown_option_is_one_line(main: Callable, monkeypatch, capsys):
    assert end_of(main, ["--no-such-option"], monkeypatch) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "usage" not in line


@pytest.mark.parametrize(
    ("main", "arguments", "says"),
    [
        (hard_table.main, ["nosuch"], "unknown preset 'nosuch'; known: standard, fine, draft, paper"),
        (hard_table.main, ["standard", "reference"], "unknown preset 'reference'"),
        (references.main, ["nosuch"], "'nosuch'"),
        (published_steps.main, [], "arguments are required"),
        (published_steps.main, ["nosuch.npz", "to.npz"], "nosuch.npz does not exist"),
        (published_steps.main, ["other.npz", "to.npz"], "no excerpt of other.npz in to.npz"),
        (published_steps.main, ["text.npz", "to.npz"], "no excerpt of text.npz in to.npz"),
        (compare_revisions.main, ["run", "--sizes", "xl"], "--sizes has 'xl'"),
        (compare_revisions.main, ["run", "--json", "text.npz/out.json"], "cannot write text.npz/out.json"),
        (compare_revisions.main, ["export", "nosuch", "--folder", "revisions"], "nosuch"),
        (compare_revisions.main, ["export"], "export: give one git revision or more"),
        (compile_time.main, ["--sizes", "xl"], "--sizes has 'xl'"),
        (compile_time.main, ["--sizes", "3"], "a world of 3 shapes"),
        (control_plane.main, ["--processes", "4", "0"], "--processes has 0"),
        (export_policy.main, ["nosuch", "to"], "there is no checkpoint nosuch"),
        (policy_rounding.main, ["--checkpoint", "generalist", "--envs", "-1"], "--envs is -1; it must be 0 or more"),
        (policy_rounding.main, ["--checkpoint", "generalist", "--recipe", "tinny"], "did you mean 'tiny'?"),
        (policy_rounding.main, ["--checkpoint", "nosuch"], "nosuch"),
        (learnability.main, ["nosuch", "--attempts", "1"], "--attempts is 1; give 2 or more"),
        (smoke.main, ["--updates", "1"], "--updates is 1; the first one is not timed, so give 2 or more"),
        (smoke.main, ["--options", "rollout.num_envs=32"], "--options has 'rollout.num_envs=32'"),
        (smoke.main, ["--options", "run.seed"], "--options has 'run.seed'; give NAME=VALUE"),
        (smoke.main, ["--keep", "."], ". exists; name a new directory"),
        (smoke.main, ["--recipe", "tinny"], "unknown recipe 'tinny'; did you mean 'tiny'?"),
        (smoke.main, ["--measured", "tinny"], "unknown recipe 'tinny'; did you mean 'tiny'?"),
        (rl_loop.main, ["--worlds", "0"], "--worlds, --compiled-worlds, --steps and --repeats are 1 or more"),
        (kernel_profile.main, ["--worlds", "33"], "--worlds is 33; give a multiple of 32"),
        (kernel_profile.main, ["--preset", "nosuch"], "'nosuch'"),
        (
            kernel_profile.main,
            ["--parts", "divergence", "--sizes", "s", "--levels", "none"],
            "no level files in none/s",
        ),
        (learner_traffic.main, ["--networks", "nosuch"], "--networks has 'nosuch'"),
        (learner_traffic.main, ["--minibatch", "1000"], "--minibatch is 1000; give a multiple of the 2,048 worlds"),
        (learner_traffic.main, ["--encoder-size", "0"], "--encoder-size is 0"),
        (mixed_cost.main, [], "arguments are required"),
        (mixed_cost.main, ["--study", "text.npz"], "text.npz is no study of accuracy"),
        (mixed_cost.main, ["--study", "text.npz", "--seconds", "nan"], "--seconds is nan; give 0.033 or more"),
        (training_memory.main, ["--worlds", "1"], "--worlds is 1"),
        (training_memory.main, ["--worlds", "1000"], "is not a multiple of num_groups 64"),
        (training_memory.main, ["--recipes", "nosuch"], "unknown recipe 'nosuch'"),
        (paper_single_steps.main, ["--levels", "none"], "no public levels in none/s"),
        (public_package.main, [], "where are the public levels?"),
        (public_package.main, ["--levels", "none"], "no public levels in none/s"),
        (public_package.main, ["--levels", "none", "--policies", "0"], "--policies is 0; give 1 or more"),
        (public_package.main, ["--levels", "none", "--ways", "nosuch"], "--ways has 'nosuch': unknown preset 'nosuch'"),
        (public_package.main, ["--levels", "none", "--ways", "paper+mass"], "--ways has 'paper+mass'"),
        (public_package.main, ["--levels", "none", "--ways", "paper,decay=1"], "--ways has 'paper,decay=1'"),
        (soak.main, ["--worlds", "0"], "--worlds is 0"),
        (soak.main, ["--replay", "xl", "0", "0"], "--replay is xl 0 0"),
        (soak.main, ["--replay", "s", "first", "0"], "--replay is s first 0"),
    ],
)
def test_bad_input_is_one_line(main: Callable, arguments: list[str], says: str, tmp_path: Path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("KINETIX_LEVELS", raising=False)
    Path("text.npz").write_text("steps")
    with zipfile.ZipFile("other.npz", "w"):
        pass
    assert end_of(main, arguments, monkeypatch) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert says in line
