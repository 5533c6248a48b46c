// Islands: bodies that contacts, joints and springs join, directly or by others that can be pushed.
// What holds takes energy from an island, or none. Where one has more kinetic energy once it is relaxed than the sub-step
// began with, when forces had acted and nothing had been solved, impulses are not solved yet, or warm-start impulses from
// another place of the bodies are far off; bodies that jam do that. It is solved again, alone, and where that does not help
// its energy is bounded.

struct Islands {
  ARRAY(int, first, ISLAND_SHAPES);        // the first body of the island of each
  ARRAY(Vec2, drift, ISLAND_SHAPES);       // m/s, of an island that nothing fixed holds: of its centre of mass when it was found
  ARRAY(real, gain, ISLAND_SHAPES);        // J, what an island has gained, at its first body
  ARRAY(real, work, ISLAND_SHAPES);        // J, that motors, springs and what carries have done to it
  ARRAY(Vec2, velocity, ISLAND_SHAPES);    // of each, when forces had acted and nothing had been solved
  ARRAY(real, omega, ISLAND_SHAPES);
  ARRAY(unsigned int, anchored, SHAPE_WORDS);  // a bit an island, at its first body: it is held by what cannot be pushed

  // Contacts of `which` have been found.
  KFN void find(const Bodies& bodies, const Contacts& contacts, const Joints& joints, const unsigned int* which) {
    for (int i = 0; i < ISLAND_SHAPES; ++i) first[i] = i;
    for (int k = 0; k < contacts.count; ++k) join(bodies, contacts.list[k].a, contacts.list[k].b);
    for (int k = 0; k < joints.count; ++k) join(bodies, joints.list[k].a, joints.list[k].b);
    for (int k = 0; k < joints.springs.count; ++k) join(bodies, joints.springs.a_of(k), joints.springs.b_of(k));
    for (Bodies::Each each = Bodies::Each::of(bodies.moving); each.next();) first[each.shape] = first_of(each.shape);
    Bodies::clear(anchored);
    for (int k = 0; k < contacts.count; ++k) anchor(bodies, contacts.list[k].a, contacts.list[k].b);
    for (int k = 0; k < joints.count; ++k) anchor(bodies, joints.list[k].a, joints.list[k].b);
    for (int k = 0; k < joints.springs.count; ++k) anchor(bodies, joints.springs.a_of(k), joints.springs.b_of(k));
    find_drift(bodies, which);
  }

  // Islands that nothing fixed holds are as free to move as any: what they gain or may have is not to depend on that.
  KFN void find_drift(const Bodies& bodies, const unsigned int* which) {
    for (Bodies::Each each = Bodies::Each::of(which); each.next();) {
      drift[each.shape] = {real(0), real(0)};
      gain[each.shape] = real(0);  // kg, here
    }
    for (Bodies::Each each = Bodies::Each::of(which); each.next();) {
      int i = each.shape, island = first[i];
      if (Bodies::has(anchored, island)) continue;
      drift[island] = drift[island].plus(bodies.velocity(i), bodies.mass(i));
      gain[island] += bodies.mass(i);
    }
    for (Bodies::Each each = Bodies::Each::of(which); each.next();) {
      int i = each.shape;
      if (gain[i] > real(0)) drift[i] = drift[i] * Fast::reciprocal(gain[i]);
    }
  }

  // J, of body i in its island.
  KFN real kinetic_energy(const Bodies& bodies, int i, Vec2 v, real w) const {
    return bodies.kinetic_energy(i, v - drift[first[i]], w);
  }

  KFN void anchor(const Bodies& bodies, int a, int b) {
    if (!bodies.is_dynamic(a) || !bodies.is_dynamic(b)) Bodies::add(anchored, of(bodies, a, b));
  }

  // Bounds the energy of islands of `which` that no pass has brought to rest: their bodies get the share of all that contacts
  // and joints have changed in the sub-step that leaves them what they may have. Impulses of contacts and springs, for the next
  // warm start, keep more: what presses goes on to press.
  KFN void limit_gains(Bodies& bodies, Contacts& contacts, Joints& joints, real h, const unsigned int* which) {
    unsigned int members[SHAPE_WORDS];
    for (Bodies::Each each = Bodies::Each::of(which); each.next();) {
      int island = each.shape;
      if (first[island] != island) continue;
      list(bodies, island, members);
      Turn turn = {{real(0), real(0)}, real(0)};
      if (!Bodies::has(anchored, island)) turn = turn_of_start(bodies, island, members);
      Change change = change_of(bodies, members, turn, h);
      change.linear -= work[island];
      real share = change.share(change.room);
      for (Bodies::Each member = Bodies::Each::of(members); member.next();) {
        int i = member.shape;
        Vec2 v = start_velocity(bodies, i, turn);
        real w = omega[i] + turn.omega;
        bool has_any = share > real(0);  // what is not finite has none
        bodies.set_velocity(i, has_any ? v + (bodies.velocity(i) - v) * share : v);
        bodies.set_omega(i, has_any ? w + (bodies.omega(i) - w) * share : w);
      }
      gain[island] = change.share(change.room + KEPT_GAIN * change.mass);
    }
    for (int k = 0; k < contacts.count; ++k) {
      int a = contacts.list[k].a, b = contacts.list[k].b;
      if (Bodies::has(which, bodies.is_dynamic(a) ? a : b)) contacts.scale_impulses(k, gain[of(bodies, a, b)]);
    }
    for (int k = 0; k < joints.springs.count; ++k) {
      int a = joints.springs.a_of(k), b = joints.springs.b_of(k);
      if (Bodies::has(which, bodies.is_dynamic(a) ? a : b)) joints.springs.scale_impulses(k, gain[of(bodies, a, b)]);
    }
  }

  // Of an island as one piece.
  struct Turn {
    Vec2 centre;
    real omega;
  };

  // By which an island that nothing holds would have begun the sub-step with the angular momentum that it has now: bodies have
  // moved since. None where a body cannot turn or be shifted.
  KFN Turn turn_of_start(const Bodies& bodies, int island, const unsigned int* members) const {
    real mass = real(0), inertia = real(0), momentum = real(0);
    Vec2 origin = place(bodies, island), shift = {real(0), real(0)};
    for (Bodies::Each each = Bodies::Each::of(members); each.next();) {
      int i = each.shape;
      if (bodies.inverse_mass(i) == real(0) || bodies.inverse_inertia(i) == real(0)) return {origin, real(0)};
      mass += bodies.mass(i);
      shift = shift.plus(place(bodies, i) - origin, bodies.mass(i));
    }
    Vec2 centre = origin.plus(shift, Fast::reciprocal(mass));
    for (Bodies::Each each = Bodies::Each::of(members); each.next();) {
      int i = each.shape;
      Vec2 arm = place(bodies, i) - centre;
      real own = Math::inverse_or_zero(bodies.inverse_inertia(i));
      inertia += own + bodies.mass(i) * arm.dot(arm);
      momentum += own * (bodies.omega(i) - omega[i]) + bodies.mass(i) * arm.cross(bodies.velocity(i) - velocity[i]);
    }
    return {centre, Fast::divide(momentum, inertia)};
  }

  KFN static Vec2 place(const Bodies& bodies, int i) { return bodies.position[i] + bodies.delta(i); }

  KFN Vec2 start_velocity(const Bodies& bodies, int i, const Turn& turn) const {
    return velocity[i].plus((place(bodies, i) - turn.centre).left(), turn.omega);
  }

  // Of an island's velocities: a share s of it changes the energy by linear s + quadratic s^2, J, of which motors and what
  // carries give theirs. `room`: J, by which it may.
  struct Change {
    real mass, linear, quadratic, room;

    // The largest that stays within `most`, J; in a form that loses no digits where the change is far too large.
    KFN real share(real most) const {
      if (!(quadratic > real(0))) return real(1);
      real half = real(0.5) * Fast::divide(linear, quadratic), r = Fast::divide(most, quadratic);
      real root = Fast::root(Math::max(half * half + r, real(0)));
      real share = half > real(0) ? Fast::divide(r, root + half) : root - half;
      return share > real(0) ? Math::min(share, real(1)) : real(0);
    }
  };

  // Since the sub-step began.
  KFN Change change_of(const Bodies& bodies, const unsigned int* members, const Turn& turn, real h) const {
    Change change = {real(0), real(0), real(0), real(0)};
    for (Bodies::Each each = Bodies::Each::of(members); each.next();) {
      int i = each.shape;
      Vec2 v = start_velocity(bodies, i, turn), dv = bodies.velocity(i) - v;
      real w = omega[i] + turn.omega, dw = bodies.omega(i) - w;
      change.mass += bodies.mass(i);
      change.linear += bodies.mass(i) * (v - drift[first[i]]).dot(dv) + Math::inverse_or_zero(bodies.inverse_inertia(i)) * w * dw;
      change.quadratic += bodies.kinetic_energy(i, dv, dw);
      change.room += may_have(bodies, i, h) - kinetic_energy(bodies, i, v, w);
    }
    return change;
  }

  // J, that the relax pass may leave body i, beside the work of motors, springs and what carries.
  KFN real may_have(const Bodies& bodies, int i, real h) const {
    return kinetic_energy(bodies, i, velocity[i], omega[i]) * (real(1) + h * SLACK_RATE) + h * SLACK_POWER * bodies.mass(i);
  }

  // Adds the other bodies of their islands to those of a set.
  KFN void complete(const Bodies& bodies, unsigned int* set) const {
    unsigned int chosen[SHAPE_WORDS];  // a bit an island, at its first body
    Bodies::clear(chosen);
    for (Bodies::Each each = Bodies::Each::of(set); each.next();) Bodies::add(chosen, first[each.shape]);
    for (Bodies::Each each = Bodies::Each::of(bodies.moving); each.next();)
      if (Bodies::has(chosen, first[each.shape])) Bodies::add(set, each.shape);
  }

  // Adds those whose contacts are found with theirs: the rest of their islands, kinematic bodies that these touch, and
  // islands on those.
  KFN void complete_groups(const Bodies& bodies, const Contacts& contacts, const Joints& joints, unsigned int* set) const {
    for (bool grows = true; grows;) {
      grows = false;
      complete(bodies, set);
      for (int k = 0; k < contacts.count && HAS_KINEMATIC_BODIES; ++k)
        grows |= links(bodies, contacts.list[k].a, contacts.list[k].b, set);
      for (int k = 0; k < joints.count && HAS_KINEMATIC_BODIES; ++k)
        grows |= links(bodies, joints.list[k].a, joints.list[k].b, set);
      for (int k = 0; k < joints.springs.count && HAS_KINEMATIC_BODIES; ++k)
        grows |= links(bodies, joints.springs.a_of(k), joints.springs.b_of(k), set);
    }
  }

  KFN static bool links(const Bodies& bodies, int a, int b, unsigned int* set) {
    if (!bodies.moves(a) || !bodies.moves(b) || Bodies::has(set, a) == Bodies::has(set, b)) return false;
    bodies.add_moving(set, a, b);
    return true;
  }

  // The bodies of one.
  KFN void list(const Bodies& bodies, int island, unsigned int* members) const {
    Bodies::clear(members);
    for (Bodies::Each each = Bodies::Each::of(bodies.moving); each.next();)
      if (first[each.shape] == island) Bodies::add(members, each.shape);
  }

  KFN int first_of(int i) const {
    while (first[i] != i) i = first[i];
    return i;
  }

  KFN void join(const Bodies& bodies, int a, int b) {
    if (!bodies.is_dynamic(a) || !bodies.is_dynamic(b)) return;
    a = first_of(a);
    b = first_of(b);
    first[a > b ? a : b] = a > b ? b : a;
  }

  // Of two bodies, one of which can be pushed; else it stands for nothing.
  KFN int of(const Bodies& bodies, int a, int b) const { return first[bodies.is_dynamic(a) ? a : b]; }

  // When forces have acted.
  KFN void begin(const Bodies& bodies) {
    for (Bodies::Each each = Bodies::Each::of(bodies.moving); each.next();) {
      int i = each.shape;
      velocity[i] = bodies.velocity(i);
      omega[i] = bodies.omega(i);
    }
  }

  // Adds what moving surfaces and kinematic bodies have done in this sub-step to what `energy` has at each island's first
  // body, J; `share` 1, or -1: takes it away.
  KFN void add_carried_work(const Bodies& bodies, const Contacts& contacts, const Joints& joints, real h, real share,
                            real* energy) const {
    for (int k = 0; k < contacts.count && HAS_KINEMATIC_BODIES + HAS_SURFACE_SPEED > 0; ++k)
      energy[of(bodies, contacts.list[k].a, contacts.list[k].b)] += share * contacts.surface_work(bodies, k, h);
    for (int k = 0; k < joints.count && HAS_KINEMATIC_BODIES; ++k)
      energy[of(bodies, joints.list[k].a, joints.list[k].b)] += share * joints.kinematic_work(bodies, k);
    for (int k = 0; k < joints.springs.count && HAS_KINEMATIC_BODIES; ++k)
      energy[of(bodies, joints.springs.a_of(k), joints.springs.b_of(k))] += share * joints.springs.kinematic_work(bodies, k);
  }

  // Marks the bodies of islands that have gained energy, of those marked where `again`. Returns whether there are any.
  KFN bool find_gains(const Bodies& bodies, const Contacts& contacts, const Joints& joints, real h, bool again,
                      unsigned int* gaining) {
    for (Bodies::Each each = Bodies::Each::of(bodies.moving); each.next();) gain[each.shape] = real(0);
    for (Bodies::Each each = Bodies::Each::of(bodies.moving); each.next();) {
      int i = each.shape;
      gain[first[i]] += kinetic_energy(bodies, i, bodies.velocity(i), bodies.omega(i)) - may_have(bodies, i, h);
    }
    bool any = false;
    for (Bodies::Each each = Bodies::Each::of(bodies.moving); each.next();) {
      int i = each.shape;
      work[i] = real(0);
      if (first[i] != i) continue;
      if (gain[i] <= real(0)) gain[i] = -FAR_DISTANCE;
      any |= gain[i] > real(0);
    }
    if (!any) return false;
    for (int k = 0; k < contacts.count; ++k)
      work[of(bodies, contacts.list[k].a, contacts.list[k].b)] += contacts.surface_work(bodies, k, h);
    for (int k = 0; k < joints.count; ++k) {
      int island = of(bodies, joints.list[k].a, joints.list[k].b);
      work[island] += joints.motor_work(bodies, k) + joints.kinematic_work(bodies, k);
    }
    for (int k = 0; k < joints.springs.count; ++k) {
      int island = of(bodies, joints.springs.a_of(k), joints.springs.b_of(k));
      work[island] += joints.springs.work(bodies, k) + joints.springs.kinematic_work(bodies, k);
    }
    unsigned int found[SHAPE_WORDS];
    Bodies::clear(found);
    any = false;
    for (Bodies::Each each = Bodies::Each::of(bodies.moving); each.next();) {
      int i = each.shape;
      if (gain[first[i]] <= work[first[i]] || (again && !Bodies::has(gaining, i))) continue;
      Bodies::add(found, i);
      any = true;
    }
    Bodies::copy(gaining, found);
    return any;
  }
};
