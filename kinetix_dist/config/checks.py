"""Checks between sections of a run's configuration. Each takes the sections that it compares and raises ConfigError."""

from __future__ import annotations

from collections.abc import Collection

from kinetix_dist.config.sections import (
    EvaluationConfig,
    ImitationConfig,
    RecordingConfig,
    RolloutConfig,
    RunConfig,
)
from kinetix_dist.curator.config import CurriculumConfig
from kinetix_dist.curator.curriculum import Curriculum
from kinetix_dist.env.action_spaces import ACTION_SPACES
from kinetix_dist.env.env_config import EnvConfig
from kinetix_dist.env.observations import OBSERVATIONS
from kinetix_dist.env.rewards import REWARDS
from kinetix_dist.learner.config import PpoConfig
from kinetix_dist.level.level import SIZES
from kinetix_dist.level.mechanisms import FAMILIES, fitting_families
from kinetix_dist.level.size_mixture import sizes_drawn
from kinetix_dist.models.colour_readout import check_heads
from kinetix_dist.models.policy import NETWORKS, PolicyConfig
from kinetix_dist.setting import ConfigError


def check_sizes(env: EnvConfig, curriculum: CurriculumConfig) -> None:
    """Levels fit the arrays of the environment."""
    order = list(SIZES)
    too_large = [size for size in sizes_drawn(curriculum.sizes) if order.index(size) > order.index(env.size)]
    if too_large:
        raise ConfigError(
            f"curriculum.sizes has {too_large[-1]!r}, which does not fit env.size {env.size!r}, the size of the "
            f"arrays; set env.size to {too_large[-1]!r}"
        )


def check_action_space(env: EnvConfig, policy: PolicyConfig, ppo: PpoConfig) -> None:
    """A policy can be trained for the action space, with the read-out and the masks chosen."""
    space = ACTION_SPACES[env.action_space]
    if space.distribution is None:
        trainable = [name for name in ACTION_SPACES if ACTION_SPACES[name].distribution is not None]
        raise ConfigError(
            f"env.action_space is {env.action_space!r}: environments have it, but no policy can be trained for it; "
            f"use {' or '.join(map(repr, trainable))}"
        )
    if ppo.mask_unbound_heads and not space.has_bound_heads:
        raise ConfigError(
            f"ppo.mask_unbound_heads is True, but no dimension of {env.action_space!r} actions is of one colour; set "
            "it to False or use another env.action_space"
        )
    if policy.read_out == "colour":
        check_heads(space.distribution.head_sizes)


def check_network(env: EnvConfig, policy: PolicyConfig) -> None:
    """The network takes what the observation gives."""
    gives, takes = OBSERVATIONS[env.observation].gives, NETWORKS[policy.network].takes
    if gives != takes:
        fitting = [name for name in NETWORKS if NETWORKS[name].takes == gives]
        advice = f"use policy.network {' or '.join(map(repr, fitting))}" if fitting else "change one of them"
        raise ConfigError(
            f"env.observation {env.observation!r} gives {gives}, but policy.network {policy.network!r} takes {takes}; "
            f"{advice}"
        )


def check_same_shapes(before: EnvConfig, env: EnvConfig, policy: PolicyConfig) -> None:
    """Parameters that learned in one environment fit another one."""
    if env.size != before.size and not NETWORKS[policy.network].plays_all_sizes:
        able = [name for name in NETWORKS if NETWORKS[name].plays_all_sizes]
        raise ConfigError(
            f"env.size is {env.size!r} after {before.size!r}, but parameters of policy.network {policy.network!r} fit "
            f"levels of one size alone; leave it as it is, or use {' or '.join(map(repr, able))}"
        )


def check_reward(env: EnvConfig, ppo: PpoConfig) -> None:
    """A reward that is shaped by a discount has that of the learner, and its episodes end where they end for it."""
    if not REWARDS[env.reward].uses_discount:
        return
    if env.shaping_discount != ppo.discount:
        raise ConfigError(
            f"env.reward {env.reward!r} discounts by env.shaping_discount {env.shaping_discount}, and ppo.discount is "
            f"{ppo.discount}; set both to one value"
        )
    if ppo.bootstrap_timeouts:
        raise ConfigError(
            f"env.reward {env.reward!r} takes the time limit for the end of an episode, and ppo.bootstrap_timeouts "
            "does not; set that to False"
        )


def check_changed_reward(changed: Collection[str], env: EnvConfig) -> None:
    """A phase with the environment `env` changes no setting that its reward does not use."""
    if "env.dense_reward_scale" in changed and not REWARDS[env.reward].uses_dense_scale:
        raise ConfigError(
            f"env.dense_reward_scale is not used by env.reward {env.reward!r}; leave it out, or set env.reward, too"
        )


def check_resets(run: RunConfig, rollout: RolloutConfig, curriculum: CurriculumConfig, kind: type[Curriculum]) -> None:
    """Worlds that go on from update to update stay where they are, and the curriculum does without their outcomes."""
    if rollout.reset_every == 1:
        return
    if run.placement == "split":
        raise ConfigError(
            f"rollout.reset_every is {rollout.reset_every}, but in placement split worlds are lost with their rollout "
            "actor, and a batch could not be played again; set it to 1 or use run.placement colocated"
        )
    if kind.observes:
        raise ConfigError(
            f"rollout.reset_every is {rollout.reset_every}, but curriculum {curriculum.name!r} observes whole levels "
            "in every update; set it to 1, or use one that does not observe, such as 'sfl' or 'domain_randomization'"
        )


def check_episode_lengths(
    rollout: RolloutConfig, env: EnvConfig, curriculum: CurriculumConfig, kind: type[Curriculum]
) -> None:
    """Enough episodes end in an update, and while candidates are scored, for the curriculum."""
    num_episodes = kind.num_episodes(curriculum)
    if rollout.num_steps < num_episodes * env.max_steps:
        needs = "the end of an episode" if num_episodes == 1 else f"the ends of {num_episodes} episodes"
        score = f" with plr.score {curriculum.plr.score!r}" if num_episodes > 1 else ""
        raise ConfigError(
            f"curriculum {curriculum.name!r}{score} needs {needs} in every world of an update, but rollout.num_steps "
            f"is {rollout.num_steps} and env.max_steps {env.max_steps}; raise the one or lower the other"
        )
    if kind.scores_by_steps and curriculum.scoring_steps < env.max_steps:
        raise ConfigError(
            f"curriculum.scoring_steps is {curriculum.scoring_steps} and env.max_steps {env.max_steps}: of a level "
            "whose episodes end at the time limit none would end while it is scored, and the buffer would fill with "
            "what fails early; raise the one or lower the other"
        )


def check_curators(run: RunConfig, curriculum: CurriculumConfig, kind: type[Curriculum]) -> None:
    """Every curator has a part of the work, and some process scores levels."""
    if run.num_curators > 1 and not kind.shares_refresh:
        raise ConfigError(
            f"run.num_curators is {run.num_curators}, but nothing of curriculum {curriculum.name!r} can be shared by "
            "several; set it to 1"
        )
    if run.num_curators > curriculum.num_batches:
        raise ConfigError(
            f"run.num_curators is {run.num_curators}, but candidates are scored in batches of "
            f"curriculum.scoring_batch {curriculum.scoring_batch}, {curriculum.num_batches} in all: some would have "
            "none; lower it or scoring_batch"
        )
    if kind.refreshes and run.num_curators == 0 and run.placement == "split":
        raise ConfigError(
            "run.num_curators is 0, but in placement split no process both learns and plays, so none can score levels "
            "between updates; set it to 1 or use run.placement colocated"
        )


def check_rollout_actors(run: RunConfig, rollout: RolloutConfig) -> None:
    """Every rollout actor has a world group."""
    if run.placement == "split" and run.num_rollout_actors > rollout.num_groups:
        raise ConfigError(
            f"{run.num_rollout_actors} rollout actors cannot share {rollout.num_groups} world groups: some would have "
            "none; lower run.num_rollout_actors or raise rollout.num_groups"
        )


def check_generator(env: EnvConfig, curriculum: CurriculumConfig) -> None:
    """Every size of levels has room for one of the mechanism families."""
    generator = curriculum.generator
    for size in sizes_drawn(curriculum.sizes) or [env.size]:
        if generator.mechanism_share and not fitting_families(generator.mechanism_families, SIZES[size]):
            named = ", ".join(generator.mechanism_families) or "()"
            raise ConfigError(
                f"curriculum.generator.mechanism_families {named}: levels of size {size!r} have room for none; add one "
                f"of {', '.join(fitting_families(list(FAMILIES), SIZES[size]))}, or use a larger size"
            )


def check_imitation(
    env: EnvConfig, policy: PolicyConfig, curriculum: CurriculumConfig, imitation: ImitationConfig, run: RunConfig
) -> None:
    """Proofs of the levels of the run, or a data set, can be imitated by its policy."""
    if not run.imitation_steps:
        if imitation.data:
            raise ConfigError(
                f"imitation.data is {imitation.data!r}, but run.imitation_steps is 0: nothing would be learned "
                "from it; set that to a number of gradient steps"
            )
        return
    needed = {"run.placement": (run.placement, "local"), "policy.recurrent": (policy.recurrent, "none")}
    if not imitation.data:
        needed["curriculum.name"] = curriculum.name, "fixed"
    if not imitation.data or imitation.class_balance:
        needed["env.action_space"] = env.action_space, "multi_discrete"
    for name, (value, expected) in needed.items():
        if value != expected:
            what = "" if imitation.data else " without imitation.data"
            if name == "env.action_space" and imitation.data:
                what = f" with imitation.class_balance {imitation.class_balance:g}"
            raise ConfigError(
                f"run.imitation_steps is {run.imitation_steps}, which{what} needs {name} {expected!r}, not {value!r}; "
                "set it to that, or imitation_steps to 0"
            )


def check_only_updates(run: RunConfig, evaluation: EvaluationConfig, recording: RecordingConfig) -> None:
    """Raises ConfigError if a run of updates alone is to evaluate or record."""
    wanted = {
        "run.stop_at": run.stop_at,
        "evaluation.every": evaluation.every,
        "evaluation.every_seconds": evaluation.every_seconds,
        "recording.every": recording.every,
        "recording.num_rollouts": recording.num_rollouts,
    }
    if run.only_updates and (names := [name for name, value in wanted.items() if value]):
        raise ConfigError(f"run.only_updates leaves out {', '.join(names)}; set only_updates to False, or these to 0")


def check_stop(run: RunConfig, evaluation: EvaluationConfig) -> None:
    """A solve rate that ends training is measured during training."""
    if run.stop_at and not evaluation.is_during_training:
        raise ConfigError(
            f"run.stop_at is {run.stop_at:g}, but evaluation.every and every_seconds are 0: nothing is evaluated "
            "during training; set one of them, or stop_at to 0"
        )
