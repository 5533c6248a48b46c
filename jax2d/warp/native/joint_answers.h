// What joints answer to an impact at once: what an articulation changes of the velocities of two bodies that are pushed.

struct JointAnswers {
  Joints& joints;

  // Joints of the articulations of two bodies; False if they have none.
  KFN bool find_articulations(int a, int b, unsigned int* which) const {
    if (joints.count == 0 || (joints.articulation[a] < 0 && joints.articulation[b] < 0)) return false;
    JointSystem::clear(which);
    if (joints.articulation[a] >= 0) JointSystem::add_all(which, joints.members_of(joints.articulation[a]));
    if (joints.articulation[b] >= 0) JointSystem::add_all(which, joints.members_of(joints.articulation[b]));
    return true;
  }

  KFN bool is_held_by_motor(int k) const {
    const Joint& joint = joints.list[k];
    return joint.has_axial_row() && !joint.is_rod() && joints.system.axial[k].holds == AxialRow::MOTOR;
  }

  // Whether a motor of theirs holds.
  KFN bool hold_by_motors(const unsigned int* which) const {
    bool any = false;
    for (EachJoint k = EachJoint::of(which); HAS_MOTORS && k.next();) any |= is_held_by_motor(k.joint);
    return any;
  }

  // Adds to changes of the velocities of two bodies by two impulses what their joints answer to each, so that rows keep their
  // speeds. Motors do not answer, since they give nothing in an instant: with bias the second round has what they make of it,
  // else the next sub-step. `is_new`: with the system of that, where bodies stand now.
  KFN void add(const Bodies& bodies, const unsigned int* which, Pair& one, Pair& other, bool is_new) {
    if (is_new) {
      for (EachJoint k = EachJoint::of(which); k.next();) {
        joints.place(bodies, k.joint);
        if (is_held_by_motor(k.joint)) JointSystem::add(joints.released, k.joint);
      }
      joints.assemble(bodies, which, false, true);
    }
    for (EachJoint k = EachJoint::of(which); k.next();) {
      bool is_theirs = has_one_of(joints.list[k.joint], one);
      JointRows rows = joints.rows_of(k.joint);
      Vec3 none = {real(0), real(0), real(0)};
      joints.system.x[k.joint] = is_theirs ? rows.speeds(seen_by(bodies, k.joint, one)) : none;
      joints.system.y[k.joint] = is_theirs ? rows.speeds(seen_by(bodies, k.joint, other)) : none;
    }
    joints.system.eliminate(which, is_new, true);
    Pair rest = one.at_rest();
    for (int k = joints.count - 1; k >= 0; --k) {
      if (!JointSystem::has(which, k)) continue;
      joints.system.substitute(k, true);
      if (!has_one_of(joints.list[k], rest)) continue;
      JointRows rows = joints.rows_of(k);
      Pair by_one = seen_by(bodies, k, rest), by_other = by_one;
      rows.push(by_one, -joints.system.x[k]);
      rows.push(by_other, -joints.system.y[k]);
      add_shared(one, by_one);
      add_shared(other, by_other);
    }
  }

  // Gives joints what they answer to `times.x` of the one and `times.y` of the other impulse of `add`.
  KFN void exert(Bodies& bodies, const unsigned int* which, Vec2 times, ActiveSet& active) {
    Vec3 none = {real(0), real(0), real(0)};
    for (int k = joints.count - 1; k >= 0; --k) {
      if (!JointSystem::has(which, k)) continue;
      Vec3 impulse = none.plus(joints.system.x[k], -times.x).plus(joints.system.y[k], -times.y);
      joints.exert(bodies, k, impulse, active);
    }
  }

  // Adds to a change what another one is of bodies that both have.
  KFN static void add_shared(Pair& change, const Pair& other) {
    if (other.a == change.a || other.a == change.b) change.add_to(other.a, other.velocity_a, other.omega_a);
    if (other.b == change.a || other.b == change.b) change.add_to(other.b, other.velocity_b, other.omega_b);
  }

  KFN static bool has_one_of(const Joint& joint, const Pair& two) {
    return joint.a == two.a || joint.a == two.b || joint.b == two.a || joint.b == two.b;
  }

  // The pair of joint k, with velocities that two bodies have and all others have not.
  KFN Pair seen_by(const Bodies& bodies, int k, const Pair& two) const {
    Pair pair = Pair::of(bodies, joints.list[k].a, joints.list[k].b);
    bool a_is_a = pair.a == two.a, a_is_b = pair.a == two.b, b_is_a = pair.b == two.a, b_is_b = pair.b == two.b;
    Vec2 none = {real(0), real(0)};
    pair.velocity_a = a_is_a ? two.velocity_a : (a_is_b ? two.velocity_b : none);
    pair.velocity_b = b_is_a ? two.velocity_a : (b_is_b ? two.velocity_b : none);
    pair.omega_a = a_is_a ? two.omega_a : (a_is_b ? two.omega_b : real(0));
    pair.omega_b = b_is_a ? two.omega_a : (b_is_b ? two.omega_b : real(0));
    return pair;
  }
};
