// Terms of the pages. Made from docs/glossary.md by `make glossary`: change that page.

/** By the anchor of a term there. @type {Record<string, { names: string[], text: string }>} */
export const GLOSSARY = {
  "action-chunk": {
    "names": [
      "action chunk"
    ],
    "text": "several actions that a policy gives at once, for the steps to come; as many as its horizon (delay)"
  },
  "adopt": {
    "names": [
      "adopt"
    ],
    "text": "to put the result of a refresh into the curriculum's state. It happens at an update that is fixed when the refresh is requested, so that timing changes no result"
  },
  "kl": {
    "names": [
      "approximate KL",
      "KL divergence"
    ],
    "text": "how far the updated policy is from the one that acted, in nat: far above 0.1, updates are too large"
  },
  "attempt": {
    "names": [
      "attempt"
    ],
    "text": "the first episode of one world on one level. Solve rates count attempts"
  },
  "bootstrap": {
    "names": [
      "bootstrap band"
    ],
    "text": "interval of a mean over runs: the runs are drawn again with replacement a thousand times, and the middle 95 % of the means is the band. One run has none, nor have runs that agree"
  },
  "buffer": {
    "names": [
      "buffer",
      "level buffer"
    ],
    "text": "levels that a curriculum has chosen, from which a share of the worlds is drawn; the others play fresh random levels. Buffer 80 was chosen by refresh 80"
  },
  "bundled": {
    "names": [
      "bundled policies"
    ],
    "text": "generalist and random_only, which an installation holds; commands find them by name"
  },
  "candidate": {
    "names": [
      "candidate"
    ],
    "text": "a random level that the curator plays to score it; the best candidates become the next buffer"
  },
  "clip-fraction": {
    "names": [
      "clip fraction",
      "clipped share"
    ],
    "text": "share of samples whose probability ratio between the updated policy and the one that acted is beyond the limit of PPO (ppo.clip), so that they no longer move the policy"
  },
  "curator": {
    "names": [
      "curator"
    ],
    "text": "the process that works out refreshes while training goes on"
  },
  "curriculum": {
    "names": [
      "curriculum"
    ],
    "text": "what chooses the levels of each update: SFL, PLR, ACCEL, PAIRED, domain randomization, a fixed set, or your own"
  },
  "designed": {
    "names": [
      "designed_s",
      "designed_m",
      "designed_l"
    ],
    "text": "held-out sets of the first five hand-made levels of a size; they never change"
  },
  "dev-designed": {
    "names": [
      "dev_designed_s",
      "dev_designed_m",
      "dev_designed_l"
    ],
    "text": "held-out sets of eight variants of each of our hand-made levels of a size: in a mirror, with other gravity, masses, friction and strength. Intervals are over the levels, not their variants"
  },
  "dev-random": {
    "names": [
      "dev_random_s",
      "dev_random_m",
      "dev_random_l"
    ],
    "text": "held-out sets of 2,048 random levels, none of them in random_s and so on: for choosing settings"
  },
  "dormant": {
    "names": [
      "dormant unit"
    ],
    "text": "a hidden unit whose mean activity is at most 0.025 of the mean of its layer: it hardly takes part in what the network computes"
  },
  "entropy": {
    "names": [
      "entropy"
    ],
    "text": "spread of the choices of the policy, in nat, summed over the heads of an action: high for nearly random actions, near zero for a policy that always does the same"
  },
  "env-step": {
    "names": [
      "environment step",
      "env step"
    ],
    "text": "one decision of the policy in one world: frame_skip physics steps of 1/60 s"
  },
  "evaluation-set": {
    "names": [
      "evaluation set",
      "held-out set"
    ],
    "text": "a named list of levels for evaluation, never trained on. Its levels and seeds stay the same, so that evaluations can be compared"
  },
  "evaluation": {
    "names": [
      "evaluation",
      "held-out solve rate"
    ],
    "text": "solve rates on level sets that are not trained on, with 95 % intervals"
  },
  "explained-variance": {
    "names": [
      "explained variance"
    ],
    "text": "share of the variance of returns that the value function predicts: 1 is all, 0 no more than a constant does"
  },
  "flow-matching": {
    "names": [
      "flow matching"
    ],
    "text": "making samples, here chunks of actions, from noise along a learned velocity"
  },
  "fresh-level": {
    "names": [
      "fresh level"
    ],
    "text": "a random level that no curriculum has chosen: what training without a curriculum would play"
  },
  "fresh-pair": {
    "names": [
      "fresh pair"
    ],
    "text": "two worlds of a group that play the same fresh level: their two attempts tell the learnability of fresh levels, against which that of the buffer is held"
  },
  "fresh": {
    "names": [
      "fresh sample"
    ],
    "text": "a sample that is learned from once and thrown away: one epoch over many worlds, since the engine is cheap"
  },
  "frontier": {
    "names": [
      "frontier_s",
      "frontier_m"
    ],
    "text": "held-out sets of 512 random levels that random actions rarely solve and at least one of six trained policies does: the levels that tell policies apart. A rate there is no rate of all random levels"
  },
  "gain": {
    "names": [
      "gain"
    ],
    "text": "solve rate now less that before training, or less that of random actions, in percentage points, with the interval of the difference"
  },
  "noise-scale": {
    "names": [
      "gradient noise scale"
    ],
    "text": "variance of the gradient over its square, in samples: from minibatches much larger than that, more samples gain little"
  },
  "idle": {
    "names": [
      "idle share"
    ],
    "text": "share of the time in which a process was in no call: it waited for others"
  },
  "inference-delay": {
    "names": [
      "inference delay"
    ],
    "text": "environment steps from an observation to the first action that follows from it"
  },
  "interquartile-mean": {
    "names": [
      "interquartile mean"
    ],
    "text": "mean of the middle half of the runs: an outlier does not move it"
  },
  "interval": {
    "names": [
      "interval",
      "95 % interval"
    ],
    "text": "range of rates that agree with what was counted: of a hundred such intervals about 95 contain the rate of endless attempts. Over attempts (Wilson's), or over base levels where a set has variants of them"
  },
  "learnability": {
    "names": [
      "learnability"
    ],
    "text": "p (1 - p) of a level that the policy solves with rate p: highest at one half, zero for what is always or never solved"
  },
  "level": {
    "names": [
      "level"
    ],
    "text": "a scene with roles, and with colours that say which action drives which motor and thruster"
  },
  "mechanism": {
    "names": [
      "mechanism"
    ],
    "text": "a machine that the generator can put into a random level: car, walker, cart with a pole. A family has one template"
  },
  "policy-lag": {
    "names": [
      "policy lag"
    ],
    "text": "number of updates between the policy that acted and the policy that learns from it"
  },
  "preset": {
    "names": [
      "preset"
    ],
    "text": "a named set of solver settings: standard, draft, fine, and paper, the published solver"
  },
  "proof": {
    "names": [
      "proof"
    ],
    "text": "stored actions that solve a level, so that it is known that it can be solved"
  },
  "random-actions": {
    "names": [
      "random actions"
    ],
    "text": "the policy that draws every action evenly: the rate that a trained policy has to beat"
  },
  "random-set": {
    "names": [
      "random_s",
      "random_m",
      "random_l"
    ],
    "text": "held-out sets of 256 random levels, drawn once as the generator draws them. Random actions solve about 35 % of those of S, so a rate is read against theirs"
  },
  "refresh": {
    "names": [
      "refresh"
    ],
    "text": "the work of drawing candidates, scoring them with the policy of now, and making the next buffer. One number names all of it: refresh 80 scores with the policy of update 80 (its policy version), makes buffer 80, and is in use from a later update on, when it is adopted"
  },
  "replay-buffer": {
    "names": [
      "replay buffer"
    ],
    "text": "levels that PLR and ACCEL store with a score and play again"
  },
  "process": {
    "names": [
      "role (of a process)"
    ],
    "text": "rollout, learner, curator, evaluator or driver: each can be watched, killed and resumed"
  },
  "role": {
    "names": [
      "role (of a shape)"
    ],
    "text": "green, blue, red or none. A level is solved when green touches blue, and failed when green touches red"
  },
  "score": {
    "names": [
      "score"
    ],
    "text": "number by which a curriculum chooses levels: learnability for SFL, an estimate of regret for PLR"
  },
  "snapshot": {
    "names": [
      "snapshot"
    ],
    "text": "a stored copy of the levels of a curriculum, with their counts, at a refresh or a checkpoint"
  },
  "solve-rate": {
    "names": [
      "solve rate"
    ],
    "text": "share of attempts that solved their level"
  },
  "training-solve-rate": {
    "names": [
      "training solve rate"
    ],
    "text": "solve rate of the attempts of one update, on levels of the buffer and fresh ones together; the curriculum makes them harder, so that it need not rise"
  },
  "update": {
    "names": [
      "update"
    ],
    "text": "one rollout of all worlds and the gradient steps on it; the clock of a run"
  }
};
