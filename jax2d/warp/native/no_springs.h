// Replaces springs.h in kernels without springs: an empty struct.

struct Springs {
  enum { count = 0 };
  KFN int a_of(int) const { return 0; }
  KFN int b_of(int) const { return 0; }
  KFN void load(const Bodies&, const Column&, const IntColumn&, const Column&, const Column&) {}
  KFN void load_impulses(const Column&) {}
  KFN void reset_slowed(const Bodies&) {}
  KFN void store(const Column&) const {}
  KFN void prepare(const Bodies&, const unsigned int*) {}
  KFN void scale_impulses(int, real) {}
  KFN void warm_start(Bodies&) {}
  KFN void solve(Bodies&, const Soft&, bool, ActiveSet&) {}
  KFN bool is_bounded(int) const { return false; }
  KFN void load_rod(int, Joint&) const {}
  KFN static Vec2 axis_of(Vec2 gap, real) { return gap; }
  KFN real kinematic_work(const Bodies&, int) const { return real(0); }
  KFN real work(const Bodies&, int) const { return real(0); }
};
