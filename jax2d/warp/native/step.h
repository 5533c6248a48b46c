// One world, num_steps physics steps: read, step, write. Read this file first.

struct World {
  const Column& scene;
  const IntColumn& ints;
  const Column& controls;
  const Column& params;
  const Column& state;
  const Column& impulses;
  const IntColumn& keys;
  Bodies bodies;
  Velocities at_detection;  // when contacts were found; in a bounce, before anything bounced
  Geometry geometry;
  Contacts contacts;
  Joints joints;
  Thrusters thrusters;
  Bounces bounces;
  Islands islands;
  LineSearch search;
  Report report;
  Soft soft;
  ARRAY(unsigned int, touching_now, NUM_SHAPES * TOUCH_WORDS);  // a row a shape, a bit a slot
  ARRAY(unsigned int, touching_ever, NUM_SHAPES * TOUCH_WORDS);
  bool first;       // nothing has been prepared in this call yet
  bool is_last_step;  // in the last step of the call
  int overflow;
  bool reports;     // contacts of this step are reported

  KFN void run(int num_steps, const IntColumn& out) {
    bodies.load(scene, ints, state);
    if (SOFT_STEP) at_detection.keep(bodies, bodies.present);
    thrusters.load(scene, ints, controls, params);
    if (SWEEP) contacts.pairs.sweep.load(bodies);
    overflow = 0;
    first = true;
    for (int i = 0; i < NUM_SHAPES * TOUCH_WORDS; ++i) touching_now[i] = touching_ever[i] = 0u;
    for (int step = 0; step < num_steps; ++step) {
      is_last_step = step == num_steps - 1;
      reports = REPORT_CONTACTS > 0 && is_last_step;
      if (reports) report.begin_step(out);
      joints.load(bodies, scene, ints, params, impulses, step == 0);
      Bodies::clear(bodies.slowed);
      if (SOFT_STEP)
        soft_step();
      else
        paper_step();
      joints.springs.reset_slowed(bodies);
      joints.store(impulses);
      if (reports) report.end_step();
    }
    bodies.store(state);
    for (int slot = 0; slot < CAPACITY_SHAPES; ++slot) {
      for (int word = 0; word < TOUCH_WORDS; ++word) {
        int row = slot * TOUCH_WORDS + word, own = Slot::shape(slot) * TOUCH_WORDS + word;
        out.set(OUT_AT_END + row, Slot::in_use(slot) ? (int)(touching_now[own]) : 0);
        out.set(OUT_DURING + row, Slot::in_use(slot) ? (int)(touching_ever[own]) : 0);
      }
    }
    out.set(OUT_OVERFLOW, overflow);
    out.set(OUT_LIMITED, bodies.limited);
    out.set(OUT_OPEN_JOINTS, joints.num_open(bodies));
  }

  // Soft-step sub-stepping (Box2D v3): contacts found once, then solved in sub-steps of h.
  KFN void soft_step() {
    soft = Soft::load(params);
    real h = params.get(PARAM_H), reach = params.get(PARAM_SPECULATIVE_DISTANCE);
    int substeps = (int)(params.get(PARAM_SUBSTEPS));
    Vec2 gravity = scene.get2(SCENE_GRAVITY);

    // Bodies whose contacts are found next, those whose contacts are found in each sub-step, since those found once would not
    // hold, those that have not moved yet in this sub-step, and those whose contacts were found for a sub-step alone.
    unsigned int found[SHAPE_WORDS], every[SHAPE_WORDS], waiting[SHAPE_WORDS], brief[SHAPE_WORDS];
    Bodies::copy(found, bodies.moving);
    Bodies::copy(waiting, bodies.moving);
    bool stopped = false;  // `found` were, before they moved: forces have acted, and only they are solved
    int stops = 0;
    for (int substep = 0; substep < substeps;) {
      // Each function is called once: what is inlined twice is twice the code.
      bool all = substep == 0 && !stopped;
      if (all || Bodies::any(found)) {
        if (!all) bodies.end_step(found);
        bodies.begin_step(first, found);
        geometry.build(scene, ints, bodies, first, found);
        geometry.predict_travel(bodies, found, all ? h * (real)(substeps) : h, h);
        for (int word = 0; word < SHAPE_WORDS; ++word) brief[word] = all ? 0u : brief[word] | found[word];
        at_detection.keep(bodies, found);
        first = false;
        contacts.find(bodies, geometry, scene, ints, params, keys, impulses, reach, geometry.ahead, true, !stopped, all, found);
        overflow += contacts.overflow;
        joints.prepare(bodies, found, scene, controls, params, h);
        islands.find(bodies, contacts, joints, found);
        if (all) {
          Bodies::copy(every, contacts.unsteady);
          if (Bodies::any(every)) islands.complete_groups(bodies, contacts, joints, every);
        }
        if (contacts.may_bounce) {
          bounces.begin(bodies, islands, found, gravity, h);
          if (stopped) add_carried_work(found, h, real(-1));  // bodies have had these impulses already
        }
        if (reports) report.begin(contacts);
      }
      if (!stopped) {
        bodies.apply_gravity(gravity, h);
        thrusters.apply(bodies, h);
        ExternalForces::apply(bodies, controls, h);
        bodies.apply_damping(scene, h);
        islands.begin(bodies);
        joints.springs.warm_start(bodies);
        contacts.warm_start(bodies);
        joints.begin(bodies, scene, h);
        if (reports) report.warm_start(contacts);
      }
      unsigned int solved[SHAPE_WORDS], ending[SHAPE_WORDS];
      for (int word = 0; word < SHAPE_WORDS; ++word) solved[word] = stopped ? found[word] : bodies.moving[word];
      unsigned int outrunning[SHAPE_WORDS];
      bool stops_now = false;
      for (int relaxes = 0; relaxes < 2; ++relaxes) {  // before and after bodies move
        if (relaxes) {
          // Islands of bodies that would now go farther than was predicted are stopped before they move: their contacts are
          // found again, from here on in each sub-step.
          unsigned int moving[SHAPE_WORDS];
          real left = h * (real)(substeps - substep);
          stops_now = stops < MAX_STOPS &&
                      contacts.outruns_contacts(bodies, geometry, at_detection, ints, reach, h * (real)(substeps), left, h,
                                                {found, every, brief, waiting}, outrunning);
          if (stops_now) islands.complete_groups(bodies, contacts, joints, outrunning);
          for (int word = 0; word < SHAPE_WORDS; ++word) {
            unsigned int out = stops_now ? outrunning[word] : 0u, ends = substep == substeps - 1 ? ~0u : every[word];
            moving[word] = waiting[word] & ~out;
            ending[word] = (moving[word] & ends) | (out & (waiting[word] | ~ends));
            waiting[word] &= out;
            outrunning[word] = out;
          }
          bodies.move(moving, h, params.get(PARAM_MAX_SPEED), params.get(PARAM_MAX_ANGULAR_SPEED));
        }
        solve(relaxes == 0, gravity, h, solved, stopped, ending);
      }
      bodies.limit_speeds(ending, params.get(PARAM_MAX_SPEED), params.get(PARAM_MAX_ANGULAR_SPEED));
      stopped = stops_now;
      for (int word = 0; word < SHAPE_WORDS; ++word) {
        every[word] |= outrunning[word];
        found[word] = stopped ? outrunning[word] : every[word];
        if (!stopped) waiting[word] = bodies.moving[word];
      }
      stops = stopped ? stops + 1 : 0;
      if (!stopped) ++substep;
    }
    bodies.end_step(bodies.moving);
  }

  // Limits speeds of bodies that have just been solved. `again`: islands of those that this slows down, with contacts or
  // joints that have a say in it; True if there are any. What is jointed keeps its spin at the limit until it is solved: what
  // is heavier and turns it faster gives way, or joints would come apart.
  KFN bool slow_down(const unsigned int* solved, bool looks, unsigned int* again) {
    Bodies::clear(again);
    bool any = false;
    for (Bodies::Each each = Bodies::Each::of(solved); each.next();) {
      if (!bodies.limit_speed(each.shape, params.get(PARAM_MAX_SPEED), params.get(PARAM_MAX_ANGULAR_SPEED)) || !looks) continue;
      Bodies::add(again, each.shape);
      any = true;
    }
    if (!any) return false;
    unsigned int touching[SHAPE_WORDS];
    Bodies::clear(touching);
    for (int k = 0; k < joints.count; ++k) bodies.add_dynamic(touching, joints.list[k].a, joints.list[k].b);
    for (Bodies::Each each = Bodies::Each::of(touching); each.next();)
      if (Bodies::has(again, each.shape)) bodies.hold_spin(each.shape, params.get(PARAM_MAX_ANGULAR_SPEED));
    for (int k = 0; k < contacts.count; ++k) bodies.add_dynamic(touching, contacts.list[k].a, contacts.list[k].b);
    islands.complete(bodies, touching);
    islands.complete(bodies, again);
    any = false;
    for (int word = 0; word < SHAPE_WORDS; ++word) {
      again[word] &= touching[word];
      any |= again[word] != 0u;
    }
    return any;
  }

  // Solves bodies of `solved`, others too unless `is_part`.
  //
  // With bias: joints, contacts, and joints again, so each has what the other answers. Where a speed limit takes back what
  // stops a body, the rest of it is solved again with all of its island. And where something hits, until all that it
  // reaches has its share.
  //
  // Without: contacts alone, since joints have the velocities that keep anchors together; but where an island has gained
  // energy they share in what takes it back, and where that does not, all its bodies get a share of what has changed. Where
  // contacts are `ending`, what hit bounces: rounds go on until joints and other contacts of its island have shared in it and
  // every bounce has its speed. What the next step is warm-started with is from before, since a bounce does not last.
  KFN void solve(bool use_bias, Vec2 gravity, real h, const unsigned int* solved, bool is_part, const unsigned int* ending) {
    int rounds = (int)(params.get(PARAM_BOUNCE_ROUNDS)), max_passes = (int)(params.get(PARAM_IMPACT_PASSES));
    bool bouncing = false, is_second = false;  // joints again
    int round = 0, passes = 0, energy_passes = 0;
    unsigned int gaining[SHAPE_WORDS], none[SHAPE_WORDS], hit[SHAPE_WORDS], passed[SHAPE_WORDS];
    Bodies::clear(none);
    Bodies::copy(gaining, solved);
    Bodies::copy(passed, solved);
    contacts.active.begin(is_part, solved);
    for (;;) {
      if (use_bias || round > 0 || energy_passes > 0)
        joints.solve_soft(bodies, soft, use_bias, !is_second, search, contacts.active);
      else
        joints.springs.solve(bodies, soft, false, contacts.active);
      if (LINE_SEARCH && use_bias && !is_second) begin_search();
      if (!is_second) contacts.solve_soft(bodies, joints, search, soft, use_bias, round);
      if (use_bias) {
        if (LINE_SEARCH && is_second && search.is_found) contacts.add_more(bodies, search);
        is_second = !is_second;
        if (is_second) continue;
        unsigned int again[SHAPE_WORDS];
        bool is_slowed = slow_down(passed, passes < LIMITED_PASSES, again);
        if (!SHARES_IMPACTS && !is_slowed) break;
        if (!contacts.active.repeat(passes++ < max_passes, again)) break;
        Bodies::copy(passed, contacts.active.now);
        islands.complete(bodies, passed);
        continue;
      }
      if (round > 0) {
        if (!bounces.end_round(bodies, contacts, islands, round + 1 == rounds) || ++round > rounds) break;
        continue;
      }
      // Joints and other contacts share in an impact.
      if (SHARES_IMPACTS && contacts.active.repeat(passes++ < max_passes, none)) continue;
      if (energy_passes <= ENERGY_PASSES && gains_energy(h, is_part || energy_passes > 0, gaining)) {
        if (energy_passes++ < ENERGY_PASSES) {
          passes = 0;
          contacts.active.begin(true, gaining);
          continue;
        }
        islands.limit_gains(bodies, contacts, joints, h, gaining);
      }
      if (contacts.may_bounce) {
        bounces.add_work(bodies, joints, thrusters, controls, islands, solved, h);
        add_carried_work(solved, h, real(1));
      }
      if (reports) report.add(contacts);
      if (!Bodies::any(ending)) break;
      if (contacts.may_bounce && contacts.begin_bounces(bodies, params, gravity, h, ending, hit)) {
        islands.complete(bodies, hit);
        bounces.pass_impacts_on(bodies, at_detection, contacts, islands, hit);
        bouncing = bounces.begin_rounds(bodies, contacts, islands, hit, rounds == 1);
        if (bouncing) at_detection.keep(bodies, contacts.active.now);
      }
      finish_contacts();
      if (!bouncing) break;
      joints.store(impulses);
      if (++round > rounds) break;
    }
    if (use_bias) bodies.release_spins(scene);
    if (!bouncing) return;
    islands.add_carried_work(bodies, contacts, joints, h, real(-1), islands.gain);
    bounces.limit(bodies, at_detection, contacts, islands, hit, gravity, h, islands.gain);
    for (int k = 0; k < contacts.count && reports; ++k)
      report.add(contacts.list[k], k, islands.gain[islands.of(bodies, contacts.list[k].a, contacts.list[k].b)]);
    joints.load_impulses(impulses);
    contacts.load_impulses(impulses, hit);
  }

  KFN void begin_search() {
    search.begin(bodies, islands.first);
    for (int k = 0; k < joints.count; ++k) search.add_joint(bodies, joints.list[k].a, joints.list[k].b);
  }

  // What moving surfaces and kinematic bodies have done to islands of `which` in this sub-step, times `share`; all of it is
  // left in `islands.gain`.
  KFN void add_carried_work(const unsigned int* which, real h, real share) {
    for (int i = 0; i < ISLAND_SHAPES; ++i) islands.gain[i] = real(0);
    islands.add_carried_work(bodies, contacts, joints, h, real(1), islands.gain);
    for (Bodies::Each each = Bodies::Each::of(which); each.next();)
      bounces.max_energy[each.shape] += share * islands.gain[each.shape];
  }

  // `of_gaining`: of the islands in it alone.
  KFN bool gains_energy(real h, bool of_gaining, unsigned int* gaining) {
    if (contacts.count + joints.count + joints.springs.count == 0) return false;
    return islands.find_gains(bodies, contacts, joints, h, of_gaining, gaining);
  }

  // Notes who touched, and keeps the impulses for the contacts found next.
  KFN void finish_contacts() {
    record_touches();
    if (reports) report.locate(bodies, contacts);
    contacts.store(keys, impulses);
  }

  // The main loop of the paper's appendix (algorithm 1), constraints solved one after another.
  KFN void paper_step() {
    real dt = params.get(PARAM_DT);
    int iterations = (int)(params.get(PARAM_SUBSTEPS));
    bodies.begin_step(first, bodies.moving);
    bodies.apply_gravity(scene.get2(SCENE_GRAVITY), dt);
    geometry.build(scene, ints, bodies, first, bodies.moving);
    first = false;
    contacts.find(bodies, geometry, scene, ints, params, keys, impulses, real(0), dt, false, true, true, bodies.moving);
    overflow += contacts.overflow;
    joints.prepare(bodies, bodies.moving, scene, controls, params, dt);
    PaperJoints paper = {joints};
    paper.apply_motors(bodies, scene, controls, params);
    thrusters.apply(bodies, dt);
    contacts.warm_start(bodies);
    if (reports) report.begin(contacts);
    if (reports) report.warm_start(contacts);
    paper.warm_start(bodies);
    real correction_rate = params.get(PARAM_COLLISION_CORRECTION) / dt, slop = params.get(PARAM_SLOP);
    for (int iteration = 0; iteration < iterations; ++iteration) {
      paper.solve(bodies, params);
      contacts.solve_hard(bodies, correction_rate, slop);
    }
    bodies.move(bodies.moving, dt, params.get(PARAM_MAX_SPEED), params.get(PARAM_MAX_ANGULAR_SPEED));
    if (reports) report.add(contacts);
    finish_contacts();
    bodies.end_step(bodies.moving);
  }

  // Shapes touch when their contact carried an impulse in the step or they overlap.
  KFN void record_touches() {
    for (int k = 0; k < contacts.count; ++k) {
      const Contact& c = contacts.list[k];
      if (c.max_impulse <= real(0) && c.separation > real(0)) continue;
      int slot_a = Slot::of(c.a), slot_b = Slot::of(c.b);
      int row_a = c.a * TOUCH_WORDS + slot_b / 32, row_b = c.b * TOUCH_WORDS + slot_a / 32;
      unsigned int bit_a = 1u << (slot_a % 32), bit_b = 1u << (slot_b % 32);
      touching_ever[row_a] |= bit_b;
      touching_ever[row_b] |= bit_a;
      if (!is_last_step) continue;
      touching_now[row_a] |= bit_b;
      touching_now[row_b] |= bit_a;
    }
  }
};

#if defined(__CUDA_ARCH__)
#undef for
#undef while
#endif
