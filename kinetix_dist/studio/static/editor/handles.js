// Targets of a pointer: elements of the level, and handles of the selection.
import { boundsOf, cornersOf, distanceTo, jointEnds, jointsOf, parsePath, reshaped, shapesOf, thrusterPlace, thrustersOf, toLocal, toWorld, wallCorners } from "./document.js";
import { middleOf, selectedShapes, turned } from "./edits.js";
import { add, distance, distanceToPolygon, hull, isInside, rotate, rounded, roundedPoint, signedArea, sub, wrapped } from "./geometry.js";
import { draggedJoint, jointHandles } from "./joint_handles.js";
import { snappedAngle } from "./snap.js";

/**
 * @typedef {import("./geometry.js").Point} Point
 * @typedef {import("./document.js").Level} Level
 * @typedef {import("./document.js").Wall} Wall
 * @typedef {{ kind: "corner" | "vertex" | "radius" | "turn" | "direction" | "lower" | "upper" | "rest" | "axis", at: Point, index: number, middle?: Point }} Handle
 */

const TURN_PX = 34; // how far the handle that turns is from what it turns
const ARROW_M = 0.45; // from a thruster to the handle of its direction
const SMALLEST_M = 0.02;

/** Paths of all elements at a point, the one on top first; walls come last.
 * @param {Level} document @param {Point} point @param {number} reach m, for joints and thrusters @param {readonly Wall[]} walls */
export function thingsAt(document, point, reach, walls) {
  /** @type {string[]} */
  const found = [];
  jointsOf(document).forEach((joint, k) => {
    if (jointEnds(document, joint, walls)?.some((end) => distance(end, point) <= reach)) found.push(`joints[${k}]`);
  });
  thrustersOf(document).forEach((thruster, k) => {
    const place = thrusterPlace(document, thruster);
    if (place && distance(add(place.at, rotate([0.06, 0], place.angle)), point) <= reach) found.push(`thrusters[${k}]`);
  });
  return [...found, ...bodiesNear(document, point, 0, walls).map(({ path }) => path)];
}

/** @typedef {{ path: string, gap: number }} Near gap: to the point, m; 0 where the point lies within */

/** Shapes and walls that are no farther from a point than `reach`, m: the nearest first, of equally near ones the upper one.
 * @param {Level} document @param {Point} point @param {number} reach @param {readonly Wall[]} walls @returns {Near[]} */
export function bodiesNear(document, point, reach, walls) {
  const near = upperFirst(document).map((index) => ({ path: `shapes[${index}]`, gap: distanceTo(document.shapes[index], point) }));
  near.push(...walls.map((wall) => ({ path: `walls.${wall.name}`, gap: distanceToPolygon(point, wallCorners(wall)) })));
  return near.filter(({ gap }) => gap <= reach).sort((a, b) => a.gap - b.gap);
}

/** Indices of shapes. Those that are drawn later lie on top: what moves over what is fixed, circles over polygons. @param {Level} document */
function upperFirst(document) {
  const drawable = shapesOf(document);
  const drawn = document.shapes.map((shape, index) => ({ shape, index })).filter(({ shape }) => drawable.includes(shape));
  const order = (/** @type {{ shape: any, index: number }} */ { shape, index }) => [Number(!shape.fixed), Number(shape.type === "circle"), index];
  drawn.sort((a, b) => order(a).reduce((result, value, k) => result || order(b)[k] - value, 0));
  return drawn.map(({ index }) => index);
}

/** The two bodies nearest to a point, the upper one first. @param {Level} document @param {Near[]} near of `bodiesNear` @returns {string[]} */
export function nearestPair(document, near) {
  const upper = upperFirst(document).map((index) => `shapes[${index}]`);
  const depth = (/** @type {string} */ path) => (upper.includes(path) ? upper.indexOf(path) : Infinity); // walls lie below
  return near.slice(0, 2).map(({ path }) => path).sort((a, b) => (depth(a) === depth(b) ? 0 : depth(a) - depth(b)));
}

/** Handles of the selection, if that is one element or some shapes. @param {Level} document @param {readonly string[]} selection
 * @param {readonly Wall[]} walls @param {number} px m of a pixel @returns {Handle[]} */
export function handlesOf(document, selection, walls, px) {
  const indices = selectedShapes(document, selection).filter((index) => shapesOf(document).includes(document.shapes[index]));
  if (indices.length === 1 && selection.length === 1) return shapeHandles(document.shapes[indices[0]], indices[0], px);
  if (indices.length > 1) {
    const shapes = indices.map((index) => document.shapes[index]);
    const middle = middleOf(shapes);
    const top = Math.max(...shapes.map((shape) => boundsOf(shape)[3]));
    return [{ kind: "turn", index: -1, at: [middle[0], top + TURN_PX * px], middle }];
  }
  const only = selection.length === 1 ? parsePath(selection[0]) : null;
  if (only?.part === "thrusters" && thrustersOf(document)[only.index]) {
    const place = thrusterPlace(document, thrustersOf(document)[only.index]);
    return place ? [{ kind: "direction", index: only.index, at: add(place.at, rotate([ARROW_M, 0], place.angle)) }] : [];
  }
  const joint = only?.part === "joints" ? jointsOf(document)[only.index] : null;
  if (only?.part === "joints" && joint) return jointHandles(document, joint, only.index, walls);
  return [];
}

/** @param {import("./document.js").Shape} shape @param {number} index @param {number} px @returns {Handle[]} */
function shapeHandles(shape, index, px) {
  const corners = cornersOf(shape);
  const top = shape.type === "circle" ? shape.radius : Math.max(...corners.map((corner) => corner[1]));
  /** @type {Handle} */
  const turn = { kind: "turn", index, at: toWorld(shape, [0, top + TURN_PX * px]), middle: shape.position };
  if (shape.type === "circle") return [turn, { kind: "radius", index, at: toWorld(shape, [shape.radius, 0]) }];
  const kind = shape.type === "box" ? "corner" : "vertex";
  return [turn, ...corners.map((corner) => /** @type {Handle} */ ({ kind, index, at: toWorld(shape, corner) }))];
}

/**
 * The document after a handle was dragged to a point; null where that cannot be (a polygon that is not convex).
 * @param {Level} document as it was when the gesture began @param {readonly string[]} selection @param {Handle} handle
 * @param {number} number of the handle among those of its kind @param {Point} point @param {boolean} snaps @param {readonly Wall[]} walls
 * @returns {Level | null}
 */
export function dragged(document, selection, handle, number, point, snaps, walls) {
  const shape = document.shapes[handle.index];
  if (handle.kind === "turn" && handle.middle) {
    const now = Math.atan2(point[1] - handle.middle[1], point[0] - handle.middle[0]);
    const before = Math.atan2(handle.at[1] - handle.middle[1], handle.at[0] - handle.middle[0]);
    const own = handle.index >= 0 ? (shape.angle ?? 0) : 0;
    const turn = snaps ? snappedAngle(own + now - before) - own : now - before;
    return turned(document, selection, turn, walls);
  }
  if (handle.kind === "direction") {
    const thruster = thrustersOf(document)[handle.index];
    const place = thrusterPlace(document, thruster);
    if (!place) return null;
    const world = Math.atan2(point[1] - place.at[1], point[0] - place.at[0]);
    const angle = rounded(wrapped((snaps ? snappedAngle(world) : world) - (place.shape.angle ?? 0)));
    return { ...document, thrusters: thrustersOf(document).with(handle.index, { ...thruster, angle }) };
  }
  if (["lower", "upper", "rest", "axis"].includes(handle.kind)) return draggedJoint(document, handle, point, snaps, walls);
  if (handle.kind === "radius") {
    const radius = rounded(Math.max(SMALLEST_M, distance(point, shape.position)));
    return reshaped(document, handle.index, { ...shape, radius }, walls);
  }
  if (handle.kind === "corner") {
    const [x, y] = cornersOf(shape)[number];
    const opposite = toWorld(shape, [-x, -y]);
    const across = rotate(sub(point, opposite), -(shape.angle ?? 0));
    const size = across.map((value) => rounded(Math.max(SMALLEST_M, Math.abs(value))));
    const half = /** @type {Point} */ (across.map((value, k) => ((Math.sign(value) || 1) * size[k]) / 2));
    const position = roundedPoint(add(opposite, rotate(half, shape.angle ?? 0)));
    return reshaped(document, handle.index, { ...shape, width: size[0], height: size[1], position }, walls);
  }
  const vertices = cornersOf(shape).with(number, roundedPoint(toLocal(shape, point)));
  return isConvex(vertices) ? reshaped(document, handle.index, { ...shape, vertices }, walls) : null;
}

/** True where all corners are those of their hull, in its order. @param {Point[]} corners */
export function isConvex(corners) {
  return signedArea(corners) > 1e-4 && hull(corners).length === corners.length && corners.every((corner) => isInside(corner, corners));
}
