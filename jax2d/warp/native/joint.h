// One joint while a world is stepped, and what its packed word says.
//
// Body b is held to body a. Angles are angle_b - angle_a - rest angle.

struct Joint {
  unsigned int a : SHAPE_BITS, b : SHAPE_BITS;  // one word: a GPU waits for each that it loads
  int index, flags;
  Vec2 local_a, local_b;
  Vec2 arm_a, arm_b;      // world orientation, since bodies last turned
  Vec2 centre_gap;        // centre of b from centre of a at the start of the step
  real start_angle;       // at the start of the step
  real axial_mass;
  real motor_target, max_motor_impulse;  // rad/s or m/s; largest impulse of one sub-step, N m s or N s
  real lower, upper;
  Vec2 impulse;           // at the common point; of a slider across its axis, and about it
  real angular_impulse, impulse_lower, impulse_upper;  // of the motor, or of a fixed joint's angle; of limits

  enum { MOTOR_BIT = 1 << JOINTS_MOTOR_ON_SHIFT };

  KFN static int kind_of(int word) { return word >> JOINTS_KIND_SHIFT & JOINTS_KIND_MASK; }

  // In kernels for one kind of joint every joint is of that kind.
  KFN bool is_fixed() const {
    return HAS_FIXED_JOINTS && ((!HAS_REVOLUTE_JOINTS && !HAS_PRISMATIC_JOINTS) || kind_of(flags) == KIND_FIXED);
  }
  KFN bool is_prismatic() const {
    return HAS_PRISMATIC_JOINTS && ((!HAS_REVOLUTE_JOINTS && !HAS_FIXED_JOINTS) || kind_of(flags) == KIND_PRISMATIC);
  }
  // One end is light, with more on its other side (softened_joints.py).
  KFN bool is_softened() const { return (flags >> JOINTS_SOFTENED_SHIFT & 1) != 0; }
  KFN bool is_driven() const { return HAS_MOTORS && (flags & MOTOR_BIT) != 0; }
  KFN int drive() const { return HAS_BRAKES_AND_SERVOS ? flags >> JOINTS_DRIVE_SHIFT & JOINTS_DRIVE_MASK : DRIVE_VELOCITY; }
  KFN bool is_limited() const { return HAS_JOINT_LIMITS && (flags >> JOINTS_HAS_LIMITS_SHIFT & 1) != 0; }

  // Limits that say how often a body has turned against the other.
  KFN bool is_wide() const {
    return is_limited() && !is_fixed() && !is_prismatic() && upper - lower > WIDE_LIMITS;
  }

  // Of an angle known up to full turns the one nearest to where the joint wants it.
  KFN real wanted_angle(real angle) const {
    if (!SOFT_STEP || is_wide()) return angle;
    bool is_bounded = is_limited() && !is_fixed() && !is_prismatic();
    return Angle::near(angle, is_bounded ? real(0.5) * (lower + upper) : real(0));
  }

  KFN static bool is_compiled_in(int word) {
    int kind = kind_of(word);
    return kind == KIND_FIXED ? HAS_FIXED_JOINTS : kind == KIND_PRISMATIC ? HAS_PRISMATIC_JOINTS : HAS_REVOLUTE_JOINTS;
  }

  KFN void turn_arms(const Bodies& bodies) {
    arm_a = bodies.rotation[a].apply(local_a);
    arm_b = bodies.rotation[b].apply(local_b);
  }

  // Anchor of b from anchor of a, with arms as they are.
  KFN Vec2 gap(const Bodies& bodies) const { return centre_gap + (bodies.delta(b) - bodies.delta(a)) + (arm_b - arm_a); }

  // To the middle of the gap, where both bodies can move: an impulse at two points would change what both have of
  // angular momentum.
  KFN Arms common_arms(const Pair& pair, Vec2 gap) const {
    bool is_fixed_a = pair.inverse_mass_a == real(0), is_fixed_b = pair.inverse_mass_b == real(0);
    if (is_fixed_a || is_fixed_b) return {arm_a, arm_b};
    return {arm_a.plus(gap, real(0.5)), arm_b.minus(gap, real(0.5))};
  }

  KFN real current_angle(const Bodies& bodies) const { return start_angle + bodies.turn(b) - bodies.turn(a); }

  // In the relax pass a motor that is not at a limit has the last word, so that what holds the joint costs it no speed.
  KFN bool is_motor_last(bool use_bias) const { return !use_bias && impulse_lower + impulse_upper == real(0); }

  // Of a motor that shall bring `mass` from `speed` to its target: what it adds to its bounded impulse. dt changes neither
  // its target nor its strength.
  KFN real motor_impulse(real speed, real mass) {
    real wanted = Fused::of(-mass, speed - motor_target, angular_impulse);
    real total = Math::clamp(wanted, -max_motor_impulse, max_motor_impulse);
    real added = total - angular_impulse;
    angular_impulse = total;
    return added;
  }

  KFN real lower_impulse(real clearance, real speed, const Soft& soft, bool use_bias, real max_return_speed) {
    return limit_impulse(clearance, speed, impulse_lower, soft, use_bias, max_return_speed);
  }
  KFN real upper_impulse(real clearance, real speed, const Soft& soft, bool use_bias, real max_return_speed) {
    return limit_impulse(clearance, speed, impulse_upper, soft, use_bias, max_return_speed);
  }

  // One-sided: clearance is what is left before the limit, speed that at which clearance grows.
  KFN real limit_impulse(real clearance, real speed, real& accumulated, const Soft& soft, bool use_bias,
                         real max_return_speed) const {
    real bias = real(0);
    if (clearance > real(0)) {
      bias = clearance * soft.inverse_h;
    } else if (use_bias) {
      // Not softened: a strong motor would lean into a limit that gives way.
      bias = Math::max(soft.joint.bias_rate * clearance, -max_return_speed);
    }
    real impulse = -axial_mass * (speed + bias);
    real total = Math::max(accumulated + impulse, real(0));
    impulse = total - accumulated;
    accumulated = total;
    return impulse;
  }
};
