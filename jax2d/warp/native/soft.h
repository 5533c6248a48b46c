// Soft constraints: springs that are given by frequency and damping and stay stable at any step (docs/engine.md).

struct Softness {
  real bias_rate, mass_scale, impulse_scale;

  KFN static Softness load(const Column& params, int first) {
    return {params.get(first), params.get(first + 1), params.get(first + 2)};
  }
};

// How a sub-step is solved.
struct Soft {
  Softness contact, fixed, joint;  // fixed: contacts with what cannot move
  real inverse_h;
  real bend_time;  // s, times a spin squared and an arm: speed that keeps an anchor on its circle
  real push_out_speed, pull_speed, turn_back_speed;  // fastest at which overlaps, gaps of joints and angles are undone

  KFN static Soft load(const Column& params) {
    return {Softness::load(params, PARAM_CONTACT_BIAS_RATE), Softness::load(params, PARAM_FIXED_BIAS_RATE),
            Softness::load(params, PARAM_JOINT_BIAS_RATE), real(1) / params.get(PARAM_H),
            real(0.5) * BEND_SHARE * params.get(PARAM_H),
            params.get(PARAM_PUSH_OUT_SPEED), params.get(PARAM_JOINT_PULL_SPEED), params.get(PARAM_JOINT_TURN_SPEED)};
  }
};
