// Display list of a level document: the same list of primitives, number by number, as jax2d/display_list.py makes of the
// level that kinetix_dist/level/schema.py reads from it. The editor draws this, so that nothing waits for the server.
import { bodyOf, cornersOf, isDrawable, jointsOf, thrustersOf, toLocal } from "../editor/document.js";
import { add, centroid, rotate, sub, wrapped } from "../editor/geometry.js";

/**
 * @typedef {import("../editor/geometry.js").Point} Point
 * @typedef {import("../editor/document.js").Level} Level
 * @typedef {import("./canvas.js").Primitive} Primitive
 * @typedef {{ palette: any, sizes: Record<string, { polygons: number, circles: number }>,
 *   walls: import("../editor/document.js").Wall[], [field: string]: any }} Engine the response of GET api/engine
 * @typedef {{ display: import("./canvas.js").Display, poses: number[], slots: Map<string, number> }} Picture
 */

const ROLES = ["none", "green", "blue", "red"];
const CENTRED_WITHIN_M = 2e-6; // see level/derive.py
const SEAM_TOLERANCE_RAD = 1e-4; // see level/canonical.py

/** @param {Level} document @param {Engine} engine @returns {Picture} */
export function levelPicture(document, engine) {
  const bodies = bodiesOf(document, engine);
  const slots = new Map(bodies.list.map((body) => [body.id, body.slot]));
  const byId = new Map(bodies.list.map((body) => [body.id, body]));
  const poses = new Array(3 * bodies.count).fill(0);
  for (const { slot, position, angle } of bodies.list) poses.splice(3 * slot, 3, ...position, angle);
  const primitives = [
    ...shapePrimitives(bodies.list, engine.palette),
    ...thrustersOf(document).flatMap((thruster, k) => thrusterPrimitives(thruster, k, byId, engine.palette)),
    ...jointsOf(document).flatMap((joint, k) => jointPrimitives(document, joint, k, byId, engine)),
  ];
  return { display: { num_shapes: bodies.count, primitives }, poses, slots };
}

/**
 * @typedef {{ id: string, slot: number, corners: Point[], radius: number, position: Point, angle: number, shift: Point,
 *   role: number, fixed: boolean, frame: { position: Point, angle?: number } }} Body about its centre of mass; `frame` is
 *   that of the document, `shift` the centre of mass in it
 * @param {Level} document @param {Engine} engine
 */
function bodiesOf(document, engine) {
  const capacity = engine.sizes[document.size] ?? Object.values(engine.sizes)[0];
  const shapes = (Array.isArray(document.shapes) ? document.shapes : []).filter(isDrawable);
  const circles = shapes.filter((shape) => shape.type === "circle").length;
  const numPolygons = engine.walls.length + Math.max(capacity.polygons, shapes.length - circles);
  let polygon = engine.walls.length;
  let circle = numPolygons;
  /** @type {Body[]} */
  const list = engine.walls.map((wall, slot) => {
    const [x, y] = wall.half_extents;
    const role = ROLES.indexOf(document.walls?.[wall.name]?.role ?? "none");
    return { id: wall.name, slot, corners: [[x, y], [-x, y], [-x, -y], [x, -y]], radius: 0, position: wall.position, angle: 0, shift: [0, 0], role, fixed: true, frame: wall };
  });
  for (const shape of shapes) {
    const isCircle = shape.type === "circle";
    const corners = isCircle ? [] : fromFirst(cornersOf(shape));
    const centre = isCircle ? /** @type {Point} */ ([0, 0]) : centroid(corners);
    const isCentred = Math.abs(centre[0]) < CENTRED_WITHIN_M && Math.abs(centre[1]) < CENTRED_WITHIN_M;
    /** @type {Point} */
    const shift = isCentred ? [0, 0] : centre;
    list.push({
      id: shape.id,
      slot: isCircle ? circle++ : polygon++,
      corners: corners.map((corner) => sub(corner, shift)),
      radius: isCircle ? shape.radius : 0,
      position: add(shape.position, rotate(shift, shape.angle ?? 0)),
      angle: shape.angle ?? 0,
      shift,
      role: Math.max(0, ROLES.indexOf(shape.role ?? "none")),
      fixed: shape.fixed ?? false,
      frame: shape,
    });
  }
  return { list, count: numPolygons + Math.max(capacity.circles, circles) };
}

/** Corners from the one with the smallest polar angle about the centroid on. @param {Point[]} corners @returns {Point[]} */
function fromFirst(corners) {
  const centre = centroid(corners);
  const angles = corners.map((corner) => {
    const angle = Math.atan2(corner[1] - centre[1], corner[0] - centre[0]);
    return angle < -SEAM_TOLERANCE_RAD ? angle + 2 * Math.PI : angle;
  });
  const first = angles.indexOf(Math.min(...angles));
  return corners.map((_, k) => corners[(first + k) % corners.length]);
}

/** Fixed shapes first. @param {Body[]} bodies @param {any} palette @returns {Primitive[]} */
function shapePrimitives(bodies, palette) {
  const sorted = [...bodies].sort((a, b) => Number(!a.fixed) - Number(!b.fixed) || a.slot - b.slot);
  return sorted.flatMap(/** @returns {Primitive[]} */ (body) => {
    const shade = body.fixed ? palette.fixed_shade : 1;
    const fill = palette.role_palette[body.role].map((/** @type {number} */ value) => Math.trunc(value * shade));
    const outline = fill.map((/** @type {number} */ value) => value * palette.outline_shade);
    const facts = { part: /** @type {[string, number]} */ (["shape", body.slot]), body: body.slot };
    if (body.corners.length) return [{ kind: "polygon", ...facts, points: body.corners, fill, outline }];
    return [
      { kind: "disc", ...facts, points: [[0, 0]], fill, outline, radius: body.radius },
      { kind: "line", ...facts, points: [[0, 0], [body.radius * palette.spoke_share, 0]], fill: outline, width: palette.line_width },
    ];
  });
}

/** @param {import("../editor/document.js").Thruster} thruster @param {number} k @param {Map<string, Body>} bodies @param {any} palette @returns {Primitive[]} */
function thrusterPrimitives(thruster, k, bodies, palette) {
  const body = bodies.get(thruster.shape);
  if (!body) return [];
  const own = thruster.anchor ? toLocal(body.frame, thruster.anchor) : (thruster.position ?? [0, 0]);
  const at = sub(own, body.shift);
  const length = palette.thruster_length_m;
  const half = palette.nozzle_share * length;
  const placed = (/** @type {Point[]} */ points) => points.map((point) => add(at, rotate(point, thruster.angle)));
  const facts = { kind: /** @type {const} */ ("polygon"), part: /** @type {[string, number]} */ (["thruster", k]), body: body.slot };
  const flame = { ...facts, points: placed([[0, half], [-palette.flame_share * length, 0], [0, -half]]), thruster: k, scale_from: at };
  return [
    { ...flame, fill: palette.thruster_palette[0], size: 1 },
    { ...flame, fill: palette.flame_core, size: palette.core_share },
    { ...facts, points: placed([[0, -half], [length, 0], [0, half]]), fill: palette.thruster_palette[thruster.colour ?? 0] ?? palette.ink },
  ];
}

/** @param {Level} document @param {import("../editor/document.js").Joint} joint @param {number} k @param {Map<string, Body>} bodies
 * @param {Engine} engine @returns {Primitive[]} */
function jointPrimitives(document, joint, k, bodies, { palette, walls }) {
  const ends = ["a", "b"].map((end) => {
    const body = bodies.get(joint[end]);
    const frame = bodyOf(document, joint[end], walls);
    if (!body || !frame) return null;
    const own = joint.anchor ? toLocal(frame, joint.anchor) : (joint[`anchor_${end}`] ?? [0, 0]);
    return { body, anchor: sub(own, body.shift) };
  });
  const [first, second] = ends;
  if (!first || !second) return [];
  const isReversed = first.body.slot > second.body.slot;
  const [a, b] = isReversed ? [second, first] : [first, second];
  const hasMotor = joint.motor ? (joint.motor.on ?? true) : false;
  const motor = palette.motor_palette[joint.motor?.colour ?? 0] ?? palette.ink;
  const facts = { part: /** @type {[string, number]} */ (["joint", k]), body: a.body.slot };
  const radius = palette.joint_radius_m;
  if (joint.type === "prismatic") {
    const rest = joint.rest_angle ?? second.body.angle - first.body.angle;
    const axis = wrapped((joint.axis ?? 0) + (isReversed ? Math.PI - rest : 0));
    return [
      rail(joint, a, b, axis, facts, palette),
      { kind: "disc", ...facts, points: [a.anchor], radius: radius * palette.slider_share, fill: hasMotor ? motor : palette.ink },
    ];
  }
  if (joint.type === "fixed") {
    return palette.weld_angles.map((/** @type {number} */ turn) => {
      const arm = rotate([radius, 0], turn);
      return { kind: "line", ...facts, points: [[-arm[0], -arm[1]], arm], upright: a.anchor, fill: palette.ink, width: palette.weld_width };
    });
  }
  /** @type {Primitive} */
  const disc = { kind: "disc", ...facts, points: [a.anchor], radius, fill: palette.hinge, outline: palette.ink };
  return hasMotor ? [disc, { kind: "disc", ...facts, points: [a.anchor], radius: radius * palette.motor_share, fill: motor }] : [disc];
}

/** @param {any} joint @param {{ anchor: Point }} a @param {{ body: Body, anchor: Point }} b @param {number} axis @param {any} facts @param {any} palette @returns {Primitive} */
function rail(joint, a, b, axis, facts, palette) {
  const line = { ...facts, fill: palette.ink, width: palette.line_width };
  if (joint.limits) return { kind: "line", ...line, points: joint.limits.map((/** @type {number} */ at) => add(a.anchor, rotate([at, 0], axis))) };
  return { kind: "rail", ...line, points: [a.anchor], other: b.body.slot, other_point: b.anchor, angle: axis, reach: palette.rail_m };
}
