"""Designs that several tests use, as text of the design file."""

from pathlib import Path

from kinetix_dist.sweep.design import Design, read_design

HEAD = """
name = "mine"
recipe = "tiny"
{seconds}
seeds = [0]
start_seconds = 10
[objective]
sets = {sets}
from_second = {from_second}
every_seconds = 10
"""
FACTORIAL = """
[factorial]
factors = [
    {name = "epochs", low = {"ppo.epochs" = 1}, high = {"ppo.epochs" = 2}},
    {name = "rate", low = {"ppo.learning_rate" = 1e-4}, high = {"ppo.learning_rate" = 1e-3}},
]
"""
ARMS = """
[[arms]]
name = "plain"
[[arms]]
name = "wide"
options = {"ppo.clip" = 0.3}
[[arms]]
name = "narrow"
options = {"ppo.clip" = 0.1}
[[arms]]
name = "slow"
options = {"ppo.learning_rate" = 1e-4}
"""
HALVING = """
[halving]
rungs = [{seconds = 20, keep = 0.5}, {seconds = 40, keep = 0.5}, {seconds = 80}]
"""
DEVELOPMENT = "{dev_designed_s = 1.0}"


def text(body=FACTORIAL, *, seconds="seconds = 20", sets=DEVELOPMENT, from_second=0):
    return HEAD.format(seconds=seconds, sets=sets, from_second=from_second) + body


def halving_text():
    return text(ARMS + HALVING, seconds="")


def write(path: Path, content: str) -> Path:
    file = path / "design.toml"
    file.write_text(content)
    return file


def design(path: Path, content: str) -> Design:
    return read_design(write(path, content))
