// Bodies of one world while it is stepped: mass, velocity, and position as a delta from the start of
// the step, so that nothing is lost far from the origin.

struct Bodies {
  Vec2 position[NUM_SHAPES];  // at the start of the step
  real angle[NUM_SHAPES];
  Vec2 velocity[NUM_SHAPES];
  real omega[NUM_SHAPES];
  Vec2 delta[NUM_SHAPES];     // moved since the start of the step
  real turn[NUM_SHAPES];      // turned since the start of the step
  Rotation rotation[NUM_SHAPES];
  real inverse_mass[NUM_SHAPES];
  real inverse_inertia[NUM_SHAPES];
  unsigned int active[TOUCH_WORDS];  // a bit a slot
  int moving[NUM_SHAPES];     // shapes that can move; most work is for these alone
  int num_moving;
  int limited;                // times a speed limit acted

  KFN bool is_dynamic(int i) const { return inverse_mass[i] > real(0) || inverse_inertia[i] > real(0); }

  KFN bool is_active(int i) const {
    int slot = Slot::of(i);
    return (active[slot / 32] >> (slot % 32) & 1u) != 0u;
  }

  KFN void load(const Column& scene, const IntColumn& ints, const Column& state) {
    limited = 0;
    num_moving = 0;
    for (int word = 0; word < TOUCH_WORDS; ++word) active[word] = (unsigned int)(ints.get(INTS_ACTIVE + word));
    for (int i = 0; i < NUM_SHAPES; ++i) {
      if (!is_active(i)) {
        inverse_mass[i] = inverse_inertia[i] = real(0);
        continue;
      }
      int slot = Slot::of(i);
      position[i] = state.get2(STATE_POSITION + 2 * slot);
      angle[i] = state.get(STATE_ANGLE + slot);
      velocity[i] = state.get2(STATE_VELOCITY + 2 * slot);
      omega[i] = state.get(STATE_OMEGA + slot);
      inverse_mass[i] = scene.get(SCENE_INVERSE_MASS + slot);
      inverse_inertia[i] = scene.get(SCENE_INVERSE_INERTIA + slot);
      if (is_dynamic(i)) moving[num_moving++] = i;
    }
  }

  KFN void store(const Column& state) const {
    for (int k = 0; k < num_moving; ++k) {
      int i = moving[k];
      int slot = Slot::of(i);
      state.set2(STATE_POSITION + 2 * slot, position[i]);
      state.set(STATE_ANGLE + slot, angle[i]);
      state.set2(STATE_VELOCITY + 2 * slot, velocity[i]);
      state.set(STATE_OMEGA + slot, omega[i]);
    }
  }

  // `fixed_too`: in the first step of a call; what cannot move stays as it was made then.
  KFN void begin_step(bool fixed_too) {
    for (int i = 0; i < NUM_SHAPES; ++i) {
      if (!is_active(i) || (!fixed_too && !is_dynamic(i))) continue;
      delta[i] = {real(0), real(0)};
      turn[i] = real(0);
      rotation[i] = {cosf(angle[i]), sinf(angle[i])};
    }
  }

  KFN void end_step() {
    for (int k = 0; k < num_moving; ++k) {
      int i = moving[k];
      position[i] = position[i] + delta[i];
      angle[i] += turn[i];
    }
  }

  // Semi-implicit Euler: velocity from gravity.
  KFN void apply_gravity(Vec2 gravity, real dt) {
    if (!HAS_GRAVITY || (gravity.x == real(0) && gravity.y == real(0))) return;
    for (int k = 0; k < num_moving; ++k) {
      int i = moving[k];
      if (inverse_mass[i] > real(0)) velocity[i] = velocity[i] + gravity * dt;
    }
  }

  // No state that a call returns moves faster than the limits: what the last relax pass and bounces gave counts too.
  KFN void limit_speeds(real max_speed, real max_omega) {
    for (int k = 0; k < num_moving; ++k) limit_speed(moving[k], max_speed, max_omega);
  }

  KFN void limit_speed(int i, real max_speed, real max_omega) {
    real speed_squared = velocity[i].dot(velocity[i]);
    if (speed_squared > max_speed * max_speed) {
      velocity[i] = velocity[i] * (max_speed / sqrtf(speed_squared));
      ++limited;
    }
    if (omega[i] > max_omega || omega[i] < -max_omega) {
      omega[i] = Math::clamp(omega[i], -max_omega, max_omega);
      ++limited;
    }
  }

  // Semi-implicit Euler: position from the velocity just solved. Speed limits that act are counted.
  KFN void move(real dt, real max_speed, real max_omega) {
    for (int k = 0; k < num_moving; ++k) {
      int i = moving[k];
      limit_speed(i, max_speed, max_omega);
      delta[i] = delta[i] + velocity[i] * dt;
      real angle_step = omega[i] * dt;
      turn[i] += angle_step;
      rotation[i] = rotation[i].turned(angle_step);
    }
  }

  KFN void push(int i, Vec2 arm, Vec2 impulse) {
    velocity[i] = velocity[i] + impulse * inverse_mass[i];
    omega[i] += inverse_inertia[i] * arm.cross(impulse);
  }
};

// Two bodies held in registers while constraints between them are solved: bodies stand in local memory, where each
// use of one is a load and each push a store and a wait.
struct Pair {
  int a, b;
  Vec2 velocity_a, velocity_b;
  real omega_a, omega_b;
  real inverse_mass_a, inverse_mass_b, inverse_inertia_a, inverse_inertia_b;

  KFN static Pair of(const Bodies& bodies, int a, int b) {
    return {a,
            b,
            bodies.velocity[a],
            bodies.velocity[b],
            bodies.omega[a],
            bodies.omega[b],
            bodies.inverse_mass[a],
            bodies.inverse_mass[b],
            bodies.inverse_inertia[a],
            bodies.inverse_inertia[b]};
  }

  KFN void give_back(Bodies& bodies) const {
    bodies.velocity[a] = velocity_a;
    bodies.omega[a] = omega_a;
    bodies.velocity[b] = velocity_b;
    bodies.omega[b] = omega_b;
  }

  // Velocity of b at the end of its arm, seen from a at the end of its own.
  KFN Vec2 relative(Vec2 arm_a, Vec2 arm_b) const {
    return (velocity_b + arm_b.left() * omega_b) - (velocity_a + arm_a.left() * omega_a);
  }

  KFN void push(Vec2 arm_a, Vec2 arm_b, Vec2 impulse_on_b) {
    Vec2 impulse_on_a = -impulse_on_b;
    velocity_a = velocity_a + impulse_on_a * inverse_mass_a;
    omega_a += inverse_inertia_a * arm_a.cross(impulse_on_a);
    velocity_b = velocity_b + impulse_on_b * inverse_mass_b;
    omega_b += inverse_inertia_b * arm_b.cross(impulse_on_b);
  }

  KFN void twist(real impulse_on_b) {
    omega_a -= inverse_inertia_a * impulse_on_b;
    omega_b += inverse_inertia_b * impulse_on_b;
  }
};
