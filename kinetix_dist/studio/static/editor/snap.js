// Snapping of a pointer: to a corner, a centre, an anchor, in line with one, or on the grid.
import { jointEnds, jointsOf, shapesOf, worldCorners } from "./document.js";
import { distance, rounded } from "./geometry.js";

/** @typedef {import("./geometry.js").Point} Point */

export const GRID_M = 0.1;
export const TURN_RAD = Math.PI / 12; // 15 degrees
const REACH_PX = 9;

/** Points that others are drawn to: centres, corners, middles of edges, anchors; of all shapes but some.
 * @param {import("./document.js").Level} document @param {readonly import("./document.js").Wall[]} walls @param {ReadonlySet<string>} [but] @returns {Point[]} */
export function snapTargets(document, walls, but = new Set()) {
  /** @type {Point[]} */
  const found = [];
  for (const shape of shapesOf(document)) {
    if (but.has(shape.id)) continue;
    const corners = worldCorners(shape);
    found.push(shape.position, ...corners);
    corners.forEach((here, k) => {
      const next = corners[(k + 1) % corners.length];
      found.push([(here[0] + next[0]) / 2, (here[1] + next[1]) / 2]);
    });
  }
  for (const joint of jointsOf(document)) {
    const ends = but.has(joint.a) || but.has(joint.b) ? null : jointEnds(document, joint, walls);
    if (ends) found.push(ends[0]);
  }
  return found;
}

/**
 * A point near a target becomes the target; near a line through one, x or y of it; else the point of the grid.
 * @param {Point} point @param {Point[]} targets @param {number} px m of a pixel
 * @returns {{ point: Point, guides: { axis: 0 | 1, at: number }[] }} guides: lines that it was drawn to
 */
export function snapped(point, targets, px) {
  const reach = REACH_PX * px;
  const near = nearest(targets, (target) => distance(point, target));
  if (near && distance(point, near) <= reach) return { point: near, guides: [] };
  /** @type {{ axis: 0 | 1, at: number }[]} */
  const guides = [];
  const placed = /** @type {const} */ ([0, 1]).map((axis) => {
    const target = nearest(targets, (entry) => Math.abs(entry[axis] - point[axis]));
    const onGrid = rounded(Math.round(point[axis] / GRID_M) * GRID_M);
    if (target && Math.abs(target[axis] - point[axis]) <= reach && Math.abs(target[axis] - onGrid) > 1e-9) {
      guides.push({ axis, at: target[axis] });
      return target[axis];
    }
    return onGrid;
  });
  return { point: /** @type {Point} */ (placed), guides };
}

/** @param {Point[]} targets @param {(target: Point) => number} far */
function nearest(targets, far) {
  return targets.reduce((/** @type {Point | null} */ best, target) => (best === null || far(target) < far(best) ? target : best), null);
}

/** @param {number} angle */
export const snappedAngle = (angle) => rounded(Math.round(angle / TURN_RAD) * TURN_RAD);
