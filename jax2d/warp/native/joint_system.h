// Linear system of the joints of a world: three rows a joint, solved by block elimination (docs/engine_solver.md).
//
//   H x = r    a block a joint, coupled where two joints share a body that can be pushed
//
// Joints are numbered in the order of elimination: by minimum degree, so that trees have no fill-in and loops little.
// Everything here is relative to positions: it is factored once where the bodies stand, and solved for any velocities.

// Three numbers of a joint; two in kernels without welds, motors and limits.
struct Vec3 {
  real x, y, z;
  KFN Vec3 operator-() const { return {-x, -y, HELD_ROWS > 2 ? -z : real(0)}; }
  KFN real dot(Vec3 o) const {
    real xy = Fused::of(x, o.x, y * o.y);
    return HELD_ROWS > 2 ? Fused::of(z, o.z, xy) : xy;
  }
  KFN Vec3 plus(Vec3 o, real s) const {  // this + o * s
    return {Fused::of(o.x, s, x), Fused::of(o.y, s, y), HELD_ROWS > 2 ? Fused::of(o.z, s, z) : real(0)};
  }
};

// A symmetric matrix, and once it is factored L D L^T: inverses of D in its diagonal, L below.
struct Symmetric3 {
  real xx, xy, xz, yy, yz, zz;

  KFN Symmetric3 factored() const {
    real i0 = Fast::reciprocal(xx), l1 = xy * i0, i1 = Fast::reciprocal(Fused::of(-l1, xy, yy));
    if (HELD_ROWS == 2) return {i0, l1, real(0), i1, real(0), real(0)};
    real l2 = xz * i0, m = Fused::of(-l1, xz, yz), l3 = m * i1;
    return {i0, l1, l2, i1, l3, Fast::reciprocal(Fused::of(-l3, m, Fused::of(-l2, xz, zz)))};
  }

  // Once factored.
  KFN Vec3 solve(Vec3 v) const {
    real y = Fused::of(-xy, v.x, v.y);
    if (HELD_ROWS == 2) {
      y *= yy;
      return {Fused::of(-xy, y, v.x * xx), y, real(0)};
    }
    real z = Fused::of(-yz, y, Fused::of(-xz, v.x, v.z)) * zz;
    y = Fused::of(-yz, z, y * yy);
    return {Fused::of(-xz, z, Fused::of(-xy, y, v.x * xx)), y, z};
  }
};

// A matrix by rows.
struct Block {
  Vec3 x, y, z;

  KFN static Block of(const Symmetric3& m) { return {{m.xx, m.xy, m.xz}, {m.xy, m.yy, m.yz}, {m.xz, m.yz, m.zz}}; }

  KFN Vec3 times(Vec3 v) const { return {x.dot(v), y.dot(v), HELD_ROWS > 2 ? z.dot(v) : real(0)}; }
  KFN Vec3 transposed_times(Vec3 v) const {
    Vec3 sum = Vec3{x.x * v.x, x.y * v.x, x.z * v.x}.plus(y, v.y);
    return HELD_ROWS > 2 ? sum.plus(z, v.z) : sum;
  }
  // F^-1 of this, column by column.
  KFN Block solved(const Symmetric3& factored) const {
    Vec3 a = factored.solve({x.x, y.x, z.x}), b = factored.solve({x.y, y.y, z.y});
    Vec3 c = HELD_ROWS > 2 ? factored.solve({x.z, y.z, z.z}) : Vec3{real(0), real(0), real(0)};
    return {{a.x, b.x, c.x}, {a.y, b.y, c.y}, {a.z, b.z, c.z}};
  }
  // This less transposed(a) b.
  KFN Block minus(const Block& a, const Block& b) const {
    return {row_minus(x, a.x.x, a.y.x, a.z.x, b), row_minus(y, a.x.y, a.y.y, a.z.y, b),
            HELD_ROWS > 2 ? row_minus(z, a.x.z, a.y.z, a.z.z, b) : z};
  }
  KFN static Vec3 row_minus(Vec3 row, real ax, real ay, real az, const Block& b) {
    row = row.plus(b.x, -ax).plus(b.y, -ay);
    return HELD_ROWS > 2 ? row.plus(b.z, -az) : row;
  }
};

// Rows of a joint as its bodies stand: speeds of b seen from a along two directions at the common point, and about it. Of a
// hinge or weld they are those of the world, and the third row is the turn: that of a motor, limits or a weld. Of a slider they
// are across and along its axis, and the third row is that along it. Of a rope or rod it is that along its line, and no other
// row is held.
struct JointRows {
  Vec2 levers_a, levers_b;  // about both centres, of the two directions
  Vec2 axis;       // of a slider, a rope or a rod
  bool is_slider;  // known when compiled, where there are none
  real third;      // 1 where the third row is held
  real is_weld;    // 1 where it yields; under a load a motor would creep
  bool is_rod;     // or a rope

  // From lever arms about both centres to the common point.
  KFN static JointRows of(Vec2 a, Vec2 b, real third, real is_weld) {
    return {{-a.y, a.x}, {-b.y, b.x}, {real(0), real(0)}, false, third, is_weld, false};
  }
  KFN static JointRows of_slider(Vec2 a, Vec2 b, Vec2 axis, real third, bool is_rod) {
    Vec2 across = axis.left();
    return {{a.cross(across), a.cross(axis)}, {b.cross(across), b.cross(axis)}, axis, true, third, real(0), is_rod};
  }
  // 1 where the first two rows are held.
  KFN real others() const { return HAS_RODS && is_rod ? real(0) : real(1); }

  // A vector of the world along the two directions, and back.
  KFN Vec2 along(Vec2 v) const { return is_slider ? Vec2{axis.left().dot(v), axis.dot(v)} : v; }
  KFN Vec2 of_world(Vec2 v) const { return is_slider ? (axis.left() * v.x).plus(axis, v.y) : v; }
  // Two directions and a turn in the order of the rows, and rows as these.
  KFN Vec3 ordered(Vec2 v, real turn) const {
    if (is_slider) return {v.x, turn, HELD_ROWS > 2 ? v.y : real(0)};
    return {v.x, v.y, HELD_ROWS > 2 ? turn : real(0)};
  }

  KFN static real turning(const Pair& pair) { return pair.omega_b - pair.omega_a; }
  KFN Vec2 at_point(const Pair& pair) const {
    Vec2 v = along(pair.velocity_b - pair.velocity_a);
    return {Fused::of(-levers_a.x, pair.omega_a, Fused::of(levers_b.x, pair.omega_b, v.x)),
            Fused::of(-levers_a.y, pair.omega_a, Fused::of(levers_b.y, pair.omega_b, v.y))};
  }
  KFN real axial_speed(const Pair& pair) const { return is_slider ? at_point(pair).y : turning(pair); }
  KFN Vec3 speeds(const Pair& pair) const {
    Vec3 all = ordered(at_point(pair), turning(pair));
    return {others() * all.x, others() * all.y, third * all.z};
  }

  KFN void push(Pair& pair, Vec3 impulse) const {
    Vec2 linear = {impulse.x, is_slider ? impulse.z : impulse.y};
    real turn = is_slider ? impulse.y : impulse.z;
    real angular_a = Fused::of(levers_a.x, linear.x, levers_a.y * linear.y);
    real angular_b = Fused::of(levers_b.x, linear.x, levers_b.y * linear.y);
    if (HELD_ROWS > 2 || is_slider) {
      angular_a += turn;
      angular_b += turn;
    }
    pair.apply_levers(of_world(linear), angular_a, angular_b);
  }

  KFN static real moved(const Pair& pair, real da, real ea, real db, real eb, real linear) {
    return Fused::of(pair.inverse_inertia_a * da, ea, Fused::of(pair.inverse_inertia_b * db, eb, linear));
  }
  KFN real across(const Pair& pair) const {
    return moved(pair, levers_a.x, levers_a.x, levers_b.x, levers_b.x, pair.inverse_mass_a + pair.inverse_mass_b);
  }
  KFN real axial(const Pair& pair) const {
    if (!is_slider) return pair.inverse_inertia_a + pair.inverse_inertia_b;
    return moved(pair, levers_a.y, levers_a.y, levers_b.y, levers_b.y, pair.inverse_mass_a + pair.inverse_mass_b);
  }

  // What impulses of the rows change of their speeds, and by how much they yield.
  KFN Symmetric3 held(const Pair& pair) const {
    real none = real(0), mass = pair.inverse_mass_a + pair.inverse_mass_b;
    real xx = moved(pair, levers_a.x, levers_a.x, levers_b.x, levers_b.x, mass);
    real xy = moved(pair, levers_a.x, levers_a.y, levers_b.x, levers_b.y, none);
    real yy = moved(pair, levers_a.y, levers_a.y, levers_b.y, levers_b.y, mass);
    Vec2 turned = (levers_a * pair.inverse_inertia_a).plus(levers_b, pair.inverse_inertia_b);
    real turn = pair.inverse_inertia_a + pair.inverse_inertia_b;
    Symmetric3 m = {xx, xy, turned.x, yy, turned.y, turn};
    if (is_slider) m = {xx, turned.x, xy, turn, turned.y, yy};
    if (HAS_RODS && is_rod) m = {none, none, none, none, none, yy};
    if (HELD_ROWS == 2 || third == none) m.xz = m.yz = m.zz = none;
    Vec3 more = yielding(pair, {real(1), real(1), real(1)});
    if (HAS_RODS && is_rod) more.z = JOINT_COMPLIANCE * mass;  // of two rounds the second makes good what this leaves
    real rounding = JOINT_ROUNDING * (m.xx + (is_slider ? none : m.yy));
    return {with(m.xx, more.x + rounding), m.xy, m.xz, with(m.yy, more.y + (is_slider ? JOINT_ROUNDING * m.yy : rounding)),
            m.yz, with(m.zz, more.z + JOINT_ROUNDING * m.zz)};
  }
  // A row that nothing can move, or that is not held, has no impulse.
  KFN static real with(real diagonal, real more) { return diagonal > real(0) ? diagonal + more : FAR_DISTANCE; }

  // Speeds at which the rows yield to their impulses.
  KFN Vec3 yielding(const Pair& pair, Vec3 impulse) const {
    real mass = JOINT_COMPLIANCE * (pair.inverse_mass_a + pair.inverse_mass_b);
    real turned = JOINT_COMPLIANCE * (pair.inverse_inertia_a + pair.inverse_inertia_b);
    return {mass * impulse.x, (is_slider ? turned : mass) * impulse.y,
            HELD_ROWS > 2 ? is_weld * turned * impulse.z : real(0)};
  }
};

// One side of two joints' rows at a body that they share: what impulses of the one change of the other.
struct JointSide {
  const JointRows& rows;
  Vec2 levers;
  real sign;  // b is pushed by what the rows say, a by its opposite

  KFN static JointSide of(const JointRows& rows, bool is_b) {
    return {rows, is_b ? rows.levers_b : -rows.levers_a, is_b ? real(1) : real(-1)};
  }
  // What impulses of the other's rows change of this one's speed along one of its directions, which in the other's are
  // `cosines`; of its turn, where these are zero.
  KFN Vec3 moved(Vec2 cosines, real lever, const JointSide& o, real mass, real inertia) const {
    real turned = inertia * lever;
    Vec3 all = o.rows.ordered({Fused::of(turned, o.levers.x, mass * cosines.x), Fused::of(turned, o.levers.y, mass * cosines.y)},
                              turned * o.sign);
    return {o.rows.others() * all.x, o.rows.others() * all.y, o.rows.third * all.z};
  }
  KFN void add_coupling(Block& block, const JointSide& o, real mass, real inertia) const {
    real none = real(0), same = sign * o.sign;
    Vec2 first = {same, none}, second = {none, same};
    if (rows.is_slider || o.rows.is_slider) {
      first = o.rows.along(rows.of_world(first));
      second = o.rows.along(rows.of_world(second));
    }
    Vec3 x = moved(first, levers.x, o, mass, inertia), y = moved(second, levers.y, o, mass, inertia);
    Vec3 turn = HELD_ROWS > 2 || rows.is_slider ? moved({none, none}, sign, o, mass, inertia) : Vec3{none, none, none};
    block.x = block.x.plus(x, rows.others());
    block.y = block.y.plus(rows.is_slider ? turn : y, rows.others());
    if (HELD_ROWS > 2) block.z = block.z.plus(rows.is_slider ? y : turn, rows.third);
  }
};

// What drives or bounds a joint along its axis. Its impulse is one number: a motor's, bounded, and beyond that what limits
// need so that the speed is between their bounds. So it has one of three speeds, and is held at it, or one of two impulses.
struct AxialRow {
  real lowest, highest;  // speeds that the limits allow
  real target;           // speed of the motor
  real least, most;      // impulses of the motor
  real impulse;          // to have where nothing is held
  int holds;
  bool is_still;  // a limit that holds still may pull

  enum { NOTHING, MOTOR, LOWER, UPPER };

  KFN bool is_limit() const { return holds >= LOWER; }
  KFN real speed() const {
    if (is_still && is_limit()) return Math::clamp(real(0), lowest, highest);
    return holds == LOWER ? lowest : (holds == UPPER ? highest : target);
  }
  // Impulse of the motor while a limit holds.
  KFN real pushing() const { return holds == LOWER ? (target > lowest ? most : least) : (target < highest ? least : most); }

  KFN void begin(real speed_now) {
    is_still = false;
    if (holds == MOTOR && !(target > lowest && target < highest && least < most)) holds = NOTHING;
    impulse = speed_now < target ? most : least;
    if (target <= lowest) impulse = least;
    if (target >= highest) impulse = most;
  }

  // Goes on to what is next to what it holds, if that cannot be with this speed and impulse. Returns whether it does.
  KFN bool choose(real speed_now, real total) {
    real above = highest, below = lowest;  // speeds at which something holds
    switch (holds) {
      case LOWER:
      case UPPER:
        if (lowest == highest || (holds == LOWER ? total >= pushing() : total <= pushing())) return false;
        return let_go(pushing());
      case MOTOR:
        return (total > most || total < least) && let_go(total > most ? most : least);
      default:
        if (least < most && impulse == most) above = Math::min(target, highest);
        if (least < most && impulse == least) below = Math::max(target, lowest);
        if (speed_now < below) holds = below == lowest ? LOWER : MOTOR;
        if (speed_now > above) holds = above == highest ? UPPER : MOTOR;
        return holds != NOTHING;
    }
  }
  KFN bool let_go(real impulse_left) {
    holds = NOTHING;
    impulse = impulse_left;
    return true;
  }

  // Bounds `most` so that as often a change of the impulse leaves what is held within what holds it.
  KFN void bound(real& most, real total, real change) const {
    if (holds == NOTHING || change == real(0)) return;
    bool is_up = change > real(0);
    real room = FAR_DISTANCE;
    if (holds == MOTOR) room = is_up ? this->most - total : total - least;
    if (holds == LOWER && !is_up) room = total - pushing();
    if (holds == UPPER && is_up) room = pushing() - total;
    most = Math::min(most, Math::max(room, real(0)) / Math::abs(change));
  }

  // Of rows that do not agree: a limit may pull for once, since nothing moves by it, and a motor has no more than it has.
  KFN void settle(real total) {
    is_still = true;
    if (holds == MOTOR) let_go(Math::clamp(total, least, most));
  }
};

// Bits of joints, one after another.
struct EachJoint {
  EachBit bits;
  int joint;
  KFN static EachJoint of(const unsigned int* words) { return {EachBit::of(words, JOINT_WORDS), -1}; }
  KFN bool next() { return bits.next(joint); }
};

struct JointSystem {
  ARRAY(int, order, NUM_JOINTS + 1);  // the joints' slots, as they are eliminated
  ARRAY(unsigned int, after, (NUM_JOINTS + 1) * JOINT_WORDS);  // a row a joint: those coupled with it that come later
  ARRAY(int, last, NUM_JOINTS + 1);                            // of the articulation of each
  ARRAY(Symmetric3, diagonal, NUM_JOINTS + 1);
  ARRAY(Block, above, NUM_JOINTS * (NUM_JOINTS - 1) / 2 + 1);  // block of a joint's row and a later one's column
  ARRAY(Vec3, bias, NUM_JOINTS + 1);  // speeds at which what is held goes wrong where its rows' speeds are zero
  ARRAY(Vec3, x, NUM_JOINTS + 1);  // right side, then solution
  ARRAY(Vec3, y, NUM_JOINTS + 1);  // a second one
  ARRAY(real, spent, LINE_SEARCH ? NUM_JOINTS + 1 : 1);  // of each its share of y H^-1 y of the second right side, J
  ARRAY(AxialRow, axial, HAS_AXES ? NUM_JOINTS + 1 : 1);  // of joints with a motor or limits
  int count;

  KFN unsigned int* after_of(int k) const { return after + k * JOINT_WORDS; }
  // Blocks of a joint's row stand one after another: where its first one is, and that with the column of a later joint.
  KFN static int first_block(int k) { return k * (2 * NUM_JOINTS - k - 1) / 2; }
  KFN int block(int k, int i) const { return first_block(k) + Bits::below(after_of(k), JOINT_WORDS, i); }
  KFN static bool has(const unsigned int* joints, int k) { return Bits::has(joints, JOINT_WORDS, k); }
  KFN static void add(unsigned int* joints, int k) { Bits::add(joints, JOINT_WORDS, k); }
  KFN static void remove(unsigned int* joints, int k) { Bits::remove(joints, JOINT_WORDS, k); }
  KFN static void clear(unsigned int* joints) { Bits::clear(joints, JOINT_WORDS); }
  KFN static bool has_all(const unsigned int* joints, const unsigned int* others) {
    unsigned int missing = 0u;
    for (int word = 0; word < JOINT_WORDS; ++word) missing |= others[word] & ~joints[word];
    return missing == 0u;
  }
  KFN static bool any(const unsigned int* joints) { return Bits::any(joints, JOINT_WORDS); }
  KFN static void add_all(unsigned int* joints, const unsigned int* others) {
    for (int word = 0; word < JOINT_WORDS; ++word) joints[word] |= others[word];
  }

  // Numbers `count` joints by minimum degree. Before, `order` holds their slots in any order, and `after` all that each is
  // coupled with.
  KFN void find_order() {
    unsigned int done[JOINT_WORDS];
    unsigned int links[(NUM_JOINTS + 1) * JOINT_WORDS];
    int slots[NUM_JOINTS + 1], rank[NUM_JOINTS + 1];
    clear(done);
    for (int i = 0; i < count * JOINT_WORDS; ++i) links[i] = after[i];
    for (int k = 0; k < count; ++k) slots[k] = order[k];
    for (int r = 0; r < count; ++r) {
      int best = next_of(links, done);
      add(done, best);
      rank[best] = r;
      order[r] = slots[best];
      // What was coupled with it is coupled with each other.
      const unsigned int* own = links + best * JOINT_WORDS;
      for (EachJoint each = EachJoint::of(own); each.next();) {
        unsigned int* other = links + each.joint * JOINT_WORDS;
        add_all(other, own);
        remove(other, best);
        remove(other, each.joint);
      }
    }
    for (int k = 0; k < count; ++k) {
      clear(after_of(rank[k]));
      for (EachJoint each = EachJoint::of(links + k * JOINT_WORDS); each.next();) add(after_of(rank[k]), rank[each.joint]);
    }
    for (int k = count - 1; k >= 0; --k) {
      EachJoint each = EachJoint::of(after_of(k));
      last[k] = each.next() ? last[each.joint] : k;
    }
  }

  // Of those not done the one that is coupled with fewest.
  KFN int next_of(const unsigned int* links, const unsigned int* done) const {
    int best = -1, fewest = count;
    for (int k = 0; k < count; ++k) {
      if (has(done, k)) continue;
      int degree = 0;
      for (EachJoint each = EachJoint::of(links + k * JOINT_WORDS); each.next();) ++degree;
      if (degree >= fewest) continue;
      best = k;
      fewest = degree;
    }
    return best;
  }

  // Eliminates the joints of `which`, whole articulations: right sides, one or `both`, and their matrix if it is new.
  KFN void eliminate(const unsigned int* which, bool is_new, bool both) {
    for (EachJoint k = EachJoint::of(which); k.next();) {
      Symmetric3 factor = is_new ? diagonal[k.joint].factored() : diagonal[k.joint];
      if (is_new) diagonal[k.joint] = factor;
      Vec3 own = factor.solve(x[k.joint]), second = both ? factor.solve(y[k.joint]) : own;
      x[k.joint] = own;
      if (both) {
        if (LINE_SEARCH) spent[k.joint] = y[k.joint].dot(second);
        y[k.joint] = second;
      }
      int column = first_block(k.joint);
      for (EachJoint i = EachJoint::of(after_of(k.joint)); i.next(); ++column) {
        Block of_i = above[column];
        x[i.joint] = x[i.joint].plus(of_i.transposed_times(own), real(-1));
        if (both) y[i.joint] = y[i.joint].plus(of_i.transposed_times(second), real(-1));
        if (!is_new) continue;
        Block solved = of_i.solved(factor), square = Block::of(diagonal[i.joint]).minus(solved, of_i);
        diagonal[i.joint] = {square.x.x, square.x.y, square.x.z, square.y.y, square.y.z, square.z.z};
        int next = column;
        for (EachJoint j = i; j.next();) {
          Block& pair = above[block(i.joint, j.joint)];
          pair = pair.minus(solved, above[++next]);
        }
      }
    }
  }

  // Solution for joint k, when those that come later have theirs.
  KFN Vec3 substitute(int k, bool both) {
    if (last[k] == k) return x[k];
    Vec3 right = {real(0), real(0), real(0)}, second = right;
    int column = first_block(k);
    for (EachJoint i = EachJoint::of(after_of(k)); i.next(); ++column) {
      Block of_i = above[column];
      right = right.plus(of_i.times(x[i.joint]), real(-1));
      if (both) second = second.plus(of_i.times(y[i.joint]), real(-1));
    }
    Vec3 solution = x[k].plus(diagonal[k].solve(right), real(1));
    x[k] = solution;
    if (both) y[k] = y[k].plus(diagonal[k].solve(second), real(1));
    return solution;
  }

  // What an impulse along the held axis of joint k changes of its speed, all that is held held. Takes the right sides.
  KFN real axial_inverse_mass(int k) {
    for (int i = k; i < count; ++i) x[i] = {real(0), real(0), i == k ? real(1) : real(0)};
    for (int i = k; i < count; ++i) {
      Vec3 own = diagonal[i].solve(x[i]);
      x[i] = own;
      int column = first_block(i);
      for (EachJoint j = EachJoint::of(after_of(i)); j.next(); ++column)
        x[j.joint] = x[j.joint].plus(above[column].transposed_times(own), real(-1));
    }
    for (int i = count - 1; i >= k; --i) substitute(i, false);
    return Math::inverse_or_zero(x[k].z);
  }
};
