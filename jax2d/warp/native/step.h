// One world, PARAM-many physics steps: read, step, write. Read this file first.

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
  unsigned int touching_now[NUM_SHAPES * TOUCH_WORDS];  // a row a shape, a bit a slot
  unsigned int touching_ever[NUM_SHAPES * TOUCH_WORDS];
  bool first;       // nothing has been prepared in this call yet
  bool noting_now;  // in the last step of the call
  int overflow;

  KFN void run(int num_steps, const IntColumn& out) {
    bodies.load(scene, ints, state);
    thrusters.load(scene, ints, controls, params);
    if (SWEEP) contacts.pairs.sweep.load(bodies);
    overflow = 0;
    first = true;
    for (int i = 0; i < NUM_SHAPES * TOUCH_WORDS; ++i) touching_now[i] = touching_ever[i] = 0u;
    for (int step = 0; step < num_steps; ++step) {
      noting_now = step == num_steps - 1;
      joints.load(bodies, scene, ints, params, impulses);
      if (SOFT_STEP)
        soft_step();
      else
        paper_step();
      joints.store(impulses);
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
    real dt = params.get(PARAM_DT), h = params.get(PARAM_H);
    int substeps = (int)(params.get(PARAM_SUBSTEPS));
    real inverse_h = real(1) / h;
    Vec2 gravity = scene.get2(SCENE_GRAVITY);
    Softness contact_soft = {params.get(PARAM_CONTACT_BIAS_RATE), params.get(PARAM_CONTACT_MASS_SCALE),
                             params.get(PARAM_CONTACT_IMPULSE_SCALE)};
    Softness fixed_soft = {params.get(PARAM_FIXED_BIAS_RATE), params.get(PARAM_FIXED_MASS_SCALE),
                           params.get(PARAM_FIXED_IMPULSE_SCALE)};
    Softness joint_soft = {params.get(PARAM_JOINT_BIAS_RATE), params.get(PARAM_JOINT_MASS_SCALE),
                           params.get(PARAM_JOINT_IMPULSE_SCALE)};
    real push_out_speed = params.get(PARAM_PUSH_OUT_SPEED);

    real reach = params.get(PARAM_SPECULATIVE_DISTANCE);

    bool anew = false;  // contacts are found for every sub-step, where a body turns too far for those found once
    for (int substep = 0; substep < substeps; ++substep) {
      // One call of each function: what is inlined twice is twice the code.
      if (anew || substep == 0) {
        bodies.begin_step(first);
        geometry.build(scene, ints, bodies, first);
        first = false;
        contacts.find(bodies, geometry, scene, ints, params, keys, impulses, reach, substep == 0 ? dt : h, true);
        joints.prepare(bodies, scene, controls, params, h);
        if (substep == 0) anew = contacts.swinging;
      }
      bodies.apply_gravity(gravity, h);
      thrusters.apply(bodies, h);
      joints.warm_start(bodies);
      contacts.warm_start(bodies);
      // Joints first, so that contacts have the last word: a heavy body must not push through a jointed light one.
      joints.solve_soft(bodies, joint_soft, inverse_h, true);
      contacts.solve_soft(bodies, contact_soft, fixed_soft, inverse_h, push_out_speed, true);
      bodies.move(h, params.get(PARAM_MAX_SPEED), params.get(PARAM_MAX_OMEGA));
      joints.solve_soft(bodies, joint_soft, inverse_h, false);
      contacts.solve_soft(bodies, contact_soft, fixed_soft, inverse_h, push_out_speed, false);
      if (anew || substep + 1 == substeps) {
        finish_contacts(gravity, h);
        bodies.limit_speeds(params.get(PARAM_MAX_SPEED), params.get(PARAM_MAX_OMEGA));
        bodies.end_step();
      }
    }
  }

  // Bounces what hit, notes who touched, and keeps the impulses for the contacts found next.
  KFN void finish_contacts(Vec2 gravity, real h) {
    if (SOFT_STEP) contacts.apply_restitution(bodies, params.get(PARAM_RESTITUTION_THRESHOLD), gravity, h);
    note_touching();
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
    contacts.find(bodies, geometry, scene, ints, params, keys, impulses, real(0), dt, false);
    joints.prepare(bodies, scene, controls, params, dt);
    PaperJoints paper = {joints};
    paper.apply_motors(bodies, scene, controls, params);
    thrusters.apply(bodies, dt);
    contacts.warm_start(bodies);
    paper.warm_start(bodies);
    real correction_rate = params.get(PARAM_COLLISION_CORRECTION) / dt, slop = params.get(PARAM_SLOP);
    for (int iteration = 0; iteration < iterations; ++iteration) {
      paper.solve(bodies, params);
      contacts.solve_hard(bodies, correction_rate, slop);
    }
    bodies.move(dt, params.get(PARAM_MAX_SPEED), params.get(PARAM_MAX_OMEGA));
    finish_contacts(scene.get2(SCENE_GRAVITY), dt);
    bodies.end_step();
  }

  // Shapes touch when their contact carried an impulse in the step or they overlap.
  KFN void note_touching() {
    for (int k = 0; k < contacts.count; ++k) {
      const Contact& c = contacts.list[k];
      if (c.most_impulse <= real(0) && c.separation > real(0)) continue;
      int slot_a = Slot::of(c.a), slot_b = Slot::of(c.b);
      int row_a = c.a * TOUCH_WORDS + slot_b / 32, row_b = c.b * TOUCH_WORDS + slot_a / 32;
      unsigned int bit_a = 1u << (slot_a % 32), bit_b = 1u << (slot_b % 32);
      touching_ever[row_a] |= bit_b;
      touching_ever[row_b] |= bit_a;
      if (!noting_now) continue;
      touching_now[row_a] |= bit_b;
      touching_now[row_b] |= bit_a;
    }
  }
};

#if defined(__CUDA_ARCH__)
#undef for
#undef while
#endif
