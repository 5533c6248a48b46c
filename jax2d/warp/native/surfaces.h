// What surfaces do beside friction, a number a contact: belts, and resistance to rolling. Of extended shapes.

struct Surfaces {
  ARRAY(real, speed, HAS_SURFACE_SPEED ? NUM_CONTACTS + 1 : 1);  // m/s along the tangent, at which b shall go against a
  ARRAY(real, rolling_arm, HAS_ROLLING_RESISTANCE ? NUM_CONTACTS + 1 : 1);  // m, largest torque a normal force
  ARRAY(real, rolling_impulse, HAS_ROLLING_RESISTANCE ? NUM_CONTACTS + 1 : 1);  // N m s

  // Of contact k, between shapes a and b. Belts run clockwise, so that their speeds along the tangent add up.
  KFN void load(int k, const Column& scene, const Geometry& geometry, int a, int b) {
    int slot_a = Slot::of(a), slot_b = Slot::of(b);
    if (HAS_SURFACE_SPEED)
      speed[k] = scene.get(SCENE_SHAPES_SURFACE_SPEED + slot_a) + scene.get(SCENE_SHAPES_SURFACE_SPEED + slot_b);
    if (!HAS_ROLLING_RESISTANCE) return;
    real share = Math::max(scene.get(SCENE_SHAPES_ROLLING_RESISTANCE + slot_a),
                           scene.get(SCENE_SHAPES_ROLLING_RESISTANCE + slot_b));
    rolling_arm[k] = share * Math::max(geometry.rolling_radius(a), geometry.rolling_radius(b));
    rolling_impulse[k] = real(0);
  }

  KFN real speed_of(int k) const { return HAS_SURFACE_SPEED ? speed[k] : real(0); }

  KFN void warm_start(Pair& pair, int k) const {
    if (HAS_ROLLING_RESISTANCE) pair.apply_angular_impulse(rolling_impulse[k]);
  }

  // A torque against the spin of one on the other, of at most the normal force times the arm.
  KFN void solve_rolling(Pair& pair, int k, real normal_impulse) {
    if (!HAS_ROLLING_RESISTANCE || rolling_arm[k] == real(0)) return;
    real inertia = Math::inverse_or_zero(pair.inverse_inertia_a + pair.inverse_inertia_b);
    real most = rolling_arm[k] * normal_impulse;
    real total = Math::clamp(rolling_impulse[k] - inertia * (pair.omega_b - pair.omega_a), -most, most);
    pair.apply_angular_impulse(total - rolling_impulse[k]);
    rolling_impulse[k] = total;
  }

  KFN void move(int from, int to) {
    if (HAS_SURFACE_SPEED) speed[to] = speed[from];
    if (!HAS_ROLLING_RESISTANCE) return;
    rolling_arm[to] = rolling_arm[from];
    rolling_impulse[to] = rolling_impulse[from];
  }

  KFN void reset_impulses(int k) {
    if (HAS_ROLLING_RESISTANCE) rolling_impulse[k] = real(0);
  }

  KFN void scale_impulses(int k, real share) {
    if (HAS_ROLLING_RESISTANCE) rolling_impulse[k] *= share;
  }

  KFN void load_impulse(int k, const Column& old_impulses, int slot) {
    if (HAS_ROLLING_RESISTANCE) rolling_impulse[k] = old_impulses.get(IMPULSE_ROLLING_IMPULSE + slot);
  }

  // `lasts`: of a contact that is there and does not bounce.
  KFN void store(int slot, bool lasts, const Column& impulses) const {
    if (HAS_ROLLING_RESISTANCE) impulses.set(IMPULSE_ROLLING_IMPULSE + slot, lasts ? rolling_impulse[slot] : real(0));
  }
};
