// Plane vectors and small helpers.
//
// The files of this folder are concatenated in the order given in ../source.py into the body of one
// native function, so everything here is a local struct: no templates, no static data. Constants in
// capitals (NUM_SHAPES, PARAM_DT, ...) are generated there from the capacity and from ../layout.py.

typedef float real;
// All functions are inlined on a GPU. One that is called has the whole World in local memory, 1.2 KiB a thread: `this` points
// to it.
#if defined(__CUDA_ARCH__)
#define KFN CUDA_CALLABLE __forceinline__
#else
#define KFN CUDA_CALLABLE inline
#endif

// An array of a struct: in memory of its own, which ../source.py declares and points to. A GPU keeps what is used
// by an index in local memory, and with it all of the object that it is in: what is left of a struct is in registers.
#define ARRAY(type, name, size) type* name

// Loops of these files stay loops on a GPU. Unrolled, size L is 260 kB of code, more than the instruction caches of a
// multiprocessor hold, and every warp is somewhere else in it.
#if defined(__CUDA_ARCH__)
#define for _Pragma("unroll 1") for
#define while _Pragma("unroll 1") while
#endif

// a b + c, rounded once on a GPU: said here and not left to the compiler, which fuses other operations in every other kernel,
// so that kernels give other bits.
struct Fused {
  static KFN real of(real a, real b, real c) {
#if defined(__CUDA_ARCH__)
    return __fmaf_rn(a, b, c);
#else
    return a * b + c;
#endif
  }
};

// Off by at most two units in the last place and one instruction each on a GPU, where correct rounding takes eight to
// twenty and a call. The same in every kernel, as it is said here. Correctly rounded on a CPU.
struct Fast {
#if defined(__CUDA_ARCH__)
  static KFN real reciprocal(real v) {
    real out;
    asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(out) : "f"(v));
    return out;
  }
  static KFN real root(real v) {
    real out;
    asm("sqrt.approx.ftz.f32 %0, %1;" : "=f"(out) : "f"(v));
    return out;
  }
  static KFN real reciprocal_root(real v) {
    real out;
    asm("rsqrt.approx.ftz.f32 %0, %1;" : "=f"(out) : "f"(v));
    return out;
  }
  static KFN real divide(real a, real b) { return a * reciprocal(b); }
#else
  static KFN real reciprocal(real v) { return real(1) / v; }
  static KFN real root(real v) { return sqrtf(v); }
  static KFN real reciprocal_root(real v) { return real(1) / sqrtf(v); }
  static KFN real divide(real a, real b) { return a / b; }
#endif
};

struct Vec2 {
  real x, y;
  KFN Vec2 operator+(Vec2 o) const { return {x + o.x, y + o.y}; }
  KFN Vec2 operator-(Vec2 o) const { return {x - o.x, y - o.y}; }
  KFN Vec2 operator-() const { return {-x, -y}; }
  KFN Vec2 operator*(real s) const { return {x * s, y * s}; }
  KFN real dot(Vec2 o) const { return Fused::of(x, o.x, y * o.y); }
  KFN real cross(Vec2 o) const { return Fused::of(x, o.y, -(y * o.x)); }
  KFN Vec2 plus(Vec2 o, real s) const { return {Fused::of(o.x, s, x), Fused::of(o.y, s, y)}; }  // this + o * s
  KFN Vec2 minus(Vec2 o, real s) const { return plus(o, -s); }
  KFN Vec2 left() const { return {-y, x}; }   // rotated by +90 degrees: omega x r = r.left() * omega
  KFN Vec2 right() const { return {y, -x}; }  // rotated by -90 degrees
  KFN real length() const { return Fast::root(dot(*this)); }
};

struct Rotation {
  real c, s;
  KFN Vec2 apply(Vec2 v) const { return {Fused::of(c, v.x, -(s * v.y)), Fused::of(s, v.x, c * v.y)}; }
  // Turned by a small angle: third-order series, then normalised (error 3e-6 rad at 0.2 rad).
  KFN Rotation turned(real angle) const {
    real half = real(0.5) * angle * angle;
    real dc = real(1) - half, ds = angle * (real(1) - half * real(0.33333334));
    real nc = Fused::of(c, dc, -(s * ds)), ns = Fused::of(s, dc, c * ds);
    real inverse_length = Fast::reciprocal_root(Fused::of(nc, nc, ns * ns));
    return {nc * inverse_length, ns * inverse_length};
  }
};

// Change of a rotation that turns by a small angle, as Rotation::turned has it.
struct Turn {
  real c, s;  // cosine less 1, sine
  KFN static Turn by(real angle) {
    real half = real(0.5) * angle * angle;
    real dc = real(1) - half, ds = angle * (real(1) - half * real(0.33333334));
    real inverse_length = Fast::reciprocal_root(Fused::of(dc, dc, ds * ds));
    return {Fused::of(dc, inverse_length, real(-1)), ds * inverse_length};
  }
  KFN Vec2 chord(Vec2 v) const { return (v * c).plus(v.left(), s); }
};

// Shapes are numbered without the polygon slots that no scene of this kernel uses; a slot is where a shape stands in the
// tables. A kernel for all slots numbers them alike.
struct Slot {
  static KFN int of(int shape) { return shape < NUM_POLYGONS ? shape : shape + SKIPPED_POLYGONS; }
  static KFN int shape(int slot) { return slot < CAPACITY_POLYGONS ? slot : slot - SKIPPED_POLYGONS; }
  static KFN bool in_use(int slot) {
    return ALL_SHAPES || slot < NUM_POLYGONS || (slot >= CAPACITY_POLYGONS && slot < CAPACITY_POLYGONS + NUM_CIRCLES);
  }
};

struct Math {
  static KFN real min(real a, real b) { return a < b ? a : b; }
  static KFN real max(real a, real b) { return a > b ? a : b; }
  static KFN real abs(real v) { return v < real(0) ? -v : v; }
  static KFN real clamp(real v, real lo, real hi) { return v < lo ? lo : (v > hi ? hi : v); }
  static KFN real inverse_or_zero(real v) { return v > real(0) ? Fast::reciprocal(v) : real(0); }
  static KFN int min_int(int a, int b) { return a < b ? a : b; }
  static KFN int max_int(int a, int b) { return a < b ? b : a; }
  static KFN int lowest_bit(unsigned int word) {
#if defined(__CUDA_ARCH__)
    return __ffs((int)word) - 1;
#else
    return __builtin_ctz(word);
#endif
  }
};

// Sets of numbers, a bit each, in so many words. `words` is a constant: a set of one word can be in a register.
struct Bits {
  static KFN int word_of(int i, int words) { return words == 1 ? 0 : i / 32; }
  static KFN void add(unsigned int* set, int words, int i) { set[word_of(i, words)] |= 1u << (i % 32); }
  static KFN void remove(unsigned int* set, int words, int i) { set[word_of(i, words)] &= ~(1u << (i % 32)); }
  static KFN bool has(const unsigned int* set, int words, int i) {
    return (set[word_of(i, words)] >> (i % 32) & 1u) != 0u;
  }
  // How many are in it below i.
  static KFN int below(const unsigned int* set, int words, int i) {
    int sum = count(set[word_of(i, words)] & ((1u << (i % 32)) - 1u));
    for (int word = 0; word < word_of(i, words); ++word) sum += count(set[word]);
    return sum;
  }
  static KFN int count(unsigned int word) {
#if defined(__CUDA_ARCH__)
    return __popc(word);
#else
    return __builtin_popcount(word);
#endif
  }
  static KFN bool any(const unsigned int* set, int words) {
    unsigned int all = 0u;
    for (int word = 0; word < words; ++word) all |= set[word];
    return all != 0u;
  }
  static KFN void clear(unsigned int* set, int words) {
    for (int word = 0; word < words; ++word) set[word] = 0u;
  }
};

// The numbers of a set, one after another.
struct EachBit {
  const unsigned int* set;
  int words, word;
  unsigned int left;
  KFN static EachBit of(const unsigned int* set, int words) { return {set, words, 0, set[0]}; }
  // Goes to the next; false after the last.
  KFN bool next(int& number) {
    while (left == 0u) {
      if (++word >= words) return false;
      left = set[word];
    }
    number = word * 32 + Math::lowest_bit(left);
    left &= left - 1u;
    return true;
  }
};

struct Angle {
  // The same direction within half a turn of another angle. As it is where it is so already.
  KFN static real near(real angle, real middle) {
    real away = angle - middle;
    if (!(Math::abs(away) > HALF_TURN)) return angle;
    real turns = rintf(away / (TURN_HIGH + TURN_LOW));
    return (angle - turns * TURN_HIGH) - turns * TURN_LOW;
  }
};

// Solves K x = v with K a symmetric 2 x 2 matrix; zero where it is singular.
struct Symmetric {
  static KFN Vec2 solve(real k11, real k12, real k22, Vec2 v) {
    real determinant = Fused::of(k11, k22, -(k12 * k12));
    real inverse = determinant != real(0) ? Fast::reciprocal(determinant) : real(0);
    return {inverse * Fused::of(k22, v.x, -(k12 * v.y)), inverse * Fused::of(k11, v.y, -(k12 * v.x))};
  }
};

// A table of [field, world] floats or ints of which this thread reads and writes one world.
struct Column {
  float* data;
  size_t stride;  // distance between two fields
  KFN real get(int field) const { return data[size_t(field) * stride]; }
  KFN Vec2 get2(int field) const { return {get(field), get(field + 1)}; }
  KFN void set(int field, real value) const { data[size_t(field) * stride] = value; }
  KFN void set2(int field, Vec2 value) const { set(field, value.x); set(field + 1, value.y); }
  // Copies what stands elsewhere, if it is elsewhere.
  KFN void take(const float* from, int fields) const {
    if (from == data) return;
    for (int i = 0; i < fields; ++i) set(i, from[size_t(i) * stride]);
  }
};

struct IntColumn {
  int* data;
  size_t stride;
  KFN int get(int field) const { return data[size_t(field) * stride]; }
  KFN void set(int field, int value) const { data[size_t(field) * stride] = value; }
  KFN void take(const int* from, int fields) const {
    if (from == data) return;
    for (int i = 0; i < fields; ++i) set(i, from[size_t(i) * stride]);
  }
};
