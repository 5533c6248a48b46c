// Soft constraints: springs that are given by frequency and damping and stay stable at any step (docs/engine.md).

struct Softness {
  real bias_rate, mass_scale, impulse_scale;

  // By value: with a pointer to one of both, all that they are part of would be in memory, not in registers.
  KFN static Softness either(bool is_first, const Softness& one, const Softness& other) {
    Softness a = one, b = other;
    return {is_first ? a.bias_rate : b.bias_rate, is_first ? a.mass_scale : b.mass_scale,
            is_first ? a.impulse_scale : b.impulse_scale};
  }

  KFN static Softness load(const Column& params, int first) {
    return {params.get(first), params.get(first + 1), params.get(first + 2)};
  }
};

// How a sub-step is solved.
struct Soft {
  Softness contact, fixed, joint, softened;  // fixed: contacts with what cannot move
  real h, inverse_h;
  real bend_time;  // s, times a spin squared and an arm: speed that keeps an anchor on its circle
  real max_spin;   // faster nothing turns in the end, however fast it does while velocities are solved
  real push_out_speed, pull_speed, turn_back_speed;  // fastest at which overlaps, gaps of joints and angles are undone

  KFN static Soft load(const Column& params) {
    return {Softness::load(params, PARAM_CONTACT_BIAS_RATE), Softness::load(params, PARAM_FIXED_BIAS_RATE),
            Softness::load(params, PARAM_JOINT_BIAS_RATE), Softness::load(params, PARAM_SOFTENED_BIAS_RATE), params.get(PARAM_H), real(1) / params.get(PARAM_H),
            real(0.5) * BEND_SHARE * params.get(PARAM_H), params.get(PARAM_MAX_ANGULAR_SPEED),
            params.get(PARAM_PUSH_OUT_SPEED), params.get(PARAM_JOINT_PULL_SPEED), params.get(PARAM_JOINT_TURN_SPEED)};
  }

  // Of a limit along a line, one-sided: clearance is what is left before it, speed that at which clearance grows. It is softened as
  // joints are: rows of rods that do not, and light sliders that carry heavy ones, would gain energy.
  KFN real limit_impulse(real clearance, real speed, real mass, real& accumulated, bool use_bias) const {
    real bias = real(0), mass_scale = real(1), impulse_scale = real(0);
    if (clearance > real(0)) {
      bias = clearance * inverse_h;
    } else if (use_bias) {
      bias = Math::max(joint.bias_rate * clearance, -pull_speed);
      mass_scale = joint.mass_scale;
      impulse_scale = joint.impulse_scale;
    }
    real impulse = -mass * mass_scale * (speed + bias) - impulse_scale * accumulated;
    real total = Math::max(accumulated + impulse, real(0));
    impulse = total - accumulated;
    accumulated = total;
    return impulse;
  }

  // Of springs (springs.h): stiffness x h^2 / mass of a joint, and how far ahead a spring looks, in sub-steps.
  KFN real max_q() const {
    return joint.impulse_scale > real(0) ? joint.mass_scale / joint.impulse_scale * joint.bias_rate * h : FAR_DISTANCE;
  }
  KFN real theta(real q) const {
    real max_theta = joint.impulse_scale > real(0) ? real(1) / (joint.bias_rate * h) : real(0), share = q / max_q();
    return q + Math::max(max_theta - max_q(), real(0)) * share * share;
  }
};
