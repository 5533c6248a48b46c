// Bodies that a pass over joints and contacts is about: all of them, or those of islands that are solved again, or those that
// an impact has moved. The last are passed over until nothing that holds or touches them changes any more: an impact is
// shared out by all that it reaches, and costs nothing elsewhere.

struct ActiveSet {
  ARRAY(unsigned int, now, SHAPE_WORDS);  // where `is_restricted`
  ARRAY(unsigned int, moved, SHAPE_WORDS);  // of these, by an impact in the pass before
  ARRAY(unsigned int, next, SHAPE_WORDS);
  bool is_restricted;

  // With all bodies, or with some alone.
  KFN void begin(bool with_some, const unsigned int* some) {
    is_restricted = with_some;
    for (int word = 0; word < SHAPE_WORDS; ++word) {
      if (with_some) now[word] = some[word];
      if (SHARES_IMPACTS) moved[word] = next[word] = 0u;
    }
  }

  KFN bool leaves_out(int a, int b) const { return is_restricted && !Bodies::has(now, a) && !Bodies::has(now, b); }

  // Whether a pass over these is a repeated one, of an impact.
  KFN bool shares(int a, int b) const {
    return SHARES_IMPACTS && is_restricted && (Bodies::has(moved, a) || Bodies::has(moved, b));
  }

  KFN void mark(const Bodies& bodies, int a, int b) {
    if (SHARES_IMPACTS) bodies.add_dynamic(next, a, b);
  }

  // In a repeated pass, of a joint or spring. `before`: m/s, of b from a, when it was come to.
  KFN void mark_if_moved(const Bodies& bodies, const Pair& pair, Vec2 before) {
    Vec2 change = pair.velocity_b - pair.velocity_a - before;
    if (change.dot(change) > SETTLED_SPEED * SETTLED_SPEED) mark(bodies, pair.a, pair.b);
  }

  // Whether another pass is called for: over what was marked, if impacts are shared out further, and over `again`, whole
  // islands that are solved as if for the first time.
  KFN bool repeat(bool shares_further, const unsigned int* again) {
    bool any = false;
    for (int word = 0; word < SHAPE_WORDS; ++word) {
      now[word] = again[word];
      if (SHARES_IMPACTS) {
        moved[word] = shares_further ? next[word] & ~again[word] : 0u;
        next[word] = 0u;
        now[word] |= moved[word];
      }
      any |= now[word] != 0u;
    }
    is_restricted = true;
    return any;
  }
};
