// Islands: bodies that contacts, joints and springs join, directly or by others that can be pushed.
// What holds takes energy from an island, or none. Where one has more kinetic energy once it is relaxed than the sub-step
// began with, when forces had acted and nothing had been solved, impulses are not solved yet, or warm-start impulses from
// another place of the bodies are far off; bodies that jam, and arms at their limits, do that. It is solved again, alone.

struct Islands {
  ARRAY(int, first, ISLAND_SHAPES);        // the first body of the island of each
  ARRAY(real, max_energy, ISLAND_SHAPES);  // J, what may be left to each beside the work of motors, springs and what carries
  ARRAY(real, gain, ISLAND_SHAPES);        // J, what an island has beyond that, at its first body
  ARRAY(Vec2, velocity, ISLAND_SHAPES);    // of each, when forces had acted and nothing had been solved
  ARRAY(real, omega, ISLAND_SHAPES);
  ARRAY(unsigned int, anchored, SHAPE_WORDS);  // a bit an island, at its first body: it is held by what cannot be pushed

  KFN void find(const Bodies& bodies, const Contacts& contacts, const Joints& joints) {
    for (int i = 0; i < ISLAND_SHAPES; ++i) first[i] = i;
    for (int k = 0; k < contacts.count; ++k) join(bodies, contacts.list[k].a, contacts.list[k].b);
    for (int k = 0; k < joints.count; ++k) join(bodies, joints.list[k].a, joints.list[k].b);
    for (int k = 0; k < joints.springs.count; ++k) join(bodies, joints.springs.a_of(k), joints.springs.b_of(k));
    for (Bodies::Each each = Bodies::Each::of(bodies.moving); each.next();) first[each.shape] = first_of(each.shape);
    Bodies::clear(anchored);
    for (int k = 0; k < contacts.count; ++k) anchor(bodies, contacts.list[k].a, contacts.list[k].b);
    for (int k = 0; k < joints.count; ++k) anchor(bodies, joints.list[k].a, joints.list[k].b);
    for (int k = 0; k < joints.springs.count; ++k) anchor(bodies, joints.springs.a_of(k), joints.springs.b_of(k));
  }

  KFN void anchor(const Bodies& bodies, int a, int b) {
    if (!bodies.is_dynamic(a) || !bodies.is_dynamic(b)) Bodies::add(anchored, of(bodies, a, b));
  }

  // Resets all impulses on bodies of `which`, in islands. What is anchored gets the velocities that the sub-step began
  // with. Elsewhere that would change angular momentum, since bodies have moved: impulses are taken back where they are.
  KFN void reset_impulses(Bodies& bodies, Contacts& contacts, Joints& joints, const unsigned int* which) const {
    for (int k = 0; k < contacts.count; ++k) {
      int a = contacts.list[k].a, b = contacts.list[k].b;
      if (!Bodies::has(which, bodies.is_dynamic(a) ? a : b)) continue;
      Pair pair = Pair::reversed(bodies, a, b);
      contacts.apply_impulses(bodies, pair, k);
      pair.write_back(bodies);
      contacts.reset_impulses(k);
    }
    for (int k = 0; k < joints.count; ++k) {
      int a = joints.list[k].a, b = joints.list[k].b;
      if (!Bodies::has(which, bodies.is_dynamic(a) ? a : b)) continue;
      Pair pair = Pair::reversed(bodies, a, b);
      joints.apply_impulses(bodies, pair, k);
      pair.write_back(bodies);
      joints.reset_impulses(k);
    }
    for (int k = 0; k < joints.springs.count; ++k) {
      int a = joints.springs.a_of(k), b = joints.springs.b_of(k);
      if (!Bodies::has(which, bodies.is_dynamic(a) ? a : b)) continue;
      Pair pair = Pair::reversed(bodies, a, b);
      joints.springs.apply_impulses(bodies, pair, k);
      pair.write_back(bodies);
      joints.springs.reset_impulses(k);
    }
    for (Bodies::Each each = Bodies::Each::of(which); each.next();) {
      int i = each.shape;
      if (!Bodies::has(anchored, first[i])) continue;
      bodies.set_velocity(i, velocity[i]);
      bodies.set_omega(i, omega[i]);
    }
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
  KFN void begin(const Bodies& bodies, real h) {
    for (Bodies::Each each = Bodies::Each::of(bodies.moving); each.next();) {
      int i = each.shape;
      velocity[i] = bodies.velocity(i);
      omega[i] = bodies.omega(i);
      max_energy[i] = bodies.kinetic_energy(i) * (real(1) + h * SLACK_RATE) + h * SLACK_POWER * bodies.mass(i);
    }
  }

  // Marks the bodies of islands that have gained more than `spare` J/kg, of those marked where `again`. Returns whether
  // there are any.
  KFN bool find_gains(const Bodies& bodies, const Contacts& contacts, const Joints& joints, real h, real spare,
                      bool again, unsigned int* gaining) {
    for (Bodies::Each each = Bodies::Each::of(bodies.moving); each.next();) gain[each.shape] = real(0);
    for (Bodies::Each each = Bodies::Each::of(bodies.moving); each.next();) {
      int i = each.shape;
      gain[first[i]] += bodies.kinetic_energy(i) - max_energy[i] - spare * bodies.mass(i);
    }
    bool any = false;
    for (Bodies::Each each = Bodies::Each::of(bodies.moving); each.next();) {
      int i = each.shape;
      if (first[i] != i) continue;
      if (gain[i] <= real(0)) gain[i] = -FAR_DISTANCE;
      any |= gain[i] > real(0);
    }
    if (!any) return false;
    unsigned int held[SHAPE_WORDS];  // a bit an island, at its first body: a contact or a limit of a joint holds it
    Bodies::clear(held);
    for (int k = 0; k < contacts.count; ++k) {
      int island = of(bodies, contacts.list[k].a, contacts.list[k].b);
      Bodies::add(held, island);
      gain[island] -= contacts.surface_work(bodies, k, h);
    }
    for (int k = 0; k < joints.count; ++k) {
      int island = of(bodies, joints.list[k].a, joints.list[k].b);
      if (joints.is_at_limit(k)) Bodies::add(held, island);
      gain[island] -= joints.motor_work(bodies, k) + joints.kinematic_work(bodies, k);
    }
    for (int k = 0; k < joints.springs.count; ++k) {
      int island = of(bodies, joints.springs.a_of(k), joints.springs.b_of(k));
      gain[island] -= joints.springs.work(bodies, k) + joints.springs.kinematic_work(bodies, k);
    }
    unsigned int found[SHAPE_WORDS];
    Bodies::clear(found);
    any = false;
    for (Bodies::Each each = Bodies::Each::of(bodies.moving); each.next();) {
      int i = each.shape;
      if (gain[first[i]] <= real(0) || !Bodies::has(held, first[i]) || (again && !Bodies::has(gaining, i))) continue;
      Bodies::add(found, i);
      any = true;
    }
    for (int word = 0; word < SHAPE_WORDS; ++word) gaining[word] = found[word];
    return any;
  }
};
