"""Every metric the system writes: its name, its unit and what it means. Sinks refuse a name that is not here.

`<set>` in a name stands for the name of a level set ("evaluation/random_s/solve_rate"), `<size>` for that of a size.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping


class UnknownMetricError(ValueError):
    """A metric was reported that `METRICS` does not describe."""


@dataclasses.dataclass(frozen=True)
class Metric:
    """One number that is followed over a run."""

    name: str
    unit: str
    meaning: str


ROLES = ("worker", "learner", "rollout", "curator", "evaluator")  # of processes

# What is copied in an update of the split placement, in the order of its way.
COPIES = {
    "device_to_host": "batches off the devices of rollout actors",
    "store_put": "batches of rollout actors into the object store",
    "store_get": "parts out of the object store by learners, from other nodes too",
    "host_layout": "parts into the order of a learner's own worlds",
    "host_to_device": "batches onto the devices of learners",
    "weights_to_host": "weights off the devices of learners",
    "weights_put": "weights into the object store",
    "weights_to_device": "weights and the state of the curriculum onto the devices of rollout actors",
}

PER_MILLION = "per million physics steps"

_ALL = (
    # Progress
    Metric("progress/updates", "updates", "policy updates done since the start of the run"),
    Metric(
        "progress/env_steps",
        "env steps",
        "environment steps played for training since the start of the run, learned from or not",
    ),
    Metric(
        "progress/seconds", "s", "time spent since the start of the run, earlier sessions of a resumed run included"
    ),
    Metric("progress/phase", "number", "of the phase that the update was in (`phases`); 0 before the first"),
    Metric(
        "progress/warmup_seconds",
        "s",
        "of that, until the first update of each session was done: programs are compiled, or read from the cache",
    ),
    Metric(
        "progress/env_steps_per_second", "env steps/s", "training speed since the previous update, everything included"
    ),
    # Where the time went since the previous update; the shares add up to 1
    Metric("time/rollout", "share", "drawing levels and playing them"),
    Metric("time/learn", "share", "advantages and gradient steps"),
    Metric(
        "time/curate",
        "share",
        "the learner waiting for (or, in local mode and with run.num_curators 0, doing) the scoring of levels",
    ),
    Metric("time/evaluate", "share", "evaluating on held-out and designed levels"),
    Metric("time/record", "share", "recording rollouts"),
    Metric("time/checkpoint", "share", "copying what a checkpoint holds, and waiting for the one before it"),
    Metric("time/idle", "share", "everything else: dispatch, transfers, waiting"),
    # Training episodes. Rates are of first episodes: of all that end, those that end early would count more often.
    Metric("train/episodes", "episodes", "episodes that ended in this update's rollout"),
    Metric(
        "train/attempts",
        "worlds",
        "first episodes since the last reset, one per world; 0 where worlds go on into the next update "
        "(rollout.reset_every): the rates below are then left out",
    ),
    Metric(
        "train/solve_rate",
        "share",
        "of the attempts, how many were solved within the steps between two resets; where these are less than "
        "env.max_steps, fewer than would be in a whole episode",
    ),
    Metric("train/failed_rate", "share", "of the attempts, how many ended so because green touched red"),
    Metric(
        "train/mean_return",
        "reward",
        "mean return of the attempts, within the steps between two resets; undiscounted, dense reward included",
    ),
    Metric("train/mean_reward", "reward", "mean reward of an environment step"),
    Metric(
        "train/solve_rate_<size>",
        "share",
        "where sizes are mixed: of the attempts at levels whose smallest fitting size it is, how many were solved",
    ),
    Metric(
        "train/solve_rate_of_<source>",
        "share",
        "where levels come from more than one source (fresh, buffer, replayed, ...): of the attempts at those of one",
    ),
    Metric("train/level_share_<size>", "share", "of the worlds of this update, how many had such a level"),
    # Physics, over all worlds of the update's rollout
    Metric("physics/unstable", PER_MILLION, "times that a world was not finite and was reset, with reward 0"),
    Metric("physics/unstable_worlds", "worlds", "the same as a number, in this update"),
    Metric("physics/contact_overflow", PER_MILLION, "contacts that found no slot in the engine and did nothing"),
    Metric("physics/speed_limited", PER_MILLION, "bodies on which a speed limit acted, each once a step"),
    Metric(
        "physics/missing_effects", PER_MILLION, "environment steps in which an engine lacked what its level calls for"
    ),
    Metric("physics/invalid_actions", PER_MILLION, "numbers of actions that were out of range and acted as off"),
    Metric("physics/invalid_rewards", PER_MILLION, "rewards that were not finite and counted as 0"),
    Metric("physics/invalid_controls", PER_MILLION, "controls that were out of range (clamped) or nan (taken as 0)"),
    Metric(
        "physics/invalid_scene",
        PER_MILLION,
        "joints and thrusters on no shape and polygons of no shape, in every environment step",
    ),
    # Curriculum
    Metric(
        "curriculum/learnability",
        "p(1-p)",
        "mean score of the levels of the buffer that are played, p = solved / finished episodes",
    ),
    Metric("curriculum/solve_rate", "share", "mean solve rate of the same levels when they were scored"),
    Metric("curriculum/learnable_share", "share", "of the candidates scored, how many had a score above zero"),
    Metric("curriculum/mean_candidate_score", "p(1-p)", "mean score of all candidates scored, stored or not"),
    Metric("curriculum/buffer_age", "updates", "updates done since the policy version that scored the buffer"),
    Metric(
        "curriculum/learnability_now",
        "p(1-p)",
        "of the levels of the buffer that sfl and sfl_slices play, without bias, from pairs of attempts of the last "
        "update at the same level; nan without such a pair",
    ),
    Metric("curriculum/learnability_now_error", "p(1-p)", "its standard error, over levels"),
    Metric(
        "curriculum/fresh_learnability",
        "p(1-p)",
        "of fresh levels in training, without bias, from one pair of worlds a group (rollout.num_groups) that plays "
        "the same level: the control of learnability_now; of few pairs, so average it over updates",
    ),
    Metric("curriculum/in_use_share", "share", "of the levels in the buffer of sfl_slices, those that have not left"),
    Metric("curriculum/mastered_share", "share", "of the levels replaced so far, those that left as mastered"),
    Metric("curriculum/out_of_reach_share", "share", "of the levels replaced so far, those that were hardly solved"),
    Metric("curriculum/level_age", "updates", "since the levels in the buffer were chosen, mean"),
    Metric("curriculum/plays_per_level", "plays", "of a level in training since it was chosen, mean"),
    Metric("curriculum/buffer_is_stale", "0 or 1", "1 when a refresh was lost and the previous buffer is still in use"),
    Metric("curriculum/filled_share", "share", "share of the slots of the replay buffer that hold a level"),
    Metric(
        "curriculum/replay_score",
        "that of curriculum.plr.score",
        "mean score of the levels in the replay buffer; nan while it is empty",
    ),
    Metric("curriculum/replay_age", "updates", "since a level of the replay buffer was last played, mean"),
    Metric(
        "curriculum/regret",
        "reward",
        "PAIRED: return of the antagonist less that of the policy, mean over levels",
    ),
    Metric("curriculum/protagonist_return", "reward", "mean return of the policy on the levels of the teacher"),
    Metric("curriculum/antagonist_return", "reward", "that of the second student, as curriculum.paired has it"),
    Metric("curriculum/protagonist_solve_rate", "share", "of the episodes of the policy, mean over levels"),
    Metric("curriculum/antagonist_solve_rate", "share", "of those of the second student, mean over levels"),
    Metric("curriculum/teacher_entropy", "nat", "entropy of the teacher's policy, summed over the heads of an action"),
    Metric(
        "curriculum/skipped_steps",
        "gradient steps",
        "of teacher and antagonist, skipped in this update because a gradient was not finite",
    ),
    Metric("curriculum/scoring_seconds", "s", "how long the scoring of the buffer in use took the curator"),
    # Learner
    Metric("learner/policy_loss", "1", "clipped surrogate loss, mean over gradient steps"),
    Metric("learner/value_loss", "reward^2", "clipped value loss, mean over gradient steps"),
    Metric("learner/entropy", "nat", "entropy of the policy, summed over action heads"),
    Metric("learner/approx_kl", "nat", "estimated KL divergence from the policy that acted"),
    Metric("learner/clip_fraction", "share", "of ratios that were clipped"),
    Metric("learner/grad_norm", "1", "global norm of the gradients before clipping"),
    Metric(
        "learner/gradient_noise_scale",
        "samples",
        "with ppo.noise_scale: variance of the gradient over its square, the two below; from minibatches much larger "
        "than that, more samples gain little; negative where it is too large to tell",
    ),
    Metric("learner/gradient_variance", "1", "trace of the covariance of the gradient of one sample, estimated"),
    Metric("learner/gradient_square", "1", "squared norm of the gradient without its noise, estimated"),
    Metric(
        "learner/learning_rate", "1", "of the steps of Adam in this update: annealed, and lowered by the guard on KL"
    ),
    Metric("learner/explained_variance", "share", "of the variance of returns that the value function explains"),
    Metric("learner/skipped_steps", "gradient steps", "skipped in this update because a gradient was not finite"),
    Metric("learner/skipped_updates", "updates", "skipped as a whole, since the start of this session"),
    # Learner, where plasticity.every says so
    Metric(
        "learner/dormant_share",
        "share",
        "of hidden units that are dormant: mean activity at most 0.025 of the mean of their layer",
    ),
    Metric(
        "learner/actor_feature_rank",
        "number",
        "of the largest singular values that are 99 % of the sum, of the features before the actor's output",
    ),
    Metric("learner/critic_feature_rank", "number", "the same of the features before the critic's output"),
    Metric("learner/weight_norm", "1", "L2 norm of all parameters"),
    # Runtime
    Metric(
        "runtime/policy_lag", "updates", "versions between the policy that acted and the policy that was updated, mean"
    ),
    Metric("runtime/policy_lag_max", "updates", "the same, maximum"),
    Metric("runtime/dropped_steps", "env steps", "rolled out but not trained on, since the start of this session"),
    Metric("runtime/restarts", "processes", "replaced after a failure, since the start of this session"),
    Metric(
        "runtime/recovery_seconds",
        "s",
        "from the last loss of a process to the first new result, compilation included; the longest of all roles",
    ),
    *(
        metric
        for role in ROLES
        for metric in (
            Metric(f"runtime/restarts_{role}", "processes", f"the same of role {role}, once there was one"),
            Metric(f"runtime/recovery_seconds_{role}", "s", f"the same of role {role}, of its last loss"),
        )
    ),
    *(
        metric
        for role in ROLES
        for metric in (
            Metric(f"runtime/idle_{role}", "share", f"of its time a process of role {role} was in no call, mean"),
            Metric(f"runtime/moved_mib_{role}", "MiB", f"that processes of role {role} got and gave since their start"),
        )
    ),
    Metric("runtime/compile_seconds", "s", "compiled since its start by the process that did most, threads added up"),
    Metric("runtime/save_seconds", "s", "writing and verifying the last checkpoint took, in the background"),
    Metric("runtime/queue_length", "batches", "waiting in the work buffer when the learner took one"),
    Metric(
        "runtime/batch_wait_seconds",
        "s",
        "of an update before learning began: waiting for the slowest rollout actor, and for copies not done by then",
    ),
    Metric("runtime/slowest_actor", "number", "of the rollout actor that took longest for its part of the batch"),
    Metric("runtime/slowest_actor_lag_seconds", "s", "that it took longer than the median of the others"),
    # Copies of an update in the split placement
    *(
        metric
        for copy, meaning in COPIES.items()
        for metric in (
            Metric(f"copies/{copy}_mib", "MiB", f"{meaning}, in this update, all processes together"),
            Metric(f"copies/{copy}_seconds", "s", "the same, of the process that took longest"),
        )
    ),
    # Memory
    *(
        Metric(f"memory/resident_gib_{role}", "GiB", f"of host memory that the largest process of role {role} holds")
        for role in (*ROLES, "driver")
    ),
    Metric("memory/host_share", "share", "of the memory of the fullest host, in use by all programs"),
    Metric("memory/gpu_share", "share", "of the memory of the fullest GPU, in use by all programs"),
    Metric("memory/pool_share", "share", "of XLA's pool, the most that a process has had in use"),
    # Telemetry
    Metric(
        "telemetry/dropped_rows",
        "rows",
        "rows that metrics.jsonl or a sink (TensorBoard) did not take, since the start of this session",
    ),
    Metric(
        "telemetry/dropped_writes",
        "writes",
        "of the files for dashboards (docs/run_data.md) that the disk did not take, since the start of this session",
    ),
    # Evaluation
    Metric(
        "evaluation/update", "updates", "done by the policy that was evaluated; a row can hold that of an earlier one"
    ),
    Metric("evaluation/<set>/solve_rate", "share", "first episodes solved on a level set"),
    Metric("evaluation/<set>/low", "share", "lower end of its 95 % Wilson interval"),
    Metric("evaluation/<set>/high", "share", "upper end of its 95 % Wilson interval"),
    Metric(
        "evaluation/<set>/random_actions",
        "share",
        "first episodes solved by random actions; before training, in TensorBoard and other sinks alone",
    ),
)

# What a healthy run does not show: (when a metric is red, what to do then). Of roles, that of any.
RED: dict[str, tuple[str, str]] = {
    "time/idle": ("above 0.2", "updates are too short for their dispatch: raise rollout.num_envs or num_steps"),
    "time/curate": (
        "above 0.1",
        "the curator is slower than training: raise curriculum.adopt_after; or, also where workers score "
        "(run.num_curators 0), raise curriculum.refresh_every or lower num_candidates",
    ),
    "time/checkpoint": ("above 0.05", "saves are slower than they come: raise run.checkpoint_every, or a faster disk"),
    "progress/env_steps_per_second": (
        "half of what it was",
        "look at time/* for the role that grew, at runtime/restarts, and at what else runs on the machine",
    ),
    "physics/unstable": ("above 0", "unstable levels or physics: see the note on the console"),
    "train/episodes": (
        "0 for long",
        "rollout.num_steps times rollout.reset_every is far below the length of an episode",
    ),
    "curriculum/learnability": ("near 0", "levels are solved always or never: widen curriculum.generator"),
    "curriculum/buffer_is_stale": ("1 for long", "the curator is lost or hangs: see process_lost in events.jsonl"),
    "curriculum/buffer_age": (
        "above refresh_every + adopt_after",
        "refreshes do not come: see curriculum/buffer_is_stale and curriculum/scoring_seconds",
    ),
    "learner/skipped_steps": ("above 0", "gradients are not finite: lower ppo.learning_rate; see rolled_back"),
    "learner/approx_kl": ("above 0.1", "updates are too large: lower ppo.learning_rate or ppo.epochs"),
    "runtime/policy_lag_max": ("above 0, split 1", "a defect: please report it with events.jsonl"),
    "runtime/dropped_steps": ("growing", "rollout actors are lost again and again: see process_lost in events.jsonl"),
    "runtime/restarts": ("growing", "processes are lost: process_lost in events.jsonl says which and where"),
    "runtime/recovery_seconds": ("above 60", "programs are compiled again: is run.compile_cache on a disk that stays?"),
    "runtime/compile_seconds": (
        "growing after the first updates, where no phase begins",
        "shapes change: report it; see run.compile_cache",
    ),
    "runtime/idle_<role>": (
        "above 0.5 for worker, learner or rollout",
        "they wait for others: in split, give the slower side more devices; else see time/*",
    ),
    "runtime/batch_wait_seconds": (
        "above half the time of an update",
        "learners wait: more rollout actors, or see runtime/slowest_actor and copies/*_seconds",
    ),
    "runtime/slowest_actor_lag_seconds": (
        "above half the time of an update",
        "one device is slower or busy: event straggler names the actor, `processes` in report.json says where it is",
    ),
    "runtime/save_seconds": ("above the time of checkpoint_every updates", "a faster disk, or raise checkpoint_every"),
    "memory/host_share": ("above 0.9", "the kernel may soon kill a process: fewer processes, or what else runs there?"),
    "memory/gpu_share": ("above 0.98", "another program is on the GPU: run.gpu_memory_gib leaves memory to it"),
    "memory/pool_share": ("above 0.95", "lower rollout.num_envs, or raise ppo.minibatches, before it runs out"),
    "telemetry/dropped_writes": ("above 0", "the same of curriculum/, evaluations.jsonl and processes.jsonl"),
    "telemetry/dropped_rows": ("above 0", "the disk of the run directory is full or hangs: see sink_failing"),
}

METRICS: dict[str, Metric] = {metric.name: metric for metric in _ALL}


def register_metric(metric: Metric) -> None:
    """Describes a metric of a plugin, of a curriculum say. Raises ValueError where the name is taken."""
    if metric.name in METRICS and METRICS[metric.name] != metric:
        raise ValueError(f"there is a metric {metric.name!r} already; report yours under another name")
    METRICS[metric.name] = metric


def describe(name: str) -> Metric:
    """The description of a metric; raises UnknownMetricError for a name that is not described."""
    if name in METRICS:
        return METRICS[name]
    pattern = re.sub(r"^evaluation/.+/", "evaluation/<set>/", name)  # a set may be a path
    pattern = re.sub(r"^train/solve_rate_of_.+$", "train/solve_rate_of_<source>", pattern)
    pattern = re.sub(r"^(train/(?:solve_rate|level_share))_[a-z]+$", r"\1_<size>", pattern)
    if pattern in METRICS:
        return METRICS[pattern]
    raise UnknownMetricError(
        f"metric {name!r} is not described; add it to kinetix_dist/telemetry/names.py, or call register_metric"
    )


def check_metrics(metrics: Mapping[str, float]) -> dict[str, float]:
    """The metrics as Python floats, every name known."""
    for name in metrics:
        describe(name)
    return {name: float(value) for name, value in metrics.items()}
