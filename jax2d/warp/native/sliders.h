// Prismatic joints: body b slides along an axis of body a and keeps its angle to it (as Box2D's b2PrismaticJoint).
//
//   gap = anchor of b - anchor of a      C = (across . gap, angle)      translation = axis . gap
//
// Impulses act on both bodies at the anchor of b, a common point, so that they change no momentum of the two together.

struct Slider {
  Vec2 axis, gap;           // world frame, as the bodies stand now
  real axis_a, axis_b;      // m, lever arms of an impulse along the axis
  real across_a, across_b;  // m, of one across it

  // The joint's arms are as the bodies stand now.
  KFN static Slider of(const Bodies& bodies, const Joint& joint, Vec2 local_axis) {
    Slider slider;
    slider.axis = bodies.rotation[joint.a].apply(local_axis);
    slider.gap = joint.gap(bodies);
    Vec2 to_common_point = joint.arm_a + slider.gap;
    slider.axis_a = to_common_point.cross(slider.axis);
    slider.axis_b = joint.arm_b.cross(slider.axis);
    slider.across_a = to_common_point.cross(slider.axis.left());
    slider.across_b = joint.arm_b.cross(slider.axis.left());
    return slider;
  }

  // kg, that an impulse along the axis moves.
  KFN real axial_mass(const Bodies& bodies, const Joint& joint) const {
    return Math::inverse_or_zero(bodies.inverse_mass(joint.a) + bodies.inverse_mass(joint.b) +
                                 bodies.inverse_inertia(joint.a) * axis_a * axis_a +
                                 bodies.inverse_inertia(joint.b) * axis_b * axis_b);
  }

  KFN real axial_speed(const Pair& pair) const {
    return axis.dot(pair.velocity_b - pair.velocity_a) + axis_b * pair.omega_b - axis_a * pair.omega_a;
  }

  KFN real across_speed(const Pair& pair) const {
    return axis.left().dot(pair.velocity_b - pair.velocity_a) + across_b * pair.omega_b - across_a * pair.omega_a;
  }

  KFN void push_along(Pair& pair, real impulse) const {
    pair.apply_levers(axis * impulse, axis_a * impulse, axis_b * impulse);
  }

  // `impulse.x` across the axis, `impulse.y` about it.
  KFN void push_across(Pair& pair, Vec2 impulse) const {
    pair.apply_levers(axis.left() * impulse.x, across_a * impulse.x + impulse.y, across_b * impulse.x + impulse.y);
  }

  KFN void warm_start(Pair& pair, const Joint& joint) const {
    push_along(pair, joint.angular_impulse + joint.impulse_lower - joint.impulse_upper);
    push_across(pair, joint.impulse);
  }

  // 1/kg: speed along the axis after a unit of impulse along it, with what the joint holds against it.
  KFN real inverse_driven_mass(const Pair& pair) const {
    real ia = pair.inverse_inertia_a, ib = pair.inverse_inertia_b;
    real free = pair.inverse_mass_a + pair.inverse_mass_b + ia * axis_a * axis_a + ib * axis_b * axis_b;
    Vec2 wrong = wrong_of_push(pair);
    return Math::max(free - wrong.dot(held_mass_times(pair, wrong)), real(0));
  }

  // Speeds across the axis and about it that a unit of impulse along it makes.
  KFN Vec2 wrong_of_push(const Pair& pair) const {
    real ia = pair.inverse_inertia_a, ib = pair.inverse_inertia_b;
    return {across_a * ia * axis_a + across_b * ib * axis_b, ia * axis_a + ib * axis_b};
  }

  KFN void drive(Pair& pair, Joint& joint, real mass) const {
    real added = joint.motor_impulse(axial_speed(pair), mass);
    push_along(pair, added);
    if (joint.drive() == DRIVE_VELOCITY) return;
    Vec2 answer = held_mass_times(pair, wrong_of_push(pair)) * -added;
    joint.impulse = joint.impulse + answer;
    push_across(pair, answer);
  }

  // Solves K x = v with K the 2 x 2 inverse effective mass across the axis and about it.
  KFN Vec2 held_mass_times(const Pair& pair, Vec2 v) const {
    real ia = pair.inverse_inertia_a, ib = pair.inverse_inertia_b;
    real k11 = pair.inverse_mass_a + pair.inverse_mass_b + ia * across_a * across_a + ib * across_b * across_b;
    real k12 = ia * across_a + ib * across_b;
    real k22 = ia + ib > real(0) ? ia + ib : real(1);  // two bodies that cannot turn keep their angle anyway
    return Symmetric::solve(k11, k12, k22, v);
  }

  KFN real translation() const { return axis.dot(gap); }

  // `motor_mass`: kg that the motor aims with.
  KFN void solve(const Bodies& bodies, Pair& pair, Joint& joint, real motor_mass, const Soft& soft, bool use_bias,
                 bool motors) const {
    bool driven = motors && joint.is_driven(), motor_last = joint.is_motor_last(use_bias);
    for (bool last = false;; last = true) {  // the motor in one place for both orders
      if (driven && last == motor_last) drive(pair, joint, motor_mass);
      if (last) break;
      if (joint.is_limited()) solve_limits(pair, joint, soft, use_bias);
      solve_held(bodies, pair, joint, soft, use_bias);
    }
  }

  KFN void solve_limits(Pair& pair, Joint& joint, const Soft& soft, bool use_bias) const {
    real translation = this->translation();
    real lower = soft.limit_impulse(translation - joint.lower, axial_speed(pair), joint.axial_mass, joint.impulse_lower, use_bias);
    push_along(pair, lower);
    real upper = soft.limit_impulse(joint.upper - translation, -axial_speed(pair), joint.axial_mass, joint.impulse_upper, use_bias);
    push_along(pair, -upper);
  }

  KFN void solve_held(const Bodies& bodies, Pair& pair, Joint& joint, const Soft& soft, bool use_bias) const {
    Vec2 wrong = {across_speed(pair), pair.omega_b - pair.omega_a};
    real mass_scale = real(1), impulse_scale = real(0);
    if (use_bias) {
      real angle = joint.current_angle(bodies), rate = soft.joint.bias_rate;
      wrong.x += Math::clamp(axis.left().dot(gap) * rate, -soft.pull_speed, soft.pull_speed);
      wrong.y += Math::clamp(angle * rate, -soft.turn_back_speed, soft.turn_back_speed);
      mass_scale = soft.joint.mass_scale;
      impulse_scale = soft.joint.impulse_scale;
    }
    Vec2 impulse = -(held_mass_times(pair, wrong) * mass_scale) - joint.impulse * impulse_scale;
    joint.impulse = joint.impulse + impulse;
    push_across(pair, impulse);
  }
};
