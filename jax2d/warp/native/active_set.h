// Bodies that an impact has moved. Passes over joints and contacts are repeated for what holds or touches them until none of
// these changes any more: an impact is shared out by all that it reaches, and costs nothing elsewhere.

struct ActiveSet {
  ARRAY(unsigned int, now, SHAPE_WORDS);
  ARRAY(unsigned int, next, SHAPE_WORDS);
  bool again;  // in a repeated pass
  ARRAY(unsigned int, only, SHAPE_WORDS);  // bodies that all passes are about, where `is_restricted`
  bool is_restricted;

  KFN void begin() {
    again = is_restricted = false;
    for (int word = 0; word < SHAPE_WORDS && SHARES_IMPACTS; ++word) next[word] = 0u;
  }

  KFN bool leaves_out(int a, int b) const {
    if (is_restricted && !Bodies::has(only, a) && !Bodies::has(only, b)) return true;
    return SHARES_IMPACTS && again && !Bodies::has(now, a) && !Bodies::has(now, b);
  }

  KFN void mark(const Bodies& bodies, int a, int b) {
    if (!SHARES_IMPACTS) return;
    if (bodies.is_dynamic(a)) Bodies::add(next, a);
    if (bodies.is_dynamic(b)) Bodies::add(next, b);
  }

  // In a repeated pass, of a joint or spring. `before`: m/s, of b from a, when it was come to.
  KFN void mark_if_moved(const Bodies& bodies, const Pair& pair, Vec2 before) {
    Vec2 change = pair.velocity_b - pair.velocity_a - before;
    if (SHARES_IMPACTS && again && change.dot(change) > SETTLED_SPEED * SETTLED_SPEED) mark(bodies, pair.a, pair.b);
  }

  // Whether another pass is called for; it is one over what was marked.
  KFN bool repeat() {
    again = false;
    if (!SHARES_IMPACTS) return false;
    for (int word = 0; word < SHAPE_WORDS; ++word) {
      again |= next[word] != 0u;
      now[word] = next[word];
      next[word] = 0u;
    }
    return again;
  }
};
