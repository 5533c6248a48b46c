// What connects bodies of one world: springs, and joints by motor, limits, the relative angle of fixed joints, and the
// common point.
//
// Body b is held to body a. Angles are angle_b - angle_a - rest angle. Soft joints follow the soft-step
// solver, hard joints the appendix of the Kinetix paper; see docs/engine.md.

struct Joints {
  ARRAY(Joint, list, NUM_JOINTS + 1);
  ARRAY(Vec2, local_axis, HAS_PRISMATIC_JOINTS ? NUM_JOINTS + 1 : 1);  // frame of a, of sliders
  ARRAY(Drive, drives, HAS_BRAKES_AND_SERVOS ? NUM_JOINTS + 1 : 1);
  Springs springs;
  int count;

  KFN void load(Bodies& bodies, const Column& scene, const IntColumn& ints, const Column& params,
                const Column& impulses) {
    springs.load(bodies, scene, ints, params, impulses);
    count = 0;
    bool warm = params.get(PARAM_WARM_START) != real(0);
    for (int j = 0; j < NUM_JOINTS; ++j) {
      int packed = ints.get(INTS_JOINTS + j);
      if ((packed >> JOINTS_ACTIVE_SHIFT & 1) == 0) continue;
      if (!Joint::is_compiled_in(packed)) continue;
      int slot_a = packed >> JOINTS_A_SHIFT & JOINTS_A_MASK, slot_b = packed >> JOINTS_B_SHIFT & JOINTS_B_MASK;
      if (!Slot::in_use(slot_a) || !Slot::in_use(slot_b)) continue;
      Joint& joint = list[count];
      joint.index = j;
      joint.flags = packed;
      joint.a = Slot::shape(slot_a);
      joint.b = Slot::shape(slot_b);
      if (!bodies.is_dynamic(joint.a) && !bodies.is_dynamic(joint.b)) continue;  // nothing to hold
      if (joint.is_prismatic()) {
        real axis_angle = scene.get(SCENE_JOINTS_AXIS_ANGLE + j);
        local_axis[count] = {cosf(axis_angle), sinf(axis_angle)};
      }
      ++count;
      joint.local_a = scene.get2(SCENE_JOINTS_ANCHOR_A + 2 * j);
      joint.local_b = scene.get2(SCENE_JOINTS_ANCHOR_B + 2 * j);
      joint.lower = scene.get(SCENE_JOINTS_LOWER_LIMIT + j);
      joint.upper = scene.get(SCENE_JOINTS_UPPER_LIMIT + j);
      if (SOFT_STEP && joint.is_wide()) {
        Bodies::add(bodies.counts_turns, joint.a);
        Bodies::add(bodies.counts_turns, joint.b);
      }
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
    springs.load_impulses(impulses);
    for (int k = 0; k < count; ++k) load_impulses(list[k], impulses);
  }

  KFN static void load_impulses(Joint& joint, const Column& impulses) {
    int row = IMPULSE_JOINT_IMPULSE + 5 * joint.index;
    joint.impulse = impulses.get2(row);
    joint.angular_impulse = impulses.get(row + 2);
    joint.impulse_lower = impulses.get(row + 3);
    joint.impulse_upper = impulses.get(row + 4);
  }

  // Joints would request again and again what a speed limit has taken back: impulses that grow
  // without end.
  KFN void reset_slowed(const Bodies& bodies) {
    springs.reset_slowed(bodies);
    for (int k = 0; k < count; ++k) {
      Joint& joint = list[k];
      if (!SOFT_STEP || !bodies.is_slowed(joint.a, joint.b)) continue;
      joint.impulse = {real(0), real(0)};
      joint.angular_impulse = joint.impulse_lower = joint.impulse_upper = real(0);
    }
  }

  KFN void store(const Column& impulses) const {
    springs.store(impulses);
    for (int k = 0; k < count; ++k) {
      const Joint& joint = list[k];
      impulses.set2(IMPULSE_JOINT_IMPULSE + 5 * joint.index, joint.impulse);
      impulses.set(IMPULSE_JOINT_IMPULSE + 5 * joint.index + 2, joint.angular_impulse);
      impulses.set(IMPULSE_JOINT_IMPULSE + 5 * joint.index + 3, joint.impulse_lower);
      impulses.set(IMPULSE_JOINT_IMPULSE + 5 * joint.index + 4, joint.impulse_upper);
    }
  }

  KFN void prepare(const Bodies& bodies, const Column& scene, const Column& controls, const Column& params, real h) {
    springs.prepare(bodies);
    for (int k = 0; k < count; ++k) {
      Joint& joint = list[k];
      joint.centre_gap = bodies.position[joint.b] - bodies.position[joint.a];
      joint.start_angle = joint.wanted_angle(bodies.angle[joint.b] - bodies.angle[joint.a] -
                                             scene.get(SCENE_JOINTS_REST_ANGLE + joint.index));
      joint.turn_arms(bodies);
      real base_speed = params.get(PARAM_BASE_MOTOR_SPEED), base_power = params.get(PARAM_BASE_MOTOR_POWER);
      if (joint.is_prismatic()) {
        joint.axial_mass = Slider::of(bodies, joint, local_axis[k]).axial_mass(bodies, joint);
        base_speed = params.get(PARAM_BASE_SLIDER_SPEED);
        base_power = params.get(PARAM_BASE_SLIDER_POWER);
      }
      real control = controls.get(CONTROLS_MOTOR + joint.index);
      bool driven = joint.is_driven() && !joint.is_fixed() && (control != real(0) || joint.drive() != DRIVE_VELOCITY);
      if (!driven) joint.flags &= ~Joint::MOTOR_BIT;
      joint.motor_target = control * scene.get(SCENE_JOINTS_MOTOR_SPEED + joint.index) * base_speed;
      // The power is the acceleration that the motor can give to the pair of bodies alone.
      joint.max_motor_impulse = h * base_power * scene.get(SCENE_JOINTS_MOTOR_POWER + joint.index) * joint.axial_mass;
      if (!driven && !joint.is_fixed()) joint.angular_impulse = real(0);
      if (driven && joint.drive() != DRIVE_VELOCITY) {
        real speed = base_speed * scene.get(SCENE_JOINTS_MOTOR_SPEED + joint.index);
        drives[k] = Drive::of(joint, inverse_driven_mass(bodies, k), control, speed, h);
      }
    }
  }

  // How fast the bodies go along or about the axis after a unit of impulse, with what their joint holds against it.
  KFN real inverse_driven_mass(const Bodies& bodies, int k) const {
    const Joint& joint = list[k];
    Pair pair = Pair::of(bodies, joint.a, joint.b);
    if (joint.is_prismatic()) return Slider::of(bodies, joint, local_axis[k]).inverse_driven_mass(pair);
    Arms arms = joint.common_arms(pair, joint.gap(bodies));
    Vec2 wrong = wrong_of_turn(pair, arms);
    real free = pair.inverse_inertia_a + pair.inverse_inertia_b;
    return Math::max(free - wrong.dot(point_mass_times(pair, arms, wrong)), real(0));
  }

  // Speed of b's point from a's that a unit of angular impulse makes.
  KFN static Vec2 wrong_of_turn(const Pair& pair, Arms arms) {
    return (arms.a.left() * pair.inverse_inertia_a).plus(arms.b.left(), pair.inverse_inertia_b);
  }

  // Where a servo aims for the next sub-step, by how far it has come: rad or m.
  KFN void aim(int k, real position, const Soft& soft) {
    Joint& joint = list[k];
    if (joint.drive() == DRIVE_SERVO)
      joint.motor_target = drives[k].speed_towards(drives[k].position - position, soft.inverse_h);
  }

  KFN real motor_mass(int k) const {
    return list[k].drive() == DRIVE_VELOCITY ? list[k].axial_mass : drives[k].mass;
  }

  KFN void warm_start(Bodies& bodies) {
    springs.warm_start(bodies);
    for (int k = 0; k < count; ++k) {
      Pair pair = Pair::of(bodies, list[k].a, list[k].b);
      apply_impulses(bodies, pair, k);
      pair.write_back(bodies);
    }
  }

  KFN void reset_impulses(int k) {
    list[k].impulse = {real(0), real(0)};
    list[k].angular_impulse = list[k].impulse_lower = list[k].impulse_upper = real(0);
  }

  KFN bool is_at_limit(int k) const { return list[k].impulse_lower + list[k].impulse_upper > real(0); }

  // All that joint k exerts, with its arms as they are.
  KFN void apply_impulses(const Bodies& bodies, Pair& pair, int k) const {
    const Joint& joint = list[k];
    if (joint.is_prismatic()) {
      Slider::of(bodies, joint, local_axis[k]).warm_start(pair, joint);
    } else {
      Arms arms = joint.common_arms(pair, joint.gap(bodies));
      pair.apply_impulse(arms.a, arms.b, joint.impulse);
      pair.apply_angular_impulse(joint.angular_impulse + joint.impulse_lower - joint.impulse_upper);
    }
  }

  // Without `motors` in a bounce: a force or torque does nothing in an instant.
  KFN void solve_soft(Bodies& bodies, const Soft& soft, bool use_bias, bool motors, ActiveSet& active) {
    springs.solve(bodies, soft, use_bias, motors, active);
    for (int k = 0; k < count; ++k) {
      Joint& joint = list[k];
      if (active.leaves_out(joint.a, joint.b)) continue;
      Pair pair = Pair::of(bodies, joint.a, joint.b);
      Vec2 before = pair.velocity_b - pair.velocity_a;
      Softness own = Softness::either(joint.is_softened(), soft.softened, soft.joint);
      if (joint.is_prismatic()) {
        joint.turn_arms(bodies);
        Slider slider = Slider::of(bodies, joint, local_axis[k]);
        if (motors && joint.is_driven()) aim(k, slider.translation(), soft);
        slider.solve(bodies, pair, joint, motor_mass(k), soft, use_bias, motors);
      } else if (joint.is_fixed()) {
        solve_weld(bodies, pair, joint, soft, own, use_bias);
      } else {
        bool driven = motors && joint.is_driven(), motor_last = joint.is_motor_last(use_bias);
        if (driven) aim(k, joint.current_angle(bodies), soft);
        // One place for both orders: what is inlined twice is twice the code.
        for (bool last = false;; last = true) {
          if (driven && last == motor_last) solve_motor(bodies, pair, joint, motor_mass(k));
          if (last) break;
          if (joint.is_limited()) solve_limits(pair, joint, joint.current_angle(bodies), soft, use_bias);
          solve_point(bodies, pair, joint, soft, own, use_bias);
        }
      }
      active.mark_if_moved(bodies, pair, before);
      pair.write_back(bodies);
    }
  }

  // Velocity constraint with a bounded torque: dt changes neither its target nor its strength.
  KFN static void solve_motor(const Bodies& bodies, Pair& pair, Joint& joint, real mass) {
    real speed = pair.omega_b - pair.omega_a;
    real added = joint.motor_impulse(speed, mass);
    pair.apply_angular_impulse(added);
    if (joint.drive() == DRIVE_VELOCITY) return;
    Arms arms = joint.common_arms(pair, joint.gap(bodies));
    Vec2 answer = point_mass_times(pair, arms, wrong_of_turn(pair, arms)) * -added;
    joint.impulse = joint.impulse + answer;
    pair.apply_impulse(arms.a, arms.b, answer);
  }

  // J, what motors and springs have added to the bodies' energy in this sub-step.
  KFN real motor_work(const Bodies& bodies) const {
    real work = springs.work(bodies);
    for (int k = 0; k < count && HAS_MOTORS; ++k) work += motor_work(bodies, k);
    return work;
  }

  KFN real motor_work(const Bodies& bodies, int k) const {
    const Joint& joint = list[k];
    if (!joint.is_driven()) return real(0);
    real speed = bodies.omega(joint.b) - bodies.omega(joint.a);
    if (joint.is_prismatic())
      speed = Slider::of(bodies, joint, local_axis[k]).axial_speed(Pair::of(bodies, joint.a, joint.b));
    return Math::max(joint.angular_impulse * speed, real(0));
  }

  // J, what kinematic bodies have done through joints and springs in this sub-step.
  KFN real kinematic_work(const Bodies& bodies) const {
    real work = springs.kinematic_work(bodies);
    for (int k = 0; k < count && HAS_KINEMATIC_BODIES; ++k) work += kinematic_work(bodies, k);
    return work;
  }

  KFN real kinematic_work(const Bodies& bodies, int k) const {
    if (!bodies.is_kinematic(list[k].a) && !bodies.is_kinematic(list[k].b)) return real(0);
    Pair taken = Pair::of_kinematic(bodies, list[k].a, list[k].b);
    apply_impulses(bodies, taken, k);
    return taken.work_of_kinematic(bodies);
  }

  // Angle and common point at once: one after the other, each undoes most of the other where the arms are long beside
  // what the bodies' inertia is like, and what they warm-start the next sub-step with then grows.
  KFN static void solve_weld(const Bodies& bodies, Pair& pair, Joint& joint, const Soft& soft, const Softness& own,
                             bool use_bias) {
    real max_speed = soft.turn_back_speed;
    real bias = use_bias ? Math::clamp(own.bias_rate * joint.current_angle(bodies), -max_speed, max_speed) : real(0);
    real mass_scale = use_bias ? own.mass_scale : real(1);
    real impulse_scale = use_bias ? own.impulse_scale : real(0);
    real turn = (pair.omega_b - pair.omega_a + bias) * joint.axial_mass;
    Arms arms;
    Vec2 wrong = wrong_of_point(bodies, pair, joint, soft, own.bias_rate, use_bias, arms);
    Vec2 lever = wrong_of_turn(pair, arms);
    Vec2 point = point_mass_times(pair, arms, wrong.minus(lever, turn), joint.axial_mass);
    real left = Fused::of(-lever.dot(point), joint.axial_mass, turn);
    real angular = Fused::of(-mass_scale, left, -(impulse_scale * joint.angular_impulse));
    Vec2 impulse = (-(point * mass_scale)).minus(joint.impulse, impulse_scale);
    joint.angular_impulse += angular;
    joint.impulse = joint.impulse + impulse;
    pair.apply_angular_impulse(angular);
    pair.apply_impulse(arms.a, arms.b, impulse);
  }

  KFN static void solve_limits(Pair& pair, Joint& joint, real angle, const Soft& soft, bool use_bias) {
    real speed = pair.omega_b - pair.omega_a;
    real lower = joint.lower_impulse(angle - joint.lower, speed, soft, use_bias, soft.turn_back_speed);
    pair.apply_angular_impulse(lower);
    speed = pair.omega_b - pair.omega_a;
    real upper = joint.upper_impulse(joint.upper - angle, -speed, soft, use_bias, soft.turn_back_speed);
    pair.apply_angular_impulse(-upper);
  }

  KFN static void solve_point(const Bodies& bodies, Pair& pair, Joint& joint, const Soft& soft, const Softness& own,
                              bool use_bias) {
    Arms arms;
    Vec2 wrong = wrong_of_point(bodies, pair, joint, soft, own.bias_rate, use_bias, arms);
    real mass_scale = use_bias ? own.mass_scale : real(1);
    real impulse_scale = use_bias ? own.impulse_scale : real(0);
    Vec2 impulse = (-(point_mass_times(pair, arms, wrong) * mass_scale)).minus(joint.impulse, impulse_scale);
    joint.impulse = joint.impulse + impulse;
    pair.apply_impulse(arms.a, arms.b, impulse);
  }

  // How fast b's point goes from a's, beyond what closes their gap; and the arms to where they are held.
  KFN static Vec2 wrong_of_point(const Bodies& bodies, const Pair& pair, Joint& joint, const Soft& soft, real rate,
                                 bool use_bias, Arms& arms) {
    if (!use_bias) joint.turn_arms(bodies);  // since the pass with bias they have moved
    Vec2 gap = joint.gap(bodies);
    arms = joint.common_arms(pair, gap);
    Vec2 wrong = pair.relative(arms.a, arms.b);
    if (!use_bias) return wrong;
    // Anchors go around their bodies: what that takes them off the tangent by the end of the sub-step counts too.
    real spin_a = Math::min(Math::abs(pair.omega_a), soft.max_spin), spin_b = Math::min(Math::abs(pair.omega_b), soft.max_spin);
    Vec2 bend = (joint.arm_a * (spin_a * spin_a)).minus(joint.arm_b, spin_b * spin_b);
    return (wrong + clamp_length(gap * rate, soft.pull_speed)).plus(bend, soft.bend_time);
  }

  KFN static Vec2 clamp_length(Vec2 v, real max_length) {
    real squared = v.dot(v);
    return squared > max_length * max_length ? v * Fast::divide(max_length, Fast::root(squared)) : v;
  }

  // Solves K x = v with K the 2 x 2 inverse effective mass of the common point.
  // With the bodies held to turn together by `axial_mass`, of a weld: less what that takes.
  KFN static Vec2 point_mass_times(const Pair& pair, Arms arms, Vec2 v, real axial_mass = real(0)) {
    real mass = pair.inverse_mass_a + pair.inverse_mass_b;
    real ia = pair.inverse_inertia_a, ib = pair.inverse_inertia_b;
    Vec2 ra = arms.a, rb = arms.b;
    // As one body turns: ia ra + ib rb is in both, what is left is ia ib / (ia + ib) (ra - rb) twice.
    if (axial_mass != real(0)) {
      Vec2 d = ra - rb;
      real i = ia * ib * axial_mass;
      return Symmetric::solve(Fused::of(i * d.y, d.y, mass), -i * d.x * d.y, Fused::of(i * d.x, d.x, mass), v);
    }
    real k11 = Fused::of(ib * rb.y, rb.y, Fused::of(ia * ra.y, ra.y, mass));
    real k12 = Fused::of(-ib * rb.x, rb.y, -ia * ra.x * ra.y);
    real k22 = Fused::of(ib * rb.x, rb.x, Fused::of(ia * ra.x, ra.x, mass));
    return Symmetric::solve(k11, k12, k22, v);
  }
};
