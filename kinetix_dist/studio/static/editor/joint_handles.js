// Handles of joints: limits and rest angle of a revolute joint, the pose that a weld holds, axis and limits of a slider.
import { bodyOf, jointEnds, jointsOf, shapesOf } from "./document.js";
import { add, rotate, rounded, sub, wrapped } from "./geometry.js";
import { GRID_M, snappedAngle } from "./snap.js";

/**
 * @typedef {import("./geometry.js").Point} Point
 * @typedef {import("./document.js").Level} Level
 * @typedef {import("./document.js").Wall} Wall
 * @typedef {import("./handles.js").Handle} Handle
 */

export const ARC_M = 0.32; // radius of the arc that shows limits
const REST_M = 0.22; // from a joint to the handle of its rest angle
const AXIS_M = 0.55; // from the anchor of a to the handle of a slider's axis, if that is beyond its limits

/** Angle of b against a less that at rest: what limits bound. @param {Level} document @param {any} joint @param {readonly Wall[]} walls */
export function jointFacts(document, joint, walls) {
  const ends = jointEnds(document, joint, walls);
  const shape = (/** @type {string} */ id) => shapesOf(document).find((entry) => entry.id === id);
  if (!ends) return null;
  const [a, b] = [shape(joint.a), shape(joint.b)];
  const now = (b?.angle ?? 0) - (a?.angle ?? 0);
  const arm = b ? sub(b.position, ends[1]) : /** @type {Point} */ ([0, 0]);
  const towards = Math.hypot(...arm) > 1e-3 ? Math.atan2(arm[1], arm[0]) : (b?.angle ?? 0);
  return { at: ends[0], now, coordinate: now - (joint.rest_angle ?? now), towards };
}

/** Start of a slider and direction in which b slides, in the world. @param {Level} document @param {any} joint @param {readonly Wall[]} walls */
export function sliderFacts(document, joint, walls) {
  const ends = jointEnds(document, joint, walls);
  const turned = bodyOf(document, joint.a, walls)?.angle ?? 0;
  if (!ends) return null;
  const angle = turned + (joint.axis ?? 0);
  return { at: ends[0], turned, angle, place: (/** @type {number} */ along) => add(ends[0], rotate([along, 0], angle)) };
}

/** @param {Level} document @param {any} joint @param {number} index @param {readonly Wall[]} walls @returns {Handle[]} */
export function jointHandles(document, joint, index, walls) {
  const ends = /** @type {const} */ (["lower", "upper"]);
  if (joint.type === "prismatic") {
    const slider = sliderFacts(document, joint, walls);
    if (!slider) return [];
    const axis = { kind: /** @type {const} */ ("axis"), index, at: slider.place(axisReach(joint)) };
    return [axis, ...ends.flatMap((kind, k) => (joint.limits ? [{ kind, index, at: slider.place(joint.limits[k]) }] : []))];
  }
  const facts = jointFacts(document, joint, walls);
  if (!facts) return [];
  const at = (/** @type {number} */ reach, /** @type {number} */ angle) => add(facts.at, rotate([reach, 0], angle));
  const rest = { kind: /** @type {const} */ ("rest"), index, at: at(REST_M, facts.towards - facts.coordinate) };
  if (joint.type !== "revolute" || !joint.limits) return [rest];
  return [rest, ...ends.map((kind, k) => ({ kind, index, at: at(ARC_M, facts.towards + joint.limits[k] - facts.coordinate) }))];
}

/** Distance along its axis of the handle that turns it, m. @param {any} joint */
export const axisReach = (joint) => Math.max(AXIS_M, (joint.limits?.[1] ?? 0) + 0.2);

/** The document after a handle of a joint was dragged to a point.
 * @param {Level} document @param {Handle} handle @param {Point} point @param {boolean} snaps @param {readonly Wall[]} walls @returns {Level | null} */
export function draggedJoint(document, handle, point, snaps, walls) {
  const joint = jointsOf(document)[handle.index];
  const change = joint.type === "prismatic" ? sliderChange(document, joint, handle, point, snaps, walls) : jointChange(document, joint, handle, point, snaps, walls);
  return change && { ...document, joints: jointsOf(document).with(handle.index, { ...joint, ...change }) };
}

/** @param {Level} document @param {any} joint @param {Handle} handle @param {Point} point @param {boolean} snaps @param {readonly Wall[]} walls */
function jointChange(document, joint, handle, point, snaps, walls) {
  const facts = jointFacts(document, joint, walls);
  if (!facts) return null;
  const direction = Math.atan2(point[1] - facts.at[1], point[0] - facts.at[0]) - facts.towards;
  if (handle.kind === "rest") {
    const rest = facts.now + wrapped(direction);
    return { rest_angle: snaps ? snappedAngle(rest) : rounded(rest) };
  }
  const k = handle.kind === "upper" ? 1 : 0;
  const before = joint.limits[k] - facts.coordinate;
  const free = before + wrapped(direction - before) + facts.coordinate; // the nearest: limits may lie beyond a whole turn
  return { limits: limited(joint.limits, k, snaps ? snappedAngle(free) : rounded(free)) };
}

/** @param {Level} document @param {any} joint @param {Handle} handle @param {Point} point @param {boolean} snaps @param {readonly Wall[]} walls */
function sliderChange(document, joint, handle, point, snaps, walls) {
  const facts = sliderFacts(document, joint, walls);
  if (!facts) return null;
  if (handle.kind === "axis") {
    const world = Math.atan2(point[1] - facts.at[1], point[0] - facts.at[0]);
    return { axis: rounded(wrapped((snaps ? snappedAngle(world) : world) - facts.turned)) };
  }
  const along = rotate(sub(point, facts.at), -facts.angle)[0];
  const value = rounded(snaps ? Math.round(along / GRID_M) * GRID_M : along);
  return { limits: limited(joint.limits, handle.kind === "upper" ? 1 : 0, value) };
}

/** The lower limit stays the lower one. @param {[number, number]} limits @param {number} k @param {number} value */
const limited = (limits, k, value) => (k ? [limits[0], Math.max(value, limits[0])] : [Math.min(value, limits[1]), limits[1]]);
