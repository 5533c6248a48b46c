// Panels of the overview with their metrics. Units and meanings come from the server.

/** @typedef {{ title: string, names: string[], help?: string, stacked?: boolean, wide?: boolean }} MetricPanel */

const ROLES = ["worker", "learner", "rollout", "curator", "evaluator"];

/** @type {MetricPanel[]} */
export const PANELS = [
  { title: "Training episodes", names: ["train/solve_rate", "train/failed_rate"], help: "first episodes on buffer and fresh levels together; the page Curriculum splits them" },
  { title: "Return", names: ["train/mean_return"] },
  { title: "Speed", names: ["progress/env_steps_per_second"], help: "env steps per second, everything included" },
  { title: "Level buffer", names: ["curriculum/learnability", "curriculum/solve_rate", "curriculum/learnable_share", "curriculum/mean_candidate_score"] },
  { title: "Age of the buffer", names: ["curriculum/buffer_age"] },
  { title: "Replay buffer", names: ["curriculum/replay_score", "curriculum/filled_share"] },
  { title: "Teacher", names: ["curriculum/regret", "curriculum/protagonist_return", "curriculum/antagonist_return"] },
  { title: "Losses", names: ["learner/policy_loss", "learner/value_loss"] },
  { title: "Entropy", names: ["learner/entropy"] },
  { title: "KL divergence", names: ["learner/approx_kl"] },
  { title: "Clipped share and explained variance", names: ["learner/clip_fraction", "learner/explained_variance"] },
  { title: "Gradient norm", names: ["learner/grad_norm"] },
  { title: "Gradient noise scale", names: ["learner/gradient_noise_scale"], help: "samples" },
  { title: "Dormant units", names: ["learner/dormant_share"], help: "measured every plasticity.every updates, as the next two panels" },
  { title: "Rank of features", names: ["learner/actor_feature_rank", "learner/critic_feature_rank"] },
  { title: "Norm of the weights", names: ["learner/weight_norm"] },
  {
    title: "Where the time goes",
    names: ["rollout", "learn", "curate", "evaluate", "record", "checkpoint", "idle"].map((name) => `time/${name}`),
    help: "shares of the time since the update before; they add up to 1",
    stacked: true,
  },
  { title: "Policy lag", names: ["runtime/policy_lag", "runtime/policy_lag_max"], help: "updates between the policy that acted and the one that learned" },
  { title: "Idle", names: ROLES.map((role) => `runtime/idle_${role}`), help: "share of time in no call" },
  { title: "Losses of processes", names: ["runtime/restarts", "runtime/dropped_steps", "learner/skipped_steps"], help: "all 0 in a healthy run" },
  { title: "Host memory", names: ["driver", ...ROLES].map((role) => `memory/resident_gib_${role}`), help: "GiB, of the largest process of a role" },
  { title: "Memory in use", names: ["memory/host_share", "memory/gpu_share", "memory/pool_share"] },
  { title: "Physics", names: ["physics/unstable", "physics/contact_overflow", "physics/speed_limited", "physics/missing_effects"], help: "per million physics steps" },
  { title: "Compiling and saving", names: ["runtime/compile_seconds", "runtime/save_seconds", "curriculum/scoring_seconds"], help: "seconds" },
];

/** The panels that a run has data for, and its other metrics. @param {string[]} names */
export function panelsOf(names) {
  const there = new Set(names);
  const panels = PANELS.map((panel) => ({
    ...panel,
    names: panel.names.filter((name) => there.has(name)),
  }));
  const used = new Set(panels.flatMap((panel) => panel.names));
  const others = names.filter((name) => !used.has(name) && !/^(evaluation|progress)\//.test(name));
  return { panels: panels.filter((panel) => panel.names.length), others };
}

/** "train/solve_rate" -> "solve rate" @param {string} name */
export function label(name) {
  return name.replace(/^[a-z]+\//, "").replaceAll("_", " ");
}
