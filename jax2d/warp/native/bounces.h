// Restitution by islands: rounds of passes over an island's joints and contacts, and what they may not give it: more energy
// than it had when contacts were found, and motors, thrusters and moving surfaces have added since.
// Where several bodies, joints or friction share in an impact, restitution contact by contact may ask for more; then all
// of the island gets the same share of its change of velocity, so that joints and contacts stay solved.
//
// Energy is that of semi-implicit Euler, which keeps m |v + g h / 2|^2 / 2 - m g.x in free flight to the last digit.

struct Bounces {
  // J, allowed to each island, at its first body; zero of height is where each body was when contacts were found
  ARRAY(real, max_energy, BOUNCE_SHAPES);
  ARRAY(unsigned int, friction_applied, SHAPE_WORDS);  // a bit a shape whose bounces have had their friction

  // Contacts of `which` have been found.
  KFN void begin(const Bodies& bodies, const Islands& islands, const unsigned int* which, Vec2 gravity, real h) {
    for (Bodies::Each each = Bodies::Each::of(which); each.next();) max_energy[each.shape] = real(0);
    for (Bodies::Each each = Bodies::Each::of(which); each.next();) {
      int i = each.shape;
      Vec2 v = midway(bodies, i, bodies.velocity(i), gravity, h);
      max_energy[islands.first[i]] += bodies.kinetic_energy(i, v, bodies.omega(i));
    }
  }

  // Of motors, springs, thrusters and forces on `which` in this sub-step.
  KFN void add_work(const Bodies& bodies, const Joints& joints, const Thrusters& thrusters, const Column& controls,
                    const Islands& islands, const unsigned int* which, real h) {
    for (int k = 0; k < joints.count && HAS_MOTORS; ++k)
      add_work(which, islands.of(bodies, joints.list[k].a, joints.list[k].b), joints.motor_work(bodies, k));
    for (int k = 0; k < joints.springs.count; ++k)
      add_work(which, islands.of(bodies, joints.springs.a_of(k), joints.springs.b_of(k)), joints.springs.work(bodies, k));
    for (int k = 0; k < thrusters.count; ++k) add_work(which, islands.first[thrusters.body[k]], thrusters.work(bodies, k, h));
    for (Bodies::Each each = Bodies::Each::of(which); HAS_EXTERNAL_FORCES && each.next();)
      add_work(which, islands.first[each.shape], ExternalForces::work(bodies, each.shape, controls, h));
  }

  KFN void add_work(const unsigned int* which, int island, real work) {
    if (Bodies::has(which, island)) max_energy[island] += work;
  }

  // Where what was hit touches something that is hit next. `bouncing`: bodies of islands.
  KFN void pass_impacts_on(Bodies& bodies, Velocities& at_detection, Contacts& contacts, const Islands& islands,
                           const unsigned int* bouncing) {
    unsigned int passed[SHAPE_WORDS], island[SHAPE_WORDS];
    ImpactPropagation impacts = {contacts};
    if (!impacts.find_passed_on(bodies, bouncing, passed)) return;
    islands.complete(bodies, passed);
    at_detection.swap(bodies, passed);
    for (Bodies::Each each = Bodies::Each::of(passed); each.next();) {
      if (islands.first[each.shape] != each.shape) continue;
      islands.list(bodies, each.shape, island);
      impacts.propagate(bodies, island);
    }
    at_detection.swap(bodies, passed);
  }

  // Of islands of `bouncing` in which something does; false: none.
  KFN bool begin_rounds(const Bodies& bodies, Contacts& contacts, const Islands& islands, const unsigned int* bouncing,
                        bool is_last) {
    if (!contacts.find_bouncing(bodies, bouncing, contacts.active.now)) return false;
    islands.complete(bodies, contacts.active.now);
    contacts.active.is_restricted = true;
    for (int word = 0; word < SHAPE_WORDS; ++word) {
      contacts.unsettled[word] = friction_applied[word] = 0u;
      contacts.with_friction[word] = is_last ? contacts.active.now[word] : 0u;
    }
    return true;
  }

  // An island whose bounces have their speed gets friction in the next round, and is done where they still have it after
  // that. `is_last`: the next one is. False: all are done.
  KFN bool end_round(const Bodies& bodies, Contacts& contacts, const Islands& islands, bool is_last) {
    islands.complete(bodies, contacts.unsettled);
    bool any = false;
    for (int word = 0; word < SHAPE_WORDS; ++word) {
      unsigned int& going = contacts.active.now[word];
      unsigned int settled = ~contacts.unsettled[word];
      going &= ~(settled & friction_applied[word]);
      friction_applied[word] |= contacts.with_friction[word];
      contacts.with_friction[word] = going & ~friction_applied[word] & (is_last ? ~0u : settled);
      contacts.unsettled[word] = 0u;
      any |= going != 0u;
    }
    return any;
  }

  // Of islands of `bouncing`. `share`, at each island's first body: J that moving surfaces have done to what bounced,
  // negative, which is theirs to give; then the share of what bounces changed that is left.
  KFN void limit(Bodies& bodies, const Velocities& unbounced, const Contacts& contacts, const Islands& islands,
                 const unsigned int* bouncing, Vec2 gravity, real h, real* share) const {
    unsigned int bounced[SHAPE_WORDS], island[SHAPE_WORDS];
    contacts.find_bouncing(bodies, bouncing, bounced);
    islands.complete(bodies, bounced);
    for (Bodies::Each each = Bodies::Each::of(bodies.moving); each.next();) {
      int i = each.shape;
      if (islands.first[i] != i || !Bodies::has(bounced, i)) continue;
      islands.list(bodies, i, island);
      share[i] = limit_island(bodies, unbounced, island, max_energy[i], gravity, h, share[i]);
    }
  }

  // `given`: J, of the bounces' change that is not theirs: less the work of moving surfaces.
  KFN real limit_island(Bodies& bodies, const Velocities& unbounced, const unsigned int* island, real max_energy, Vec2 gravity,
                        real h, real given) const {
    Islands::Change change = {real(0), given, real(0), max_energy};
    for (Bodies::Each each = Bodies::Each::of(island); each.next();) {
      int i = each.shape;
      real mass = bodies.mass(i);
      real inertia = Math::inverse_or_zero(bodies.inverse_inertia(i));
      Vec2 was = unbounced.velocity[i], v = midway(bodies, i, was, gravity, h), dv = bodies.velocity(i) - was;
      real w = unbounced.omega[i], dw = bodies.omega(i) - w;
      change.room -= bodies.kinetic_energy(i, v, w) - mass * gravity.dot(bodies.delta(i));
      change.linear += mass * v.dot(dv) + inertia * w * dw;
      change.quadratic += bodies.kinetic_energy(i, dv, dw);
    }
    if (change.linear + change.quadratic <= change.room + ENERGY_ROUNDING * change.quadratic) return real(1);
    real share = change.share(Math::max(change.room, real(0)));
    for (Bodies::Each each = Bodies::Each::of(island); each.next();) {
      int i = each.shape;
      Vec2 v = unbounced.velocity[i];
      real w = unbounced.omega[i];
      bodies.set_velocity(i, v + (bodies.velocity(i) - v) * share);
      bodies.set_omega(i, w + (bodies.omega(i) - w) * share);
    }
    return share;
  }

  KFN static Vec2 midway(const Bodies& bodies, int i, Vec2 velocity, Vec2 gravity, real h) {
    return bodies.inverse_mass(i) > real(0) ? velocity + gravity * (real(0.5) * h) : velocity;
  }
};
