// Which pairs of shapes are near each other: their bounds overlap when widened by the margin of the pair, or by little more.
//
// They are found before any is looked at closely. The worlds of a GPU's warp run in lockstep: so each goes to its own
// next pair, where a loop over all pairs would have every world wait at each pair that is near in any of them.

struct Pairs {
  Sweep sweep;                                                  // in kernels of many shapes, else:
  ARRAY(unsigned int, rows, SWEEP ? 1 : NUM_SHAPES * TOUCH_WORDS + 1);  // row a, bit of slot b: near; only later slots

  // Those of bodies of `found`, with each other and with what is fixed. `reach` is the distance at which a contact is
  // prepared.
  KFN void find(const Bodies& bodies, const Geometry& geometry, const IntColumn& ints, real reach, bool ahead,
                const unsigned int* found) {
    if (SWEEP) sweep.find(bodies, geometry, reach, ahead);
    for (int a = 0; a < NUM_SHAPES; ++a) {
      for (int word = first_word(a); word < TOUCH_WORDS; word = next_word(a, word)) {
        unsigned int partners = 0u, near = 0u;
        if (bodies.is_active(a)) partners = (unsigned int)(ints.get(INTS_SHAPES_CAN_TOUCH + Slot::of(a) * TOUCH_WORDS + word));
        if (SWEEP) partners &= sweep.nearby(a, word);
        for (; partners != 0u; partners &= partners - 1u) {
          int slot_b = word * 32 + Math::lowest_bit(partners);
          if (!Slot::in_use(slot_b)) continue;
          int b = Slot::shape(slot_b);
          bool of_a = Bodies::has(found, a), of_b = Bodies::has(found, b);
          if ((!of_a && (!of_b || bodies.moves(a))) || (!of_b && bodies.moves(b))) continue;
          Vec2 d = bodies.position[b] - bodies.position[a], motion = bodies.velocity(b) - bodies.velocity(a);
          // At least its length, without a root: Contacts::find asks again with that, of few pairs.
          real speed = Math::abs(motion.x) + Math::abs(motion.y);
          if (geometry.bounds_overlap(a, b, d, margin(geometry, a, b, speed, reach, ahead)))
            near |= partners & (~partners + 1u);  // its lowest bit
        }
        row(a, word) = near;
      }
    }
  }

  // The words of row a that may hold a bit, in turn; TOUCH_WORDS or more after the last.
  KFN int first_word(int a) const { return SWEEP ? sweep.first_word(a) : Slot::of(a) / 32; }
  KFN int next_word(int a, int word) const { return SWEEP ? sweep.next_word(a, word) : word + 1; }
  KFN unsigned int& row(int a, int word) { return (SWEEP ? sweep.rows : rows)[a * TOUCH_WORDS + word]; }

  // A contact is prepared within `reach`, or within what both move against each other in a step, so that it does not end
  // inside; and within both for a body that could step over what is in its way. speed: of b against a.
  KFN static real margin(const Geometry& geometry, int a, int b, real speed, real reach, bool ahead) {
    if (!ahead) return reach;
    real travel = geometry.predicted_travel(a, b, speed);
    real safe = SAFE_CORE_SHARE * Math::min(geometry.core[a], geometry.core[b]);
    return travel > safe ? reach + travel : Math::max(reach, travel);
  }
};

// The pairs found, one after another, in the order of slots.
struct PairWalk {
  int a, word;
  unsigned int left;  // of the row

  KFN static PairWalk over(Pairs& pairs) {
    int word = pairs.first_word(0);
    return {0, word, word < TOUCH_WORDS ? pairs.row(0, word) : 0u};
  }

  // Goes to the next pair and gives the slot of b; -1 after the last.
  KFN int next_slot(Pairs& pairs) {
    while (left == 0u) {
      if (word < TOUCH_WORDS) word = pairs.next_word(a, word);
      if (word >= TOUCH_WORDS) {
        if (++a == NUM_SHAPES) return -1;
        word = pairs.first_word(a);
      }
      if (word < TOUCH_WORDS) left = pairs.row(a, word);
    }
    int slot_b = word * 32 + Math::lowest_bit(left);
    left &= left - 1u;
    return slot_b;
  }
};
