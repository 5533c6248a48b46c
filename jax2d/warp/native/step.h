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
  Geometry geometry;
  Contacts contacts;
  Joints joints;
  Thrusters thrusters;
  Bounces bounces;
  Islands islands;
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
    thrusters.load(scene, ints, controls, params);
    if (SWEEP) contacts.pairs.sweep.load(bodies);
    overflow = 0;
    first = true;
    for (int i = 0; i < NUM_SHAPES * TOUCH_WORDS; ++i) touching_now[i] = touching_ever[i] = 0u;
    for (int step = 0; step < num_steps; ++step) {
      is_last_step = step == num_steps - 1;
      reports = REPORT_CONTACTS > 0 && is_last_step;
      if (reports) report.begin_step(out);
      joints.load(bodies, scene, ints, params, impulses);
      Bodies::clear(bodies.slowed);
      if (SOFT_STEP)
        soft_step();
      else
        paper_step();
      joints.reset_slowed(bodies);
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
  }

  // Soft-step sub-stepping (Box2D v3): contacts found once, then solved in sub-steps of h.
  KFN void soft_step() {
    soft = Soft::load(params);
    real h = params.get(PARAM_H), reach = params.get(PARAM_SPECULATIVE_DISTANCE);
    int substeps = (int)(params.get(PARAM_SUBSTEPS));
    Vec2 gravity = scene.get2(SCENE_GRAVITY);

    bool every_substep = false;  // contacts are found in each, where those found once would not hold
    bool find = true, interrupted = false;
    int interruptions = 0, max_passes = (int)(params.get(PARAM_IMPACT_PASSES));
    for (int substep = 0; substep < substeps;) {
      // Each function is called once: what is inlined twice is twice the code.
      real left = every_substep ? h : h * (real)(substeps - substep);
      if (find) {
        bodies.begin_step(first);
        geometry.build(scene, ints, bodies, first);
        geometry.predict_travel(bodies, left, h);
        first = false;
        contacts.find(bodies, geometry, scene, ints, params, keys, impulses, reach, left, true, !interrupted);
        joints.prepare(bodies, scene, controls, params, h);
        islands.find(bodies, contacts, joints);
        if (substep == 0 && !interrupted) every_substep = contacts.each_substep;
        if (contacts.may_bounce) {
          bounces.begin(bodies, gravity, h);
          if (interrupted) bounces.max_energy -= carried_work(h);  // bodies have had these impulses already
        }
        if (reports) report.begin(contacts);
      }
      if (!interrupted) {
        bodies.apply_gravity(gravity, h);
        thrusters.apply(bodies, h);
        ExternalForces::apply(bodies, controls, h);
        bodies.apply_damping(scene, h);
        islands.begin(bodies, h);
        joints.warm_start(bodies);
        contacts.warm_start(bodies);
        if (reports) report.warm_start(contacts);
      }
      // Joints first, so that contacts have the last word: a heavy body must not push through a jointed light one.
      // Where a speed limit takes back what stops a body, the rest of it is solved again.
      // And where something hits, until all that it reaches has its share.
      bool was_limited = false;
      contacts.active.begin();
      for (int pass = 0;; ++pass) {
        for (int joint_pass = 0; joint_pass < JOINT_PASSES; ++joint_pass) joints.solve_soft(bodies, soft, true, true, contacts.active);
        contacts.solve_soft(bodies, soft, true, 0, false);
        int before = bodies.limited;
        bodies.limit_speeds(params.get(PARAM_MAX_SPEED), params.get(PARAM_MAX_ANGULAR_SPEED));
        bool is_limited = bodies.limited != before && contacts.count > 0 && pass < LIMITED_PASSES;
        if (was_limited) bodies.limited = before;
        was_limited |= is_limited;
        bool is_shared_out = !contacts.active.repeat() || pass >= max_passes;
        if (is_shared_out && !is_limited) break;
        if (is_limited) contacts.active.begin();
      }
      // Where a body would now go farther than was predicted, contacts are found again before anything moves.
      interrupted = interruptions < MAX_INTERRUPTIONS && contacts.outruns_contacts(bodies, geometry, ints, reach, left);
      if (interrupted) {
        ++interruptions;
      } else {
        bodies.move(h, params.get(PARAM_MAX_SPEED), params.get(PARAM_MAX_ANGULAR_SPEED));
        ++substep;
      }
      find = interrupted || every_substep || substep == substeps;
      relax(gravity, h, find);
      if (find) {
        bodies.limit_speeds(params.get(PARAM_MAX_SPEED), params.get(PARAM_MAX_ANGULAR_SPEED));
        bodies.end_step();
      }
    }
  }

  // Solves without bias. The last time in a step what hit bounces: rounds go on until joints and other contacts have
  // shared in it and every bounce has its speed. What the next step is warm-started with is from before, since a bounce
  // does not last.
  KFN void relax(Vec2 gravity, real h, bool is_last) {
    int rounds = (int)(params.get(PARAM_BOUNCE_ROUNDS));
    bool bouncing = false, friction_applied = false;
    int repeats = 0, energy_passes = 0;
    contacts.active.begin();
    real carried = real(0);
    for (int round = 0; round <= rounds; ++round) {
      int joint_passes = round == 0 ? 1 : JOINT_PASSES_OF_BOUNCE;
      bool with_friction = round > 0 && !friction_applied && (contacts.converged || round == rounds);
      for (int pass = 0; pass < joint_passes; ++pass) joints.solve_soft(bodies, soft, false, round == 0, contacts.active);
      contacts.solve_soft(bodies, soft, false, round, with_friction);
      if (round == 0) {  // joints and other contacts share in an impact
        if (contacts.active.repeat() && repeats++ < (int)(params.get(PARAM_IMPACT_PASSES))) {
          --round;
          continue;
        }
        contacts.active.begin();
        bool would_reset = energy_passes + 1 == ENERGY_PASSES_BEFORE_RESET;
        if (energy_passes < ENERGY_PASSES && gains_energy(h, would_reset ? RESET_GAIN : real(0), energy_passes > 0)) {
          ++energy_passes;
          contacts.active.is_restricted = true;
          if (would_reset) islands.reset_impulses(bodies, contacts, joints, contacts.active.only);
          --round;
          continue;
        }
      }
      if (round > 0) {
        if (friction_applied && contacts.converged) break;
        friction_applied |= with_friction;
        continue;
      }
      if (contacts.may_bounce) {
        bounces.max_energy += joints.motor_work(bodies) + thrusters.work(bodies, h);
        bounces.max_energy += ExternalForces::work(bodies, controls, h);
        carried = carried_work(h);
        bounces.max_energy += carried;
      }
      if (reports) report.add(contacts, real(1));
      if (!is_last) break;
      if (contacts.may_bounce) bouncing = contacts.begin_bounces(bodies, params, gravity, h);
      if (HAS_RESTITUTION && bouncing && contacts.passes_impacts_on()) {
        bounces.swap_velocities(bodies);
        bouncing = contacts.propagate_impacts(bodies);
        bounces.swap_velocities(bodies);
      }
      finish_contacts();
      if (!bouncing) break;
      contacts.converged = false;
      bounces.keep_velocities(bodies);
      joints.store(impulses);
    }
    if (!bouncing) return;
    real share = bounces.limit(bodies, gravity, h, carried_work(h) - carried);
    if (reports) report.add(contacts, share);
    joints.load_impulses(impulses);
  }

  // More than `spare` J/kg; `again`: of islands that did so before.
  KFN bool gains_energy(real h, real spare, bool again) {
    if (contacts.count == 0 && !(HAS_JOINT_LIMITS && joints.count > 0)) return false;
    return islands.find_gains(bodies, contacts, joints, h, spare, again, contacts.active.only);
  }

  // J, what moving surfaces and kinematic bodies have done in this sub-step.
  KFN real carried_work(real h) const {
    return contacts.surface_work(bodies, h) + joints.kinematic_work(bodies);
  }

  // Notes who touched, and keeps the impulses for the contacts found next.
  KFN void finish_contacts() {
    record_touches();
    if (reports) report.locate(bodies, contacts);
    contacts.store(keys, impulses);
    overflow += contacts.overflow;
  }

  // The main loop of the paper's appendix (algorithm 1), constraints solved one after another.
  KFN void paper_step() {
    real dt = params.get(PARAM_DT);
    int iterations = (int)(params.get(PARAM_SUBSTEPS));
    bodies.begin_step(first);
    bodies.apply_gravity(scene.get2(SCENE_GRAVITY), dt);
    geometry.build(scene, ints, bodies, first);
    first = false;
    contacts.find(bodies, geometry, scene, ints, params, keys, impulses, real(0), dt, false, true);
    joints.prepare(bodies, scene, controls, params, dt);
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
    bodies.move(dt, params.get(PARAM_MAX_SPEED), params.get(PARAM_MAX_ANGULAR_SPEED));
    if (reports) report.add(contacts, real(1));
    finish_contacts();
    bodies.end_step();
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
