// Joints of one world: motor, limits, the relative angle of fixed joints, and the common point.
//
// Body b is held to body a. Angles are angle_b - angle_a - rest angle. Soft joints follow the soft-step
// solver, hard joints the appendix of the Kinetix paper; see docs/engine.md.

struct Joint {
  int a, b, index, flags;
  Vec2 local_a, local_b;
  Vec2 arm_a, arm_b;      // current, world orientation
  Vec2 centre_gap;        // centre of b from centre of a at the start of the step
  real start_angle;       // at the start of the step
  real axial_mass;
  real motor_target, max_motor_impulse;  // rad/s; largest impulse of one sub-step, N m s
  real lower, upper;
  Vec2 impulse;
  real angular_impulse, impulse_lower, impulse_upper;  // of the motor, or of a fixed joint's angle; of limits
};

struct Joints {
  enum { MOTOR_BIT = 1 << JOINTS_MOTOR_ON_SHIFT };
  Joint list[NUM_JOINTS + 1];
  int count;

  KFN static int kind_of(int word) { return word >> JOINTS_KIND_SHIFT & JOINTS_KIND_MASK; }

  KFN static bool is_fixed(int word) { return HAS_FIXED_JOINTS && (!HAS_REVOLUTE_JOINTS || kind_of(word) == KIND_FIXED); }

  KFN static bool is_driven(int word) { return HAS_MOTORS && (word & MOTOR_BIT) != 0; }

  KFN static bool is_limited(int word) { return HAS_JOINT_LIMITS && (word >> JOINTS_HAS_LIMITS_SHIFT & 1) != 0; }

  KFN void load(const Bodies& bodies, const Column& scene, const IntColumn& ints, const Column& params,
                const Column& impulses) {
    count = 0;
    bool warm = params.get(PARAM_WARM_START) != real(0);
    for (int j = 0; j < NUM_JOINTS; ++j) {
      int packed = ints.get(INTS_JOINTS + j);
      if ((packed >> JOINTS_ACTIVE_SHIFT & 1) == 0) continue;
      if (kind_of(packed) == KIND_FIXED ? !HAS_FIXED_JOINTS : !HAS_REVOLUTE_JOINTS) continue;
      int slot_a = packed >> JOINTS_A_SHIFT & JOINTS_A_MASK, slot_b = packed >> JOINTS_B_SHIFT & JOINTS_B_MASK;
      if (!Slot::in_use(slot_a) || !Slot::in_use(slot_b)) continue;
      Joint& joint = list[count];
      joint.index = j;
      joint.flags = packed;
      joint.a = Slot::shape(slot_a);
      joint.b = Slot::shape(slot_b);
      if (!bodies.is_dynamic(joint.a) && !bodies.is_dynamic(joint.b)) continue;  // nothing to hold
      ++count;
      joint.local_a = scene.get2(SCENE_JOINTS_ANCHOR_A + 2 * j);
      joint.local_b = scene.get2(SCENE_JOINTS_ANCHOR_B + 2 * j);
      joint.lower = scene.get(SCENE_JOINTS_LOWER_LIMIT + j);
      joint.upper = scene.get(SCENE_JOINTS_UPPER_LIMIT + j);
      if (warm) {
        load_impulses(joint, impulses);
      } else {
        joint.impulse = {real(0), real(0)};
        joint.angular_impulse = joint.impulse_lower = joint.impulse_upper = real(0);
      }
      joint.axial_mass =
          Math::inverse_or_zero(bodies.inverse_inertia(joint.a) + bodies.inverse_inertia(joint.b));
    }
  }

  // The impulses as they were last stored.
  KFN void load_impulses(const Column& impulses) {
    for (int k = 0; k < count; ++k) load_impulses(list[k], impulses);
  }

  KFN static void load_impulses(Joint& joint, const Column& impulses) {
    int row = IMPULSE_JOINT_IMPULSE + 5 * joint.index;
    joint.impulse = impulses.get2(row);
    joint.angular_impulse = impulses.get(row + 2);
    joint.impulse_lower = impulses.get(row + 3);
    joint.impulse_upper = impulses.get(row + 4);
  }

  KFN void store(const Column& impulses) const {
    for (int k = 0; k < count; ++k) {
      const Joint& joint = list[k];
      impulses.set2(IMPULSE_JOINT_IMPULSE + 5 * joint.index, joint.impulse);
      impulses.set(IMPULSE_JOINT_IMPULSE + 5 * joint.index + 2, joint.angular_impulse);
      impulses.set(IMPULSE_JOINT_IMPULSE + 5 * joint.index + 3, joint.impulse_lower);
      impulses.set(IMPULSE_JOINT_IMPULSE + 5 * joint.index + 4, joint.impulse_upper);
    }
  }

  KFN void prepare(const Bodies& bodies, const Column& scene, const Column& controls, const Column& params, real h) {
    for (int k = 0; k < count; ++k) {
      Joint& joint = list[k];
      joint.centre_gap = bodies.position[joint.b] - bodies.position[joint.a];
      joint.start_angle = bodies.angle[joint.b] - bodies.angle[joint.a] - scene.get(SCENE_JOINTS_REST_ANGLE + joint.index);
      turn_arms(bodies, joint);
      real control = controls.get(joint.index);
      bool driven = is_driven(joint.flags) && !is_fixed(joint.flags) && control != real(0);
      if (!driven) joint.flags &= ~MOTOR_BIT;
      joint.motor_target = control * scene.get(SCENE_JOINTS_MOTOR_SPEED + joint.index) * params.get(PARAM_BASE_MOTOR_SPEED);
      // The power is the angular acceleration that the motor can give to the pair of bodies alone.
      joint.max_motor_impulse = h * params.get(PARAM_BASE_MOTOR_POWER) * scene.get(SCENE_JOINTS_MOTOR_POWER + joint.index) *
                         joint.axial_mass;
      if (!driven && !is_fixed(joint.flags)) joint.angular_impulse = real(0);
    }
  }

  KFN static void turn_arms(const Bodies& bodies, Joint& joint) {
    joint.arm_a = bodies.rotation[joint.a].apply(joint.local_a);
    joint.arm_b = bodies.rotation[joint.b].apply(joint.local_b);
  }

  KFN void warm_start(Bodies& bodies) {
    for (int k = 0; k < count; ++k) {
      Joint& joint = list[k];
      turn_arms(bodies, joint);
      Pair pair = Pair::of(bodies, joint.a, joint.b);
      pair.apply_impulse(joint.arm_a, joint.arm_b, joint.impulse);
      pair.apply_angular_impulse(joint.angular_impulse + joint.impulse_lower - joint.impulse_upper);
      pair.write_back(bodies);
    }
  }

  KFN static real current_angle(const Bodies& bodies, const Joint& joint) {
    return joint.start_angle + bodies.turn(joint.b) - bodies.turn(joint.a);
  }

  // Without `motors` in a bounce: a torque does nothing in an instant.
  KFN void solve_soft(Bodies& bodies, const Soft& soft, bool use_bias, bool motors) {
    for (int k = 0; k < count; ++k) {
      Joint& joint = list[k];
      Pair pair = Pair::of(bodies, joint.a, joint.b);
      if (is_fixed(joint.flags)) {
        solve_angle(pair, joint, current_angle(bodies, joint), soft, use_bias);
      } else {
        if (motors && is_driven(joint.flags)) solve_motor(pair, joint);
        if (is_limited(joint.flags))
          solve_limits(pair, joint, current_angle(bodies, joint), soft, use_bias);
      }
      solve_point(bodies, pair, joint, soft, use_bias);
      pair.write_back(bodies);
    }
  }

  // Velocity constraint with a bounded torque: dt changes neither its target nor its strength.
  KFN static void solve_motor(Pair& pair, Joint& joint) {
    real speed = pair.omega_b - pair.omega_a;
    real total = Math::clamp(joint.angular_impulse - joint.axial_mass * (speed - joint.motor_target), -joint.max_motor_impulse,
                             joint.max_motor_impulse);
    real angular_impulse = total - joint.angular_impulse;
    joint.angular_impulse = total;
    pair.apply_angular_impulse(angular_impulse);
  }

  // J, what motors have added to the bodies' energy in this sub-step.
  KFN real motor_work(const Bodies& bodies) const {
    real work = real(0);
    for (int k = 0; k < count && HAS_MOTORS; ++k) {
      const Joint& joint = list[k];
      if (!is_driven(joint.flags)) continue;
      work += Math::max(joint.angular_impulse * (bodies.omega(joint.b) - bodies.omega(joint.a)), real(0));
    }
    return work;
  }

  KFN static void solve_angle(Pair& pair, Joint& joint, real angle, const Soft& soft, bool use_bias) {
    real max_speed = soft.turn_back_speed;
    real bias = use_bias ? Math::clamp(soft.joint.bias_rate * angle, -max_speed, max_speed) : real(0);
    real mass_scale = use_bias ? soft.joint.mass_scale : real(1);
    real impulse_scale = use_bias ? soft.joint.impulse_scale : real(0);
    real speed = pair.omega_b - pair.omega_a;
    real angular_impulse = -joint.axial_mass * mass_scale * (speed + bias) - impulse_scale * joint.angular_impulse;
    joint.angular_impulse += angular_impulse;
    pair.apply_angular_impulse(angular_impulse);
  }

  KFN static void solve_limits(Pair& pair, Joint& joint, real angle, const Soft& soft, bool use_bias) {
    real speed = pair.omega_b - pair.omega_a;
    real lower = limit_impulse(joint, angle - joint.lower, speed, joint.impulse_lower, soft, use_bias);
    pair.apply_angular_impulse(lower);
    speed = pair.omega_b - pair.omega_a;
    real upper = limit_impulse(joint, joint.upper - angle, -speed, joint.impulse_upper, soft, use_bias);
    pair.apply_angular_impulse(-upper);
  }

  // One-sided: room is what is left before the limit, speed that at which room grows.
  KFN static real limit_impulse(const Joint& joint, real room, real speed, real& accumulated, const Soft& soft,
                                bool use_bias) {
    real bias = real(0);
    if (room > real(0)) {
      bias = room * soft.inverse_h;
    } else if (use_bias) {
      // Not softened: a strong motor would lean into a limit that yields.
      bias = Math::max(soft.joint.bias_rate * room, -soft.turn_back_speed);
    }
    real impulse = -joint.axial_mass * (speed + bias);
    real total = Math::max(accumulated + impulse, real(0));
    impulse = total - accumulated;
    accumulated = total;
    return impulse;
  }

  KFN static void solve_point(const Bodies& bodies, Pair& pair, Joint& joint, const Soft& soft, bool use_bias) {
    turn_arms(bodies, joint);
    Vec2 wrong = pair.relative(joint.arm_a, joint.arm_b);
    real mass_scale = real(1), impulse_scale = real(0);
    if (use_bias) {
      Vec2 gap = joint.centre_gap + (bodies.delta(joint.b) - bodies.delta(joint.a)) + (joint.arm_b - joint.arm_a);
      wrong = wrong + clamp_length(gap * soft.joint.bias_rate, soft.pull_speed);
      mass_scale = soft.joint.mass_scale;
      impulse_scale = soft.joint.impulse_scale;
    }
    Vec2 impulse = -(point_mass_times(pair, joint, wrong) * mass_scale) - joint.impulse * impulse_scale;
    joint.impulse = joint.impulse + impulse;
    pair.apply_impulse(joint.arm_a, joint.arm_b, impulse);
  }

  KFN static Vec2 clamp_length(Vec2 v, real max_length) {
    real squared = v.dot(v);
    return squared > max_length * max_length ? v * (max_length / sqrtf(squared)) : v;
  }

  // Solves K x = v with K the 2 x 2 inverse effective mass of the common point.
  KFN static Vec2 point_mass_times(const Pair& pair, const Joint& joint, Vec2 v) {
    real mass = pair.inverse_mass_a + pair.inverse_mass_b;
    real ia = pair.inverse_inertia_a, ib = pair.inverse_inertia_b;
    Vec2 ra = joint.arm_a, rb = joint.arm_b;
    real k11 = mass + ia * ra.y * ra.y + ib * rb.y * rb.y;
    real k12 = -ia * ra.x * ra.y - ib * rb.x * rb.y;
    real k22 = mass + ia * ra.x * ra.x + ib * rb.x * rb.x;
    real determinant = k11 * k22 - k12 * k12;
    real inverse = determinant != real(0) ? real(1) / determinant : real(0);
    return {inverse * (k22 * v.x - k12 * v.y), inverse * (k11 * v.y - k12 * v.x)};
  }
};
