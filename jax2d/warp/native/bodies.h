// Bodies of one world while it is stepped: mass, velocity, and position as a delta from the start of
// the step, so that nothing is lost far from the origin.

struct Bodies {
  ARRAY(Vec2, position, NUM_SHAPES);  // at the start of the step
  ARRAY(real, angle, NUM_SHAPES);
  ARRAY(Rotation, rotation, NUM_SHAPES);
  ARRAY(unsigned int, present, SHAPE_WORDS);  // a bit a shape that is active
  ARRAY(unsigned int, moving, SHAPE_WORDS);  // a bit a shape that moves; most work is for these alone
  ARRAY(unsigned int, counts_turns, SHAPE_WORDS);  // a bit a shape whose angle is not wrapped
  int limited;                        // shapes on which a speed limit acted, each once a step
  ARRAY(unsigned int, slowed, SHAPE_WORDS);  // a bit a shape on which one has acted in this step

  ARRAY(unsigned int, held_spins, SHAPE_WORDS);  // a bit a shape that is not turned by its own inertia for now

  // What solving uses of a body. On a GPU much of it is in shared memory: the worlds of a warp use different bodies at
  // a time, and in local memory that would be a transaction for each world and a wait for the slowest.
  enum { VELOCITY, OMEGA = 2, INVERSE_MASS, INVERSE_INERTIA, DELTA, TURN = 7, RECORD };
#if defined(__CUDA_ARCH__)
  enum { LOCAL_RECORD = RECORD - SHARED_RECORD };
#else
  enum { LOCAL_RECORD = RECORD };
#endif
  ARRAY(real, record, NUM_SHAPES * Bodies::LOCAL_RECORD + 1);

  KFN real& at(int i, int word) {
#if defined(__CUDA_ARCH__)
    __shared__ real shared[NUM_SHAPES * SHARED_RECORD * WP_TILE_BLOCK_DIM + 1];
    if (word < SHARED_RECORD) return shared[(i * SHARED_RECORD + word) * WP_TILE_BLOCK_DIM + threadIdx.x];
#endif
    return record[i * LOCAL_RECORD + word - (RECORD - LOCAL_RECORD)];
  }
  KFN real at(int i, int word) const { return const_cast<Bodies*>(this)->at(i, word); }
  KFN Vec2 velocity(int i) const { return {at(i, VELOCITY), at(i, VELOCITY + 1)}; }
  KFN real omega(int i) const { return at(i, OMEGA); }
  KFN real inverse_mass(int i) const { return at(i, INVERSE_MASS); }
  KFN real inverse_inertia(int i) const { return at(i, INVERSE_INERTIA); }
  KFN Vec2 delta(int i) const { return {at(i, DELTA), at(i, DELTA + 1)}; }  // moved since the start of the step
  KFN real turn(int i) const { return at(i, TURN); }                        // turned since the start of the step
  KFN void set_velocity(int i, Vec2 v) { at(i, VELOCITY) = v.x; at(i, VELOCITY + 1) = v.y; }
  KFN void set_omega(int i, real v) { at(i, OMEGA) = v; }
  KFN void set_delta(int i, Vec2 v) { at(i, DELTA) = v.x; at(i, DELTA + 1) = v.y; }

  // The shapes of a set, a bit each, one after another.
  struct Each {
    EachBit bits;
    int shape;
    KFN static Each of(const unsigned int* words) { return {EachBit::of(words, SHAPE_WORDS), -1}; }
    KFN bool next() { return bits.next(shape); }
  };

  KFN static void clear(unsigned int* shapes) { Bits::clear(shapes, SHAPE_WORDS); }
  KFN static void copy(unsigned int* to, const unsigned int* from) {
    for (int word = 0; word < SHAPE_WORDS; ++word) to[word] = from[word];
  }
  KFN static bool any(const unsigned int* shapes) { return Bits::any(shapes, SHAPE_WORDS); }
  KFN static void add(unsigned int* shapes, int i) { Bits::add(shapes, SHAPE_WORDS, i); }
  KFN static void remove(unsigned int* shapes, int i) { Bits::remove(shapes, SHAPE_WORDS, i); }
  KFN static bool has(const unsigned int* shapes, int i) { return Bits::has(shapes, SHAPE_WORDS, i); }
  KFN void add_dynamic(unsigned int* shapes, int a, int b) const {
    if (is_dynamic(a)) add(shapes, a);
    if (is_dynamic(b)) add(shapes, b);
  }
  KFN void add_moving(unsigned int* shapes, int a, int b) const {
    if (moves(a)) add(shapes, a);
    if (moves(b)) add(shapes, b);
  }
  KFN bool is_active(int i) const { return has(present, i); }
  KFN bool moves(int i) const { return has(moving, i); }
  // Something can push it: kinematic bodies move at their own velocity.
  KFN bool is_dynamic(int i) const {
    return HAS_KINEMATIC_BODIES ? inverse_mass(i) > real(0) || inverse_inertia(i) > real(0) || has(held_spins, i) : moves(i);
  }
  KFN bool is_kinematic(int i) const { return HAS_KINEMATIC_BODIES && moves(i) && !is_dynamic(i); }

  KFN void load(const Column& scene, const IntColumn& ints, const Column& state) {
    limited = 0;
    clear(present);
    clear(moving);
    clear(counts_turns);
    clear(held_spins);
    unsigned int active[TOUCH_WORDS];  // a bit a slot
    for (int word = 0; word < TOUCH_WORDS; ++word) active[word] = (unsigned int)(ints.get(INTS_SHAPES_ACTIVE + word));
    for (int i = 0; i < NUM_SHAPES; ++i) {
      int slot = Slot::of(i);
      if (!Bits::has(active, TOUCH_WORDS, slot)) {
        at(i, INVERSE_MASS) = at(i, INVERSE_INERTIA) = real(0);
        continue;
      }
      position[i] = state.get2(STATE_POSITION + 2 * slot);
      angle[i] = state.get(STATE_ANGLE + slot);
      at(i, INVERSE_MASS) = scene.get(SCENE_SHAPES_INVERSE_MASS + slot);
      at(i, INVERSE_INERTIA) = scene.get(SCENE_SHAPES_INVERSE_INERTIA + slot);
      add(present, i);
      bool moves = inverse_mass(i) > real(0) || inverse_inertia(i) > real(0);
      if (HAS_KINEMATIC_BODIES)
        moves |= ((unsigned int)(ints.get(INTS_SHAPES_KINEMATIC + slot / 32)) >> (slot % 32) & 1u) != 0u;
      if (moves) add(moving, i);
      set_velocity(i, moves ? state.get2(STATE_VELOCITY + 2 * slot) : Vec2{real(0), real(0)});
      set_omega(i, moves ? state.get(STATE_ANGULAR_VELOCITY + slot) : real(0));
    }
  }

  KFN void store(const Column& state) const {
    for (Each each = Each::of(moving); each.next();) {
      int i = each.shape;
      int slot = Slot::of(i);
      state.set2(STATE_POSITION + 2 * slot, position[i]);
      state.set(STATE_ANGLE + slot, angle[i]);
      state.set2(STATE_VELOCITY + 2 * slot, velocity(i));
      state.set(STATE_ANGULAR_VELOCITY + slot, omega(i));
    }
  }

  // Of `which`, where contacts are found. `fixed_too`: in the first step of a call; what cannot move stays as it was made
  // then.
  KFN void begin_step(bool fixed_too, const unsigned int* which) {
    for (int i = 0; i < NUM_SHAPES; ++i) {
      if (!is_active(i) || (!fixed_too && !has(which, i))) continue;
      set_delta(i, {real(0), real(0)});
      at(i, TURN) = real(0);
      rotation[i] = {cosf(angle[i]), sinf(angle[i])};
    }
  }

  KFN void end_step(const unsigned int* which) {
    for (Each each = Each::of(which); each.next();) {
      int i = each.shape;
      position[i] = position[i] + delta(i);
      angle[i] += turn(i);
      if (SOFT_STEP && !has(counts_turns, i)) angle[i] = Angle::near(angle[i], real(0));
    }
  }

  // Semi-implicit Euler: velocity from gravity.
  KFN void apply_gravity(Vec2 gravity, real dt) {
    if (!HAS_GRAVITY || (gravity.x == real(0) && gravity.y == real(0))) return;
    for (Each each = Each::of(moving); each.next();) {
      int i = each.shape;
      if (inverse_mass(i) > real(0)) set_velocity(i, velocity(i).plus(gravity, dt));
    }
  }

  // Implicit Euler: v / (1 + h d), which no rate makes unstable.
  KFN void apply_damping(const Column& scene, real h) {
    if (!HAS_DAMPING) return;
    for (Each each = Each::of(moving); each.next();) {
      int i = each.shape, slot = Slot::of(i);
      real one = real(1);
      if (inverse_mass(i) > real(0))
        set_velocity(i, velocity(i) * (one / (one + h * scene.get(SCENE_SHAPES_LINEAR_DAMPING + slot))));
      if (inverse_inertia(i) > real(0))
        set_omega(i, omega(i) * (one / (one + h * scene.get(SCENE_SHAPES_ANGULAR_DAMPING + slot))));
    }
  }

  KFN real mass(int i) const { return Math::inverse_or_zero(inverse_mass(i)); }

  // J, at velocity v and spin w.
  KFN real kinetic_energy(int i, Vec2 v, real w) const {
    return real(0.5) * (mass(i) * v.dot(v) + Math::inverse_or_zero(inverse_inertia(i)) * w * w);
  }

  // No state that a call returns moves faster than the limits: what the last relax pass and bounces gave counts too.
  KFN void limit_speeds(const unsigned int* which, real max_speed, real max_omega) {
    for (Each each = Each::of(which); each.next();) limit_speed(each.shape, max_speed, max_omega);
  }

  // True if one has acted.
  KFN bool limit_speed(int i, real max_speed, real max_omega) {
    real speed_squared = velocity(i).dot(velocity(i));
    bool is_fast = speed_squared > max_speed * max_speed, spins = omega(i) > max_omega || omega(i) < -max_omega;
    if (is_fast) set_velocity(i, velocity(i) * Fast::divide(max_speed, Fast::root(speed_squared)));
    if (spins) set_omega(i, Math::clamp(omega(i), -max_omega, max_omega));
    if (!is_fast && !spins) return false;
    if (!has(slowed, i)) ++limited;
    add(slowed, i);
    return true;
  }

  // A joint that pulls along `arm` holds its body against turning: stiffness x h^2 is `inertia`. Where that is more than what
  // turns, a sub-step is too long for the swing that comes of it: to what changes its spin in this one, until it is released,
  // the body has that inertia. What turns is the body and, as far as the other's anchor holds still, its mass at the arm: a
  // bob on a pivot swings as slowly as its arm is long.
  KFN void stretch(const Column& scene, int i, Vec2 arm, real inertia, int other, Vec2 other_arm) {
    if (inertia * inverse_inertia(i) <= real(1)) return;
    // By their own inertias, whatever another joint has made of them: no order of joints decides.
    real own = scene.get(SCENE_SHAPES_INVERSE_INERTIA + Slot::of(i)), mass = inverse_mass(i);
    real others = is_dynamic(other) ? scene.get(SCENE_SHAPES_INVERSE_INERTIA + Slot::of(other)) : real(0);
    real still = Math::inverse_or_zero(mass + Fused::of(others, other_arm.dot(other_arm), inverse_mass(other)));
    if (inertia * own <= Fused::of(arm.dot(arm) * mass * still, still * own, real(1))) return;
    at(i, INVERSE_INERTIA) = real(1) / inertia;
    add(held_spins, i);
  }
  // A spin at its limit is not changed by anything, until it is released.
  KFN void hold_spin(int i, real max_omega) {
    if (Math::abs(omega(i)) < max_omega) return;
    add(held_spins, i);
    at(i, INVERSE_INERTIA) = real(0);
  }
  KFN void release_spins(const Column& scene) {
    for (Each each = Each::of(held_spins); each.next();)
      at(each.shape, INVERSE_INERTIA) = scene.get(SCENE_SHAPES_INVERSE_INERTIA + Slot::of(each.shape));
    clear(held_spins);
  }

  KFN bool is_slowed(int a, int b) const { return has(slowed, a) || has(slowed, b); }

  // Semi-implicit Euler: position from the velocity just solved, which World::slow_down has limited.
  KFN void move(const unsigned int* which, real dt, real max_speed, real max_omega) {
    for (Each each = Each::of(which); each.next();) {
      int i = each.shape;
      if (!SOFT_STEP) limit_speed(i, max_speed, max_omega);
      set_delta(i, delta(i).plus(velocity(i), dt));
      real angle_step = omega(i) * dt;
      at(i, TURN) += angle_step;
      rotation[i] = rotation[i].turned(angle_step);
    }
  }

  KFN void apply_impulse(int i, Vec2 arm, Vec2 impulse) {
    set_velocity(i, velocity(i).plus(impulse, inverse_mass(i)));
    set_omega(i, Fused::of(inverse_inertia(i), arm.cross(impulse), omega(i)));
  }
};

// Velocities of all bodies at another moment.
struct Velocities {
  ARRAY(Vec2, velocity, ISLAND_SHAPES);
  ARRAY(real, omega, ISLAND_SHAPES);

  // Of `which`, a bit a shape.
  KFN void keep(const Bodies& bodies, const unsigned int* which) {
    for (Bodies::Each each = Bodies::Each::of(which); each.next();) {
      velocity[each.shape] = bodies.velocity(each.shape);
      omega[each.shape] = bodies.omega(each.shape);
    }
  }

  KFN void swap(Bodies& bodies, const unsigned int* which) {
    for (Bodies::Each each = Bodies::Each::of(which); each.next();) {
      int i = each.shape;
      Vec2 v = bodies.velocity(i);
      real w = bodies.omega(i);
      bodies.set_velocity(i, velocity[i]);
      bodies.set_omega(i, omega[i]);
      velocity[i] = v;
      omega[i] = w;
    }
  }
};

// From the centres of mass of two bodies to where an impulse acts on both.
struct Arms {
  Vec2 a, b;
};

// Two bodies held in registers while constraints between them are solved: bodies stand in local or shared
// memory, where each use of one is a load and each push a store and a wait.
struct Pair {
  int a, b;
  Vec2 velocity_a, velocity_b;
  real omega_a, omega_b;
  real inverse_mass_a, inverse_mass_b, inverse_inertia_a, inverse_inertia_b;

  KFN static Pair of(const Bodies& bodies, int a, int b) {
    return {a,
            b,
            bodies.velocity(a),
            bodies.velocity(b),
            bodies.omega(a),
            bodies.omega(b),
            bodies.inverse_mass(a),
            bodies.inverse_mass(b),
            bodies.inverse_inertia(a),
            bodies.inverse_inertia(b)};
  }

  // Of two where what is not kinematic has no mass, and what is has one of 1 and stands still: impulses are what it takes.
  KFN static Pair of_kinematic(const Bodies& bodies, int a, int b) {
    real none = real(0), of_a = bodies.is_kinematic(a) ? real(1) : none, of_b = bodies.is_kinematic(b) ? real(1) : none;
    return {a, b, {none, none}, {none, none}, none, none, of_a, of_b, of_a, of_b};
  }

  // J, what kinematic bodies have done with the impulses that such a pair has had: they took the opposite of what they
  // gave.
  KFN real work_of_kinematic(const Bodies& bodies) const {
    return -(bodies.velocity(a).dot(velocity_a) + bodies.omega(a) * omega_a + bodies.velocity(b).dot(velocity_b) +
             bodies.omega(b) * omega_b);
  }

  KFN void write_back(Bodies& bodies) const {
    bodies.set_velocity(a, velocity_a);
    bodies.set_omega(a, omega_a);
    bodies.set_velocity(b, velocity_b);
    bodies.set_omega(b, omega_b);
  }

  // Velocity of b at the end of its arm, seen from a at the end of its own.
  KFN Vec2 relative(Vec2 arm_a, Vec2 arm_b) const {
    return velocity_b.plus(arm_b.left(), omega_b) - velocity_a.plus(arm_a.left(), omega_a);
  }

  // kg, that an impulse along a direction moves.
  KFN real mass(Vec2 arm_a, Vec2 arm_b, Vec2 direction) const {
    real ra = arm_a.cross(direction), rb = arm_b.cross(direction);
    real moved = Fused::of(inverse_inertia_a * ra, ra, inverse_mass_a + inverse_mass_b);
    return Math::inverse_or_zero(Fused::of(inverse_inertia_b * rb, rb, moved));
  }

  KFN void apply_impulse(Vec2 arm_a, Vec2 arm_b, Vec2 impulse_on_b) {
    Vec2 impulse_on_a = -impulse_on_b;
    velocity_a = velocity_a.plus(impulse_on_a, inverse_mass_a);
    omega_a = Fused::of(inverse_inertia_a, arm_a.cross(impulse_on_a), omega_a);
    velocity_b = velocity_b.plus(impulse_on_b, inverse_mass_b);
    omega_b = Fused::of(inverse_inertia_b, arm_b.cross(impulse_on_b), omega_b);
  }

  // The same by lever arms times impulses, N m s.
  KFN void apply_levers(Vec2 impulse_on_b, real angular_on_a, real angular_on_b) {
    velocity_a = velocity_a.minus(impulse_on_b, inverse_mass_a);
    omega_a = Fused::of(-inverse_inertia_a, angular_on_a, omega_a);
    velocity_b = velocity_b.plus(impulse_on_b, inverse_mass_b);
    omega_b = Fused::of(inverse_inertia_b, angular_on_b, omega_b);
  }

  // With the same masses.
  KFN Pair at_rest() const {
    Pair pair = *this;
    pair.velocity_a = pair.velocity_b = {real(0), real(0)};
    pair.omega_a = pair.omega_b = real(0);
    return pair;
  }
  KFN void add_to(int body, Vec2 v, real w) {
    Vec2& velocity = body == a ? velocity_a : velocity_b;
    velocity = velocity + v;
    (body == a ? omega_a : omega_b) += w;
  }
  KFN void add(const Pair& change, real times) {
    velocity_a = velocity_a.plus(change.velocity_a, times);
    velocity_b = velocity_b.plus(change.velocity_b, times);
    omega_a = Fused::of(change.omega_a, times, omega_a);
    omega_b = Fused::of(change.omega_b, times, omega_b);
  }

  KFN void apply_angular_impulse(real impulse_on_b) {
    omega_a = Fused::of(-inverse_inertia_a, impulse_on_b, omega_a);
    omega_b = Fused::of(inverse_inertia_b, impulse_on_b, omega_b);
  }
};
