// Springs, dampers, ropes and rods: forces and limits along the line between an anchor on a and one on b.
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
  real impulse, impulse_min, impulse_max;  // N s, positive where it pushes apart; of the limits

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

  KFN real total() const { return impulse + impulse_min - impulse_max; }

  KFN Line line(const Bodies& bodies) const {
    Vec2 arm_a = bodies.rotation[a].apply(local_a), arm_b = bodies.rotation[b].apply(local_b);
    Vec2 gap = centre_gap + (bodies.delta(b) - bodies.delta(a)) + (arm_b - arm_a);
    real length = gap.length();
    // Anchors in one place are pushed apart upwards, as circles in one place are.
    Vec2 axis = length > COINCIDENT_DISTANCE ? gap * (real(1) / length) : Vec2{real(0), real(1)};
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

  KFN void solve_limits(const Line& line, Pair& pair, const Soft& soft, bool use_bias) {
    real mass = Math::inverse_or_zero(line.inverse_mass(pair));
    if (min_length > real(0))
      line.push(pair, soft.limit_impulse(line.length - min_length, line.speed(pair), mass, impulse_min, use_bias));
    if (max_length < NO_MAXIMUM)
      line.push(pair, -soft.limit_impulse(max_length - line.length, -line.speed(pair), mass, impulse_max, use_bias));
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
      spring.stretch = spring.impulse = spring.impulse_min = spring.impulse_max = real(0);
    }
    if (params.get(PARAM_WARM_START) != real(0)) load_impulses(impulses);
  }

  // The impulses as they were last stored.
  KFN void load_impulses(const Column& impulses) {
    for (int k = 0; k < count; ++k) {
      int row = IMPULSE_SPRING_IMPULSE + 3 * list[k].index;
      list[k].impulse = impulses.get(row);
      list[k].impulse_min = impulses.get(row + 1);
      list[k].impulse_max = impulses.get(row + 2);
    }
  }

  KFN void reset_slowed(const Bodies& bodies) {
    for (int k = 0; k < count; ++k)
      if (bodies.is_slowed(list[k].a, list[k].b))
        list[k].impulse = list[k].impulse_min = list[k].impulse_max = real(0);
  }

  KFN void store(const Column& impulses) const {
    for (int k = 0; k < count; ++k) {
      int row = IMPULSE_SPRING_IMPULSE + 3 * list[k].index;
      impulses.set(row, list[k].impulse);
      impulses.set(row + 1, list[k].impulse_min);
      impulses.set(row + 2, list[k].impulse_max);
    }
  }

  KFN int a_of(int k) const { return list[k].a; }
  KFN int b_of(int k) const { return list[k].b; }

  // Those on bodies of `which`, in islands.
  KFN void prepare(const Bodies& bodies, const unsigned int* which) {
    for (int k = 0; k < count; ++k) {
      int a = list[k].a, b = list[k].b;
      if (Bodies::has(which, bodies.is_dynamic(a) ? a : b)) list[k].centre_gap = bodies.position[b] - bodies.position[a];
    }
  }

  KFN void scale_impulses(int k, real share) {
    list[k].impulse *= share;
    list[k].impulse_min *= share;
    list[k].impulse_max *= share;
  }

  // All that spring k exerts, where the bodies are now.
  KFN void apply_impulses(const Bodies& bodies, Pair& pair, int k) const {
    list[k].line(bodies).push(pair, list[k].total());
  }

  KFN void warm_start(Bodies& bodies) {
    for (int k = 0; k < count; ++k) {
      Pair pair = Pair::of(bodies, list[k].a, list[k].b);
      apply_impulses(bodies, pair, k);
      pair.write_back(bodies);
    }
  }

  // Without `forces` in a bounce: they do nothing in an instant.
  KFN void solve(Bodies& bodies, const Soft& soft, bool use_bias, bool forces, ActiveSet& active) {
    for (int k = 0; k < count; ++k) {
      Spring& spring = list[k];
      if (active.leaves_out(spring.a, spring.b)) continue;
      Pair pair = Pair::of(bodies, spring.a, spring.b);
      Vec2 before = pair.velocity_b - pair.velocity_a;
      Spring::Line line = spring.line(bodies);
      if (forces) spring.solve_force(line, pair, soft, use_bias);
      spring.solve_limits(line, pair, soft, use_bias);
      if (active.shares(spring.a, spring.b)) active.mark_if_moved(bodies, pair, before);
      pair.write_back(bodies);
    }
  }

  // J, what kinematic bodies have done through spring k in this sub-step.
  KFN real kinematic_work(const Bodies& bodies, int k) const {
    if (!bodies.is_kinematic(list[k].a) && !bodies.is_kinematic(list[k].b)) return real(0);
    Pair taken = Pair::of_kinematic(bodies, list[k].a, list[k].b);
    list[k].line(bodies).push(taken, list[k].total());
    return taken.work_of_kinematic(bodies);
  }

  // J, what it has added to the bodies' energy.
  KFN real work(const Bodies& bodies, int k) const {
    real speed = list[k].line(bodies).speed(Pair::of(bodies, list[k].a, list[k].b));
    return Math::max(list[k].impulse * speed, real(0));
  }
};
