// Springs and dampers: forces along the line between an anchor on a and one on b. Bounds of its length are a joint (joints.h).
//
//   impulse = -h (k (C + theta h v) + c v), C = length - rest length at the start of the sub-step, v the speed after it
//
// With q = k h^2 / mass, theta = q + (theta_max - q_max) (q / q_max)^2: a spring that is slow against the sub-step is solved
// as free motion is (semi-implicit, which keeps its energy), a fast one implicitly. The stiffest that can be solved has
// the frequency and damping of the settings: q_max and theta_max are its. The line is where both anchors are now, so that the impulse acts on both bodies
// along one line and changes no momentum of the two.

struct Spring {
  int a, b, index;
  Vec2 local_a, local_b;
  Vec2 centre_gap;  // centre of b from centre of a at the start of the step
  real rest_length, stiffness, damping, min_length, max_length;
  real stretch;     // m, at the start of the sub-step
  real impulse;     // N s, positive where it pushes apart

  // As the bodies stand now.
  struct Line {
    Vec2 axis;  // from a's anchor to b's
    real length, lever_a, lever_b;

    KFN real speed(const Pair& pair) const {
      return axis.dot(pair.velocity_b - pair.velocity_a) + lever_b * pair.omega_b - lever_a * pair.omega_a;
    }
    KFN real inverse_mass(const Pair& pair) const {
      return pair.inverse_mass_a + pair.inverse_mass_b + pair.inverse_inertia_a * lever_a * lever_a +
             pair.inverse_inertia_b * lever_b * lever_b;
    }
    KFN void push(Pair& pair, real impulse) const {
      pair.apply_levers(axis * impulse, lever_a * impulse, lever_b * impulse);
    }
  };

  // Anchors in one place are pushed apart upwards, as circles in one place are.
  KFN static Vec2 axis_of(Vec2 gap, real length) {
    return length > COINCIDENT_DISTANCE ? gap * (real(1) / length) : Vec2{real(0), real(1)};
  }

  KFN Line line(const Bodies& bodies) const {
    Vec2 arm_a = bodies.rotation[a].apply(local_a), arm_b = bodies.rotation[b].apply(local_b);
    Vec2 gap = centre_gap + (bodies.delta(b) - bodies.delta(a)) + (arm_b - arm_a);
    real length = gap.length();
    Vec2 axis = axis_of(gap, length);
    return {axis, length, arm_a.cross(axis), arm_b.cross(axis)};
  }

  // A force, whose limit of dt = 0 is the differential equation: it is the same in the relax pass.
  KFN void solve_force(const Line& line, Pair& pair, const Soft& soft, bool use_bias) {
    real h = soft.h;
    if (stiffness == real(0) && damping == real(0)) return;
    if (use_bias) stretch = line.length - rest_length;
    real inverse_mass = line.inverse_mass(pair), k = Math::min(stiffness, soft.max_q() / (h * h * inverse_mass));
    real resistance = damping + soft.theta(k * h * h * inverse_mass) * h * k;  // N s/m
    real free_speed = line.speed(pair) - inverse_mass * impulse;
    real total = -h * (k * stretch + resistance * free_speed) / (real(1) + h * resistance * inverse_mass);
    line.push(pair, total - impulse);
    impulse = total;
  }
};

struct Springs {
  ARRAY(Spring, list, NUM_SPRINGS);
  int count;

  KFN void load(const Bodies& bodies, const Column& scene, const IntColumn& ints, const Column& params,
                const Column& impulses) {
    count = 0;
    for (int s = 0; s < NUM_SPRINGS; ++s) {
      int packed = ints.get(INTS_SPRINGS + s);
      int slot_a = packed >> SPRINGS_A_SHIFT & SPRINGS_A_MASK, slot_b = packed >> SPRINGS_B_SHIFT & SPRINGS_B_MASK;
      if ((packed >> SPRINGS_ACTIVE_SHIFT & 1) == 0 || !Slot::in_use(slot_a) || !Slot::in_use(slot_b)) continue;
      Spring& spring = list[count];
      spring.index = s;
      spring.a = Slot::shape(slot_a);
      spring.b = Slot::shape(slot_b);
      if (!bodies.is_dynamic(spring.a) && !bodies.is_dynamic(spring.b)) continue;
      ++count;
      spring.local_a = scene.get2(SCENE_SPRINGS_ANCHOR_A + 2 * s);
      spring.local_b = scene.get2(SCENE_SPRINGS_ANCHOR_B + 2 * s);
      spring.rest_length = scene.get(SCENE_SPRINGS_REST_LENGTH + s);
      spring.stiffness = scene.get(SCENE_SPRINGS_STIFFNESS + s);
      spring.damping = scene.get(SCENE_SPRINGS_DAMPING + s);
      spring.min_length = scene.get(SCENE_SPRINGS_MIN_LENGTH + s);
      spring.max_length = scene.get(SCENE_SPRINGS_MAX_LENGTH + s);
      spring.stretch = spring.impulse = real(0);
    }
    if (params.get(PARAM_WARM_START) != real(0)) load_impulses(impulses);
  }

  // The impulses as they were last stored.
  KFN void load_impulses(const Column& impulses) {
    for (int k = 0; k < count; ++k) list[k].impulse = impulses.get(IMPULSE_SPRING_IMPULSE + 3 * list[k].index);
  }

  KFN void reset_slowed(const Bodies& bodies) {
    for (int k = 0; k < count; ++k)
      if (bodies.is_slowed(list[k].a, list[k].b)) list[k].impulse = real(0);
  }

  KFN void store(const Column& impulses) const {
    for (int k = 0; k < count; ++k) impulses.set(IMPULSE_SPRING_IMPULSE + 3 * list[k].index, list[k].impulse);
  }

  KFN int a_of(int k) const { return list[k].a; }
  KFN int b_of(int k) const { return list[k].b; }
  KFN static Vec2 axis_of(Vec2 gap, real length) { return Spring::axis_of(gap, length); }

  // A rope, a rod, or a spring that goes no farther.
  KFN bool is_bounded(int k) const { return list[k].min_length > real(0) || list[k].max_length < NO_MAXIMUM; }

  // What bounds the length of spring k, as a joint.
  KFN void load_rod(int k, Joint& joint) const {
    const Spring& spring = list[k];
    joint.index = spring.index;
    joint.flags = Joint::KIND_ROD << JOINTS_KIND_SHIFT;
    joint.a = spring.a;
    joint.b = spring.b;
    joint.local_a = spring.local_a;
    joint.local_b = spring.local_b;
    joint.lower = spring.min_length > real(0) ? spring.min_length : -FAR_DISTANCE;
    joint.upper = spring.max_length < NO_MAXIMUM ? spring.max_length : FAR_DISTANCE;
    joint.start_angle = joint.axial_mass = joint.motor_target = joint.max_motor_impulse = real(0);
  }

  // Those on bodies of `which`, in islands.
  KFN void prepare(const Bodies& bodies, const unsigned int* which) {
    for (int k = 0; k < count; ++k) {
      int a = list[k].a, b = list[k].b;
      if (Bodies::has(which, bodies.is_dynamic(a) ? a : b)) list[k].centre_gap = bodies.position[b] - bodies.position[a];
    }
  }

  KFN void scale_impulses(int k, real share) { list[k].impulse *= share; }

  // All that spring k exerts, where the bodies are now.
  KFN void apply_impulses(const Bodies& bodies, Pair& pair, int k) const {
    list[k].line(bodies).push(pair, list[k].impulse);
  }

  KFN void warm_start(Bodies& bodies) {
    for (int k = 0; k < count; ++k) {
      Pair pair = Pair::of(bodies, list[k].a, list[k].b);
      apply_impulses(bodies, pair, k);
      pair.write_back(bodies);
    }
  }

  KFN void solve(Bodies& bodies, const Soft& soft, bool use_bias, ActiveSet& active) {
    for (int k = 0; k < count; ++k) {
      Spring& spring = list[k];
      if (active.leaves_out(spring.a, spring.b)) continue;
      Pair pair = Pair::of(bodies, spring.a, spring.b);
      Vec2 before = pair.velocity_b - pair.velocity_a;
      Spring::Line line = spring.line(bodies);
      spring.solve_force(line, pair, soft, use_bias);
      if (active.shares(spring.a, spring.b)) active.mark_if_moved(bodies, pair, before);
      pair.write_back(bodies);
    }
  }

  // J, what kinematic bodies have done through spring k in this sub-step.
  KFN real kinematic_work(const Bodies& bodies, int k) const {
    if (!bodies.is_kinematic(list[k].a) && !bodies.is_kinematic(list[k].b)) return real(0);
    Pair taken = Pair::of_kinematic(bodies, list[k].a, list[k].b);
    list[k].line(bodies).push(taken, list[k].impulse);
    return taken.work_of_kinematic(bodies);
  }

  // J, what it has added to the bodies' energy.
  KFN real work(const Bodies& bodies, int k) const {
    real speed = list[k].line(bodies).speed(Pair::of(bodies, list[k].a, list[k].b));
    return Math::max(list[k].impulse * speed, real(0));
  }
};
