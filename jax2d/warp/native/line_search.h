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
  // other; and what softness takes of them.
  ARRAY(real, slope, NUM_JOINTS > 0 ? ISLAND_SHAPES : 1);
  ARRAY(real, yielded, NUM_JOINTS > 0 ? ISLAND_SHAPES : 1);
  Velocities given;  // to bodies, from rest: the difference of two velocities would have their rounding

  KFN void begin(const Bodies& bodies) {
    given.clear(bodies.moving);
    for (Bodies::Each each = Bodies::Each::of(bodies.moving); each.next();) slope[each.shape] = yielded[each.shape] = real(0);
  }

  // An impulse; `wrong` has half of what it changes, and `yields` is the speed at which its contact yields to a unit.
  KFN void add(int island, real change, real wrong, real yields) {
    slope[island] = Fused::of(change, wrong, slope[island]);
    yielded[island] = Fused::of(yields * change, change, yielded[island]);
  }

  // Of an impact, which knows its joints already.
  KFN void leave_out(int island) { slope[island] = FAR_DISTANCE; }

  KFN bool is_called_for(int island) const { return slope[island] != real(0) && slope[island] < real(0.5) * FAR_DISTANCE; }
};
