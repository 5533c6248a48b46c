// Which plane keeps two shapes apart while they move on as they do: C = n . (p_b - p_a) >= 0 for the rest of the step.
//
// Every plane that has one shape behind it and the other before it is safe: while it holds, nothing passes. The nearest
// features give one, but one that a shape may have to cross on its way past: the side of the next tile of a floor, the
// plane of a wall beyond the wall's end. So the plane is chosen by the path: one that the path does not cross, else the
// one that it crosses last, which is where the shapes meet (separating axes in time).

struct ImpactPlane {
  Vec2 normal;  // outward of what the disc may hit
  real separation;
  bool on_face;  // it is that of a face, not of a corner

  // A disc against one corner or another disc, `away` from it: radius `r` is the sum of both radii. `graze`: passing by
  // so much less than `r` is passing.
  KFN static bool corner(Vec2 away, Vec2 motion, real r, real graze, ImpactPlane& out) {
    out.on_face = false;
    real squared = motion.dot(motion), beside = away.cross(motion), along = away.dot(motion);
    if (along >= real(0)) return false;  // it leaves
    if (beside * beside >= (r - graze) * (r - graze) * squared) {
      real speed = Fast::root(squared);
      out.normal = motion.left() * Fast::divide(beside < real(0) ? real(1) : real(-1), speed);
      out.separation = Math::max(Fast::divide(Math::abs(beside), speed) - r, real(0));
      return true;
    }
    real clearance_squared = away.dot(away) - r * r;
    if (clearance_squared <= real(0)) return false;  // it overlaps
    real root = Fast::root(Math::max(along * along - squared * clearance_squared, real(0)));
    real seconds = Fast::divide(-along - root, squared);
    out.normal = (away + motion * seconds) * Fast::reciprocal(r);
    out.separation = out.normal.dot(away) - r;
    return true;
  }

  // Whether a point is over an edge or on its way there.
  KFN static bool is_over(Vec2 from, Vec2 to, Vec2 point, Vec2 motion) {
    Vec2 edge = to - from;
    real heading = motion.dot(edge);
    return ((point - from).dot(edge) >= real(0) || heading > real(0)) && ((point - to).dot(edge) <= real(0) || heading < real(0));
  }

  // Whether a disc, `away` from the end of a face, grazes the corner there and then goes on into the face, which leads
  // along `inward` from there: passing the corner would let it in.
  KFN static bool grazes_onto(Vec2 away, Vec2 inward, Vec2 face_normal, real r, real graze, Vec2 motion, real seconds) {
    real beside = away.cross(motion), squared = motion.dot(motion);
    if (beside * beside >= r * r * squared || beside * beside < (r - graze) * (r - graze) * squared) return false;
    Vec2 then = away + motion * seconds;
    return then.dot(inward) > real(0) && face_normal.dot(then) - r < -graze;
  }

  // v, n: corners and outward edge normals of a polygon; centre, motion: of the disc against it. False: as they stand.
  KFN static bool polygon(const Vec2* v, const Vec2* n, int count, Vec2 centre, real r, Vec2 motion, real seconds,
                          ImpactPlane& out) {
    real graze = Math::min(GRAZING_DISTANCE, GRAZING_SHARE * r);
    real last = real(-1), best = -FAR_DISTANCE;
    int last_face = -1, best_face = -1;
    for (int k = 0; k < count; ++k) {
      real separation = n[k].dot(centre - v[k]) - r;
      if (separation < -graze) continue;
      real rate = n[k].dot(motion);
      // Along it and onto it, as over the next tile of a floor: not into it, and not off its end.
      if (separation > best && rate * seconds >= -graze && is_over(v[k], v[k + 1 < count ? k + 1 : 0], centre, motion)) {
        best = separation;
        best_face = k;
      }
      real crossed = rate < real(0) ? Fast::divide(Math::max(separation, real(0)), -rate) : FAR_DISTANCE;
      if (crossed > last) {
        last = crossed;
        last_face = k;
      }
    }
    if (best_face < 0 && (last_face < 0 || last == FAR_DISTANCE)) return false;
    int face = best_face >= 0 ? best_face : last_face;
    if (best_face < 0) {
      // Where it crosses the last plane, beyond the face it meets the corner there, or passes it.
      Vec2 from = v[face], to = v[face + 1 < count ? face + 1 : 0], at = centre + motion * last;
      Vec2 edge = to - from;
      bool before = (at - from).dot(edge) < real(0);
      if (before || (at - to).dot(edge) > real(0)) {
        Vec2 end = before ? from : to;
        if (!grazes_onto(centre - end, before ? edge : edge * real(-1), n[face], r, graze, motion, seconds))
          return corner(centre - end, motion, r, graze, out);
      }
    }
    out.on_face = true;
    out.normal = n[face];
    out.separation = Math::max(n[face].dot(centre - v[face]) - r, real(0));
    return true;
  }
};
