// One joint while a world is stepped, and what its packed word says.
//
// Body b is held to body a. Angles are angle_b - angle_a - rest angle. Ropes and rods are joints that hold nothing but the length
// between their anchors, within bounds (Joints::begin_rod).

struct Joint {
  unsigned int a : SHAPE_BITS, b : SHAPE_BITS;  // one word: a GPU waits for each that it loads
  int index, flags;
  Vec2 local_a, local_b;
  Vec2 arm_a, arm_b;      // world orientation, as the bodies stand
  Vec2 apart;             // anchor of b from anchor of a, as the bodies stand
  Vec2 common_a, common_b;  // to the point where impulses act
  Vec2 centre_gap;        // centre of b from centre of a at the start of the step
  real start_angle;       // at the start of the step
  real axial_mass;
  real motor_target, max_motor_impulse;  // rad/s or m/s; largest impulse of one sub-step, N m s or N s
  real lower, upper;      // rad; of a slider, rope or rod m
  Vec2 impulse;           // at the common point; of a slider across its axis, and about it
  real angular_impulse, impulse_lower, impulse_upper;  // of the motor, or of a fixed joint's angle; of limits

  enum { MOTOR_BIT = 1 << JOINTS_MOTOR_ON_SHIFT };
  enum { KIND_ROD = JOINTS_KIND_MASK };  // after those of a scene

  KFN static int kind_of(int word) { return word >> JOINTS_KIND_SHIFT & JOINTS_KIND_MASK; }

  // In kernels for one kind of joint every joint is of that kind.
  KFN bool is_fixed() const {
    return HAS_FIXED_JOINTS && ((!HAS_REVOLUTE_JOINTS && !HAS_AXIS_JOINTS) || kind_of(flags) == KIND_FIXED);
  }
  KFN bool is_prismatic() const {
    bool is_only_kind = !HAS_REVOLUTE_JOINTS && !HAS_FIXED_JOINTS && !HAS_RODS;
    return HAS_PRISMATIC_JOINTS && (is_only_kind || kind_of(flags) == KIND_PRISMATIC);
  }
  KFN bool is_rod() const { return HAS_RODS && kind_of(flags) == KIND_ROD; }
  KFN bool is_along_line() const { return is_prismatic() || is_rod(); }
  KFN bool is_driven() const { return HAS_MOTORS && (flags & MOTOR_BIT) != 0; }
  KFN int drive() const { return HAS_BRAKES_AND_SERVOS ? flags >> JOINTS_DRIVE_SHIFT & JOINTS_DRIVE_MASK : DRIVE_VELOCITY; }
  KFN bool is_limited() const { return is_rod() || (HAS_JOINT_LIMITS && (flags >> JOINTS_HAS_LIMITS_SHIFT & 1) != 0); }

  // Limits that say how often a body has turned against the other.
  KFN bool is_wide() const { return bounds_angle() && upper - lower > WIDE_LIMITS; }
  KFN bool bounds_angle() const { return is_limited() && !is_fixed() && !is_along_line(); }

  // Of an angle known up to full turns the one nearest to where the joint wants it.
  KFN real wanted_angle(real angle) const {
    if (!SOFT_STEP || is_wide()) return angle;
    return Angle::near(angle, bounds_angle() ? real(0.5) * (lower + upper) : real(0));
  }

  KFN static bool is_compiled_in(int word) {
    int kind = kind_of(word);
    return kind == KIND_FIXED ? HAS_FIXED_JOINTS : kind == KIND_PRISMATIC ? HAS_PRISMATIC_JOINTS : HAS_REVOLUTE_JOINTS;
  }

  // A motor or limits may act along its axis.
  KFN bool has_axial_row() const { return !is_fixed() && (is_driven() || is_limited()); }

  // With rotations of both bodies as they stand. Impulses act on both at one point, or they would change what both have
  // of angular momentum: of a slider at the anchor of b, of others in the middle of the gap; what is fixed takes any. Those along
  // the line of a rope or rod change none, wherever on it.
  KFN void place(const Bodies& bodies) {
    arm_a = bodies.rotation[a].apply(local_a);
    arm_b = bodies.rotation[b].apply(local_b);
    apart = centre_gap + (bodies.delta(b) - bodies.delta(a)) + (arm_b - arm_a);
    bool both_move = bodies.inverse_mass(a) > real(0) && bodies.inverse_mass(b) > real(0);
    real share = is_prismatic() ? real(1) : (both_move && !is_rod() ? real(0.5) : real(0));
    common_a = arm_a.plus(apart, share);
    common_b = is_prismatic() ? arm_b : arm_b.minus(apart, share);
  }

  KFN real current_angle(const Bodies& bodies) const { return start_angle + bodies.turn(b) - bodies.turn(a); }

  KFN real total_impulse() const { return angular_impulse + impulse_lower - impulse_upper; }

  // Of its rows.
  KFN Vec3 held_impulse() const { return {impulse.x, impulse.y, is_fixed() ? angular_impulse : total_impulse()}; }

  // `total` of a row along its axis: a limit's beyond what the motor gives.
  KFN void set_axial(const AxialRow& row, real total) {
    if (is_rod()) {
      impulse_lower = Math::max(total, real(0));
      impulse_upper = Math::max(-total, real(0));
      return;
    }
    real motor = row.is_limit() ? row.pushing() : total;
    angular_impulse = motor;
    impulse_lower = Math::max(total - motor, real(0));
    impulse_upper = Math::max(motor - total, real(0));
  }
};
