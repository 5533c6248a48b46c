// The contacts of one world in one step: found, matched with the impulses of the step before, solved.
//
// Soft contacts follow the soft-step solver of Box2D v3 (Solver2D study); their equations are in docs/engine_solver.md.
// Hard contacts (preset paper) follow the appendix of the Kinetix paper.

struct Contacts {
  ARRAY(Contact, list, NUM_CONTACTS + 1);
  Surfaces surfaces;
  int count, overflow;
  Pairs pairs;
  ARRAY(unsigned int, unsteady, SHAPE_WORDS);  // bodies whose contacts do not hold for the step: they turn too far or hit too hard
  ARRAY(unsigned int, exceeding, SHAPE_WORDS);  // bodies so much faster than predicted that they may outrun their contacts
  bool may_bounce;  // something approaches fast enough
  ARRAY(unsigned int, unsettled, SHAPE_WORDS);  // bodies of bounces that had not their speed in the last pass
  ARRAY(unsigned int, with_friction, SHAPE_WORDS);  // bodies whose bounces get friction in this pass
  ActiveSet active;

  KFN static int key_of(int slot_a, int slot_b, int feature) { return (slot_a << (FEATURE_BITS + SHAPE_BITS)) | (slot_b << FEATURE_BITS) | feature; }

  // Looks at the pairs near each other in the order of slots, so that pairs ascend and old impulses are found by one
  // walk over the old list. `reach` is the distance at which a contact is prepared; `is_start`: nothing has acted yet in
  // this sub-step. Unless `all`, only contacts of `found` are, with each other and what is fixed; others stay.
  KFN void find(const Bodies& bodies, const Geometry& geometry, const Column& scene, const IntColumn& ints,
                const Column& params, const IntColumn& old_keys, const Column& old_impulses, real reach, real dt,
                bool ahead, bool is_start, bool all, const unsigned int* found) {
    int kept = NUM_CONTACTS;  // the first of those that stay: they wait at the end of the list
    for (int k = count - 1; k >= 0 && !all; --k)
      if (!list[k].is_of(found)) move(k, --kept);
    count = 0;
    overflow = 0;
    if (all) {
      may_bounce = false;
      Bodies::clear(unsteady);
    }
    for (int word = 0; word < SHAPE_WORDS; ++word) exceeding[word] = all ? 0u : exceeding[word] & ~found[word];
    real threshold = params.get(PARAM_RESTITUTION_THRESHOLD);
    if (NUM_CONTACTS == 0) return;
    ahead = ahead && HAS_CONTINUOUS_COLLISION;
    bool warm = params.get(PARAM_WARM_START) != real(0);
    pairs.find(bodies, geometry, ints, reach, ahead, found);
    PairWalk walk = PairWalk::over(pairs);
    int old_slot = 0, slot_b;
    while ((slot_b = walk.next_slot(pairs)) >= 0) {
      int a = walk.a, b = Slot::shape(slot_b), slot_a = Slot::of(a);
      Vec2 d = bodies.position[b] - bodies.position[a], motion = bodies.velocity(b) - bodies.velocity(a);
      real speed = motion.length(), margin = Pairs::margin(geometry, a, b, speed, reach, ahead);
      if (!geometry.bounds_overlap(a, b, d, margin)) continue;
      Manifold m = geometry.collide(a, b, d, motion, bodies.omega(a), margin);
      if (m.count == 0) continue;
      bool is_unsteady = ahead && rotates_too_far(bodies, geometry, a, b, motion, reach, dt);
      real friction = real(0), restitution = real(0);
      if (HAS_FRICTION)
        friction = mix_friction(scene.get(SCENE_SHAPES_FRICTION + slot_a), scene.get(SCENE_SHAPES_FRICTION + slot_b), params);
      if (HAS_RESTITUTION)
        restitution = Math::min(scene.get(SCENE_SHAPES_RESTITUTION + slot_a), scene.get(SCENE_SHAPES_RESTITUTION + slot_b));
      int pair_key = key_of(slot_a, slot_b, 0);
      while (old_slot < CAPACITY_CONTACTS) {  // keys of earlier pairs are behind us for good
        int key = old_keys.get(old_slot);
        if (key < 0 || key >= pair_key) break;
        ++old_slot;
      }
      for (; kept < NUM_CONTACTS && list[kept].key < pair_key; ++kept) move(kept, count++);
      for (int p = 0; p < m.count; ++p) {
        if (count == kept) {
          ++overflow;
          continue;
        }
        surfaces.load(count, scene, geometry, a, b);
        Contact& c = list[count++];
        c.a = a;
        c.b = b;
        c.key = pair_key | m.points[p].feature;
        c.normal = m.normal;
        // Where the surfaces are apart each is met at its own point: they will have moved together by then.
        Vec2 half_gap = m.normal * (real(0.5) * Math::max(m.points[p].separation, real(0)));
        c.arm_a = m.points[p].point - half_gap;
        c.arm_b = m.points[p].point + half_gap - (SOFT_STEP && c.are_discs() ? m.normal * m.normal.dot(d) : d);
        c.separation = m.points[p].separation;
        c.follows_b = m.follows_b;
        c.disc_on_face = m.on_face;
        c.friction = friction;
        c.restitution = restitution;
        c.against_fixed = !(bodies.is_dynamic(a) && bodies.is_dynamic(b));
        if (HAS_KINEMATIC_BODIES) c.against_kinematic = bodies.is_kinematic(a) || bodies.is_kinematic(b);
        c.mass_normal = c.pair_mass(bodies, m.normal);
        c.mass_tangent = c.pair_mass(bodies, m.normal.right());
        c.impulse_normal = real(0);
        c.impulse_tangent = real(0);
        c.max_impulse = real(0);
        c.bounce = real(0);
        for (int s = old_slot; warm && s < CAPACITY_CONTACTS; ++s) {
          int key = old_keys.get(s);
          if (key < 0 || (key >> FEATURE_BITS) != (pair_key >> FEATURE_BITS)) break;
          if (key == c.key) {
            c.impulse_normal = old_impulses.get(IMPULSE_CONTACT_IMPULSE + 2 * s);
            c.impulse_tangent = old_impulses.get(IMPULSE_CONTACT_IMPULSE + 2 * s + 1);
            surfaces.load_impulse(count - 1, old_impulses, s);
            break;
          }
        }
        c.approach = c.normal_speed(bodies);
        // What an impact next to it has left of an impulse would throw apart what it no longer holds.
        if (SOFT_STEP && is_start && c.approach > MIN_SEPARATING_SPEED) reset_impulses(count - 1);
        // Discs have no corners to turn about: theirs are handed on (SHARES_IMPACTS) or left to the next sub-step.
        c.is_impact = SOFT_STEP && c.approach < -MIN_IMPACT_SPEED && c.impulse_normal == real(0) && (SHARES_IMPACTS || b < NUM_POLYGONS);
        c.is_second = SOFT_STEP && p > 0 && count > 1 && list[count - 2].key >> FEATURE_BITS == pair_key >> FEATURE_BITS;
        if (c.is_second) c.is_impact = list[count - 2].is_impact = c.is_impact | list[count - 2].is_impact;
        if (SOFT_STEP) may_bounce |= c.hits(threshold);
        if (ahead) is_unsteady |= c.hits_hard(geometry, reach, dt) || c.bounces_aside(bodies, d, threshold, dt);
      }
      if (is_unsteady) bodies.add_moving(unsteady, a, b);
    }
    for (; kept < NUM_CONTACTS; ++kept) move(kept, count++);
  }

  KFN void move(int from, int to) {
    list[to] = list[from];
    surfaces.move(from, to);
  }

  // Which contacts hold until when, and of whom.
  struct Found {
    const unsigned int* last;     // bodies whose contacts were found last, with each other's
    const unsigned int* every;    // those whose contacts are found in each sub-step
    const unsigned int* brief;    // those whose contacts have been, for one
    const unsigned int* waiting;  // those that have not moved yet in this sub-step
  };

  // Marks bodies that could meet without a contact, since they move on farther than was predicted from velocities
  // `before`: every margin has `reach` to spare. Where contacts of the two were not found together, those that could meet
  // in this sub-step. step, left, h: seconds of the step, of what is left of it, and of the sub-step.
  KFN bool outruns_contacts(const Bodies& bodies, const Geometry& geometry, const Velocities& before, const IntColumn& ints,
                            real reach, real step, real left, real h, const Found& found, unsigned int* outrunning) {
    Bodies::clear(outrunning);
    if (!HAS_CONTINUOUS_COLLISION || NUM_CONTACTS == 0) return false;
    for (Bodies::Each each = Bodies::Each::of(bodies.moving); each.next();) {
      int i = each.shape;
      real ahead = Bodies::has(found.brief, i) ? h : step;
      if (geometry.exceeds_prediction(bodies, i, before.velocity[i], reach, ahead)) Bodies::add(exceeding, i);
    }
    bool is_part = false;
    for (int word = 0; word < SHAPE_WORDS; ++word) is_part |= (bodies.moving[word] & ~found.last[word]) != 0u;
    is_part = is_part && Bodies::any(found.last);
    if (!is_part && !Bodies::any(exceeding)) return false;
    unsigned int looks[SHAPE_WORDS];
    for (int word = 0; word < SHAPE_WORDS; ++word) looks[word] = exceeding[word] | (is_part ? found.last[word] : 0u);
    bool any = false;
    for (Bodies::Each one = Bodies::Each::of(looks); one.next();) {
      int i = one.shape;
      Vec2 gone = bodies.delta(i), motion = bodies.velocity(i), was = before.velocity[i];
      bool waits = Bodies::has(found.waiting, i), is_brief = Bodies::has(found.every, i);
      real ahead = Bodies::has(found.brief, i) ? h : step, moved = waits ? real(0) : h, until = (is_brief ? h : left) - moved;
      real alone = gone.length() + motion.length() * until + geometry.current_swing(bodies, i, until) -
                   was.length() * ahead - geometry.swing[i];
      // What is fixed it meets only if it goes farther itself.
      for (Bodies::Each other = Bodies::Each::of(alone > reach ? bodies.present : bodies.moving); other.next();) {
        int j = other.shape, a = Math::min_int(i, j), b = Math::max_int(i, j);
        bool both_move = bodies.moves(j), other_waits = both_move && Bodies::has(found.waiting, j);
        if (i == j || (!waits && !other_waits) || !can_touch(ints, a, b)) continue;
        bool together = !both_move || Bodies::has(found.last, i) == Bodies::has(found.last, j);
        bool is_soon = !together || is_brief || (both_move && Bodies::has(found.every, j));
        real end = is_soon ? h : left, own = end - moved, others = both_move && !other_waits ? end - h : end;
        Vec2 way = ((bodies.velocity(j) - motion) * others).plus(motion, others - own);
        real travel = (bodies.delta(j) - gone).length() + way.length() + geometry.current_swing(bodies, i, own) +
                      geometry.current_swing(bodies, j, others);
        real predicted = (before.velocity[j] - was).length() * ahead + geometry.swing[i] + geometry.swing[j];
        if (together && travel - predicted <= reach) continue;
        Vec2 d = bodies.position[b] - bodies.position[a];
        if (geometry.bounding_distance(a, b, d) > travel || has_contact(a, b)) continue;
        if (geometry.least_distance(a, b, d) > travel) continue;
        bodies.add_moving(outrunning, a, b);
        any = true;
      }
    }
    return any;
  }

  KFN static bool can_touch(const IntColumn& ints, int a, int b) {
    int slot_a = Slot::of(a), slot_b = Slot::of(b);
    int partners = ints.get(INTS_SHAPES_CAN_TOUCH + slot_a * TOUCH_WORDS + slot_b / 32);
    return ((unsigned int)(partners) >> (slot_b % 32) & 1u) != 0u;
  }

  KFN bool has_contact(int a, int b) const {
    for (int k = 0; k < count; ++k)
      if (list[k].a == a && list[k].b == b) return true;
    return false;
  }

  // Contact points and normals of a step hold for small turns only: a rod that spins fast sweeps over what they say.
  // So does a bar along which something fast goes meanwhile.
  KFN static bool rotates_too_far(const Bodies& bodies, const Geometry& geometry, int a, int b, Vec2 motion, real reach, real dt) {
    real turn_a = geometry.arm(a) > real(0) ? Math::abs(bodies.omega(a)) : real(0);
    real turn_b = geometry.arm(b) > real(0) ? Math::abs(bodies.omega(b)) : real(0);
    return geometry.predicted_travel(a, b, motion.length()) * Math::max(turn_a, turn_b) * dt > reach;
  }

  KFN static real mix_friction(real a, real b, const Column& params) {
    real base = params.get(PARAM_BASE_FRICTION);
    return base * (FRICTION_ROOT_SUM_SQUARE ? Fast::root(a * a + b * b) : Fast::root(a * b));
  }

  KFN void reset_impulses(int k) {
    list[k].impulse_normal = list[k].impulse_tangent = real(0);
    surfaces.reset_impulses(k);
  }

  KFN void scale_impulses(int k, real share) {
    if (share == real(0)) return reset_impulses(k);  // they may not be finite
    list[k].impulse_normal *= share;
    list[k].impulse_tangent *= share;
    surfaces.scale_impulses(k, share);
  }

  // All that contact k exerts, where the bodies are now.
  KFN void apply_impulses(const Bodies& bodies, Pair& pair, int k) const {
    const Contact& c = list[k];
    Arms arms = c.arms_now(bodies, c.moved(bodies));
    pair.apply_impulse(arms.a, arms.b, (c.normal * c.impulse_normal).plus(c.normal.right(), c.impulse_tangent));
    surfaces.warm_start(pair, k);
  }

  // J, what the moving surface of contact i has done to the bodies in this sub-step of h.
  KFN real surface_work(const Bodies& bodies, int i, real h) const {
    const Contact& c = list[i];
    real work = real(0);
    if (HAS_SURFACE_SPEED) work += c.impulse_tangent * surfaces.speed_of(i);
    if (!HAS_KINEMATIC_BODIES || !c.against_kinematic) return work;
    bool is_a = bodies.is_kinematic(c.a);
    int k = is_a ? c.a : c.b;
    Arms arms = c.carried_arms(bodies, c.moved(bodies), real(-0.5) * h);
    Vec2 impulse_on_b = c.normal * c.impulse_normal + c.normal.right() * c.impulse_tangent;
    real done = impulse_on_b.dot(bodies.velocity(k) + (is_a ? arms.a : arms.b).left() * bodies.omega(k));
    return work + (is_a ? done : -done);
  }

  KFN void warm_start(Bodies& bodies) {
    for (int i = 0; i < count; ++i) {
      if (!list[i].lasts()) reset_impulses(i);
      Pair pair = Pair::of(bodies, list[i].a, list[i].b);
      apply_impulses(bodies, pair, i);
      pair.write_back(bodies);
    }
  }

  // One pass of the soft-step solver. With bias: pushes out of penetration softly; without (relax): takes
  // back the velocity that the push added, and applies friction. In later rounds of it what bounces leaves.
  KFN void solve_soft(Bodies& bodies, Joints& joints, LineSearch& search, const Soft& soft, bool use_bias, int round) {
    int repeats = 0;
    real first_change = real(0);
    unsigned int ready[JOINT_WORDS];  // joints whose system does for impacts, where bodies stand and without motors
    JointSystem::clear(ready);
    JointAnswers answers = {joints};
    for (int i = 0; i < count; ++i) {
      Contact& c = list[i];
      if (active.leaves_out(c.a, c.b)) continue;
      int searched = LINE_SEARCH && use_bias ? search.island_of(bodies, c.a, c.b) : -1;
      Pair pair = Pair::of(bodies, c.a, c.b);
      Vec2 moved = c.moved(bodies);
      real separation = c.current_separation(bodies, moved);
      bool shares = active.shares(c.a, c.b);
      if (shares) c.is_impact = true;
      Arms arms = c.is_impact && round == 0 ? c.arms_of_impact(bodies, moved) : c.arms_now(bodies, moved);
      // With bias the sub-step is to come, in the relax pass it is past.
      if (HAS_KINEMATIC_BODIES && c.against_kinematic)
        arms = c.carried_arms(bodies, moved, (use_bias ? real(0.5) : real(-0.5)) / soft.inverse_h);
      // A disc that has not come yet is hit in the next step, by what then has left.
      if (HAS_RESTITUTION && round > 0 && c.b >= NUM_POLYGONS && separation > real(0) && c.restitution > real(0) && c.max_impulse == real(0)) continue;
      real bias = real(0), mass_scale = real(1), impulse_scale = real(0);
      if (HAS_RESTITUTION && round > 0 && c.b >= NUM_POLYGONS && c.is_impact) {
        // The impact went through here.
      } else if (separation > TOUCHING_DISTANCE) {
        bias = separation * soft.inverse_h;  // speculative: may close the gap, not more
      } else if (use_bias) {
        Softness of = Softness::either(c.against_fixed, soft.fixed, soft.contact);
        mass_scale = of.mass_scale;
        impulse_scale = of.impulse_scale;
        bias = Math::max(mass_scale * of.bias_rate * separation, -soft.push_out_speed);
      }
      if (use_bias && (c.b < NUM_POLYGONS || c.disc_on_face))
        bias = Fused::of(mass_scale, c.closes_by(pair, arms, soft), bias);
      real vn = c.normal.dot(pair.relative(arms.a, arms.b));
      bool bounces = HAS_RESTITUTION && round > 0 && c.bounce > real(0);
      if (c.is_impact && round == 0) {
        unsigned int jointed[JOINT_WORDS];
        bool is_jointed = NUM_JOINTS > 0 && answers.find_articulations(c.a, c.b, jointed);
        real change = solve_impact(bodies, answers, pair, c, {arms, bias, surfaces.speed_of(i), is_jointed, !use_bias, jointed, ready});
        if (change > (shares ? SETTLED_SPEED : SHARED_SPEED)) active.mark(bodies, c.a, c.b);
        if (!use_bias) surfaces.solve_rolling(pair, i, c.impulse_normal);
        if (searched >= 0) {
          search.impulse[i] = real(0);
          if (change > real(0)) search.leave_out(searched);
        }
        pair.write_back(bodies);
        // Both points of a pair in turn, until they agree: what one had on the way does not count.
        if (c.is_second && Math::max(first_change, change) > SETTLED_SPEED && repeats < POINT_ROUNDS) {
          ++repeats;
          i -= 2;
        } else if (c.is_second || i + 1 == count || !list[i + 1].is_second) {
          for (int k = c.is_second ? i - 1 : i; k <= i; ++k)
            list[k].max_impulse = Math::max(list[k].max_impulse, list[k].impulse_normal);
          repeats = 0;
        }
        first_change = change;
        continue;
      }
      real mass = c.mass_normal, mass_tangent = c.mass_tangent;
      if (!c.against_fixed) {
        if (!bounces || round == 1) mass = pair.mass(arms.a, arms.b, c.normal);
        if (bounces) c.mass_normal = mass;
        mass_tangent = pair.mass(arms.a, arms.b, c.normal.right());
      }
      if (bounces) {
        bias = -c.bounce;
        bool is_settled = c.update_secant_mass(pair.mass(arms.a, arms.b, c.normal), vn, round);
        if (!is_settled) bodies.add_dynamic(unsettled, c.a, c.b);
        mass = c.mass_normal;
      }
      real impulse = Fused::of(-mass, Fused::of(mass_scale, vn, bias), -(impulse_scale * c.impulse_normal));
      real total = Math::max(c.impulse_normal + impulse, real(0)), had = c.impulse_normal;
      impulse = total - had;
      c.impulse_normal = total;
      c.max_impulse = Math::max(c.max_impulse, total);
      pair.apply_impulse(arms.a, arms.b, c.normal * impulse);
      if (searched >= 0) {
        search.impulse[i] = impulse;
        if (impulse != real(0) && mass > real(0)) {
          // The contact's row is speed + bias / mass_scale + yields * impulse, which is to be zero.
          real yields = Fast::divide(impulse_scale, mass * mass_scale);
          real wrong = vn + Fast::divide(bias, mass_scale) + yields * had;
          real changed = c.normal.dot(search.give(bodies, pair, arms, c.normal * impulse));
          search.add(searched, impulse, total, wrong + real(0.5) * changed, yields);
        }
      }
      if (!use_bias && (!bounces || c.is_of(with_friction))) {
        c.solve_friction(pair, arms, mass_tangent, surfaces.speed_of(i));
        surfaces.solve_rolling(pair, i, c.impulse_normal);
      }
      pair.write_back(bodies);
    }
  }

  // How much more each island of the last pass with bias has taken; its bodies have it (LineSearch::find).
  KFN void add_more(const Bodies& bodies, const LineSearch& search) {
    for (int i = 0; i < count; ++i) {
      Contact& c = list[i];
      int island = active.leaves_out(c.a, c.b) ? -1 : search.island_of(bodies, c.a, c.b);
      if (island < 0 || search.slope[island] == real(0)) continue;
      c.impulse_normal = Math::max(Fused::of(search.slope[island], search.impulse[i], c.impulse_normal), real(0));
      c.max_impulse = Math::max(c.max_impulse, c.impulse_normal);
    }
  }

  // Where an impact acts, the speeds that are wanted, and joints of the articulations of its bodies, which `have_moved` since
  // they were solved. `ready`: those whose system does for impacts.
  struct Impact {
    Arms arms;
    real bias, along;
    bool is_jointed, have_moved;
    const unsigned int* jointed;
    unsigned int* ready;
  };

  // Solves an impact. What is jointed to its bodies answers at once, to an impulse of 1 along the normal and along the tangent;
  // what it answers to that of the impact is a sum of both. What opens by itself has none, though friction could hold it
  // (Painleve's paradox). Returns by how much (m/s) it changed a speed.
  KFN real solve_impact(Bodies& bodies, JointAnswers& answers, Pair& pair, Contact& c, const Impact& impact) {
    Vec2 tangent = c.normal.right(), v = pair.relative(impact.arms.a, impact.arms.b);
    Vec2 speeds = {c.normal.dot(v) + impact.bias, tangent.dot(v) - impact.along};
    if (c.impulse_normal == real(0) && c.impulse_tangent == real(0) && speeds.x >= real(0)) return real(0);
    Pair by_normal = pair.at_rest(), by_tangent = pair.at_rest();
    by_normal.apply_impulse(impact.arms.a, impact.arms.b, c.normal);
    by_tangent.apply_impulse(impact.arms.a, impact.arms.b, tangent);
    if (impact.is_jointed) {
      bool is_ready = JointSystem::has_all(impact.ready, impact.jointed);
      answers.add(bodies, impact.jointed, by_normal, by_tangent,
                  !is_ready && (impact.have_moved || answers.hold_by_motors(impact.jointed)));
      JointSystem::add_all(impact.ready, impact.jointed);
    }
    Vec2 along_normal = by_normal.relative(impact.arms.a, impact.arms.b), along_tangent = by_tangent.relative(impact.arms.a, impact.arms.b);
    Contact::Response moves = {c.normal.dot(along_normal), tangent.dot(along_normal), tangent.dot(along_tangent)};
    Vec2 total = c.stick_or_slide(speeds, moves), added = {total.x - c.impulse_normal, total.y - c.impulse_tangent};
    c.impulse_normal = total.x;
    c.impulse_tangent = total.y;
    if (impact.is_jointed) answers.exert(bodies, impact.jointed, added, active);
    pair.add(by_normal, added.x);
    pair.add(by_tangent, added.y);
    return Math::max(Math::abs(added.x) * moves.nn, Math::abs(added.y) * moves.tt);
  }

  // Restitution, where contacts of `ends` end: what hit gets the speed at which it must leave. Marks its bodies; False if
  // nothing bounces.
  KFN bool begin_bounces(const Bodies& bodies, const Column& params, Vec2 gravity, real h, const unsigned int* ends,
                         unsigned int* bouncing) {
    real threshold = params.get(PARAM_RESTITUTION_THRESHOLD);
    Bodies::clear(bouncing);
    bool any = false;
    for (int i = 0; i < count; ++i) {
      Contact& c = list[i];
      if (!c.hits(threshold) || c.max_impulse == real(0) || !c.is_of(ends)) continue;
      c.bounce = c.restitution * c.impact_speed(bodies, gravity, h);
      bodies.add_dynamic(bouncing, c.a, c.b);
      any = true;
    }
    return any;
  }

  // Of bodies of `hit` those of what bounces.
  KFN bool find_bouncing(const Bodies& bodies, const unsigned int* hit, unsigned int* bouncing) const {
    Bodies::clear(bouncing);
    bool any = false;
    for (int i = 0; i < count; ++i) {
      if (list[i].bounce <= real(0) || !list[i].is_of(hit)) continue;
      bodies.add_dynamic(bouncing, list[i].a, list[i].b);
      any = true;
    }
    return any;
  }

  // One iteration of sequential impulses (paper, appendix Collision Resolution): restitution target and
  // penetration bias in the numerator, accumulated impulse never negative, friction by Coulomb's law.
  KFN void solve_hard(Bodies& bodies, real correction_rate, real slop) {
    for (int i = 0; i < count; ++i) {
      Contact& c = list[i];
      real bias = correction_rate * Math::max(-c.separation - slop, real(0));
      Pair pair = Pair::of(bodies, c.a, c.b);
      real vn = c.normal.dot(pair.relative(c.arm_a, c.arm_b));
      real wanted = c.restitution * c.approach;
      real total = Math::max(c.impulse_normal + c.mass_normal * (-vn + bias - wanted), real(0));
      real impulse = total - c.impulse_normal;
      c.impulse_normal = total;
      c.max_impulse = Math::max(c.max_impulse, total);
      pair.apply_impulse(c.arm_a, c.arm_b, c.normal * impulse);
      c.solve_friction(pair, {c.arm_a, c.arm_b}, c.mass_tangent, real(0));
      pair.write_back(bodies);
    }
  }

  // Impulses of contacts of `which` as they were last stored.
  KFN void load_impulses(const Column& impulses, const unsigned int* which) {
    for (int k = 0; k < count; ++k) {
      if (!list[k].is_of(which)) continue;
      list[k].impulse_normal = impulses.get(IMPULSE_CONTACT_IMPULSE + 2 * k);
      list[k].impulse_tangent = impulses.get(IMPULSE_CONTACT_IMPULSE + 2 * k + 1);
      surfaces.load_impulse(k, impulses, k);
    }
  }

  // Stores impulses for warm starting, none of what bounces apart; slots in use before and free now are marked free.
  KFN void store(const IntColumn& keys, const Column& impulses) const {
    for (int s = 0; s < CAPACITY_CONTACTS; ++s) {
      if (s < count) {
        keys.set(s, list[s].key);
        bool lasts = list[s].lasts();
        impulses.set(IMPULSE_CONTACT_IMPULSE + 2 * s, lasts ? list[s].impulse_normal : real(0));
        impulses.set(IMPULSE_CONTACT_IMPULSE + 2 * s + 1, lasts ? list[s].impulse_tangent : real(0));
        surfaces.store(s, lasts, impulses);
      } else if (keys.get(s) >= 0) {
        keys.set(s, -1);
        impulses.set(IMPULSE_CONTACT_IMPULSE + 2 * s, real(0));
        impulses.set(IMPULSE_CONTACT_IMPULSE + 2 * s + 1, real(0));
        surfaces.store(s, false, impulses);
      } else {
        break;  // used slots are always the first ones
      }
    }
  }
};
