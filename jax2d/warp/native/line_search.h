// Exact line search over what contacts of an island with joints have got in a pass with bias (docs/engine_solver.md).
//
// A contact pushes as if it moved its two bodies alone. Joints answer, and its speed is another one then: that of a light
// roller below a lift is nearly what it was. So all impulses that contacts of an island have got in the pass, and what
// joints answer to them, are taken 1 + more times, such that the energy of what is still wrong is least:
//
//   (1 + more) d M d = -(impulses) (what was wrong before)
//
// where d is what contacts have changed of velocities, projected onto what joints allow, and d M d includes what contacts
// yield. That is the same whatever the order of contacts. Contacts do not pull, and motors and limits stay within their
// bounds as far as they answer to contacts. Impacts know their joints already (Contacts::solve_impact): islands with one
// stay as they are.

struct LineSearch {
  ARRAY(real, impulse, SEARCHED_CONTACTS);  // that each contact has got
  // Of each island, at its first body, J: impulses times what was wrong before, but for half of what contacts change of each
  // other; then how much more the island takes.
  ARRAY(real, slope, SEARCHED_SHAPES);
  ARRAY(real, curve, SEARCHED_SHAPES);  // impulses times what a further one would change, J
  ARRAY(real, most, SEARCHED_SHAPES);   // that it may take more
  // What contacts have given to bodies, from rest: the difference of two velocities would have their rounding.
  ARRAY(Vec2, given_velocity, SEARCHED_SHAPES);
  ARRAY(real, given_omega, SEARCHED_SHAPES);
  ARRAY(unsigned int, jointed, SHAPE_WORDS);  // a bit an island: it has joints
  const int* first;  // of each body's island
  bool is_called_for, is_found;

  // An island has the number of its first body.
  KFN void begin(const Bodies& bodies, const int* first_of_island) {
    first = first_of_island;
    is_called_for = is_found = false;
    Bodies::clear(jointed);
    for (Bodies::Each each = Bodies::Each::of(bodies.moving); each.next();) {
      int i = each.shape;
      given_velocity[i] = {real(0), real(0)};
      given_omega[i] = slope[i] = curve[i] = real(0);
      most[i] = FAR_DISTANCE;
    }
  }

  KFN void add_joint(const Bodies& bodies, int a, int b) { Bodies::add(jointed, first[bodies.is_dynamic(a) ? a : b]); }

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

  // To bodies, of a contact's impulse. Returns by how much that changes the velocity of b against a at the contact.
  KFN Vec2 give(const Bodies& bodies, const Pair& masses, Arms arms, Vec2 impulse_on_b) {
    Pair pair = masses.at_rest();
    pair.apply_impulse(arms.a, arms.b, impulse_on_b);
    if (bodies.moves(pair.a)) {
      given_velocity[pair.a] = given_velocity[pair.a] + pair.velocity_a;
      given_omega[pair.a] += pair.omega_a;
    }
    if (bodies.moves(pair.b)) {
      given_velocity[pair.b] = given_velocity[pair.b] + pair.velocity_b;
      given_omega[pair.b] += pair.omega_b;
    }
    return pair.relative(arms.a, arms.b);
  }

  // What two bodies have been given.
  KFN Pair given(const Bodies& bodies, int a, int b) const {
    Pair pair = Pair::of(bodies, a, b).at_rest();
    if (bodies.moves(a)) pair.add_to(a, given_velocity[a], given_omega[a]);
    if (bodies.moves(b)) pair.add_to(b, given_velocity[b], given_omega[b]);
    return pair;
  }

  // Of an impact, which knows its joints already.
  KFN void leave_out(int island) { most[island] = real(-1); }

  // Joints have answered: `slope` is how much more each island takes from here on, and bodies get that of what contacts gave.
  KFN void find(Bodies& bodies) {
    is_found = true;
    for (Bodies::Each each = Bodies::Each::of(bodies.moving); each.next();) {
      int i = each.shape, island = first[i];
      if (slope[island] == real(0)) continue;
      Vec2 v = given_velocity[i];
      real w = given_omega[i];
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
      bodies.set_velocity(i, bodies.velocity(i) + given_velocity[i] * more);
      bodies.set_omega(i, Fused::of(more, given_omega[i], bodies.omega(i)));
    }
  }
};
