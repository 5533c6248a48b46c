"""`bench model`: seconds of an update on numbers of GPUs, from what its parts were measured to cost. Nothing is run.

    update   = rollouts(worlds of a GPU) + gradient steps x step + control(GPUs)
    rollouts = fixed + worlds x a world
    step     = fixed + samples of a GPU x a sample + reduce(GPUs)
    reduce   = doublings within a host x one + doublings between hosts x one + bytes over the slowest link (ring)
    control  = GPUs x a message

`COSTS` has the figures and where each was measured; what was not measured is an assumption and is named so. docs/
benchmarks.md holds the predictions next to measurements.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Literal

from kinetix_dist.benchmarks.measuring import BenchmarkOptions, Results
from kinetix_dist.config import TrainConfig
from kinetix_dist.recipes import recipe

GPUS_A_HOST = 8


@dataclasses.dataclass(frozen=True, kw_only=True)
class Costs:
    """Costs of one size on one model of GPU, in seconds."""

    rollout_fixed: float  # an update of 256 steps, whatever the number of worlds
    rollout_world: float  # a world more
    step_fixed: float  # a gradient step, whatever the number of samples
    step_sample: float  # a sample more
    doubling_in_host: float  # of GPUs: what a gradient step waits longer for the slowest
    doubling_between_hosts: float
    gradient_bytes: float
    link_in_host: float  # bytes/s of an all-reduce, measured at two GPUs
    link_between_hosts: float
    message: float  # of the control plane, a process and update


# M, H200, all of docs/results/distribution.md. Rollouts: shares of time with 2,048 and 16,384 worlds. Doublings in a
# host: fitted to `local` on 2 and 4 GPUs. Message: measured on two slow and busy cores.
# Assumed, never measured: a doubling between hosts costs twice one within; the link between hosts moves 40 GB/s.
COSTS = Costs(
    rollout_fixed=0.143,
    rollout_world=35.4e-6,
    step_fixed=0.605e-3,
    step_sample=0.394e-6,
    doubling_in_host=0.110e-3,
    doubling_between_hosts=0.220e-3,
    gradient_bytes=786_417 * 4.0,
    link_in_host=202e9,
    link_between_hosts=40e9,
    message=1.3e-3,
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options(BenchmarkOptions):
    """Seconds of an update on numbers of GPUs, predicted from measured costs of size M on an H200."""

    recipe: Literal["sfl_m"] = "sfl_m"
    """The costs are those of size M with the paper's network."""
    settings: Literal["paper", "fresh"] = "paper"
    """paper: 2,048 worlds, 8 epochs of 32 minibatches; fresh: 16,384 worlds, 1 epoch of 256."""
    mode: Literal["strong", "weak"] = "strong"
    """strong: the same worlds and minibatches divided; weak: as many a GPU."""
    devices: tuple[int, ...] = (1, 2, 4, 8, 64, 512)
    """Numbers of GPUs."""

    def __post_init__(self) -> None:
        if not self.devices or min(self.devices) < 1:
            raise ValueError(f"--devices has {list(self.devices)}; give numbers of devices, each 1 or more")


@dataclasses.dataclass(frozen=True, kw_only=True)
class ModelRecord:
    """A prediction."""

    benchmark: str = "model"
    settings: str
    mode: str
    devices: int
    worlds: int  # in all; fewer than one a GPU cannot be
    seconds: dict[str, float]  # of an update: rollout, compute, reduce, control
    env_steps_per_second: float
    efficiency: float  # relative to one GPU


def measure(options: Options, results: Results) -> None:
    """A record a number of devices."""
    for record in predictions(options):
        results.add(dataclasses.asdict(record))
        parts = ", ".join(f"{name} {1e3 * seconds:,.0f} ms" for name, seconds in record.seconds.items())
        speed = f"{record.env_steps_per_second:,.0f} env steps/s, efficiency {record.efficiency:.0%}"
        results.report(f"  {record.settings} {record.mode} {record.devices:>4} GPUs {speed:>40} ({parts})")


def predictions(options: Options, costs: Costs = COSTS) -> list[ModelRecord]:
    """Predictions in the order of the devices."""
    config = _settings(options)
    of_one = _predict(config, options, 1, costs, reference=None)
    return [_predict(config, options, devices, costs, reference=of_one) for devices in options.devices]


def _settings(options: Options) -> TrainConfig:
    config = recipe(options.recipe)
    if options.settings == "paper":
        return config
    return dataclasses.replace(
        config,
        rollout=dataclasses.replace(config.rollout, num_envs=16_384),
        ppo=dataclasses.replace(config.ppo, epochs=1, minibatches=256),
    )


def _predict(
    config: TrainConfig, options: Options, devices: int, costs: Costs, *, reference: ModelRecord | None
) -> ModelRecord:
    rollout, ppo = config.rollout, config.ppo
    worlds = rollout.num_envs * (devices if options.mode == "weak" else 1)
    steps = worlds * rollout.num_steps
    num_gradient_steps = ppo.epochs * ppo.minibatches
    samples = steps / ppo.minibatches / devices
    seconds = {
        "rollout": costs.rollout_fixed + costs.rollout_world * worlds / devices,
        "compute": num_gradient_steps * (costs.step_fixed + costs.step_sample * samples),
        "reduce": num_gradient_steps * reduce_seconds(devices, costs),
        "control": costs.message * devices,
    }
    speed = steps / sum(seconds.values())
    return ModelRecord(
        settings=options.settings,
        mode=options.mode,
        devices=devices,
        worlds=worlds,
        seconds={name: round(value, 5) for name, value in seconds.items()},
        env_steps_per_second=round(speed, 1),
        efficiency=1.0 if reference is None else round(speed / devices / reference.env_steps_per_second, 4),
    )


def reduce_seconds(devices: int, costs: Costs) -> float:
    """Seconds that the mean of the gradients adds to a gradient step."""
    if devices == 1:
        return 0.0
    inside = min(devices, GPUS_A_HOST)
    between = math.log2(devices / inside)
    link = costs.link_in_host if between == 0 else costs.link_between_hosts
    ring = 2 * (devices - 1) / devices * costs.gradient_bytes / link
    return costs.doubling_in_host * math.log2(inside) + costs.doubling_between_hosts * between + ring
