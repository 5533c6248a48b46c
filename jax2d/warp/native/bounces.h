// What bounces may not give a world: more energy than the step began with, and motors, thrusters and moving surfaces
// have added since.
// Where several bodies, joints or friction share in an impact, restitution contact by contact may ask for more; then
// everything that bounces gets the same share of its change of velocity, so that joints and contacts stay solved.
//
// Energy is that of semi-implicit Euler, which keeps m |v + g h / 2|^2 / 2 - m g.x in free flight to the last digit.

struct Bounces {
  ARRAY(Vec2, velocity, BOUNCE_SHAPES);  // when contacts were found; later before anything bounced
  ARRAY(real, omega, BOUNCE_SHAPES);
  real max_energy;               // J, energy allowed; zero of height is where each body was when contacts were found

  KFN void begin(const Bodies& bodies, Vec2 gravity, real h) {
    keep_velocities(bodies);
    max_energy = real(0);
    for (Bodies::Each each = Bodies::Each::of(bodies.moving); each.next();) {
      int i = each.shape;
      Vec2 v = midway(bodies, i, bodies.velocity(i), gravity, h);
      max_energy += real(0.5) * (Math::inverse_or_zero(bodies.inverse_mass(i)) * v.dot(v) +
                           Math::inverse_or_zero(bodies.inverse_inertia(i)) * bodies.omega(i) * bodies.omega(i));
    }
  }

  KFN void keep_velocities(const Bodies& bodies) {
    for (Bodies::Each each = Bodies::Each::of(bodies.moving); each.next();) {
      int i = each.shape;
      velocity[i] = bodies.velocity(i);
      omega[i] = bodies.omega(i);
    }
  }

  KFN void swap_velocities(Bodies& bodies) {
    for (Bodies::Each each = Bodies::Each::of(bodies.moving); each.next();) {
      int i = each.shape;
      Vec2 v = bodies.velocity(i);
      real w = bodies.omega(i);
      bodies.set_velocity(i, velocity[i]);
      bodies.set_omega(i, omega[i]);
      velocity[i] = v;
      omega[i] = w;
    }
  }

  // `carried`: J, what moving surfaces have done to what bounced, which is theirs to give. Returns the share of what
  // bounces changed that is left.
  KFN real limit(Bodies& bodies, Vec2 gravity, real h, real carried) const {
    // With a share s of the change: before + linear s + quadratic s^2, of which the surfaces give their share.
    real before = real(0), linear = real(0), quadratic = real(0);
    for (Bodies::Each each = Bodies::Each::of(bodies.moving); each.next();) {
      int i = each.shape;
      real mass = Math::inverse_or_zero(bodies.inverse_mass(i));
      real inertia = Math::inverse_or_zero(bodies.inverse_inertia(i));
      Vec2 v = midway(bodies, i, velocity[i], gravity, h), dv = bodies.velocity(i) - velocity[i];
      real dw = bodies.omega(i) - omega[i];
      before += real(0.5) * (mass * v.dot(v) + inertia * omega[i] * omega[i]) - mass * gravity.dot(bodies.delta(i));
      linear += mass * v.dot(dv) + inertia * omega[i] * dw;
      quadratic += real(0.5) * (mass * dv.dot(dv) + inertia * dw * dw);
    }
    linear -= carried;
    real after = before + linear + quadratic;
    if (after <= max_energy * (real(1) + ENERGY_ROUNDING)) return real(1);
    real energy_left = Math::max(max_energy - before, real(0));
    real root = sqrtf(linear * linear + real(4) * quadratic * energy_left);
    real share = quadratic > real(0) ? Math::clamp((root - linear) / (real(2) * quadratic), real(0), real(1)) : real(1);
    for (Bodies::Each each = Bodies::Each::of(bodies.moving); each.next();) {
      int i = each.shape;
      bodies.set_velocity(i, velocity[i] + (bodies.velocity(i) - velocity[i]) * share);
      bodies.set_omega(i, omega[i] + (bodies.omega(i) - omega[i]) * share);
    }
    return share;
  }

  KFN static Vec2 midway(const Bodies& bodies, int i, Vec2 velocity, Vec2 gravity, real h) {
    return bodies.inverse_mass(i) > real(0) ? velocity + gravity * (real(0.5) * h) : velocity;
  }
};
