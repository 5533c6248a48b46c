"""Named configurations: a recipe is a function that returns a `TrainConfig`. The command line overrides any field."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable

from kinetix_dist.config import (
    ConfigError,
    EvaluationConfig,
    ImitationConfig,
    RecordingConfig,
    RolloutConfig,
    RunConfig,
    TrainConfig,
)
from kinetix_dist.config.phases import PhaseConfig
from kinetix_dist.curator.config import CurriculumConfig
from kinetix_dist.env.environment import EnvConfig
from kinetix_dist.learner.config import AnnealConfig, PpoConfig
from kinetix_dist.level.generator_config import GeneratorConfig
from kinetix_dist.level.level import SIZES
from kinetix_dist.models.policy import PolicyConfig
from kinetix_dist.near_names import did_you_mean
from kinetix_dist.renamed_settings import RENAMED_RECIPES
from kinetix_dist.telemetry.curriculum_log import CurriculumLogConfig


def quickstart() -> TrainConfig:
    """SFL on size S for two CPU cores and a few minutes: small network, long actions (docs/training.md says why)."""
    return TrainConfig(
        # An action lasts 8 physics steps, 2/15 s: an episode is as long as ever, but has a quarter of the decisions.
        env=EnvConfig(size="s", frame_skip=8, max_steps=64, dense_reward_scale=0.3),
        policy=PolicyConfig(encoder_size=48, num_layers=1, hidden_size=64, hidden_layers=1),
        ppo=PpoConfig(
            epochs=3,
            minibatches=8,
            virtual_shards=8,
            clip=0.2,
            value_clip=False,
            learning_rate=1.5e-3,
            max_grad_norm=0.5,
            discount=0.98,
            mask_unbound_heads=True,
        ),
        curriculum=CurriculumConfig(
            num_candidates=512,
            scoring_batch=256,
            scoring_steps=192,
            refresh_every=16,
            adopt_after=2,
            buffer_size=128,
            generator=GeneratorConfig(varied_share=0.5),
        ),
        rollout=RolloutConfig(num_envs=256, num_steps=64, num_groups=8),
        # Levels like those of training, and of these such as random actions rarely solve.
        evaluation=EvaluationConfig(sets=("random_s", "frontier_s"), attempts=4, min_attempts=400),
        recording=RecordingConfig(num_rollouts=8),
        # Training waits for the curator here, and the program that plays them takes several seconds to compile.
        curriculum_log=CurriculumLogConfig(probe_levels=0),
        run=RunConfig(
            name="quickstart", total_env_steps=1_000_000, placement="local", device="cpu", checkpoint_every=20
        ),
    )


def quickstart_finetune() -> TrainConfig:
    """One hand-made S level after another, for `finetune --each` from a policy of `quickstart` or from scratch.

    A quarter of its worlds, half of its minibatch: all worlds show the same level, and smaller updates are enough."""
    base = quickstart()
    return dataclasses.replace(
        base,
        ppo=dataclasses.replace(base.ppo, minibatches=4),
        curriculum=CurriculumConfig(name="fixed", levels="quickstart_s"),
        rollout=dataclasses.replace(base.rollout, num_envs=64),
        evaluation=EvaluationConfig(sets=("quickstart_s",), attempts=1, min_attempts=100, every=1),
        run=dataclasses.replace(base.run, name="quickstart_finetune", total_env_steps=200_000),
    )


def single_level() -> TrainConfig:
    """One hand-designed S level until it is solved: shows that learning works, on CPU, in a minute or two."""
    return TrainConfig(
        env=EnvConfig(size="s", dense_reward_scale=1.0),
        policy=PolicyConfig(encoder_size=32, num_layers=1, hidden_size=64, hidden_layers=1),
        ppo=PpoConfig(
            epochs=4,
            minibatches=8,
            virtual_shards=8,
            clip=0.2,
            value_clip=False,
            learning_rate=1e-3,
            max_grad_norm=0.5,
            discount=0.99,
        ),
        curriculum=CurriculumConfig(name="fixed", levels="s/hop_home"),
        rollout=RolloutConfig(num_envs=32, num_steps=256, num_groups=8),  # whole episodes
        evaluation=EvaluationConfig(sets=("s/hop_home",), attempts=100, every=1),
        recording=RecordingConfig(num_rollouts=4),
        run=RunConfig(
            name="single_level", total_env_steps=200_000, placement="local", device="cpu", checkpoint_every=10
        ),
    )


def specialist() -> TrainConfig:
    """One level with continuous actions, as the experts of the public benchmark of RTC are trained (its
    train_expert.py): worlds, steps, epochs, minibatches, rates and 65 M steps are theirs; network and reward are ours.

    `finetune --each` gives each level one, or one a seed; the size is that of the levels."""
    return TrainConfig(
        env=EnvConfig(size="l", action_space="continuous", dense_reward_scale=1.0),
        policy=PolicyConfig(dtype="bfloat16", kernels="auto"),
        ppo=PpoConfig(
            epochs=4,
            minibatches=8,
            clip=0.2,
            learning_rate=3e-4,
            max_grad_norm=1.0,
            entropy_coefficient=0.0,
            mask_unbound_heads=True,
        ),
        curriculum=CurriculumConfig(name="fixed", levels="designed_l"),
        rollout=RolloutConfig(num_envs=256),
        evaluation=EvaluationConfig(sets=("designed_l",), attempts=256, every=50),
        recording=RecordingConfig(num_rollouts=0),
        run=RunConfig(name="specialist", total_env_steps=65_000_000, checkpoint_every=100),
    )


def teach() -> TrainConfig:
    """One level from a pretrained policy in a minute or two on two CPU cores, as the editor's "teach it" trains.

    Small updates: the network of a pretrained policy learns from 4,096 samples in some seconds there, and begins with
    skills that larger steps would lose."""
    base = single_level()
    return dataclasses.replace(
        base,
        ppo=dataclasses.replace(base.ppo, epochs=2, learning_rate=2e-4, discount=0.995, mask_unbound_heads=True),
        rollout=RolloutConfig(num_envs=16, num_steps=256, num_groups=8),
        evaluation=EvaluationConfig(sets=("s/hop_home",), attempts=64, min_attempts=64, every_seconds=15.0),
        recording=RecordingConfig(num_rollouts=0),
        run=dataclasses.replace(
            base.run, name="teach", total_env_steps=0, max_seconds=120.0, warmup_counts=False, stop_at=0.95
        ),
    )


def tiny() -> TrainConfig:
    """A run of seconds that learns nothing, with all parts of PPO: for tests and for trying an installation.

    An update plays the first half of its episodes, which a run says when it starts."""
    return TrainConfig(
        env=EnvConfig(size="s", max_steps=16),
        policy=PolicyConfig(encoder_size=8, attention_features=8, num_layers=1, hidden_size=8, hidden_layers=1),
        ppo=PpoConfig(
            epochs=2,
            minibatches=2,
            virtual_shards=4,
            clip=0.2,
            learning_rate=1e-3,
            mask_unbound_heads=True,
            bootstrap_timeouts=True,
            average_updates=2,
            max_kl=0.1,
            anneal=AnnealConfig(start=256, end=1024, learning_rate=0.1, clip=0.5, entropy_coefficient=0.5),
        ),
        curriculum=CurriculumConfig(
            num_candidates=16, scoring_batch=8, scoring_steps=16, refresh_every=3, adopt_after=2, buffer_size=8
        ),
        rollout=RolloutConfig(num_envs=16, num_steps=8, num_groups=4),
        evaluation=EvaluationConfig(sets=("random_s",)),
        recording=RecordingConfig(num_rollouts=0),
        curriculum_log=CurriculumLogConfig(probe_levels=4),
        run=RunConfig(name="tiny", total_env_steps=8 * 16 * 8, placement="local", device="cpu", checkpoint_every=2),
    )


# Of `pretrain_s` and its like: more than twice what a head has that does not collapse (docs/lab_log.md).
MAX_QK_NORM = 4.0

# How often `pretrain_l` draws each family of mechanisms: those that a policy is slow to learn more often
# (docs/training.md). The others (pendulums, ramps, grippers, pinball) have not been shown to help at hand-made levels.
FAMILY_WEIGHTS = {
    "car": 1.0,
    "unicycle": 2.0,
    "walker": 2.0,
    "arm": 1.0,
    "runner": 3.0,
    "snake": 2.0,
    "cartpole": 2.0,
    "flyer": 3.0,
    "pusher": 0.5,
    "beam": 0.5,
    "lander": 3.0,
    "carrier": 2.0,
    "jumper": 1.0,
    "sprinter": 8.0,
    "thrower": 3.0,
    "turner": 2.0,
    "flipper": 1.0,
    "grasper": 2.0,
    "reacher": 2.0,
    "climber": 2.0,
}

# The curricula of `sfl_s` and its like: the paper's hyperparameters for each size of levels.
_CURRICULA = {
    "sfl": CurriculumConfig(),
    "dr": CurriculumConfig(name="domain_randomization"),
    "plr": CurriculumConfig(name="plr", buffer_size=8000),
    "robust_plr": CurriculumConfig(name="robust_plr", buffer_size=8000),
    "accel": CurriculumConfig(name="accel", buffer_size=8000),
    "paired": CurriculumConfig(name="paired"),
}


def _paper(curriculum: str, size: str) -> TrainConfig:
    """Hyperparameters of the paper, activations in bfloat16; ends after 1 B environment steps unless overridden."""
    return TrainConfig(
        env=EnvConfig(size=size),
        policy=PolicyConfig(dtype="bfloat16", kernels="auto"),
        # These learn from half of the worlds: as many samples in a minibatch.
        ppo=PpoConfig(minibatches=16) if curriculum in ("robust_plr", "accel", "paired") else PpoConfig(),
        curriculum=_CURRICULA[curriculum],
        # In the background, every few minutes: docs/training.md says what that costs.
        evaluation=EvaluationConfig(sets=(f"random_{size}", f"designed_{size}"), every=100),
        recording=RecordingConfig(every=500),
        run=RunConfig(name=f"{curriculum}_{size}", total_env_steps=1_000_000_000, device="gpu", checkpoint_every=100),
    )


def _pretrain(size: str) -> TrainConfig:
    """Every sample used once, from eight times as many worlds, and what is known to pay (docs/training.md)."""
    paper = _paper("sfl", size)
    network = "transformer_lean" if size == "s" else "transformer"  # compared at equal seconds at M alone
    # What hand-made levels have and random ones lack (docs/results/generalist.md); shown in arrays of L alone.
    tasks = GeneratorConfig(
        mechanism_share=0.45,
        mechanism_families=tuple(FAMILY_WEIGHTS),
        mechanism_weights=tuple(FAMILY_WEIGHTS.values()),
        varied_share=0.3,
    )
    # Where failing costs as much as solving gives, it stands still on a red floor (docs/training.md).
    env = dataclasses.replace(paper.env, failure_penalty=0.0) if size == "l" else paper.env
    return dataclasses.replace(
        paper,
        env=env,
        policy=PolicyConfig(
            network=network, dtype="bfloat16", read_out="colour", kernels="auto", max_qk_norm=MAX_QK_NORM
        ),
        ppo=PpoConfig(
            epochs=1,
            minibatches=256,
            clip=0.2,
            learning_rate=2e-4,
            entropy_coefficient=0.003,
            max_grad_norm=1.0,
            mask_unbound_heads=True,
        ),
        curriculum=CurriculumConfig(
            buffer_size=4096,
            num_candidates=12_288,
            scoring_batch=12_288,
            refresh_every=16,
            generator=tasks if size == "l" else GeneratorConfig(),
        ),
        rollout=RolloutConfig(num_envs=16_384),
        # 256 worlds are bound by latency: they take up to a third of the time of all candidates.
        curriculum_log=CurriculumLogConfig(probe_every=8),
        evaluation=dataclasses.replace(paper.evaluation, every=25),
        recording=RecordingConfig(every=200),
        # Two processes on a GPU take turns: scoring in the background costs more than alone (docs/operating.md).
        run=dataclasses.replace(
            paper.run,
            name=f"pretrain_{size}",
            total_env_steps=4_000_000_000,
            checkpoint_every=25,
            num_curators=0,
        ),
    )


def _clone(size: str) -> TrainConfig:
    """Behaviour cloning of a data set (--data DIR), with the network of `pretrain_m` and its like. No PPO: that follows
    where run.total_env_steps is set, with the settings of that recipe."""
    base = _pretrain(size)
    return dataclasses.replace(
        base,
        imitation=ImitationConfig(data="data", batch_size=1024, learning_rate=1e-3),
        recording=RecordingConfig(num_rollouts=0),
        run=RunConfig(
            name=f"clone_{size}", imitation_steps=10_000, placement="local", checkpoint_every=25, num_curators=0
        ),
    )


def pretrain_all() -> TrainConfig:
    """Levels of M first, then of all sizes at once, as `pretrain_l` otherwise: what is learned on M is learned faster
    and helps on L. Arrays are those of L from the beginning. Neither the step nor the weights have been tuned."""
    base = _pretrain("l")
    sets = (*(f"random_{size}" for size in SIZES), *(f"designed_{size}" for size in SIZES))
    return dataclasses.replace(
        base,
        curriculum=dataclasses.replace(base.curriculum, sizes=(("m", 1.0),)),
        phases=(PhaseConfig(start=1_000_000_000, options={"curriculum.sizes": [["s", 0.2], ["m", 0.5], ["l", 0.3]]}),),
        evaluation=dataclasses.replace(base.evaluation, sets=sets),
        run=dataclasses.replace(base.run, name="pretrain_all"),
    )


RECIPES: dict[str, Callable[[], TrainConfig]] = {
    **{function.__name__: function for function in (quickstart, quickstart_finetune, single_level, specialist, teach)},
    **{f"{name}_{size}": functools.partial(_paper, name, size) for name in _CURRICULA for size in "sml"},
    **{f"pretrain_{size}": functools.partial(_pretrain, size) for size in "sml"},
    "pretrain_all": pretrain_all,
    **{f"clone_{size}": functools.partial(_clone, size) for size in "sml"},
    "tiny": tiny,
}


def recipe(name: str) -> TrainConfig:
    """The configuration of a recipe; raises ConfigError for an unknown one."""
    if name in RENAMED_RECIPES:
        raise ConfigError(f"recipe {name!r} is now called {RENAMED_RECIPES[name]!r}; use that")
    if name not in RECIPES:
        hint = did_you_mean(name, RECIPES, f"recipes: {', '.join(RECIPES)}")
        raise ConfigError(f"unknown recipe {name!r}; {hint}")
    return RECIPES[name]()
