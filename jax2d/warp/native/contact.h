// One contact point of two bodies in one step: where it is while they move, and what each pass over contacts asks of it.
//
// The normal stays as it was when the contact was found; arms and the separation go with the bodies.

struct Contact {
  unsigned int a : SHAPE_BITS, b : SHAPE_BITS;  // with what follows one word: a GPU waits for each that it loads
  bool against_fixed : 1;      // one of the two cannot be pushed
  bool against_kinematic : 1;  // and moves
  bool is_impact : 1;          // they meet fast, and were apart before
  bool is_second : 1;          // of two points of one pair
  bool disc_on_face : 1;       // b is a disc on a face of a
  int key;
  Vec2 normal;
  Vec2 arm_a, arm_b;         // from the centres of mass to both surfaces, at the start of the step
  real follows_b;            // share by which the common point goes with b; the rest goes with a
  real separation;           // at the start of the step
  real mass_normal, mass_tangent;
  real impulse_normal, impulse_tangent;
  real friction, restitution;
  real approach;             // relative normal speed before solving, negative when approaching; later before a last push
  real bounce;               // normal speed to leave with, once it is known that it bounces; else 0
  real max_impulse;         // largest normal impulse in this step

  KFN bool is_of(const unsigned int* bodies) const { return Bodies::has(bodies, a) || Bodies::has(bodies, b); }

  // a is the earlier of the two shapes. Nothing turns a disc about its own centre by pushing it along the line to
  // another's: until they meet they are beside that line, and are there when they do.
  KFN bool are_discs() const { return HAS_CIRCLE_PAIRS && a >= NUM_POLYGONS; }

  // Whether the same impulse is to be expected again: not that of an impact or bounce.
  KFN bool lasts() const { return bounce == real(0) && !is_impact; }

  // Slower impacts do not bounce.
  KFN bool hits(real threshold) const { return restitution > real(0) && approach <= -threshold; }

  // Both as it was found.
  KFN real pair_mass(const Bodies& bodies, Vec2 direction) const { return Pair::of(bodies, a, b).mass(arm_a, arm_b, direction); }
  KFN real normal_speed(const Bodies& bodies) const { return normal.dot(Pair::of(bodies, a, b).relative(arm_a, arm_b)); }

  // How b has moved against a since the contact was found.
  KFN Vec2 moved(const Bodies& bodies) const { return bodies.delta(b) - bodies.delta(a); }

  // From a's surface to b's where they meet.
  KFN Vec2 apart(const Bodies& bodies, Vec2 moved) const {
    Vec2 gap = moved.plus(normal, Math::max(separation, real(0)));
    if (!are_discs()) return gap;
    Vec2 d = bodies.position[b] - bodies.position[a];
    return (gap + d).minus(normal, normal.dot(d));
  }

  // Where both bodies can move, arms lead to one point, wherever they have gone since: an impulse at two points would
  // change what both have of angular momentum. What is fixed takes any, so that the other's own surface is the point.
  KFN Arms arms_now(const Bodies& bodies, Vec2 moved) const {
    if (against_fixed) return {arm_a, arm_b};
    Vec2 gap = apart(bodies, moved);
    return {arm_a.plus(gap, follows_b), arm_b.minus(gap, real(1) - follows_b)};
  }

  // Where an impact of two polygons acts: to where both have got and turned since. On what is fixed the point stays on the
  // other's surface, and a disc has its point below its centre, however it turns.
  KFN Arms arms_of_impact(const Bodies& bodies, Vec2 moved) const {
    if (b >= NUM_POLYGONS) return arms_now(bodies, moved);
    Vec2 turn_a = swung(arm_a, turn_of_a(bodies)), turn_b = swung(arm_b, turn_of_b(bodies));
    Vec2 gap = apart(bodies, moved) + turn_b - turn_a;
    if (against_fixed) gap = gap.minus(normal, normal.dot(gap));
    return {(arm_a + turn_a).plus(gap, follows_b), (arm_b + turn_b).minus(gap, real(1) - follows_b)};
  }

  // On a kinematic body the place where the other's surface is, `ahead` seconds from now: in the middle of a sub-step the
  // velocity there is the mean of how the place moves, so that what a turntable carries drifts neither out nor in.
  KFN Arms carried_arms(const Bodies& bodies, Vec2 moved, real ahead) const {
    Vec2 gap = apart(bodies, moved);
    bool is_a = bodies.is_kinematic(a);
    Vec2 arm = is_a ? arm_a + gap : arm_b - gap;
    arm = arm.plus(arm.left(), bodies.omega(is_a ? a : b) * ahead);
    return is_a ? Arms{arm, arm_b} : Arms{arm_a, arm};
  }

  // Surfaces move and turn with their bodies.
  KFN real current_separation(const Bodies& bodies, Vec2 moved) const {
    Vec2 opened = moved;
    if (bodies.moves(b)) opened = opened + swung(arm_b, turn_of_b(bodies));
    if (bodies.moves(a)) opened = opened - swung(arm_a, turn_of_a(bodies));
    return separation + opened.dot(normal);
  }

  // On a face the point of a disc stays below its centre, and those of two discs between their centres: turned with one
  // that rolls it would rise, and the disc sink.
  KFN real turn_of_a(const Bodies& bodies) const { return are_discs() ? real(0) : bodies.turn(a); }
  KFN real turn_of_b(const Bodies& bodies) const { return disc_on_face || are_discs() ? real(0) : bodies.turn(b); }

  // What turning an arm adds to it.
  KFN static Vec2 swung(Vec2 arm, real turn) {
    return (arm.left() * sinf_small(turn)).minus(arm, one_minus_cos_small(turn));
  }

  // Within a step bodies turn by less than a radian: series with errors below 3e-6 (sine) and 3e-5 (cosine).
  KFN static real sinf_small(real t) {
    real t2 = t * t;
    real series = Fused::of(-t2, Fused::of(-t2, real(0.00019841270), real(0.0083333333)), real(0.16666667));
    return t * Fused::of(-t2, series, real(1));
  }
  KFN static real one_minus_cos_small(real t) {
    real t2 = t * t;
    return t2 * Fused::of(-t2, Fused::of(-t2, real(0.0013888889), real(0.041666667)), real(0.5));
  }

  // m/s by which a face that turns closes on what slides along it, which would go straight on, negative; 0 where it
  // opens, or closes by less than what rests may move. The normal turns with the body of the face, and a corner with its
  // own; the point of a disc stays below its centre.
  KFN real closes_by(const Pair& pair, Arms arms, const Soft& soft) const {
    bool is_a = follows_b > real(0.5);
    real spin = Math::clamp(is_a ? pair.omega_a : pair.omega_b, -soft.max_spin, soft.max_spin);
    Vec2 velocity = pair.velocity_b - pair.velocity_a, from_face = is_a ? arms.a : -arms.b;
    if (disc_on_face)
      from_face = from_face - arms.b;
    else
      velocity = is_a ? velocity.plus(arms.b.left(), pair.omega_b) : velocity.minus(arms.a.left(), pair.omega_a);
    real rate = Fused::of(real(2) * spin, normal.left().dot(velocity), -(spin * spin * normal.dot(from_face)));
    real speed = real(0.5) * soft.h * rate;
    return speed < -RESTING_SPEED ? speed : real(0);
  }

  // Speed at the moment of impact, which falls somewhere inside the step. Under a closing acceleration a,
  // semi-implicit Euler keeps u^2/2 + a h u/2 + a s (u approach speed, s separation) exactly, so a bounce that
  // leaves from where the body now is with the same value neither gains nor loses energy, wherever in the step it falls.
  KFN real impact_speed(const Bodies& bodies, Vec2 gravity, real h) const {
    Vec2 pull = gravity * ((bodies.inverse_mass(a) > real(0) ? real(1) : real(0)) -
                           (bodies.inverse_mass(b) > real(0) ? real(1) : real(0)));
    real acceleration = pull.dot(normal), u = -approach;
    real half = real(0.5) * acceleration * h;
    real fallen = separation - current_separation(bodies, moved(bodies));
    real twice_energy = u * u + real(2) * half * u + real(2) * acceleration * fallen;
    return Fast::root(Math::max(half * half + twice_energy, real(0))) + half;
  }

  // What hits so fast that it would go through the thinner of the two in what is left of the step moves on in ways that
  // no prediction has: around a corner, or over an end.
  KFN bool hits_hard(const Geometry& geometry, real reach, real dt) const {
    real distance = Math::max(separation, real(0)) + reach + SAFE_CORE_SHARE * Math::min(geometry.core[a], geometry.core[b]);
    return -approach * dt > distance;
  }

  // Whether two free discs bounce in what is left of the step and are beside each other's line when it ends: their
  // impulse would act at one point, and turn them.
  KFN bool bounces_aside(const Bodies& bodies, Vec2 d, real threshold, real dt) const {
    if (!HAS_RESTITUTION || !are_discs() || against_fixed || !hits(threshold)) return false;
    real aside = Math::abs(normal.cross(bodies.velocity(b) - bodies.velocity(a)));
    return -approach * dt > separation && aside * dt > ASIDE_SHARE * normal.dot(d);
  }

  // What impulses along the normal and the tangent change of the speeds along them.
  struct Response {
    real nn, nt, tt;
  };

  // Normal impulse and friction of an impact together, as each changes the other's speed: it sticks, or slides at Coulomb's
  // limit.
  KFN Vec2 stick_or_slide(Vec2 speeds, const Response& moves) const {
    Vec2 stick = Symmetric::solve(moves.nn, moves.nt, moves.tt, speeds);
    real n = impulse_normal - stick.x, t = impulse_tangent - stick.y;
    if (n >= real(0) && Math::abs(t) <= friction * n) return {n, t};
    // It slides, and friction is mu times what the normal impulse then is: on the way from none to what would stop it.
    real closing = moves.nn * impulse_normal + moves.nt * impulse_tangent - speeds.x;  // without its impulses
    real side = t > real(0) ? friction : -friction, k = moves.nn + side * moves.nt;
    n = closing > real(0) && k > real(0) ? Fast::divide(closing, k) : real(0);
    return {n, side * n};
  }

  // Towards the `wanted` speed of b against a along the tangent.
  KFN void solve_friction(Pair& pair, Arms arms, real mass_tangent, real wanted) {
    if (!HAS_FRICTION || friction == real(0)) return;
    Vec2 tangent = normal.right();
    real vt = tangent.dot(pair.relative(arms.a, arms.b)) - wanted;
    real max_friction = friction * impulse_normal;
    real total = Math::clamp(Fused::of(-mass_tangent, vt, impulse_tangent), -max_friction, max_friction);
    real impulse = total - impulse_tangent;
    impulse_tangent = total;
    pair.apply_impulse(arms.a, arms.b, tangent * impulse);
  }

  // What the last pass gave a bounce, joints and other contacts have shared out since. The next pass pushes as if the
  // contact moved the mass that it was seen to move (secant method); where others push against it, its pair's alone.
  // True if it has its speed, or no push can give it any more.
  KFN bool update_secant_mass(real mass_of_pair, real vn, int round) {
    real gained = Fast::divide(vn - approach, bounce - approach);
    approach = vn;
    if (round == 1) return false;
    if (Math::abs(vn - bounce) <= BOUNCE_TOLERANCE * bounce || Math::abs(gained) < MIN_GAINED_SHARE) return true;
    bool is_seen = gained > real(0) && gained < MAX_SECANT_SHARE;
    mass_normal = is_seen ? Fast::divide(mass_normal, Math::max(gained, MIN_SECANT_SHARE)) : mass_of_pair;
    return false;
  }
};
