// Panels of the overview with their metrics. Units, meanings, sections and normal values come from the server.

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
  { title: "Losses of processes", names: ["runtime/restarts", "runtime/dropped_steps", "learner/skipped_steps"] },
  { title: "Host memory", names: ["driver", ...ROLES].map((role) => `memory/resident_gib_${role}`), help: "GiB, of the largest process of a role" },
  { title: "Memory in use", names: ["memory/host_share", "memory/gpu_share", "memory/pool_share"] },
  { title: "Speed limits of bodies", names: ["physics/speed_limited"], help: "bodies faster than 100 m/s or 50 rad/s, which are slowed to that, each counted once a step; per million physics steps" },
  { title: "Faults of the physics", names: ["unstable", "contact_overflow", "missing_effects", "invalid_actions", "invalid_rewards", "invalid_controls", "invalid_scene"].map((name) => `physics/${name}`) },
  { title: "Compiling and saving", names: ["runtime/compile_seconds", "runtime/save_seconds", "curriculum/scoring_seconds"], help: "seconds" },
];

/** The panels that a run has data for, and its other metrics, a panel each.
 * @param {string[]} names @returns {{ panels: MetricPanel[], others: MetricPanel[] }} */
export function panelsOf(names) {
  const there = new Set(names);
  const panels = PANELS.map((panel) => ({
    ...panel,
    names: panel.names.filter((name) => there.has(name)),
  }));
  const used = new Set(panels.flatMap((panel) => panel.names));
  const others = names.filter((name) => !used.has(name) && !name.startsWith("evaluation/"));
  return { panels: panels.filter((panel) => panel.names.length), others: others.map((name) => ({ title: name, names: [name] })) };
}

/** "train/solve_rate" -> "solve rate" @param {string} name */
export function label(name) {
  return name.replace(/^[a-z]+\//, "").replaceAll("_", " ");
}
