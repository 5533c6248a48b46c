// Forces on bodies from outside: of thrusters, and what callers compute themselves.

struct Thrusters {
  ARRAY(Vec2, local_position, NUM_THRUSTERS + 1);
  ARRAY(Vec2, local_force, NUM_THRUSTERS + 1);
  ARRAY(int, body, NUM_THRUSTERS + 1);
  int count;

  KFN void load(const Column& scene, const IntColumn& ints, const Column& controls, const Column& params) {
    count = 0;
    for (int t = 0; t < NUM_THRUSTERS; ++t) {
      real control = controls.get(CONTROLS_THRUSTER + t);
      int word = ints.get(INTS_THRUSTERS + t), owner = word >> THRUSTERS_BODY_SHIFT & THRUSTERS_BODY_MASK;
      if ((word >> THRUSTERS_ACTIVE_SHIFT & 1) == 0 || control == real(0) || !Slot::in_use(owner)) continue;
      body[count] = Slot::shape(owner);
      local_position[count] = scene.get2(SCENE_THRUSTERS_POSITION + 2 * t);
      real angle = scene.get(SCENE_THRUSTERS_ANGLE + t);
      real force = control * scene.get(SCENE_THRUSTERS_POWER + t) * params.get(PARAM_BASE_THRUSTER_POWER);
      local_force[count] = {force * cosf(angle), force * sinf(angle)};
      ++count;
    }
  }

  KFN void apply(Bodies& bodies, real dt) const {
    for (int k = 0; k < count; ++k) {
      Rotation q = bodies.rotation[body[k]];
      bodies.apply_impulse(body[k], q.apply(local_position[k]), q.apply(local_force[k]) * dt);
    }
  }

  // J, what thruster k has added to its body's energy in `dt`.
  KFN real work(const Bodies& bodies, int k, real dt) const {
    int i = body[k];
    Rotation q = bodies.rotation[i];
    Vec2 at = bodies.velocity(i) + q.apply(local_position[k]).left() * bodies.omega(i);
    return Math::max(q.apply(local_force[k]).dot(at) * dt, real(0));
  }
};

// At centres of mass, in the world's frame, constant over a call.
struct ExternalForces {
  KFN static void apply(Bodies& bodies, const Column& controls, real dt) {
    if (!HAS_EXTERNAL_FORCES) return;
    for (Bodies::Each each = Bodies::Each::of(bodies.moving); each.next();) {
      int i = each.shape, slot = Slot::of(i);
      bodies.set_velocity(i, bodies.velocity(i) + controls.get2(CONTROLS_FORCE + 2 * slot) * (dt * bodies.inverse_mass(i)));
      bodies.set_omega(i, bodies.omega(i) + controls.get(CONTROLS_TORQUE + slot) * (dt * bodies.inverse_inertia(i)));
    }
  }

  // J, what they have added to the energy of body i in `dt`.
  KFN static real work(const Bodies& bodies, int i, const Column& controls, real dt) {
    int slot = Slot::of(i);
    real push = controls.get2(CONTROLS_FORCE + 2 * slot).dot(bodies.velocity(i));
    return Math::max((push + controls.get(CONTROLS_TORQUE + slot) * bodies.omega(i)) * dt, real(0));
  }
};
