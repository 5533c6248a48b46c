// Exact line search over what contacts of an island with joints have got in a pass with bias (docs/engine_solver.md).
//
// A contact pushes as if it moved its two bodies alone. Joints answer, and its speed is another one then: that of a light
// roller below a lift is nearly what it was. So all impulses that contacts of an island have got in the pass, and what
// joints answer to them, are taken 1 + more times, such that the energy of what is still wrong is least:
//
//   (1 + more) d M d = -(impulses) (what was wrong before)
//
// where d is what contacts have changed of velocities, projected onto what joints allow. That is the same whatever the
// order of contacts, and is never worse than what they left. No row leaves its bounds: contacts do not pull, motors give
// what they have. Impacts know their joints already (Contacts::solve_impact): islands with one stay as they are.

struct LineSearch {
  ARRAY(real, impulse, NUM_JOINTS > 0 ? NUM_CONTACTS + 1 : 1);  // that each contact has got
  // Of each island, at its first body, J: impulses times what was wrong before, but for half of what contacts change of each
  // other; then how much more the island takes.
  ARRAY(real, slope, NUM_JOINTS > 0 ? ISLAND_SHAPES : 1);
  ARRAY(real, curve, NUM_JOINTS > 0 ? ISLAND_SHAPES : 1);  // impulses times what a further one would change, J
  ARRAY(real, most, NUM_JOINTS > 0 ? ISLAND_SHAPES : 1);   // that it may take more
  Velocities given;  // to bodies, from rest: the difference of two velocities would have their rounding
  const int* first;  // of each body's island
  const unsigned int* jointed;  // a bit an island
  bool is_called_for, is_found;

  KFN void begin(const Bodies& bodies, const int* first_of_island, const unsigned int* with_joints) {
    first = first_of_island;
    jointed = with_joints;
    given.clear(bodies.moving);
    for (Bodies::Each each = Bodies::Each::of(bodies.moving); each.next();) {
      slope[each.shape] = curve[each.shape] = real(0);
      most[each.shape] = FAR_DISTANCE;
    }
  }

  // Of two bodies; -1: it has no joints, and is not searched.
  KFN int island_of(const Bodies& bodies, int a, int b) const {
    int island = first[bodies.is_dynamic(a) ? a : b];
    return Bodies::has(jointed, island) ? island : -1;
  }

  // An impulse, of `total` that its contact has; `wrong` has half of what it changes, and `yields` is the speed at which the
  // contact yields to a unit.
  KFN void add(int island, real change, real total, real wrong, real yields) {
    is_called_for = true;
    slope[island] = Fused::of(change, wrong, slope[island]);
    curve[island] = Fused::of(yields * change, change, curve[island]);
    if (change < real(0)) most[island] = Math::min(most[island], total / -change);
  }

  // Of an impact, which knows its joints already.
  KFN void leave_out(int island) { most[island] = real(-1); }

  // Joints have answered: `slope` is how much more each island takes from here on, and bodies get that of what contacts gave.
  KFN void find(Bodies& bodies) {
    is_found = true;
    for (Bodies::Each each = Bodies::Each::of(bodies.moving); each.next();) {
      int i = each.shape, island = first[i];
      if (slope[island] == real(0)) continue;
      Vec2 v = given.velocity[i];
      real w = given.omega[i];
      real moved = bodies.mass(i) * v.dot(v) + Math::inverse_or_zero(bodies.inverse_inertia(i)) * w * w;
      slope[island] -= real(0.5 + LEAST_CURVE) * moved;
      curve[island] += real(1 + LEAST_CURVE) * moved;
    }
    for (Bodies::Each each = Bodies::Each::of(jointed); each.next();) {
      int i = each.shape;
      bool searches = slope[i] != real(0) && curve[i] > real(0) && most[i] >= real(0);
      slope[i] = searches ? Math::clamp(-(slope[i] + curve[i]) / curve[i], real(-1), most[i]) : real(0);
    }
    for (Bodies::Each each = Bodies::Each::of(bodies.moving); each.next();) {
      int i = each.shape;
      real more = slope[first[i]];
      if (more == real(0)) continue;
      bodies.set_velocity(i, bodies.velocity(i) + given.velocity[i] * more);
      bodies.set_omega(i, Fused::of(more, given.omega[i], bodies.omega(i)));
    }
  }
};
