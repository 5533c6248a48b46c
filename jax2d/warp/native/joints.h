// What connects bodies of one world: springs, and joints by what they hold, motors and limits.
//
// Body b is held to body a. Angles are angle_b - angle_a - rest angle. A hinge holds a common point, a weld the angle as
// well; a slider (Box2D's b2PrismaticJoint) holds b's anchor on an axis of a, and the angle. Joints are solved as one linear
// system (joint_system.h), and with them ropes and rods: springs with a bound of their length. Hard joints follow the appendix of
// the Kinetix paper (paper.h).

struct Joints {
  ARRAY(Joint, list, NUM_JOINTS + 1);
  ARRAY(Vec2, local_axis, HAS_PRISMATIC_JOINTS ? NUM_JOINTS + 1 : 1);  // frame of a, of sliders
  ARRAY(Vec2, axis, HAS_AXIS_JOINTS ? NUM_JOINTS + 1 : 1);  // world frame, as the bodies stand; of ropes and rods their line
  ARRAY(Drive, drives, HAS_BRAKES_AND_SERVOS ? NUM_JOINTS + 1 : 1);
  ARRAY(unsigned int, included, JOINT_WORDS);  // a bit a joint that a pass is about
  ARRAY(unsigned int, repeated, JOINT_WORDS);  // the same: for which it is a repeated one, of an impact
  ARRAY(unsigned int, released, JOINT_WORDS);  // the same: held by a motor, which their system of an impact leaves out
  ARRAY(int, articulation, NUM_JOINTS > 0 ? NUM_SHAPES : 1);  // of each body: its last joint, -1: none
  ARRAY(unsigned int, members, (NUM_JOINTS + 1) * JOINT_WORDS);  // a row an articulation, at its last joint: a bit a joint
  JointSystem system;
  Springs springs;
  int count;

  // Which joints there are and how they are coupled: the same in all steps of a call.
  KFN void find(const Bodies& bodies, const IntColumn& ints) {
    count = 0;
    for (int j = 0; j < JOINT_SLOTS; ++j) {
      int packed = ints.get(INTS_JOINTS + j);
      if ((packed >> JOINTS_ACTIVE_SHIFT & 1) == 0) continue;
      if (!Joint::is_compiled_in(packed)) continue;
      int slot_a = packed >> JOINTS_A_SHIFT & JOINTS_A_MASK, slot_b = packed >> JOINTS_B_SHIFT & JOINTS_B_MASK;
      if (!Slot::in_use(slot_a) || !Slot::in_use(slot_b)) continue;
      int a = Slot::shape(slot_a), b = Slot::shape(slot_b);
      if (!bodies.is_dynamic(a) && !bodies.is_dynamic(b)) continue;  // nothing to hold
      list[count].a = a;
      list[count].b = b;
      system.order[count++] = j;
    }
    for (int s = 0; s < springs.count; ++s) {  // none in the preset of the paper
      if (!springs.is_bounded(s)) continue;
      list[count].a = springs.a_of(s);
      list[count].b = springs.b_of(s);
      system.order[count++] = JOINT_SLOTS + s;
    }
    system.count = count;
    JointSystem::clear(released);
    if (!SOFT_STEP) return;
    for (int k = 0; k < count; ++k) system.clear(system.after_of(k));
    for (int k = 0; k < count; ++k)
      for (int i = 0; i < k; ++i) {
        if (!shares_body(bodies, list[k], list[i])) continue;
        system.add(system.after_of(k), i);
        system.add(system.after_of(i), k);
      }
    system.find_order();
  }

  // Which articulation each body is of. Joints are in the order of elimination.
  KFN void note_articulations(const Bodies& bodies) {
    for (int i = 0; i < NUM_SHAPES && NUM_JOINTS > 0; ++i) articulation[i] = -1;
    for (int k = 0; k < count; ++k) JointSystem::clear(members_of(k));
    for (int k = 0; k < count; ++k) {
      if (bodies.is_dynamic(list[k].a)) articulation[list[k].a] = system.last[k];
      if (bodies.is_dynamic(list[k].b)) articulation[list[k].b] = system.last[k];
      JointSystem::add(members_of(system.last[k]), k);
    }
  }

  KFN static bool shares_body(const Bodies& bodies, const Joint& one, const Joint& other) {
    bool has_a = one.a == other.a || one.a == other.b, has_b = one.b == other.a || one.b == other.b;
    return (has_a && bodies.is_dynamic(one.a)) || (has_b && bodies.is_dynamic(one.b));
  }

  KFN void load(Bodies& bodies, const Column& scene, const IntColumn& ints, const Column& params, const Column& impulses,
                bool is_first) {
    springs.load(bodies, scene, ints, params, impulses);
    if (is_first) find(bodies, ints);
    for (int k = 0; k < count; ++k) {
      Joint& joint = list[k];
      int j = system.order[k];
      if (j >= JOINT_SLOTS) {
        springs.load_rod(j - JOINT_SLOTS, joint);
        reset_impulses(k);
        if (params.get(PARAM_WARM_START) != real(0)) load_impulses(joint, impulses);
        continue;
      }
      int packed = ints.get(INTS_JOINTS + j);
      joint.index = j;
      joint.flags = packed;
      joint.a = Slot::shape(packed >> JOINTS_A_SHIFT & JOINTS_A_MASK);
      joint.b = Slot::shape(packed >> JOINTS_B_SHIFT & JOINTS_B_MASK);
      if (joint.is_prismatic()) {
        real axis_angle = scene.get(SCENE_JOINTS_AXIS_ANGLE + j);
        local_axis[k] = {cosf(axis_angle), sinf(axis_angle)};
      }
      joint.local_a = scene.get2(SCENE_JOINTS_ANCHOR_A + 2 * j);
      joint.local_b = scene.get2(SCENE_JOINTS_ANCHOR_B + 2 * j);
      joint.lower = scene.get(SCENE_JOINTS_LOWER_LIMIT + j);
      joint.upper = scene.get(SCENE_JOINTS_UPPER_LIMIT + j);
      if (SOFT_STEP && joint.is_wide()) {
        Bodies::add(bodies.counts_turns, joint.a);
        Bodies::add(bodies.counts_turns, joint.b);
      }
      reset_impulses(k);
      if (params.get(PARAM_WARM_START) != real(0)) load_impulses(joint, impulses);
      joint.axial_mass =
          Math::inverse_or_zero(bodies.inverse_inertia(joint.a) + bodies.inverse_inertia(joint.b));
    }
    if (SOFT_STEP && is_first) note_articulations(bodies);
  }

  // The impulses as they were last stored.
  KFN void load_impulses(const Column& impulses) {
    springs.load_impulses(impulses);
    for (int k = 0; k < count; ++k) load_impulses(list[k], impulses);
  }

  KFN static void load_impulses(Joint& joint, const Column& impulses) {
    if (joint.is_rod()) {
      joint.impulse_lower = impulses.get(IMPULSE_SPRING_IMPULSE + 3 * joint.index + 1);
      joint.impulse_upper = impulses.get(IMPULSE_SPRING_IMPULSE + 3 * joint.index + 2);
      return;
    }
    int row = IMPULSE_JOINT_IMPULSE + 5 * joint.index;
    joint.impulse = impulses.get2(row);
    joint.angular_impulse = impulses.get(row + 2);
    joint.impulse_lower = impulses.get(row + 3);
    joint.impulse_upper = impulses.get(row + 4);
  }

  KFN void store(const Column& impulses) const {
    springs.store(impulses);
    for (int k = 0; k < count; ++k) {
      const Joint& joint = list[k];
      if (joint.is_rod()) {
        impulses.set(IMPULSE_SPRING_IMPULSE + 3 * joint.index + 1, joint.impulse_lower);
        impulses.set(IMPULSE_SPRING_IMPULSE + 3 * joint.index + 2, joint.impulse_upper);
        continue;
      }
      impulses.set2(IMPULSE_JOINT_IMPULSE + 5 * joint.index, joint.impulse);
      impulses.set(IMPULSE_JOINT_IMPULSE + 5 * joint.index + 2, joint.angular_impulse);
      impulses.set(IMPULSE_JOINT_IMPULSE + 5 * joint.index + 3, joint.impulse_lower);
      impulses.set(IMPULSE_JOINT_IMPULSE + 5 * joint.index + 4, joint.impulse_upper);
    }
  }

  // Those on bodies of `which`, in islands.
  KFN void prepare(const Bodies& bodies, const unsigned int* which, const Column& scene, const Column& controls,
                   const Column& params, real h) {
    springs.prepare(bodies, which);
    for (int k = 0; k < count; ++k) {
      Joint& joint = list[k];
      if (!Bodies::has(which, bodies.is_dynamic(joint.a) ? joint.a : joint.b)) continue;
      joint.centre_gap = bodies.position[joint.b] - bodies.position[joint.a];
      if (joint.is_rod()) {
        place(bodies, k);
        system.axial[k].holds = held_before(bodies, k);
        continue;
      }
      joint.start_angle = joint.wanted_angle(bodies.angle[joint.b] - bodies.angle[joint.a] -
                                             scene.get(SCENE_JOINTS_REST_ANGLE + joint.index));
      place(bodies, k);
      real base_speed = params.get(PARAM_BASE_MOTOR_SPEED), base_power = params.get(PARAM_BASE_MOTOR_POWER);
      if (joint.is_prismatic()) {
        joint.axial_mass = Math::inverse_or_zero(rows_of(k).axial(Pair::of(bodies, joint.a, joint.b)));
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
      if (driven && joint.drive() != DRIVE_VELOCITY)
        drives[k] = Drive::of(joint, control, base_speed * scene.get(SCENE_JOINTS_MOTOR_SPEED + joint.index));
      if (SOFT_STEP && joint.has_axial_row()) system.axial[k].holds = held_before(bodies, k);
    }
  }

  // What the row along its axis holds, by the impulses that it has and the motor's speed.
  KFN int held_before(const Bodies& bodies, int k) const {
    const Joint& joint = list[k];
    if (joint.is_rod()) return joint.total_impulse() != real(0) ? AxialRow::MOTOR : AxialRow::NOTHING;
    if (joint.is_limited() && joint.impulse_lower > real(0)) return AxialRow::LOWER;
    if (joint.is_limited() && joint.impulse_upper > real(0)) return AxialRow::UPPER;
    real speed = rows_of(k).axial_speed(Pair::of(bodies, joint.a, joint.b));
    real more = joint.drive() == DRIVE_VELOCITY ? joint.motor_target - speed : real(0);
    real needed = Fused::of(more, joint.axial_mass, joint.angular_impulse);
    return joint.is_driven() && Math::abs(needed) < joint.max_motor_impulse ? AxialRow::MOTOR : AxialRow::NOTHING;
  }

  KFN JointRows rows_of(int k) const {
    const Joint& joint = list[k];
    real none = real(0), one = real(1), is_weld = joint.is_fixed() ? one : none, third = is_weld;
    if (HAS_AXES && joint.has_axial_row()) third = system.axial[k].holds != AxialRow::NOTHING && !JointSystem::has(released, k) ? one : none;
    if (joint.is_along_line()) return JointRows::of_slider(joint.common_a, joint.common_b, axis[k], third, joint.is_rod());
    return JointRows::of(joint.common_a, joint.common_b, third, is_weld);
  }

  // Of a sub-step. Joints need no warm start: they are solved directly. What they exerted in the one before says how stiffly
  // their bodies are held against turning.
  KFN void begin(Bodies& bodies, const Column& scene, real h) {
    for (int k = 0; k < count; ++k) {
      const Joint& joint = list[k];
      if (!joint.is_prismatic()) {
        Vec2 arm_a = bodies.rotation[joint.a].apply(joint.local_a), arm_b = bodies.rotation[joint.b].apply(joint.local_b);
        Vec2 impulse = joint.impulse;
        if (joint.is_rod()) {
          place(bodies, k);
          impulse = axis[k] * (joint.impulse_lower - joint.impulse_upper);
        }
        bodies.stretch(scene, joint.a, arm_a, -h * arm_a.dot(impulse), joint.b, arm_b);
        bodies.stretch(scene, joint.b, arm_b, h * arm_b.dot(impulse), joint.a, arm_a);
      }
      reset_impulses(k);
    }
  }

  KFN void reset_impulses(int k) {
    list[k].impulse = {real(0), real(0)};
    list[k].angular_impulse = list[k].impulse_lower = list[k].impulse_upper = real(0);
  }

  // All that joint k exerts.
  KFN void apply_impulses(const Bodies&, Pair& pair, int k) const {
    const Joint& joint = list[k];
    rows_of(k).push(pair, joint.held_impulse());
  }

  // One of two rounds of a pass with bias, or a bounce. A second one is for what contacts and changed spins have made wrong
  // since the first; where lines are searched, contacts take more of what they gave once it is known what joints answer to it.
  // A bounce is without motors: a force or torque does nothing in an instant.
  //
  // A round is solved with what motors and limits held at last. Where that is not what they would do at the speeds that come
  // out, their articulation is solved again with what they would. Where they do not agree with each other in the end, limits
  // hold still, which takes energy and gives none.
  KFN void solve_soft(Bodies& bodies, const Soft& soft, bool use_bias, bool is_first, LineSearch& search, ActiveSet& active) {
    if (is_first && use_bias)
      for (int pass = 0; pass < SPRING_PASSES; ++pass) springs.solve(bodies, soft, true, active);
    if (count == 0) return;
    bool is_new = is_first || JointSystem::any(released);
    JointSystem::clear(released);
    if (is_first) {
      find_included(active);
      begin(bodies, soft, use_bias);
    }
    bool searches = LINE_SEARCH && use_bias && !is_first && search.is_called_for;
    unsigned int which[JOINT_WORDS];  // that an attempt is about
    for (int word = 0; word < JOINT_WORDS; ++word) which[word] = included[word];
    // By velocities that no motor of this round has changed yet: a strong one spins a light body far beyond what is solved.
    for (EachJoint k = EachJoint::of(which); use_bias && k.next();)
      system.bias[k.joint] = bias_of(bodies, Pair::of(bodies, list[k.joint].a, list[k.joint].b), k.joint, soft);
    for (int attempt = HAS_BRAKES_AND_SERVOS && is_first && use_bias ? -1 : 0;; ++attempt) {
      if (HAS_AXES && is_new && attempt >= 0) push_unheld(bodies, which, active);
      assemble(bodies, which, use_bias, is_new);
      for (EachJoint k = EachJoint::of(which); searches && k.next();)
        system.y[k.joint] = rows_of(k.joint).speeds(search.given(bodies, list[k.joint].a, list[k.joint].b));
      system.eliminate(which, is_new, searches);
      if (attempt < 0) {
        aim_servos(bodies, which, soft);
        continue;
      }
      if (searches) take_more(bodies, which, search);
      for (int k = count - 1; k >= 0; --k)
        if (JointSystem::has(which, k)) exert(bodies, k, -(searches ? system.x[k] : system.substitute(k, false)), active);
      searches = false;
      if (!HAS_AXES || attempt == AXIAL_CHANGES || !choose_held(bodies, which, use_bias, attempt + 1 == AXIAL_CHANGES)) break;
      is_new = true;
    }
  }

  // Each island takes more of what its contacts have given, and joints answer to it all.
  KFN void take_more(Bodies& bodies, const unsigned int* which, LineSearch& search) {
    for (int k = count - 1; k >= 0; --k)
      if (JointSystem::has(which, k)) system.substitute(k, true);
    for (EachJoint k = EachJoint::of(which); k.next();) {
      int island = search.island_of(bodies, list[k.joint].a, list[k.joint].b);
      search.curve[island] -= system.spent[k.joint];
      real change = -system.y[k.joint].z;
      if (HAS_AXES && list[k.joint].has_axial_row())
        system.axial[k.joint].bound(search.most[island], list[k.joint].total_impulse() + change, change);
    }
    search.find(bodies);
    for (EachJoint k = EachJoint::of(which); k.next();) {
      int island = search.island_of(bodies, list[k.joint].a, list[k.joint].b);
      system.x[k.joint] = system.x[k.joint].plus(system.y[k.joint], search.slope[island]);
    }
  }

  KFN void exert(Bodies& bodies, int k, Vec3 impulse, ActiveSet& active) {
    Joint& joint = list[k];
    Pair pair = Pair::of(bodies, joint.a, joint.b);
    Vec2 before = pair.velocity_b - pair.velocity_a;
    rows_of(k).push(pair, impulse);
    joint.impulse = joint.impulse + Vec2{impulse.x, impulse.y};
    if (joint.is_fixed()) joint.angular_impulse += impulse.z;
    if (HAS_AXES && joint.has_axial_row()) joint.set_axial(system.axial[k], joint.total_impulse() + impulse.z);
    write(bodies, pair, k, before, active);
  }

  KFN unsigned int* members_of(int last) const { return members + last * JOINT_WORDS; }

  // Where bodies stand, and what drives and bounds axes.
  KFN void begin(const Bodies& bodies, const Soft& soft, bool use_bias) {
    for (EachJoint k = EachJoint::of(included); k.next();) {
      place(bodies, k.joint);
      if (HAS_AXES && list[k.joint].has_axial_row()) begin_axis(bodies, k.joint, soft, use_bias);
    }
  }

  // Impulses of motors that have not their speed, and none of limits that are not reached.
  KFN void push_unheld(Bodies& bodies, const unsigned int* which, ActiveSet& active) {
    for (EachJoint k = EachJoint::of(which); k.next();) {
      Joint& joint = list[k.joint];
      const AxialRow& row = system.axial[k.joint];
      if (!joint.has_axial_row() || row.holds != AxialRow::NOTHING) continue;
      real change = row.impulse - joint.total_impulse();
      if (change == real(0)) continue;
      Pair pair = Pair::of(bodies, joint.a, joint.b);
      Vec2 before = pair.velocity_b - pair.velocity_a;
      rows_of(k.joint).push(pair, {real(0), real(0), change});
      joint.set_axial(row, row.impulse);
      write(bodies, pair, k.joint, before, active);
    }
  }

  KFN void write(Bodies& bodies, const Pair& pair, int k, Vec2 before, ActiveSet& active) const {
    if (SHARES_IMPACTS && JointSystem::has(repeated, k)) active.mark_if_moved(bodies, pair, before);
    pair.write_back(bodies);
  }

  // What motors and limits would hold now. `which` are then articulations where that is something else; False if none.
  KFN bool choose_held(const Bodies& bodies, unsigned int* which, bool use_bias, bool is_last) {
    unsigned int changed[JOINT_WORDS];  // last joints of articulations
    JointSystem::clear(changed);
    bool any = false;
    for (EachJoint k = EachJoint::of(which); k.next();) {
      const Joint& joint = list[k.joint];
      if (!joint.has_axial_row()) continue;
      AxialRow& row = system.axial[k.joint];
      real speed = row.holds == AxialRow::NOTHING ? rows_of(k.joint).axial_speed(Pair::of(bodies, joint.a, joint.b)) : real(0);
      if (joint.is_rod() && use_bias) speed += system.bias[k.joint].z;
      if (!row.choose(speed, joint.total_impulse())) continue;
      JointSystem::add(changed, system.last[k.joint]);
      any = true;
    }
    if (!any) return false;
    for (EachJoint k = EachJoint::of(which); k.next();) {
      const Joint& joint = list[k.joint];
      if (!JointSystem::has(changed, system.last[k.joint])) JointSystem::remove(which, k.joint);
      else if (is_last && joint.has_axial_row()) system.axial[k.joint].settle(joint.total_impulse());
    }
    return true;
  }

  // Articulations as a whole.
  KFN void find_included(const ActiveSet& active) {
    unsigned int articulations[JOINT_WORDS];  // their last joints
    JointSystem::clear(articulations);
    JointSystem::clear(included);
    unsigned int repeating[JOINT_WORDS];
    JointSystem::clear(repeating);
    JointSystem::clear(repeated);
    for (int k = 0; k < count; ++k) {
      if (!active.leaves_out(list[k].a, list[k].b)) JointSystem::add(articulations, system.last[k]);
      if (active.shares(list[k].a, list[k].b)) JointSystem::add(repeating, system.last[k]);
    }
    for (int k = 0; k < count; ++k) {
      if (JointSystem::has(articulations, system.last[k])) JointSystem::add(included, k);
      if (JointSystem::has(repeating, system.last[k])) JointSystem::add(repeated, k);
    }
  }

  // Right sides, and the matrix if it is new. Biases are those of the round: attempts lead to what depends on nothing but what
  // they hold.
  KFN void assemble(const Bodies& bodies, const unsigned int* which, bool use_bias, bool is_new) {
    for (EachJoint k = EachJoint::of(which); k.next();) {
      const Joint& joint = list[k.joint];
      Pair pair = Pair::of(bodies, joint.a, joint.b);
      JointRows rows = rows_of(k.joint);
      Vec3 wrong = rows.speeds(pair);
      if (use_bias) wrong = wrong.plus(system.bias[k.joint], real(1));
      if (HAS_AXES && joint.has_axial_row()) {
        real speed = rows.axial_speed(pair);
        if (joint.is_rod() && use_bias) speed += system.bias[k.joint].z;
        wrong.z = rows.third * (speed - system.axial[k.joint].speed());
      }
      if (use_bias) wrong = wrong.plus(rows.yielding(pair, joint.held_impulse()), real(1));
      system.x[k.joint] = wrong;
      if (!is_new) continue;
      system.diagonal[k.joint] = rows.held(pair);
      int column = JointSystem::first_block(k.joint);
      for (EachJoint i = EachJoint::of(system.after_of(k.joint)); i.next(); ++column)
        system.above[column] = coupling(bodies, joint, rows, list[i.joint], rows_of(i.joint));
    }
  }

  // What two joints change of each other, at bodies that they share.
  KFN static Block coupling(const Bodies& bodies, const Joint& joint, const JointRows& rows, const Joint& other,
                            const JointRows& others) {
    Vec3 none = {real(0), real(0), real(0)};
    Block sum = {none, none, none};
    for (int side = 0; side < 2; ++side) {
      int body = side == 0 ? joint.a : joint.b;
      bool is_b = other.b == body;
      if ((!is_b && other.a != body) || !bodies.is_dynamic(body)) continue;
      JointSide::of(rows, side == 1).add_coupling(sum, JointSide::of(others, is_b), bodies.inverse_mass(body),
                                                  bodies.inverse_inertia(body));
    }
    return sum;
  }

  KFN void place(const Bodies& bodies, int k) {
    list[k].place(bodies);
    if (list[k].is_prismatic()) axis[k] = bodies.rotation[list[k].a].apply(local_axis[k]);
    if (list[k].is_rod()) axis[k] = Springs::axis_of(list[k].apart, list[k].apart.length());
  }

  // Number of joints and bounds of springs that do not hold in the current positions (`measure.num_open`).
  KFN int num_open(const Bodies& bodies) {
    int number = 0;
    for (int k = 0; k < count; ++k) {
      place(bodies, k);
      const Joint& joint = list[k];
      Vec2 gap = joint.apart;
      if (joint.is_rod()) {
        real length = gap.length();
        if (length - joint.upper > OPEN_GAP || joint.lower - length > OPEN_GAP) ++number;
        continue;
      }
      if (joint.is_prismatic()) gap = axis[k].left() * axis[k].left().dot(gap);
      bool turns = joint.is_fixed() || joint.is_prismatic();
      real turn = turns ? Angle::near(joint.current_angle(bodies), real(0)) : real(0);
      if (gap.dot(gap) > OPEN_GAP * OPEN_GAP || Math::abs(turn) > OPEN_TURN) ++number;
    }
    return number;
  }

  // Where servos aim, all axes that they turn held.
  KFN void aim_servos(const Bodies& bodies, const unsigned int* which, const Soft& soft) {
    for (EachJoint k = EachJoint::of(which); k.next();) {
      const Joint& joint = list[k.joint];
      if (!joint.is_driven() || joint.drive() != DRIVE_SERVO) continue;
      AxialRow& row = system.axial[k.joint];
      real way = drives[k.joint].position - axial_position(bodies, k.joint);
      row.target = drives[k.joint].speed_towards(way, row.most * system.axial_inverse_mass(k.joint), soft.inverse_h);
      row.begin(rows_of(k.joint).axial_speed(Pair::of(bodies, joint.a, joint.b)));
    }
  }

  KFN real axial_position(const Bodies& bodies, int k) const {
    return list[k].is_along_line() ? axis[k].dot(list[k].apart) : list[k].current_angle(bodies);
  }

  KFN void begin_axis(const Bodies& bodies, int k, const Soft& soft, bool use_bias) {
    const Joint& joint = list[k];
    AxialRow& row = system.axial[k];
    bool drives = use_bias && joint.is_driven();
    row.most = drives ? joint.max_motor_impulse : joint.angular_impulse;
    row.least = drives ? -row.most : row.most;
    row.target = joint.motor_target;
    row.lowest = -FAR_DISTANCE;
    row.highest = FAR_DISTANCE;
    if (joint.is_rod()) return begin_rod(bodies, k, soft, use_bias);
    if (joint.is_limited()) {
      real position = axial_position(bodies, k), back = joint.is_along_line() ? soft.pull_speed : soft.turn_back_speed;
      row.lowest = -soft.limit_speed(position - joint.lower, back, use_bias);
      row.highest = Math::max(soft.limit_speed(joint.upper - position, back, use_bias), row.lowest);
    }
    // Of a servo first what its motor moves.
    if (drives && joint.drive() == DRIVE_SERVO)
      row.holds = AxialRow::MOTOR;
    else
      row.begin(rows_of(k).axial_speed(Pair::of(bodies, joint.a, joint.b)));
  }

  // A rope or rod holds its length at the nearer bound as a motor does its speed, with bounded impulses. The other bound is a limit
  // in this sub-step.
  KFN void begin_rod(const Bodies& bodies, int k, const Soft& soft, bool use_bias) {
    const Joint& joint = list[k];
    AxialRow& row = system.axial[k];
    JointRows rows = rows_of(k);
    Pair pair = Pair::of(bodies, joint.a, joint.b);
    real length = axial_position(bodies, k), left = joint.upper - length, above = length - joint.lower;
    bool is_long = left < above, is_rigid = joint.lower == joint.upper;
    real way = soft.limit_speed(is_long ? left : above, soft.pull_speed, use_bias), speed = rows.axial_speed(pair);
    real across = Math::max(length, is_long ? joint.upper : joint.lower) * Math::inverse_or_zero(rows.across(pair));
    real most = ROD_STRENGTH * across * soft.inverse_h;
    row.target = is_long ? way : -way;
    row.least = is_long || is_rigid ? -most : real(0);
    row.most = is_long && !is_rigid ? real(0) : most;
    if (!is_rigid) (is_long ? row.lowest : row.highest) = (is_long ? -above : left) * soft.inverse_h;
    if (row.is_limit()) row.holds = AxialRow::NOTHING;
    // What is at its bound holds at first: to let go takes one attempt, to be pulled tight one after the other takes many.
    bool is_met = is_long ? speed > row.target : speed < row.target;
    if (is_met || Math::min(left, above) < TOUCHING_DISTANCE) row.holds = AxialRow::MOTOR;
    row.begin(speed);
  }

  // Speeds at which what is held goes wrong beside its rows' speeds if the bodies move as they do, and what undoes the errors
  // that there are. Anchors go around their bodies: by where they get to, they stay on their circles.
  KFN Vec3 bias_of(const Bodies& bodies, const Pair& pair, int k, const Soft& soft) const {
    const Joint& joint = list[k];
    Turn a = Turn::by(Math::clamp(pair.omega_a, -soft.max_spin, soft.max_spin) * soft.h);
    Turn b = Turn::by(Math::clamp(pair.omega_b, -soft.max_spin, soft.max_spin) * soft.h);
    Vec2 turned = (b.chord(joint.arm_b) - a.chord(joint.arm_a)) * soft.inverse_h;
    Vec2 bend = turned.minus(joint.common_b.left(), pair.omega_b).plus(joint.common_a.left(), pair.omega_a);
    real none = real(0), angle = none;
    if (joint.is_rod()) {  // its length, as the anchors move on
      Vec2 moved = turned + (pair.velocity_b - pair.velocity_a), after = joint.apart.plus(moved, soft.h);
      real lengths = Math::max(joint.apart.length() + after.length(), COINCIDENT_DISTANCE);
      return {none, none, Fast::divide(moved.dot(joint.apart + after), lengths) - rows_of(k).axial_speed(pair)};
    }
    if (joint.is_fixed() || joint.is_prismatic())
      angle = Math::clamp(soft.joint_rate * joint.current_angle(bodies), -soft.turn_back_speed, soft.turn_back_speed);
    if (joint.is_prismatic()) {
      Vec2 across = axis[k].left(), swing = a.chord(axis[k]).left();
      Vec2 moved = turned + (pair.velocity_b - pair.velocity_a) + joint.apart * soft.inverse_h;
      real error = Math::clamp(soft.joint_rate * across.dot(joint.apart), -soft.pull_speed, soft.pull_speed);
      return {across.dot(bend) + swing.dot(moved) + error, angle, none};
    }
    Vec2 wrong = bend + clamp_length(joint.apart * soft.joint_rate, soft.pull_speed);
    return {wrong.x, wrong.y, angle};
  }

  KFN static Vec2 clamp_length(Vec2 v, real max_length) {
    real squared = v.dot(v);
    return squared > max_length * max_length ? v * Fast::divide(max_length, Fast::root(squared)) : v;
  }

  // J, what the motor of joint k has added to the bodies' energy in this sub-step.
  KFN real motor_work(const Bodies& bodies, int k) const {
    const Joint& joint = list[k];
    if (!joint.is_driven()) return real(0);
    return Math::max(joint.angular_impulse * rows_of(k).axial_speed(Pair::of(bodies, joint.a, joint.b)), real(0));
  }

  // J, what kinematic bodies have done through it.
  KFN real kinematic_work(const Bodies& bodies, int k) const {
    if (!bodies.is_kinematic(list[k].a) && !bodies.is_kinematic(list[k].b)) return real(0);
    Pair taken = Pair::of_kinematic(bodies, list[k].a, list[k].b);
    apply_impulses(bodies, taken, k);
    return taken.work_of_kinematic(bodies);
  }
};
