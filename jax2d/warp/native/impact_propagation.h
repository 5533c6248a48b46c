// Impacts that bodies pass on, as in a billiard break or in Newton's cradle: the speeds that their bounces aim at.

struct ImpactPropagation {
  Contacts& contacts;

  // Bodies that meet in one point pass an impact on; what else is solved together bounces as if it were one.
  KFN static bool passes_on(const Contact& c) { return c.b >= NUM_POLYGONS && c.max_impulse > real(0); }

  // Of bodies of `bouncing` those of what was hit and touches something that is hit next.
  KFN bool find_passed_on(const Bodies& bodies, const unsigned int* bouncing, unsigned int* passed) const {
    unsigned int hit[SHAPE_WORDS];
    Bodies::clear(hit);
    Bodies::clear(passed);
    for (int i = 0; i < contacts.count; ++i) {
      const Contact& c = contacts.list[i];
      if (passes_on(c) && c.bounce > real(0) && c.is_of(bouncing)) bodies.add_dynamic(hit, c.a, c.b);
    }
    bool any = false;
    for (int i = 0; i < contacts.count; ++i) {
      const Contact& c = contacts.list[i];
      if (!passes_on(c) || c.against_fixed || c.bounce > real(0) || c.restitution == real(0)) continue;
      if (!Bodies::has(hit, c.a) && !Bodies::has(hit, c.b)) continue;
      bodies.add_dynamic(passed, c.a, c.b);
      any = true;
    }
    return any;
  }

  // In one island, impact after impact, the fastest first, from the velocities with which bodies came, which it changes:
  // what that leaves of a contact's speed is what its bounce aims at. Impacts of one speed are one: a ball that meets two
  // alike goes straight on, whichever comes first in the list.
  KFN void propagate(Bodies& bodies, const unsigned int* island) {
    unsigned int once[SHAPE_WORDS], again[SHAPE_WORDS];
    Bodies::clear(once);
    Bodies::clear(again);
    real factor = real(1);  // the moment of the impact falls inside the step: its speed is that of the bounce
    for (int impact = 0; impact < MAX_IMPACTS; ++impact) {
      int fastest = -1;
      real speed = SETTLED_SPEED;
      for (int i = 0; i < contacts.count; ++i) {
        Contact& c = contacts.list[i];
        if (!passes_on(c) || !c.is_of(island)) continue;
        c.approach = c.normal_speed(bodies);
        if (-c.approach <= speed) continue;
        speed = -c.approach;
        fastest = i;
      }
      if (fastest < 0) break;
      const Contact& first = contacts.list[fastest];
      if (impact == 0 && first.bounce > real(0)) factor = Fast::divide(first.bounce, first.restitution * speed);
      unsigned int hit[SHAPE_WORDS];
      collide_at_once(bodies, island, (real(1) - SIMULTANEOUS_SHARE) * speed, hit);
      for (int word = 0; word < SHAPE_WORDS; ++word) {
        again[word] |= once[word] & hit[word];
        once[word] |= hit[word];
      }
    }
    for (int i = 0; i < contacts.count; ++i) {
      Contact& c = contacts.list[i];
      bool took_part = (bodies.is_dynamic(c.a) && Bodies::has(again, c.a)) || (bodies.is_dynamic(c.b) && Bodies::has(again, c.b));
      if (!passes_on(c) || !took_part) continue;
      real speed = c.normal_speed(bodies);
      c.bounce = speed > SETTLED_SPEED ? factor * speed : real(0);
      c.is_impact = true;  // its impulse does not last
    }
  }

  // What approaches at `speed` or faster in an island leaves with its restitution, all at once: pass after pass until no
  // contact changes by much. Marks its bodies.
  KFN void collide_at_once(Bodies& bodies, const unsigned int* island, real speed, unsigned int* hit) {
    real given[NUM_CONTACTS + 1];
    Bodies::clear(hit);
    bool is_settled = false;
    for (int pass = 0; pass < MAX_IMPACTS && !is_settled; ++pass) {
      is_settled = true;
      for (int i = 0; i < contacts.count; ++i) {
        const Contact& c = contacts.list[i];
        if (!passes_on(c) || !c.is_of(island) || -c.approach < speed) continue;
        if (pass == 0) given[i] = real(0);
        bodies.add_dynamic(hit, c.a, c.b);
        Pair pair = Pair::of(bodies, c.a, c.b);
        real wrong = c.normal.dot(pair.relative(c.arm_a, c.arm_b)) + c.restitution * c.approach;
        real total = Math::max(given[i] - wrong * pair.mass(c.arm_a, c.arm_b, c.normal), real(0));
        real impulse = total - given[i];
        given[i] = total;
        is_settled &= impulse == real(0) || Math::abs(wrong) < SIMULTANEOUS_SHARE * speed;
        pair.apply_impulse(c.arm_a, c.arm_b, c.normal * impulse);
        pair.write_back(bodies);
      }
    }
  }
};
