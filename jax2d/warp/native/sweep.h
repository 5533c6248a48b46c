// Which shapes are near each other, by sort and sweep: for kernels of many shapes (SWEEP, see ../source.py).
//
// Bounds are widened by each shape's share of what the pair's margin can be and sorted by their lower ends along one
// axis; each then meets those that begin before it ends. That costs n log n and one comparison for each pair that
// overlaps along the axis. What is found holds every pair that Pairs::find would find by testing them all, and
// contacts still come in the order of slots, so both searches give bitwise the same.

struct Sweep {
  struct Entry {
    real begin;
    int shape;
  };
  ARRAY(Sweep::Entry, sorted, SWEEP_SHAPES);
  ARRAY(Sweep::Entry, spare, SWEEP_SHAPES);  // the order stays from step to step, and then nearly right
  ARRAY(real, end, SWEEP_SHAPES);   // in sorted order, along the axis
  ARRAY(real, low, SWEEP_SHAPES);   // as `end` in sorted order, across the axis
  ARRAY(real, high, SWEEP_SHAPES);
  ARRAY(Vec2, lower, SWEEP_SHAPES);  // widened bounds, world frame, by shape
  ARRAY(Vec2, upper, SWEEP_SHAPES);
  ARRAY(unsigned int, rows, SWEEP_SHAPES * TOUCH_WORDS);  // a row a shape, a bit a later slot: may be near
  ARRAY(unsigned int, used, SWEEP_SHAPES);  // bit w: word w of the row holds a bit; the others are stale
  int count;

  // Active shapes, once a launch: those of unused slots all stand in one place.
  KFN void load(const Bodies& bodies) {
    count = 0;
    for (int i = 0; i < NUM_SHAPES; ++i)
      if (bodies.is_active(i)) sorted[count++].shape = i;
  }

  KFN void find(const Bodies& bodies, const Geometry& geometry, real reach, bool ahead) {
    for (int i = 0; i < SWEEP_SHAPES; ++i) used[i] = 0u;
    Vec2 common = mean_velocity(bodies);
    for (int k = 0; k < count; ++k) widen(bodies, geometry, sorted[k].shape, common, reach, ahead);
    bool along_x = fewer_overlap_along_x();
    for (int k = 0; k < count; ++k) sorted[k].begin = along_x ? lower[sorted[k].shape].x : lower[sorted[k].shape].y;
    sort();
    for (int k = 0; k < count; ++k) {
      Vec2 lo = lower[sorted[k].shape], hi = upper[sorted[k].shape];
      end[k] = along_x ? hi.x : hi.y;
      low[k] = along_x ? lo.y : lo.x;
      high[k] = along_x ? hi.y : hi.x;
    }
    for (int k = 0; k < count; ++k)
      for (int other = k + 1; other < count && sorted[other].begin <= end[k]; ++other)
        if (low[other] <= high[k] && high[other] >= low[k]) mark(sorted[k].shape, sorted[other].shape);
  }

  KFN Vec2 mean_velocity(const Bodies& bodies) const {
    Vec2 sum = {real(0), real(0)};
    for (int k = 0; k < count; ++k) sum = sum + bodies.velocity(sorted[k].shape);
    return sum * Fast::reciprocal((real)(count > 0 ? count : 1));
  }

  // Margins of pairs are at most the sum of both shapes' shares: half the reach, and how far the surface moves against
  // what moves at the `common` velocity, whichever that is.
  KFN void widen(const Bodies& bodies, const Geometry& geometry, int i, Vec2 common, real reach, bool ahead) {
    real share = real(0.5) * reach, way = common.length() * geometry.ahead;
    if (ahead) share += (bodies.velocity(i) - common).length() * geometry.ahead + geometry.swing[i];
    Vec2 at = bodies.position[i];
    // Neither search does sixteen roundings.
    real rounding = (Math::abs(at.x) + Math::abs(at.y) + geometry.extent[i] + share + (ahead ? way : real(0))) * SWEEP_ROUNDING;
    share += rounding;
    lower[i] = at + geometry.lower[i] - Vec2{share, share};
    upper[i] = at + geometry.upper[i] + Vec2{share, share};
    bool is_finite = upper[i].x - lower[i].x < real(1e30) && upper[i].y - lower[i].y < real(1e30);
    if (!is_finite) {  // near everything: the test of each pair decides
      lower[i] = {real(-3e38), real(-3e38)};
      upper[i] = {real(3e38), real(3e38)};
    }
  }

  // The axis for the sweep, judged by as many pairs as there are shapes. Pairs are drawn at random, since shapes in
  // neighbouring slots often stand in rows.
  KFN bool fewer_overlap_along_x() const {
    unsigned int random = 1u;
    int along_x = 0, along_y = 0;
    for (int k = 0; k < count; ++k) {
      random = random * 1664525u + 1013904223u;
      int a = sorted[k].shape, b = sorted[((random >> 16) * (unsigned int)(count)) >> 16].shape;
      along_x += lower[a].x <= upper[b].x && upper[a].x >= lower[b].x;
      along_y += lower[a].y <= upper[b].y && upper[a].y >= lower[b].y;
    }
    return along_x <= along_y;
  }

  // Natural merge sort: n log n at most, n when the order of the step before still holds.
  KFN void sort() {
    Entry* from = sorted;
    Entry* to = spare;
    while (run_from(from, 0) < count) {
      for (int start = 0; start < count;) {
        int middle = run_from(from, start), stop = run_from(from, middle);
        int a = start, b = middle;
        for (int k = start; k < stop; ++k)
          to[k] = b == stop || (a < middle && from[a].begin <= from[b].begin) ? from[a++] : from[b++];
        start = stop;
      }
      Entry* merged = to;
      to = from;
      from = merged;
    }
    if (from == spare)
      for (int k = 0; k < count; ++k) sorted[k] = spare[k];
  }

  // Where the ascending run that begins at `start` ends.
  KFN int run_from(const Entry* entries, int start) const {
    if (start >= count) return count;
    int k = start + 1;
    while (k < count && entries[k - 1].begin <= entries[k].begin) ++k;
    return k;
  }

  KFN void mark(int i, int j) {
    int a = i < j ? i : j, slot_b = Slot::of(i < j ? j : i);
    int word = slot_b / 32;
    unsigned int bit = 1u << (slot_b % 32), in_use = 1u << word;
    unsigned int& row = rows[a * TOUCH_WORDS + word];
    row = (used[a] & in_use) != 0u ? row | bit : bit;
    used[a] |= in_use;
  }

  // The words of row a that hold a bit, in turn; TOUCH_WORDS after the last.
  KFN int first_word(int a) const { return first_of(used[a]); }
  KFN int next_word(int a, int word) const { return first_of(used[a] & (~0u << word << 1)); }
  KFN static int first_of(unsigned int words) { return words != 0u ? Math::lowest_bit(words) : TOUCH_WORDS; }
  KFN unsigned int nearby(int a, int word) const { return rows[a * TOUCH_WORDS + word]; }
};
