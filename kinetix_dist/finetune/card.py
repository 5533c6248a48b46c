"""Cards of specialists: what each was trained on and how, what it solves, and how to play it, as Markdown.

OUT/scratch/hop_home.md   `card_of`, beside the figures that it is made of
OUT/README.md             `overview_of` all that is there: a row a level, a column a seed
"""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from kinetix_dist.config import TrainConfig
from kinetix_dist.env.env_config import describe
from kinetix_dist.stored_specialists import MIN_RATE, Record

VERSIONS = ("kinetix-dist", "engine", "jax", "warp-lang")  # that a card names; the figures have all


def card_of(record: Record, config: TrainConfig, policy: Path) -> str:
    """Card of one specialist. record: its figures; config: with its start and seed; policy: its checkpoint."""
    env, net, ppo, rollout = config.env, config.policy, config.ppo, config.rollout
    lineage = record["from"]
    first = record["curve"][0]
    reached = [
        f"{float(share):.0%} solved {'never' if steps is None else f'after {steps:,} steps'}"
        for share, steps in record["env_steps_to"].items()
    ]
    rows = {
        "trained on": f"level `{record['level']}` of `{config.curriculum.levels}`, and nothing else",
        "begun with": f"parameters drawn from seed {record['seed']}" if lineage is None else _lineage(lineage, record),
        "seed": str(record["seed"]),
        "steps": f"{record['env_steps']:,} of the environment, {record['curve'][-1]['updates']:,} updates",
        "network": f"`{net.network}`, {record['num_parameters']:,} parameters, {net.dtype}",
        "observation, actions": f"`{env.observation}`, `{env.action_space}`",
        "environment": f"size {env.size}, frame skip {env.frame_skip}, episodes of {env.max_steps} steps at most, "
        f"dense reward {env.dense_reward_scale:g}",
        "physics": describe(env.physics),
        "PPO": f"{rollout.num_envs} worlds x {rollout.num_steps} steps, {ppo.epochs} epochs of {ppo.minibatches} "
        f"minibatches, learning rate {ppo.learning_rate:g}, discount {ppo.discount:g}, trace {ppo.trace:g}, clip "
        f"{ppo.clip:g}",
        "configuration": f"hash `{record['config_hash']}`; whole in `checkpoint.json` of the policy",
        "chosen": "no: parameters of the end of training",
        "time": f"{record['seconds']['training']:.0f} s of training, {record['seconds']['evaluation']:.0f} s of "
        f"evaluation on {record['device']}",
        "versions": ", ".join(f"{name} {record['versions'].get(name, 'unknown')}" for name in VERSIONS),
    }
    final = record["final"]
    solved = (
        f"{final['rate']:.1%} ({final['low']:.1%} to {final['high']:.1%}, 95 %) of {final['attempts']} first episodes "
        f"at the end, {first['solved'] / first['attempts']:.1%} before; {'; '.join(reached)}."
    )
    return "\n".join(
        [
            f"# {record['level']}, {record['label']}, seed {record['seed']}",
            "",
            f"Solves {solved}",
            "",
            "The interval is of attempts by this one policy at this one level, actions sampled. It says nothing of "
            "other levels or of other seeds.",
            "",
            "| | |",
            "|---|---|",
            *(f"| {name} | {text} |" for name, text in rows.items()),
            "",
            "```sh",
            f"kinetix-dist eval --checkpoint {shlex.quote(str(policy))} --levels LEVEL",
            "```",
            "",
        ]
    )


def _lineage(lineage: Record, record: Record) -> str:
    return (
        f"{record['start']} ({lineage['policy_updates']:,} updates, SHA-256 of its manifest `{lineage['sha256'][:12]}`)"
    )


def overview_of(records: Sequence[Record], path: Path) -> str:
    """Card of a directory of specialists: final solve rates, a row a level and a column a start and seed."""
    folders = list(dict.fromkeys(record["folder"] for record in records))
    levels = list(dict.fromkeys(record["level"] for record in records))
    of = {(record["level"], record["folder"]): record for record in records}
    rows = [
        [f"`{level}`", *(_rate(of.get((level, folder))) for folder in folders), _good_seeds(records, level)]
        for level in levels
    ]
    rates = [[record["final"]["rate"] for record in records if record["folder"] == folder] for folder in folders]
    rows.append(["mean", *(f"{100 * np.mean(own):.0f}" for own in rates), ""])
    header = ["level", *(f"`{folder}`" for folder in folders), f"{MIN_RATE:.0%} or more"]
    attempts = records[0]["final"]["attempts"]
    return "\n".join(
        [
            f"# {len(records)} specialists of {len(levels)} levels",
            "",
            f"Solve rates in % at the end of training, {attempts} first episodes each. A rate of 50 % wavers by "
            f"{196 * 0.5 / attempts**0.5:.0f} points (95 %). Each has a card, `START/LEVEL.md`.",
            "",
            *(f"| {' | '.join(row)} |" for row in [header, ["---"] * len(header), *rows]),
            "",
            "```sh",
            f"kinetix-dist collect --policy {shlex.quote(str(path))} --levels LEVELS --transitions "
            f"{len(levels)}e6 --out DATA",
            "```",
            "",
        ]
    )


def _rate(record: Record | None) -> str:
    return "-" if record is None else f"{100 * record['final']['rate']:.0f}"


def _good_seeds(records: Sequence[Record], level: str) -> str:
    own = [record for record in records if record["level"] == level]
    return f"{sum(record['final']['rate'] >= MIN_RATE for record in own)} of {len(own)}"
