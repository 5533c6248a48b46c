// How a sub-step began: with these velocities, when forces had acted and nothing had been solved.
// What holds takes energy, or none. Where a world has more kinetic energy once it is relaxed, impulses are not solved
// yet, or those remembered from another place of the bodies are far off; bodies that jam do that.

struct Begun {
  ARRAY(Vec2, velocity, BEGUN_SHAPES);
  ARRAY(real, omega, BEGUN_SHAPES);
  real mass;        // kg, of all that moves
  real max_energy;  // J, what may be left beside the work of motors, springs and what carries

  KFN void begin(const Bodies& bodies, real h) {
    mass = real(0);
    for (Bodies::Each each = Bodies::Each::of(bodies.moving); each.next();) {
      int i = each.shape;
      velocity[i] = bodies.velocity(i);
      omega[i] = bodies.omega(i);
      mass += Math::inverse_or_zero(bodies.inverse_mass(i));
    }
    max_energy = bodies.kinetic_energy() * (real(1) + h * SLACK_RATE) + h * SLACK_POWER * mass;
  }

  KFN void restore(Bodies& bodies) const {
    for (Bodies::Each each = Bodies::Each::of(bodies.moving); each.next();) {
      bodies.set_velocity(each.shape, velocity[each.shape]);
      bodies.set_omega(each.shape, omega[each.shape]);
    }
  }
};
