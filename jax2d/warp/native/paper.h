// The joint and motor rules of the Kinetix paper (appendices Joints, Motors), for preset paper.

struct PaperJoints {
  Joints& joints;

  // j = p tanh((w_b - w_a - s A) rho), weaker within PARAM_MOTOR_FADE_ANGLE of a limit it runs into. All at once (as in
  // "Parallelised Computation"): no motor sees what another does in the same step.
  KFN void apply_motors(Bodies& bodies, const Column& scene, const Column& controls, const Column& params) {
    if (!HAS_MOTORS) return;
    real angular_impulse[NUM_JOINTS + 1];
    for (int k = 0; k < joints.count; ++k) {
      const Joint& joint = joints.list[k];
      if (!joint.is_driven()) continue;
      real power = joint.max_motor_impulse;
      if (joint.is_limited()) {
        real fade = params.get(PARAM_MOTOR_FADE_ANGLE);
        real beyond = joint.start_angle - Math::clamp(joint.start_angle, joint.lower + fade, joint.upper - fade);
        bool into_limit = beyond * controls.get(CONTROLS_MOTOR + joint.index) > real(0);
        if (into_limit) power *= Math::max(real(0), real(1) - fabsf(beyond) / fade);
      }
      real excess = bodies.omega(joint.b) - bodies.omega(joint.a) - joint.motor_target;
      angular_impulse[k] = -power * tanhf(excess * params.get(PARAM_MOTOR_DECAY));
    }
    for (int k = 0; k < joints.count; ++k) {
      const Joint& joint = joints.list[k];
      if (!joint.is_driven()) continue;
      Pair pair = Pair::of(bodies, joint.a, joint.b);
      pair.apply_angular_impulse(angular_impulse[k]);
      pair.write_back(bodies);
    }
  }

  KFN void warm_start(Bodies& bodies) {
    for (int k = 0; k < joints.count; ++k) {
      Joint& joint = joints.list[k];
      Pair pair = Pair::of(bodies, joint.a, joint.b);
      pair.apply_impulse(joint.arm_a, joint.arm_b, joint.impulse);
      if (joint.is_fixed()) pair.apply_angular_impulse(joint.angular_impulse);
      pair.write_back(bodies);
      joint.impulse_lower = joint.impulse_upper = real(0);
    }
  }

  // One iteration over all joints: point (impulse along the relative velocity, velocity and positional
  // correction), then the angle of fixed joints, or limits where they are exceeded.
  KFN void solve(Bodies& bodies, const Column& params) {
    for (int k = 0; k < joints.count; ++k) {
      Joint& joint = joints.list[k];
      int a = joint.a, b = joint.b;
      Vec2 gap = joint.centre_gap + (bodies.delta(b) - bodies.delta(a)) + (joint.arm_b - joint.arm_a);
      real ma = bodies.inverse_mass(a), mb = bodies.inverse_mass(b);
      // The joint sits between the anchors, nearer to the heavier body's.
      Vec2 at_a = ma == real(0) ? joint.arm_a : joint.arm_a + gap * (ma / (ma + mb));
      Vec2 at_b = ma == real(0) ? joint.arm_b - gap : joint.arm_b - gap * (mb / (ma + mb));
      Pair pair = Pair::of(bodies, a, b);
      Vec2 relative = pair.relative(at_a, at_b);
      real speed = relative.length();
      Vec2 direction = speed > real(0) ? relative * (real(1) / speed) : Vec2{real(0), real(0)};
      real ca = joint.arm_a.cross(direction), cb = joint.arm_b.cross(direction);
      real effective = ma + mb + ca * ca * bodies.inverse_inertia(a) + cb * cb * bodies.inverse_inertia(b);
      Vec2 impulse = (relative + gap * params.get(PARAM_JOINT_VELOCITY_CORRECTION)) *
                     (-params.get(PARAM_JOINT_STIFFNESS) * Math::inverse_or_zero(effective));
      pair.apply_impulse(joint.arm_a, joint.arm_b, impulse);
      joint.impulse = joint.impulse + impulse;

      solve_angular(pair, joint, params);
      pair.write_back(bodies);

      Vec2 correction = gap * (params.get(PARAM_JOINT_POSITION_CORRECTION) / (ma + mb));
      bodies.set_delta(a, bodies.delta(a) + correction * ma);
      bodies.set_delta(b, bodies.delta(b) - correction * mb);
    }
  }

  KFN static void solve_angular(Pair& pair, Joint& joint, const Column& params) {
    real speed = pair.omega_b - pair.omega_a;
    if (joint.is_fixed()) {
      real angular_impulse = -joint.axial_mass * (speed + joint.start_angle * params.get(PARAM_FIXED_ANGLE_RATE));
      joint.angular_impulse += angular_impulse;
      pair.apply_angular_impulse(angular_impulse);
    } else if (joint.is_limited()) {
      real beyond = joint.start_angle - Math::clamp(joint.start_angle, joint.lower, joint.upper);
      if (beyond * speed > real(0))  // not while it already returns
        pair.apply_angular_impulse(-joint.axial_mass * (speed + beyond * params.get(PARAM_LIMIT_ANGLE_RATE)));
    }
  }
};
