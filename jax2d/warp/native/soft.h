// Soft constraints: springs that are given by frequency and damping and stay stable at any step (docs/engine_solver.md).

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
  Softness contact, fixed, spring;  // fixed: contacts with what cannot move
  real h, inverse_h;
  real joint_rate;  // 1/s, at which errors of joints are undone
  real max_spin;    // faster nothing turns in the end, however fast it does while velocities are solved
  real push_out_speed, pull_speed, turn_back_speed;  // fastest at which overlaps, gaps of joints and angles are undone

  KFN static Soft load(const Column& params) {
    real inverse_h = real(1) / params.get(PARAM_H);
    return {Softness::load(params, PARAM_CONTACT_BIAS_RATE), Softness::load(params, PARAM_FIXED_BIAS_RATE),
            Softness::load(params, PARAM_SPRING_BIAS_RATE), params.get(PARAM_H), inverse_h,
            params.get(PARAM_JOINT_CORRECTION) * inverse_h, params.get(PARAM_MAX_ANGULAR_SPEED),
            params.get(PARAM_PUSH_OUT_SPEED), params.get(PARAM_JOINT_PULL_SPEED), params.get(PARAM_JOINT_TURN_SPEED)};
  }

  // Fastest at which a joint may go towards its limit, at `clearance` from it. Beyond the limit it comes back.
  KFN real limit_speed(real clearance, real max_return_speed, bool use_bias) const {
    if (clearance > real(0)) return clearance * inverse_h;
    return use_bias ? Math::max(joint_rate * clearance, -max_return_speed) : real(0);
  }

  // Of springs (springs.h): stiffness x h^2 / mass of a joint, and how far ahead a spring looks, in sub-steps.
  KFN real max_q() const {
    return spring.impulse_scale > real(0) ? spring.mass_scale / spring.impulse_scale * spring.bias_rate * h : FAR_DISTANCE;
  }
  KFN real theta(real q) const {
    real max_theta = spring.impulse_scale > real(0) ? real(1) / (spring.bias_rate * h) : real(0), share = q / max_q();
    return q + Math::max(max_theta - max_q(), real(0)) * share * share;
  }
};
