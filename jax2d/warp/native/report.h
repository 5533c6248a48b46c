// What contacts did in the last step of a call, where an engine is built with report_contacts: rows of OUT, one slot a contact.
//
// Contacts may be found several times in a step. Impulses of one key add up, wherever in the step they acted, and a
// contact that is gone before the end keeps its slot, so that the sum over slots is all that bodies exchanged. They add
// up as vectors, since a contact found again may have another normal.

struct Report {
  IntColumn out;
  Column values;  // the same rows as floats
  int used, dropped;
  ARRAY(int, slot, REPORT_CONTACTS + 1);  // of each contact of the list, -1: none is free
  ARRAY(Vec2, acted, REPORT_CONTACTS + 1);  // normal and tangential impulse of it that has been counted, or is of an earlier step

  KFN void begin_step(const IntColumn& table) {
    out = table;
    values = {(float*)(table.data), table.stride};
    used = dropped = 0;
  }

  // Contacts have just been found, with impulses that have acted already.
  KFN void begin(const Contacts& contacts) {
    for (int i = 0; i < contacts.count; ++i) {
      const Contact& c = contacts.list[i];
      int s = 0;
      while (s < used && out.get(OUT_CONTACT_KEY + s) != c.key) ++s;
      if (s == CAPACITY_CONTACTS) {
        ++dropped;
        s = -1;
      } else if (s == used) {
        ++used;
        out.set(OUT_CONTACT_KEY + s, c.key);
        values.set2(OUT_CONTACT_IMPULSE + 2 * s, {real(0), real(0)});
      }
      slot[i] = s;
      acted[i] = {c.impulse_normal, c.impulse_tangent};
    }
  }

  // All warm-start impulses act again.
  KFN void warm_start(const Contacts& contacts) {
    for (int i = 0; i < contacts.count; ++i) acted[i] = {real(0), real(0)};
  }

  // Counts what has acted since the last time.
  KFN void add(const Contacts& contacts) {
    for (int i = 0; i < contacts.count; ++i) add(contacts.list[i], i, real(1));
  }

  // Of contact i; `share` of it was left to act.
  KFN void add(const Contact& c, int i, real share) {
    Vec2 now = {c.impulse_normal, c.impulse_tangent};
    if (slot[i] >= 0) {
      int row = OUT_CONTACT_IMPULSE + 2 * slot[i];
      Vec2 more = (now - acted[i]) * share;
      values.set2(row, values.get2(row) + c.normal * more.x + c.normal.right() * more.y);
    }
    acted[i] = now;
  }

  // Where contacts are, midway between both surfaces as their bodies stand.
  KFN void locate(const Bodies& bodies, const Contacts& contacts) {
    for (int i = 0; i < contacts.count; ++i) {
      const Contact& c = contacts.list[i];
      int s = slot[i];
      if (s < 0) continue;
      Vec2 moved = c.moved(bodies);
      Vec2 on_a = turned(c.arm_a, c.turn_of_a(bodies));
      Vec2 on_b = turned(c.arm_b, c.turn_of_b(bodies));
      Vec2 halfway = on_a + (bodies.position[c.b] - bodies.position[c.a] + moved + on_b - on_a) * real(0.5);
      values.set2(OUT_CONTACT_POINT + 2 * s, bodies.position[c.a] + bodies.delta(c.a) + halfway);
      values.set2(OUT_CONTACT_NORMAL + 2 * s, c.normal);
      values.set(OUT_CONTACT_SEPARATION + s, c.current_separation(bodies, moved));
    }
  }

  KFN static Vec2 turned(Vec2 arm, real turn) {
    return arm + arm.left() * Contact::sinf_small(turn) - arm * Contact::one_minus_cos_small(turn);
  }

  // What is not used is empty.
  KFN void end_step() {
    for (int s = used; s < CAPACITY_CONTACTS; ++s) {
      out.set(OUT_CONTACT_KEY + s, -1);
      values.set2(OUT_CONTACT_IMPULSE + 2 * s, {real(0), real(0)});
      values.set2(OUT_CONTACT_POINT + 2 * s, {real(0), real(0)});
      values.set2(OUT_CONTACT_NORMAL + 2 * s, {real(0), real(0)});
      values.set(OUT_CONTACT_SEPARATION + s, real(0));
    }
    out.set(OUT_CONTACT_DROPPED, dropped);
  }
};
