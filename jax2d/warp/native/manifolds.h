// Contact manifolds: where and along which normal two convex shapes meet. C = (pB - pA) . n >= 0
//
// Everything is computed relative to the centre of mass of shape a, so that worlds far from the origin
// keep their precision. Normals point from a to b; a separation below zero is a penetration depth.

// Contact points lie midway between the surfaces; for `paper` where its appendix has them (Collision Manifolds): on the
// surface of circle a, on the polygon that meets a circle, on the incident edge of two polygons.
#define HALFWAY (SOFT_STEP ? real(0.5) : real(0))

struct ContactPoint {
  Vec2 point;       // relative to the centre of mass of a; midway between the surfaces, for `paper` see HALFWAY
  real separation;  // m
  int feature;      // which vertex on which edge: matches the point between steps
};

struct Manifold {
  Vec2 normal;
  int count;
  bool on_face;    // b is a disc on a face of a
  real follows_b;  // share by which points go with b while both move, so that a disc's stays below its centre
  ContactPoint points[2];
};

// Four corners of a polygon, the last again where it has three, in registers: each world of a warp looks at its own pair, so
// that a load from local memory is as many as there are shapes.
struct FourCorners {
  Vec2 first, second, third, fourth;

  // Least distance from a plane with this normal through `origin`.
  KFN real nearest(Vec2 n, Vec2 origin) const {
    return Math::min(Math::min(n.dot(first - origin), n.dot(second - origin)),
                     Math::min(n.dot(third - origin), n.dot(fourth - origin)));
  }
};

// World-oriented corners and outward edge normals of all polygons, with bounds, for one step.
struct Geometry {
  ARRAY(Vec2, corner, NUM_CORNERS);  // relative to the centre of mass
  ARRAY(Vec2, normal, NUM_CORNERS);  // of the edge from corner k to its successor
  ARRAY(int, corners, NUM_POLYGONS + 1);
  ARRAY(real, radius, NUM_CIRCLES + 1);
  ARRAY(Vec2, lower, NUM_SHAPES);  // axis-aligned bounds relative to the centre of mass
  ARRAY(Vec2, upper, NUM_SHAPES);
  ARRAY(real, core, NUM_SHAPES);  // least distance from centre to surface: what a fast body may not step over
  ARRAY(real, extent, NUM_SHAPES);  // largest distance from centre to surface
  ARRAY(real, swing, NUM_SHAPES);  // m, how far the surface goes in `ahead` seconds by turning, at most
  real ahead;
  real substep;

  KFN int successor(int polygon, int k) const { return k + 1 < corners[polygon] ? k + 1 : 0; }

  // `which`, `fixed_too`: as in Bodies::begin_step.
  KFN void build(const Column& scene, const IntColumn& ints, const Bodies& bodies, bool fixed_too, const unsigned int* which) {
    for (int p = 0; p < NUM_POLYGONS; ++p) {
      if (!bodies.is_active(p) || (!fixed_too && !Bodies::has(which, p))) continue;
      corners[p] = ints.get(INTS_SHAPES_NUM_VERTICES + p);
      Rotation q = bodies.rotation[p];
      Vec2 lo = {FAR_DISTANCE, FAR_DISTANCE}, hi = {-FAR_DISTANCE, -FAR_DISTANCE};
      real far_squared = real(0);
      for (int k = 0; k < corners[p]; ++k) {
        Vec2 v = q.apply(scene.get2(SCENE_SHAPES_VERTICES + 2 * (p * MAX_VERTICES + k)));
        corner[p * MAX_VERTICES + k] = v;
        lo = {Math::min(lo.x, v.x), Math::min(lo.y, v.y)};
        hi = {Math::max(hi.x, v.x), Math::max(hi.y, v.y)};
        far_squared = Math::max(far_squared, v.dot(v));
      }
      real nearest = FAR_DISTANCE;
      for (int k = 0; k < corners[p]; ++k) {
        Vec2 v = corner[p * MAX_VERTICES + k];
        Vec2 n = (corner[p * MAX_VERTICES + successor(p, k)] - v).right();
        n = n * Math::inverse_or_zero(n.length());
        normal[p * MAX_VERTICES + k] = n;
        nearest = Math::min(nearest, n.dot(v));
      }
      lower[p] = lo;
      upper[p] = hi;
      core[p] = nearest;
      extent[p] = Fast::root(far_squared);
      swing[p] = real(0);
    }
    for (int c = 0; c < NUM_CIRCLES; ++c) {
      if (!bodies.is_active(NUM_POLYGONS + c) || (!fixed_too && !Bodies::has(which, NUM_POLYGONS + c))) continue;
      real r = scene.get(SCENE_SHAPES_RADIUS + c);
      radius[c] = r;
      lower[NUM_POLYGONS + c] = {-r, -r};
      upper[NUM_POLYGONS + c] = {r, r};
      core[NUM_POLYGONS + c] = r;
      extent[NUM_POLYGONS + c] = r;
      swing[NUM_POLYGONS + c] = real(0);
    }
  }

  // m, of what can roll: only circles.
  KFN real rolling_radius(int i) const { return i < NUM_POLYGONS ? real(0) : radius[i - NUM_POLYGONS]; }

  KFN void predict_travel(const Bodies& bodies, const unsigned int* which, real seconds, real h) {
    ahead = seconds;
    substep = h;
    for (Bodies::Each each = Bodies::Each::of(which); each.next();)
      swing[each.shape] = arm(each.shape) * Math::abs(bodies.omega(each.shape)) * seconds;
  }

  // m, by which a surface goes farther than its centre when it turns by a radian. A disc's stays in its place.
  KFN real arm(int i) const { return extent[i] - core[i]; }

  // How far two surfaces move against each other in `ahead` seconds, at most. speed: of b against a.
  KFN real predicted_travel(int a, int b, real speed) const { return speed * ahead + swing[a] + swing[b]; }

  // How far a surface goes by turning until the end of the step, `left` seconds from now.
  KFN real current_swing(const Bodies& bodies, int i, real left) const {
    return arm(i) * (Math::abs(bodies.turn(i)) + Math::abs(bodies.omega(i)) * left);
  }

  // A pair of bodies that never did since `predict_travel` gets by less than `reach` farther than predicted. `before`:
  // velocity then; `seconds`: those predicted.
  KFN bool exceeds_prediction(const Bodies& bodies, int i, Vec2 before, real reach, real seconds) const {
    Vec2 change = bodies.velocity(i) - before;
    real spare = real(0.5) * reach + swing[i] - arm(i) * Math::abs(bodies.omega(i)) * seconds;
    return spare < real(0) || change.dot(change) * seconds * seconds > spare * spare;
  }

  KFN bool bounds_overlap(int a, int b, Vec2 d, real margin) const {
    return lower[b].x + d.x <= upper[a].x + margin && upper[b].x + d.x >= lower[a].x - margin &&
           lower[b].y + d.y <= upper[a].y + margin && upper[b].y + d.y >= lower[a].y - margin;
  }

  // d: centre of b relative to centre of a; motion: how that changes; spin: of a. Points farther apart than margin are left out.
  KFN Manifold collide(int a, int b, Vec2 d, Vec2 motion, real spin, real margin) const {
    if (b < NUM_POLYGONS) {
      if (HAS_POLYGON_PAIRS) return polygon_polygon(a, b, d, motion, margin);
    } else if (a < NUM_POLYGONS) {
      if (HAS_POLYGON_CIRCLE_PAIRS) return polygon_circle(a, b - NUM_POLYGONS, d, motion, spin, margin);
    } else if (HAS_CIRCLE_PAIRS) {
      return circle_circle(a - NUM_POLYGONS, b - NUM_POLYGONS, d, motion, margin);
    }
    Manifold none;
    none.count = 0;
    return none;
  }

  // Largest distance of a point from the planes of a polygon's faces, and the face.
  KFN real distance_of_faces(int polygon, Vec2 point, int& face) const {
    real largest = -FAR_DISTANCE;
    face = 0;
    for (int k = 0; k < corners[polygon]; ++k) {
      real s = normal[polygon * MAX_VERTICES + k].dot(point - corner[polygon * MAX_VERTICES + k]);
      if (s > largest) {
        largest = s;
        face = k;
      }
    }
    return largest;
  }

  // Two surfaces are at least so far from each other: between the circles around them, which is found fast.
  KFN real bounding_distance(int a, int b, Vec2 d) const { return d.length() - extent[a] - extent[b]; }

  // Two surfaces are at least so far from each other: along the normal of a face, between discs along their line.
  KFN real least_distance(int a, int b, Vec2 d) const {
    int face;
    if (a >= NUM_POLYGONS) return bounding_distance(a, b, d);
    if (b >= NUM_POLYGONS) return distance_of_faces(a, d, face) - extent[b];
    Vec2 zero = {real(0), real(0)};
    return Math::max(max_separation(a, zero, b, d, face), max_separation(b, d, a, zero, face));
  }

  KFN Manifold circle_circle(int a, int b, Vec2 d, Vec2 motion, real margin) const {
    Manifold m;
    m.count = 0;
    real distance = d.length();
    real separation = distance - radius[a] - radius[b];
    if (separation > margin) return m;
    // Coincident centres have no direction of their own: any fixed one separates them.
    m.normal = distance > COINCIDENT_DISTANCE ? d * Fast::reciprocal(distance) : Vec2{real(0), real(1)};
    ImpactPlane plane;
    if (SOFT_STEP && separation > real(0) && moves(motion) &&
        ImpactPlane::corner(d, motion, radius[a] + radius[b], real(0), plane)) {
      m.normal = plane.normal;
      separation = plane.separation;
    }
    m.count = 1;
    m.on_face = false;
    m.follows_b = Fast::divide(radius[a], radius[a] + radius[b]);
    m.points[0] = {m.normal * (radius[a] + HALFWAY * separation), separation, 0};
    return m;
  }

  KFN static bool moves(Vec2 motion) { return motion.dot(motion) > RESTING_SPEED * RESTING_SPEED; }

  KFN Manifold polygon_circle(int polygon, int circle, Vec2 centre, Vec2 motion, real spin, real margin) const {
    Manifold m;
    m.count = 0;
    const Vec2* v = corner + polygon * MAX_VERTICES;
    const Vec2* n = normal + polygon * MAX_VERTICES;
    int face;
    real face_distance = distance_of_faces(polygon, centre, face);
    real r = radius[circle];
    if (face_distance - r > margin) return m;
    Vec2 from = v[face], to = v[successor(polygon, face)];
    Vec2 closest = {real(0), real(0)};
    bool at_corner = false;
    if (face_distance > ON_FACE_DISTANCE) {  // outside: the closest feature may be a corner of the face
      if ((centre - from).dot(to - from) < real(0)) {
        closest = from;
        at_corner = true;
      } else if ((centre - to).dot(from - to) < real(0)) {
        closest = to;
        at_corner = true;
      }
    }
    real distance = face_distance;
    m.normal = n[face];
    if (at_corner) {
      Vec2 away = centre - closest;
      distance = away.length();
      if (distance - r > margin) return m;
      m.normal = away * Fast::reciprocal(distance);  // distance >= face_distance > 0
    }
    real separation = distance - r;
    m.on_face = !at_corner;
    ImpactPlane plane;
    real graze = at_corner ? Math::min(GRAZING_DISTANCE, GRAZING_SHARE * r) : real(0);
    motion = motion - centre.left() * spin;  // as a point of the polygon there sees it
    if (SOFT_STEP && separation > -graze && moves(motion) &&
        ImpactPlane::polygon(v, n, corners[polygon], centre, r, motion, ahead, plane)) {
      m.on_face = plane.on_face;
      m.normal = plane.normal;
      separation = plane.separation;
    }
    m.count = 1;
    m.follows_b = real(1);
    m.points[0] = {centre - m.normal * (r + (real(1) - HALFWAY) * separation), separation, 0};
    return m;
  }

  // About to meet (or just met) along the reference face's normal, and level with one of its ends to within GRAZING_DISTANCE:
  // what lies ahead there is the next tile of a floor rather than a wall. Such a pair slides along the neighbouring
  // face, which gives the normal then; with the reference face's every seam of a floor would stop what slides over it.
  // upper_end, lower_end: the incident edge, relative to the centre of ref; u: how far along the reference face.
  KFN bool slides_past(int ref, int inc, int edge, Vec2 inc_from_ref, Vec2 lower_end, Vec2 upper_end, real u_lower,
                       real u_upper, real length, real closing, real margin, Manifold& m) const {
    real overlap = Math::min(u_upper, length) - Math::max(u_lower, real(0));
    if (overlap > GRAZING_DISTANCE || overlap < -GRAZING_DISTANCE) return false;
    if (overlap > THIN_SHARE * Math::min(u_upper - u_lower, length)) return false;  // a thin shape, met in full
    bool at_start = u_upper < length - u_lower;
    Vec2 end = at_start ? upper_end : lower_end;
    int ref_corner = at_start ? edge : successor(ref, edge);
    Vec2 origin = corner[ref * MAX_VERTICES + ref_corner];
    real separation = normal[ref * MAX_VERTICES + edge].dot(end - origin);
    if (separation <= (closing > RESTING_SPEED ? -GRAZING_DISTANCE : real(0))) return false;
    int neighbour = at_start ? (edge > 0 ? edge - 1 : corners[ref] - 1) : ref_corner;
    Vec2 n = normal[ref * MAX_VERTICES + neighbour];
    real gap = FAR_DISTANCE;
    for (int j = 0; j < corners[inc]; ++j)
      gap = Math::min(gap, n.dot(corner[inc * MAX_VERTICES + j] + inc_from_ref - origin));
    if (gap < -GRAZING_DISTANCE || gap > margin) return false;
    gap = Math::max(gap, real(0));
    m.normal = n;
    m.count = 1;
    m.points[0] = {end.minus(n, real(0.5) * gap), gap, at_start ? 0 : 1};
    return true;
  }

  // Largest over the edges of one polygon of the least distance of the other's corners to that edge.
  KFN real max_separation(int one, Vec2 one_at, int other, Vec2 other_at, int& edge) const {
    real best = -FAR_DISTANCE;
    edge = 0;
    FourCorners theirs = four_corners(other);
    for (int k = 0; k < corners[one]; ++k) {
      real nearest = nearest_corner(other, theirs, normal[one * MAX_VERTICES + k], corner[one * MAX_VERTICES + k] + one_at - other_at);
      if (nearest > best) {
        best = nearest;
        edge = k;
      }
    }
    return best;
  }

  KFN FourCorners four_corners(int polygon) const {
    const Vec2* v = corner + polygon * MAX_VERTICES;
    return {v[0], v[1], v[2], v[MAX_VERTICES > 3 && corners[polygon] > 3 ? 3 : 2]};
  }

  // Least distance of the corners of a polygon, of which four are at hand, from a plane through `origin`.
  KFN real nearest_corner(int polygon, const FourCorners& four, Vec2 n, Vec2 origin) const {
    real nearest = four.nearest(n, origin);
    for (int j = 4; MAX_VERTICES > 4 && j < corners[polygon]; ++j)
      nearest = Math::min(nearest, n.dot(corner[polygon * MAX_VERTICES + j] - origin));
    return nearest;
  }

  // Which face of two polygons apart keeps them so while they move on, see `ImpactPlane`.
  struct ImpactFace {
    bool exists, flipped;
    int edge;
    real seconds;  // until they meet there, 0 if they do not
  };

  // From where to where a polygon reaches along n, and with which corners.
  struct Span {
    real lower, upper;
    int lowest, highest;
    KFN real width() const { return upper - lower; }
  };
  KFN Span span(int polygon, Vec2 n) const {
    Span of = {FAR_DISTANCE, -FAR_DISTANCE, 0, 0};
    for (int k = 0; k < corners[polygon]; ++k) {
      real u = n.dot(corner[polygon * MAX_VERTICES + k]);
      if (u < of.lower) of.lowest = k;
      if (u > of.upper) of.highest = k;
      of.lower = Math::min(of.lower, u);
      of.upper = Math::max(of.upper, u);
    }
    return of;
  }

  // One of two polygons; motion: of the other against it. Goes on from what was found for the first.
  KFN void impact_face(int one, Vec2 one_at, int other, Vec2 other_at, Vec2 motion, bool flipped, real& best, real& last,
                       ImpactFace& inert, ImpactFace& met) const {
    FourCorners theirs = four_corners(other);
    for (int k = 0; k < corners[one]; ++k) {
      Vec2 n = normal[one * MAX_VERTICES + k];
      real separation = nearest_corner(other, theirs, n, corner[one * MAX_VERTICES + k] + one_at - other_at);
      if (separation < -GRAZING_DISTANCE) continue;
      // A thin shape is met in full, not passed over.
      if (separation < real(0) && separation < -THIN_SHARE * Math::min(span(one, n).width(), span(other, n).width())) continue;
      real rate = n.dot(motion);
      // Along its plane, as over the next tile of a floor: not into it.
      if (separation > best && rate * ahead >= -GRAZING_DISTANCE) {
        best = separation;
        inert = {true, flipped, k, real(0)};
      }
      real crossed = rate < real(0) ? Fast::divide(Math::max(separation, real(0)), -rate) : FAR_DISTANCE;
      if (crossed > last) {
        last = crossed;
        met = {true, flipped, k, crossed};
      }
    }
  }

  KFN ImpactFace impact_face(int a, int b, Vec2 d, Vec2 motion, real advantage) const {
    ImpactFace inert = {false, false, 0, real(0)}, met = inert;
    real best = -FAR_DISTANCE, last = real(-1);
    Vec2 zero = {real(0), real(0)};
    impact_face(a, zero, b, d, motion, false, best, last, inert, met);
    if (inert.exists) best = best + advantage;
    impact_face(b, d, a, zero, -motion, true, best, last, inert, met);
    if (!inert.exists && last == FAR_DISTANCE) met.exists = false;
    return inert.exists ? inert : met;
  }

  // Two polygons that pass each other: the plane along their motion between them. At most one point.
  KFN bool pass_each_other(int a, int b, Vec2 d, Vec2 motion, real margin, Manifold& m) const {
    Vec2 n = motion.left() * Fast::reciprocal(motion.length());
    Span of_a = span(a, n), of_b = span(b, n);
    real offset = n.dot(d), above = offset + of_b.lower - of_a.upper, below = of_a.lower - of_b.upper - offset;
    real gap = Math::max(above, below);
    if (gap < real(0)) return false;
    bool is_above = above > below;
    m.normal = is_above ? n : -n;
    m.follows_b = real(1);
    m.count = gap > margin ? 0 : 1;
    Vec2 nearest = corner[b * MAX_VERTICES + (is_above ? of_b.lowest : of_b.highest)] + d;
    m.points[0] = {nearest - m.normal * (HALFWAY * gap), gap, FEATURE_SEAM + 2};
    return true;
  }

  KFN Manifold polygon_polygon(int a, int b, Vec2 d, Vec2 motion, real margin) const {
    Manifold m;
    m.count = 0;
    m.on_face = false;
    Vec2 zero = {real(0), real(0)};
    int edge_a, edge_b;
    real depth_a = max_separation(a, zero, b, d, edge_a);
    if (depth_a > margin) return m;
    real depth_b = max_separation(b, d, a, zero, edge_b);
    if (depth_b > margin) return m;

    // The reference face is that of the clearly larger shape (a's if neither is) unless the other's is clearly better:
    // no flicker between near-equal axes, and a floor holds its normal while what stands on it rocks.
    bool larger_b = extent[b] > CLEARLY_LARGER * extent[a];
    real advantage = larger_b ? -FLIP_ADVANTAGE : FLIP_ADVANTAGE;
    bool flipped = depth_b > depth_a + advantage;
    ImpactFace impact = {false, false, 0, real(0)};
    real apart = Math::max(depth_a, depth_b);
    real rate = flipped ? -normal[b * MAX_VERTICES + edge_b].dot(motion) : normal[a * MAX_VERTICES + edge_a].dot(motion);
    bool passes = SOFT_STEP && apart > real(0) && moves(motion);
    // The last relax pass asks what would be met in a sub-step more; what goes half a graze in one needs no care.
    bool is_fast = motion.dot(motion) * substep * substep > real(0.25) * GRAZING_DISTANCE * GRAZING_DISTANCE;
    real lookahead = is_fast ? ahead + substep : ahead;
    bool holds = passes && is_fast && apart + rate * lookahead >= real(0);  // the face is not crossed
    if (passes && apart + rate * lookahead < real(0)) impact = impact_face(a, b, d, motion, advantage);
    if (impact.exists && impact.seconds > real(0) && pass_each_other(a, b, d, motion, margin, m)) return m;
    if (impact.exists) flipped = impact.flipped;
    int ref = flipped ? b : a, inc = flipped ? a : b;
    Vec2 ref_at = flipped ? d : zero, inc_at = flipped ? zero : d;
    int edge = impact.exists ? impact.edge : flipped ? edge_b : edge_a;
    // The incident polygon is looked at where it will be when they meet; points go back from there.
    Vec2 onward = (flipped ? -motion : motion) * impact.seconds;
    inc_at = inc_at + onward;
    Vec2 n = normal[ref * MAX_VERTICES + edge];
    Vec2 r1 = corner[ref * MAX_VERTICES + edge] + ref_at;
    Vec2 r2 = corner[ref * MAX_VERTICES + successor(ref, edge)] + ref_at;

    // The incident edge is the one that faces the reference face most, for `paper` the one whose corners are deepest.
    int incident = 0;
    real min_alignment = FAR_DISTANCE;
    for (int k = 0; k < corners[inc]; ++k) {
      Vec2 v = normal[inc * MAX_VERTICES + k];
      if (!SOFT_STEP) v = corner[inc * MAX_VERTICES + k] + corner[inc * MAX_VERTICES + successor(inc, k)];
      real alignment = n.dot(v);
      if (alignment < min_alignment) {
        min_alignment = alignment;
        incident = k;
      }
    }
    int incident_end = successor(inc, incident);
    // Edges run counter-clockwise, so the incident edge runs against the reference edge.
    Vec2 upper_end = corner[inc * MAX_VERTICES + incident] + inc_at;
    Vec2 lower_end = corner[inc * MAX_VERTICES + incident_end] + inc_at;
    Vec2 along = n.left();  // from r1 to r2
    real length = (r2 - r1).dot(along);
    real u_upper = (upper_end - r1).dot(along), u_lower = (lower_end - r1).dot(along);
    if (!SOFT_STEP && u_upper < u_lower) {  // the deepest corners may be those of a steep and short edge
      Vec2 end = upper_end;
      upper_end = lower_end;
      lower_end = end;
      real u = u_upper;
      u_upper = u_lower;
      u_lower = u;
    }

    m.normal = flipped ? -n : n;
    m.follows_b = flipped ? real(0) : real(1);  // with the corners that meet a face
    int base = (flipped ? FEATURE_FLIPPED : 0) + edge * FEATURE_EDGE;
    real closing = n.dot(flipped ? motion : -motion);
    if (SOFT_STEP && !impact.exists && slides_past(ref, inc, edge, inc_at - ref_at, lower_end - ref_at, upper_end - ref_at, u_lower,
                                 u_upper, length, closing, margin, m)) {
      m.normal = flipped ? -m.normal : m.normal;
      m.points[0].point = m.points[0].point + ref_at;
      m.points[0].feature += FEATURE_SEAM + base;
      return m;
    }
    if (u_upper < real(0) || u_lower > length) {
      // Nothing of the incident edge is over the reference face: corner against corner.
      Vec2 ref_corner = u_upper < real(0) ? r1 : r2;
      Vec2 inc_corner = u_upper < real(0) ? upper_end : lower_end;
      Vec2 gap = inc_corner - ref_corner;
      real distance = gap.length();
      real face_separation = n.dot(gap);
      // Where the path crosses the plane between two corners, but not the face, it passes: the face keeps them apart.
      real corner_rate = gap.dot(flipped ? -motion : motion);  // times the distance
      if (impact.exists || (holds && distance * distance + corner_rate * lookahead < real(0))) {
        inc_corner = inc_corner - onward;
        face_separation = Math::max(face_separation - n.dot(onward), real(0));
        if (face_separation > margin) return m;
        m.count = 1;
        m.points[0] = {inc_corner - n * (HALFWAY * face_separation), face_separation,
                       FEATURE_CORNER_OUTSIDE + base + (u_upper < real(0) ? 0 : 1)};
        return m;
      }
      if (face_separation > real(0)) {
        if (distance > margin) return m;
        n = gap * Fast::reciprocal(distance);
        m.normal = flipped ? -n : n;
        m.count = 1;
        m.points[0] = {(ref_corner + inc_corner) * real(0.5), distance, FEATURE_CORNER_OUTSIDE + base + (u_upper < real(0) ? 0 : 1)};
      } else {
        m.count = 1;
        m.points[0] = {inc_corner - n * (HALFWAY * face_separation), face_separation,
                       FEATURE_CORNER_INSIDE + base + (u_upper < real(0) ? 0 : 1)};
      }
      return m;
    }

    // Clip the incident edge to the sides of the reference face; depth follows the clipped point.
    real span = u_upper - u_lower;
    Vec2 lower_point = lower_end, upper_point = upper_end;
    if (u_lower < real(0) && span > MIN_SPAN)
      lower_point = lower_end.plus(upper_end - lower_end, Fast::divide(-u_lower, span));
    if (u_upper > length && span > MIN_SPAN)
      upper_point = lower_end.plus(upper_end - lower_end, Fast::divide(length - u_lower, span));
    lower_point = lower_point - onward;
    upper_point = upper_point - onward;
    real s_lower = n.dot(lower_point - r1), s_upper = n.dot(upper_point - r1);
    int feature = base + incident * FEATURE_INCIDENT;
    if (s_lower <= margin) m.points[m.count++] = {lower_point.minus(n, HALFWAY * s_lower), s_lower, feature};
    if (s_upper <= margin) m.points[m.count++] = {upper_point.minus(n, HALFWAY * s_upper), s_upper, feature + 1};
    // Points are solved one after another: the deeper last, so that a mirror image is solved alike.
    if (SOFT_STEP && m.count == 2 && s_upper > s_lower) {
      ContactPoint lower = m.points[0];
      m.points[0] = m.points[1];
      m.points[1] = lower;
    }
    return m;
  }
};
